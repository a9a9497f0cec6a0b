"""Demodulation: colour = divisor x lighting, so that filters see smooth lighting instead of textures.

The divisor is the base colour (ExtraSS, notes section on G-buffer-guided reprojection), or with `specular`
the one of ExtraNet for glossy scenes, `base + 0.08 specular (1 - metallic)`. Everything is scene-linear.

On a surface each channel of the divisor is at least `eps`, also where the base colour is exactly 0 or NaN.
This guard bounds lighting by `color / eps`, and its gradient with respect to the base colour by
`color / eps^2`. Without it a dark texel would make a bright speck of lighting that a filter spreads. The
divisor is continuous in the base colour: lighting that a filter carries from a dark surface to a black one
keeps its scale.

On sky the divisor is 1, so that lighting equals colour. Only `surface` says what is sky, and it comes from
depth: `surface=jnp.isfinite(depth_linear)`. A base colour of 0 does not mean sky, because ink, rubber and
dark screens have it too. `modulate` inverts `demodulate` for equal arguments.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsr.errors import JaxsrError


def demodulation_divisor(
    base_color: Float[Array, "*n 3"],
    *,
    surface: Bool[Array, "*n 1"] | Float[Array, "*n 1"] | None = None,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """What `demodulate` divides by and `modulate` multiplies with.

    Args:
        base_color: in [0, 1]; NaN counts as 0.
        surface: True (or above 1/2) where a surface is seen, False for sky. None: every pixel is a surface.
        specular: in [0, 1] (0.5 for common materials), NaN counts as 0; None for plain base colour.
        metallic: in [0, 1], NaN counts as 0; 0 if None. It only matters together with `specular`.
        eps: smallest divisor of a surface.

    Raises:
        JaxsrError: `eps` is not positive.
    """
    if isinstance(eps, float | int) and not eps > 0:
        raise JaxsrError("bad guard", where="demodulation eps", expected="a positive number", found=eps)
    divisor = _nan_to_zero(base_color)
    if specular is not None:
        dielectric = 1.0 if metallic is None else 1.0 - _nan_to_zero(metallic)
        divisor = divisor + 0.08 * _nan_to_zero(specular) * dielectric
    divisor = jnp.where(divisor >= eps, divisor, eps)
    if surface is None:
        return divisor
    return jnp.where(jnp.asarray(surface, jnp.float32) > 0.5, divisor, 1.0)


def _nan_to_zero(x: Array | float) -> Array:
    # Before any product: 0 times NaN would be a NaN gradient.
    return jnp.where(jnp.isnan(x), 0.0, x)


@functools.partial(jax.jit, static_argnames=("eps",))
def demodulate(
    color_linear: Float[Array, "*n 3"],
    base_color: Float[Array, "*n 3"],
    *,
    surface: Bool[Array, "*n 1"] | Float[Array, "*n 1"] | None = None,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """Lighting: colour over the divisor. Arguments as for `demodulation_divisor`."""
    return color_linear / demodulation_divisor(
        base_color, surface=surface, specular=specular, metallic=metallic, eps=eps
    )


@functools.partial(jax.jit, static_argnames=("eps",))
def modulate(
    lighting: Float[Array, "*n 3"],
    base_color: Float[Array, "*n 3"],
    *,
    surface: Bool[Array, "*n 1"] | Float[Array, "*n 1"] | None = None,
    specular: float | Float[Array, ""] | Float[Array, "*n 1"] | None = None,
    metallic: Float[Array, "*n 1"] | None = None,
    eps: float = 0.02,
) -> Float[Array, "*n 3"]:
    """Colour of lighting: lighting times the divisor. Arguments as for `demodulation_divisor`."""
    return lighting * demodulation_divisor(
        base_color, surface=surface, specular=specular, metallic=metallic, eps=eps
    )
