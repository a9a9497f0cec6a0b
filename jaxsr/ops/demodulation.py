"""Demodulation: colour = divisor x lighting, so that filters see smooth lighting instead of textures.

The divisor is the base colour (ExtraSS, notes section on G-buffer-guided reprojection), or with `specular`
that of ExtraNet for glossy scenes, `base + 0.08 specular (1 - metallic)`. All is scene-linear.

Guard: where no channel of the divisor is positive (sky, emitters, missing or NaN base colour) the divisor is
1, hence lighting is colour; elsewhere each channel is at least `eps`. The guard bounds lighting by
`color / eps` and the gradient with respect to the base colour by `color / eps^2`; without it a dark texel
makes one bright speck of lighting that a filter would spread. Among surfaces the divisor is continuous:
lighting that crosses from a dark to a darker one keeps its scale. `modulate` inverts `demodulate`.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError


def demodulation_divisor(
    base_color: Float[Array, "*n 3"],
    *,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """What `demodulate` divides by and `modulate` multiplies with.

    Args:
        base_color: in [0, 1], 0 for sky.
        specular: in [0, 1] (0.5 for common materials); None for plain base colour.
        metallic: in [0, 1], 0 if None; it counts only together with `specular`.
        eps: smallest divisor of a surface.

    Raises:
        JaxsrError: `eps` is not positive.
    """
    if isinstance(eps, float | int) and eps <= 0:
        raise JaxsrError("bad guard", where="demodulation eps", expected="a positive number", found=eps)
    divisor = base_color
    if specular is not None:
        dielectric = 1.0 if metallic is None else 1.0 - metallic
        divisor = divisor + 0.08 * specular * dielectric
    guarded = jnp.where(divisor >= eps, divisor, eps)  # eps for NaN
    return jnp.where(jnp.any(divisor > 0, axis=-1, keepdims=True), guarded, 1.0)


@functools.partial(jax.jit, static_argnames=("eps",))
def demodulate(
    color_linear: Float[Array, "*n 3"],
    base_color: Float[Array, "*n 3"],
    *,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """Lighting: colour over the divisor. Arguments as for `demodulation_divisor`."""
    return color_linear / demodulation_divisor(base_color, specular=specular, metallic=metallic, eps=eps)


@functools.partial(jax.jit, static_argnames=("eps",))
def modulate(
    lighting: Float[Array, "*n 3"],
    base_color: Float[Array, "*n 3"],
    *,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """Colour of lighting: lighting times the divisor. Arguments as for `demodulation_divisor`."""
    return lighting * demodulation_divisor(base_color, specular=specular, metallic=metallic, eps=eps)
