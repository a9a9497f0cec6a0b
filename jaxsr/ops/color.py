"""Tone curves, sRGB, YCoCg, luminance, and DISPLAY: the display-referred colour of jaxsr.

Scene-linear colour is unbounded. DISPLAY colour is `sRGB(clip(ACES(exposure * linear)))` in [0, 1]. Metrics,
perceptual losses and written images see only this colour. ACES is Narkowicz' fit of the filmic curve. The
primaries are those of sRGB throughout; no gamut is converted.

Values out of range: a value below 0 counts as 0 and has no gradient (the curves are one-sided, with their
right derivative at 0). +inf counts as a very large value. NaN stays NaN, so that a broken pixel can be seen.
Gradients are finite at 0 and at any finite value whose result does not overflow.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr import srgb as curve
from jaxsr.errors import JaxsrError

KINDS = ("aces", "reinhard", "log")

WHITE = 7.2416735
"""Linear value at which the fit reaches 1: the positive root of 0.08 x^2 - 0.56 x - 0.14."""


def _floor(x: Array, low: float = 0.0) -> Array:
    return curve.at_least(x, low, jnp)


def _ceil(x: Array, high: float) -> Array:
    # The same as `at_least`, for an upper bound.
    return jnp.where(x > high, high, x)


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise JaxsrError("unknown tone curve", where="kind", expected=" | ".join(KINDS), found=kind)


@functools.partial(jax.jit, static_argnames=("kind",))
def tone_map(color_linear: Float[Array, "*n"], kind: str = "aces") -> Float[Array, "*n"]:
    """Compress scene-linear values, channel by channel.

    "aces": `x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14)` clipped to [0, 1] (Narkowicz 2016), 1 from
    x = 7.24 on. "reinhard": `x / (1 + x)` in [0, 1]. "log": `log(1 + x)`, unbounded (the tone of ExtraNet).

    Raises:
        JaxsrError: unknown kind.
    """
    _check_kind(kind)
    x = _floor(color_linear)
    if kind == "aces":
        x = _ceil(x, WHITE)
        return _ceil(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
    if kind == "reinhard":
        # The second form does not overflow, the first keeps the precision of dark values.
        return jnp.where(x > 1, 1 / (1 + 1 / _floor(x, 1.0)), x / (1 + _ceil(x, 1.0)))
    return jnp.log1p(x)


@functools.partial(jax.jit, static_argnames=("kind",))
def inverse_tone_map(toned: Float[Array, "*n"], kind: str = "aces") -> Float[Array, "*n"]:
    """The inverse of `tone_map`, finite everywhere.

    Values at or above saturation give the largest value that the curve can tell apart: 7.24 for "aces",
    1e6 for "reinhard"; "log" stops at exp(60).

    Raises:
        JaxsrError: unknown kind.
    """
    _check_kind(kind)
    y = _floor(toned)
    if kind == "aces":
        y = _ceil(y, 1.0)
        # (2.51 - 2.43 y) x^2 + (0.03 - 0.59 y) x - 0.14 y = 0, in the form without cancellation.
        a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, 0.14 * y
        root = jnp.sqrt(b * b + 4 * a * c)
        return jnp.where(b > 0, 2 * c / (_floor(b) + root), (root - b) / (2 * a))
    if kind == "reinhard":
        y = _ceil(y, 1 - 1e-6)
        return y / (1 - y)
    return jnp.expm1(_ceil(y, 60.0))


@jax.jit
def srgb_from_linear(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The sRGB transfer function, IEC 61966-2-1, exact in both pieces; not clipped above 1."""
    return curve.srgb_from_linear(linear, jnp)


@jax.jit
def linear_from_srgb(srgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The inverse of `srgb_from_linear`, likewise exact and not clipped above 1."""
    return curve.linear_from_srgb(srgb, jnp)


@jax.jit
def to_display(
    color_linear: Float[Array, "*n"], exposure: float | Float[Array, ""] = 1.0
) -> Float[Array, "*n"]:
    """DISPLAY colour in [0, 1]: `sRGB(clip(ACES(exposure * color_linear)))`."""
    return srgb_from_linear(tone_map(color_linear * exposure, "aces"))


@jax.jit
def from_display(display: Float[Array, "*n"], exposure: float | Float[Array, ""] = 1.0) -> Float[Array, "*n"]:
    """Scene-linear colour of DISPLAY colour: exact below saturation, at most `7.24 / exposure`."""
    return inverse_tone_map(linear_from_srgb(_ceil(display, 1.0)), "aces") / exposure


@jax.jit
def ycocg_from_rgb(rgb: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Luma Y and chroma differences Co (orange), Cg (green), of any range (Malvar and Sullivan 2003).

    Linear and invertible: `Y = (R + 2 G + B) / 4, Co = (R - B) / 2, Cg = (2 G - R - B) / 4`.
    """
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    return jnp.stack([0.25 * (r + b) + 0.5 * g, 0.5 * (r - b), 0.5 * g - 0.25 * (r + b)], axis=-1)


@jax.jit
def rgb_from_ycocg(ycocg: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """The inverse of `ycocg_from_rgb`."""
    y, co, cg = ycocg[..., 0], ycocg[..., 1], ycocg[..., 2]
    return jnp.stack([y - cg + co, y + cg, y - cg - co], axis=-1)


@jax.jit
def luminance(linear: Float[Array, "*n 3"]) -> Float[Array, "*n 1"]:
    """Relative luminance of linear sRGB (Rec. 709): `0.2126 R + 0.7152 G + 0.0722 B`."""
    return 0.2126 * linear[..., 0:1] + 0.7152 * linear[..., 1:2] + 0.0722 * linear[..., 2:3]
