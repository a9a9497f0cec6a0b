"""Backward warping, forward splatting, occlusion motion vectors, and motion over several frames.

All functions follow the convention of `jaxsr.frames`: motion is backward and in pixels of its own image, so
that the point seen at p lies at `p - motion_px(p)` in the previous frame. Warping reads there; splatting
writes there. Images are `[H, W, C]` or `[B, H, W, C]`; values have no range, results keep the dtype.

Whole pixels and fractions are split on the motion itself, not on `p - motion_px` as `resampling.sample` does
with positions: a uniform motion then means the same thing at every pixel, also thousands of pixels from the
origin. Halves of the motion round to even, whereas `sample` rounds halves of positions up. Motion may have
any size. A NaN component counts as 0 and gets no gradient; an infinite one points outside the image.

Nothing here uses a guide or fills holes: `jaxsr.ops.reprojection` does.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.ops._batch import over_batch
from jaxsr.ops.resampling import axis_taps, check_mode, weigh_taps

_FAR = 1e6
"""Pixels beyond any image, yet a number that can be interpolated and added to."""


@functools.partial(jax.jit, static_argnames=("mode", "boundary"))
def backward_warp(
    image: Float[Array, "*b h w c"],
    motion_px: Float[Array, "*b h w 2"],
    *,
    mode: str = "bilinear",
    boundary: str = "clamp",
) -> Float[Array, "*b h w c"]:
    """Read `image` where each pixel came from: `out(p) = image(p - motion_px(p))`.

    The filters are those of `resampling.sample`; "bicubic" is the history filter of temporal anti-aliasing
    (Jimenez 2016) and overshoots at edges. A tap of zero weight adds nothing, so that whole motion is an
    exact shift of any values. With fractional motion an infinite or NaN pixel makes every result that gives
    it a weight infinite or NaN: warp depth with "nearest".

    Differentiable in `image` and, unless the mode is "nearest", in `motion_px`.

    Args:
        image: the previous frame, any range.
        motion_px: backward motion (x, y) in pixels of `image`.
        mode: "nearest" (halves of the motion round to even), "bilinear" or "bicubic".
        boundary: taps outside the image repeat its border ("clamp") or are "zero".

    Raises:
        JaxsrError: unknown mode or boundary, or sizes that do not agree.
    """
    check_mode(mode, boundary)
    _check_sizes("backward_warp", motion_px, image)
    return over_batch(functools.partial(_warp, mode=mode, boundary=boundary), image, motion_px)


@functools.partial(jax.jit, static_argnames=("scale",))
def warp_zero_upsampled(
    image: Float[Array, "*b h w c"],
    motion_px: Float[Array, "*b h2 w2 2"],
    scale: int,
    offset: Int[Array, "*b 2"] | None = None,
) -> Float[Array, "*b h2 w2 c"]:
    """`backward_warp(zero_upsample(image, scale, offset), motion_px, boundary="zero")`, bilinear, but faster.

    Samples are `scale` pixels apart: of four bilinear taps at most one is a sample. It is read from `image`
    itself, so that there is a quarter of the gather (and of its gradient's scatter) and no large image.

    Differentiable in `image` and `motion_px`.

    Args:
        image: the samples, any range; NaN and infinity as in `backward_warp`.
        motion_px: backward motion (x, y) in pixels of the result.
        scale: s, size of the result over that of `image`.
        offset: (x, y) in [0, s), where in its s x s block each sample sits, one per image; else top left.

    Raises:
        JaxsrError: a scale below 1, or sizes that do not agree.
    """
    height, width = image.shape[-3:-1]
    if scale < 1:
        raise JaxsrError("bad scale", where="scale", expected="a whole number of at least 1", found=scale)
    if motion_px.shape[-3:] != (height * scale, width * scale, 2):
        raise JaxsrError(
            "image sizes differ",
            where="warp_zero_upsampled",
            expected=f"motion_px [.., {height * scale}, {width * scale}, 2]",
            found=list(motion_px.shape),
        )
    if scale == 1:
        return backward_warp(image, motion_px, boundary="zero")
    if offset is None:
        offset = jnp.zeros((*image.shape[:-3], 2), jnp.int32)

    def warp(image: Array, motion: Array, offset: Array) -> Array:
        (h, w, _), (h2, w2, _) = image.shape, motion.shape
        if image.size == 0:
            return jnp.zeros((h2, w2, image.shape[-1]), image.dtype)
        dx, fx = _whole_and_fraction(-motion[..., 0], w2, "floor")
        dy, fy = _whole_and_fraction(-motion[..., 1], h2, "floor")
        column = _sample_tap(jnp.arange(w2, dtype=jnp.int32)[None, :] + dx - offset[0], fx, w, scale)
        row = _sample_tap(jnp.arange(h2, dtype=jnp.int32)[:, None] + dy - offset[1], fy, h, scale)
        return weigh_taps(image, [column], [row])

    return over_batch(warp, image, motion_px, offset)


@jax.jit
def compose_motion(
    motion_px: Float[Array, "*b h w 2"], before_px: Float[Array, "*b h w c"]
) -> Float[Array, "*b h w c"]:
    """Motion over one more frame: `out(p) = motion(p) + before(p - motion(p))`, `before` read bilinearly.

    `before` leads from the previous frame to an earlier one, the result from the current frame to that one:
    an image many frames old is then warped once, and not blurred once per frame (Xiao et al. 2020).
    Where p comes from outside the image, the motion of the border goes on.

    Motion is at most 1e6 pixels: infinite motion stays outside any image, but is a number, as interpolation
    and sums need. A NaN component counts as 0.

    Differentiable in both.

    Args:
        motion_px: backward motion (x, y) of the current frame, in pixels.
        before_px: the same of the previous frame, to as many earlier frames as there are pairs of channels.

    Raises:
        JaxsrError: sizes that do not agree, or an odd number of channels.
    """
    _check_sizes("compose_motion", motion_px, before_px)
    pairs, odd = divmod(before_px.shape[-1], 2)
    if odd:
        raise JaxsrError(
            "not motions", where="compose_motion", expected="pairs of channels", found=list(before_px.shape)
        )

    def compose(motion: Array, before: Array) -> Array:
        motion, before = _finite(motion), _finite(before)
        rest = _warp(before, motion, mode="bilinear", boundary="clamp")
        return _finite(jnp.tile(motion, (1, 1, pairs)) + rest)

    return over_batch(compose, motion_px, before_px)


@jax.jit
def forward_splat(
    values: Float[Array, "*b h w c"],
    motion_px: Float[Array, "*b h w 2"],
    depth_linear: Float[Array, "*b h w 1"],
) -> tuple[Float[Array, "*b h w c"], Bool[Array, "*b h w 1"]]:
    """Write each pixel's value where it came from; the nearest one wins (the splat of Guo et al. 2021).

    Pixel q lands whole on `q - round(motion_px(q))`. Among those that land on one pixel the smallest
    depth wins, and among equal depths the first in row order: the result is deterministic. What lands
    outside the image is lost. NaN depth counts as +inf. To carry a frame forward in time, give the
    negated motion.

    Differentiable in `values` only.

    Args:
        values: what is carried, any range.
        motion_px: backward motion (x, y) in pixels.
        depth_linear: linear view depth, +inf for sky.

    Returns:
        The splatted values, 0 where nothing landed, and a mask that is True where something did.

    Raises:
        JaxsrError: sizes that do not agree.
    """
    _check_sizes("forward_splat", motion_px, values, depth_linear)

    def splat(v: Array, motion: Array, depth: Array) -> tuple[Array, Array]:
        h, w, c = v.shape
        winner = _nearest_arrival(_origin(motion), depth)
        landed = winner < h * w
        rows = v.reshape(-1, c)[jnp.minimum(winner, h * w - 1)]
        return jnp.where(landed[:, None], rows, 0).reshape(h, w, c), landed.reshape(h, w, 1)

    return over_batch(splat, values, motion_px, depth_linear)


@jax.jit
def occlusion_motion(
    motion_px: Float[Array, "*b h w 2"], depth_linear: Float[Array, "*b h w 1"]
) -> Float[Array, "*b h w 2"]:
    """Occlusion motion: at disoccluded pixels the motion of the occluder, elsewhere the motion itself.

    The motion of a disoccluded pixel p points at the surface that hid it, and a warp shows its ghost.
    Zeng et al. 2021 (dual motion vectors) move p along with that occluder instead, so that p reads the
    background beside it. In ExtraNet's form (Guo et al. 2021): splat the current frame's motion into the
    previous frame with a depth test, and read it at the motion's origin,

        MV_occ(p) = MV(q*),   q* = argmin depth(q) over { q : q - round(MV(q)) = p - round(MV(p)) }.

    p itself is one of the q, so a pixel that nothing hid keeps its motion. Where the origin lies outside
    the image the motion is returned unchanged. Depths are those of the current frame.

    Args:
        motion_px: backward motion (x, y) in pixels.
        depth_linear: linear view depth, +inf for sky.

    Returns:
        Backward motion in pixels, for `backward_warp`. Differentiable in `motion_px` (as a gather).

    Raises:
        JaxsrError: sizes that do not agree.
    """
    _check_sizes("occlusion_motion", motion_px, depth_linear)

    def occlude(motion: Array, depth: Array) -> Array:
        h, w, _ = motion.shape
        origin = _origin(motion)
        winner = _nearest_arrival(origin, depth)[jnp.minimum(origin, h * w - 1)]
        chosen = jnp.where(origin < h * w, winner, jnp.arange(h * w, dtype=jnp.int32))
        return motion.reshape(-1, 2)[chosen].reshape(h, w, 2)

    return over_batch(occlude, motion_px, depth_linear)


def _check_sizes(where: str, motion_px: ArrayLike, *others: ArrayLike) -> None:
    """All arrays must agree but for the channels: jaxtyping says so only when it is switched on."""
    shapes = [jnp.shape(a) for a in (motion_px, *others)]
    if shapes[0][-1:] != (2,):
        raise JaxsrError(
            "not a motion", where=where, expected="motion_px [.., H, W, 2]", found=list(shapes[0])
        )
    if len({shape[:-1] for shape in shapes}) != 1:
        raise JaxsrError("image sizes differ", where=where, expected="equal [.., H, W]", found=shapes)


def _whole_and_fraction(
    offset: Float[Array, "h w"], size: int, rounding: Literal["floor", "round"]
) -> tuple[Int[Array, "h w"], Float[Array, "h w"]]:
    """Split an offset along one axis; beyond the reach of the image it is clipped, which changes nothing."""
    reach = size + 4  # past the last tap of any kernel, and small enough for exact float32 fractions
    offset = jnp.clip(jnp.where(jnp.isnan(offset), 0, offset), -reach, reach)
    whole = jax.lax.stop_gradient(jnp.floor(offset) if rounding == "floor" else jnp.round(offset))
    return whole.astype(jnp.int32), offset - whole


def _warp(image: Array, motion: Array, *, mode: str, boundary: str) -> Array:
    h, w, _ = image.shape
    if image.size == 0:
        return image
    rounding: Literal["floor", "round"] = "round" if mode == "nearest" else "floor"
    dx, fx = _whole_and_fraction(-motion[..., 0], w, rounding)
    dy, fy = _whole_and_fraction(-motion[..., 1], h, rounding)
    columns = axis_taps(jnp.arange(w, dtype=jnp.int32)[None, :] + dx, fx, w, mode, boundary)
    rows = axis_taps(jnp.arange(h, dtype=jnp.int32)[:, None] + dy, fy, h, mode, boundary)
    return weigh_taps(image, columns, rows)


def _sample_tap(
    place: Int[Array, "h w"], fraction: Float[Array, "h w"], size: int, scale: int
) -> tuple[Array, Array]:
    """Of the taps at `place` and `place + 1` the one that is a multiple of `scale`: its sample and weight."""
    cell, rest = place // scale, place % scale
    after = rest == scale - 1
    weight = jnp.where(after, fraction, jnp.where(rest == 0, 1 - fraction, 0))
    cell = cell + after.astype(cell.dtype)
    weight = jnp.where((cell >= 0) & (cell < size), weight, 0)
    return jnp.clip(cell, 0, size - 1), weight


def _finite(motion: Array) -> Array:
    return jnp.clip(jnp.where(jnp.isnan(motion), 0, motion), -_FAR, _FAR)


def _origin(motion: Float[Array, "h w 2"]) -> Int[Array, " n"]:
    """Row-order index of `p - round(motion(p))` for every p; H * W where that lies outside the image."""
    h, w, _ = motion.shape
    dx, _ = _whole_and_fraction(-motion[..., 0], w, "round")
    dy, _ = _whole_and_fraction(-motion[..., 1], h, "round")
    x, y = jnp.arange(w, dtype=jnp.int32)[None, :] + dx, jnp.arange(h, dtype=jnp.int32)[:, None] + dy
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    return jnp.where(inside, y * w + x, h * w).reshape(-1)


def _nearest_arrival(target: Int[Array, " n"], depth: Float[Array, "h w 1"]) -> Int[Array, " n"]:
    """For every pixel the index of the nearest one that lands on it, or N. Two min-scatters: no races."""
    n = target.shape[0]
    z = jax.lax.stop_gradient(depth).reshape(n)
    z = jnp.where(jnp.isnan(z), jnp.inf, z)
    nearest = jnp.full(n, jnp.inf, z.dtype).at[target].min(z, mode="drop")
    wins = z == nearest.at[target].get(mode="fill", fill_value=jnp.nan)
    arrivals = jnp.where(wins, target, n)
    return jnp.full(n, n, jnp.int32).at[arrivals].min(jnp.arange(n, dtype=jnp.int32), mode="drop")
