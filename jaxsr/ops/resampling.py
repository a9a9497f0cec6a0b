"""Values of an image between its pixels: sampling at positions, resizing, and pixel rearrangement.

Images are `[..., H, W, C]`. Positions are (x, y) in pixels of the sampled image, integers are pixel centres.
Filters interpolate: a minified image is not low-passed first. "bicubic" is Keys' kernel with a = -0.5
(Catmull-Rom), which reproduces linear and quadratic ramps; PyTorch and OpenCV use a = -0.75, which does not.

Everything is linear, hence differentiable, in the image; `sample` is also differentiable in the positions
(the right-sided derivative at pixel centres; zero for "nearest" and beyond a clamped border). An infinite or
NaN pixel reaches only the results that give it a weight: depth +inf for sky does not spread.
"""

import functools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.ops._batch import over_batch

MODES = ("nearest", "bilinear", "bicubic")
BOUNDARIES = ("clamp", "zero")

_SUPPORT = {"nearest": 1, "bilinear": 2, "bicubic": 4}


def check_mode(mode: str, boundary: str = "clamp") -> None:
    """Raise JaxsrError unless `mode` and `boundary` are known."""
    if mode not in MODES:
        raise JaxsrError("unknown mode", where="mode", expected=" | ".join(MODES), found=mode)
    if boundary not in BOUNDARIES:
        raise JaxsrError(
            "unknown boundary", where="boundary", expected=" | ".join(BOUNDARIES), found=boundary
        )


def gather_pixels(
    image: Float[Array, "h w c"], x: Int[Array, "*n"], y: Int[Array, "*n"]
) -> Float[Array, "*n c"]:
    """Whole pixels at integer positions inside the image (the caller clamps). One read of C values each."""
    height, width, channels = image.shape
    return image.reshape(height * width, channels).at[y * width + x].get(mode="promise_in_bounds")


def kernel_taps(fraction, mode: str, xnp=jnp) -> list:
    """Weights of the taps of one axis: at 0, 1 for "bilinear", at -1, 0, 1, 2 for "bicubic".

    Args:
        fraction: distance in [0, 1) to the tap at 0.
        mode: "nearest" has the one tap at 0.
        xnp: jax.numpy, or numpy where the positions are known in advance.
    """
    f = fraction
    if mode == "nearest":
        return [xnp.ones_like(f)]
    if mode == "bilinear":
        return [1 - f, f]
    return [  # Keys 1981, with a = -1/2
        ((-0.5 * f + 1) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1,
        ((-1.5 * f + 2) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ]


def axis_taps(
    base: Int[Array, "*n"], fraction: Float[Array, "*n"], size: int, mode: str, boundary: str
) -> list[tuple[Array, Array]]:
    """Clamped indices and weights of the taps of one axis, for samples `fraction` past the pixels `base`."""
    first = base - (1 if mode == "bicubic" else 0)
    taps = []
    for k, weight in enumerate(kernel_taps(fraction, mode)):
        index = first + k
        if boundary == "zero":
            weight = jnp.where((index >= 0) & (index < size), weight, 0)
        taps.append((jnp.clip(index, 0, size - 1), weight))
    return taps


@jax.custom_jvp
def _weighted(weight: Float[Array, "*n 1"], tap: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    """`weight * tap`, and 0 where the weight is 0: the plain product makes NaN of 0 and infinity."""
    return jnp.where(weight != 0, weight * tap, 0)


@_weighted.defjvp
def _weighted_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    weight, tap = primals
    # A finite tap of weight 0 has a slope all the same; an infinite one would make NaN of a zero cotangent.
    slope = jnp.where(jnp.isfinite(tap), tap, 0)
    return _weighted(weight, tap), tangents[0] * slope + weight * tangents[1]


def weigh_taps(
    image: Float[Array, "h w c"], columns: list[tuple[Array, Array]], rows: list[tuple[Array, Array]]
) -> Float[Array, "*n c"]:
    """The weighted sum of both axes' taps; one of zero weight adds nothing, even where it is infinite.

    Half-precision images are summed in the precision of the weights; the result has that of the image.
    """
    dtype = np.promote_types(image.dtype, columns[0][1].dtype)
    total = None
    for y, weight_y in rows:
        for x, weight_x in columns:
            weight = (weight_y * weight_x)[..., None].astype(dtype)
            product = _weighted(weight, gather_pixels(image, x, y).astype(dtype))
            total = product if total is None else total + product
    assert total is not None
    return total.astype(image.dtype)


def _split(position, mode: str, xnp=jnp):
    """The whole pixel before each position ("nearest": the nearest, halves round up), and the fraction."""
    base = xnp.floor(position + 0.5) if mode == "nearest" else xnp.floor(position)
    return base, position - base


def _taps_at(position: Float[Array, "*n"], size: int, mode: str, boundary: str) -> list[tuple[Array, Array]]:
    # Far or NaN positions would overflow the integers. At four pixels outside, all taps are outside too.
    position = jnp.clip(jnp.where(jnp.isnan(position), -4.0, position), -4.0, size + 3.0)
    base, fraction = _split(position, mode)
    return axis_taps(jax.lax.stop_gradient(base).astype(jnp.int32), fraction, size, mode, boundary)


@functools.partial(jax.jit, static_argnames=("mode", "boundary"))
def sample(
    image: Float[Array, "*b h w c"],
    positions_px: Float[Array, "*bn 2"],
    *,
    mode: str = "bilinear",
    boundary: str = "clamp",
) -> Float[Array, "*bn c"]:
    """The image at arbitrary positions.

    Args:
        image: any range, any number of channels; batch axes lead.
        positions_px: (x, y) in pixels of `image`, with the batch axes of `image` and then any others.
            NaN counts as far outside, to the upper left.
        mode: "nearest" (halves round up; `warping.backward_warp` rounds the motion instead, half to even),
            "bilinear" or "bicubic".
        boundary: taps outside the image repeat its border ("clamp") or are "zero".

    Raises:
        JaxsrError: unknown mode or boundary.
    """
    check_mode(mode, boundary)

    def one(image: Array, positions: Array) -> Array:
        height, width, _ = image.shape
        columns = _taps_at(positions[..., 0], width, mode, boundary)
        rows = _taps_at(positions[..., 1], height, mode, boundary)
        return weigh_taps(image, columns, rows)

    return over_batch(one, image, positions_px)


def pixel_grid(height: int, width: int, dtype: DTypeLike = jnp.float32) -> Float[Array, "h w 2"]:
    """The position (x, y) of every pixel, in pixels: (0, 0) is the centre of the top left one."""
    return grid(height, width, dtype, jnp)


def grid(height: int, width: int, dtype: DTypeLike, xnp: ModuleType) -> Any:
    """`pixel_grid` in NumPy or JAX."""
    y, x = xnp.mgrid[:height, :width]
    return xnp.stack([x, y], axis=-1).astype(dtype)


def _resize_axis(image: Array, size: int, axis: int, mode: str) -> Array:
    old = image.shape[axis]
    if old == size:
        return image
    # Positions are known in advance, so that indices and weights are float64 constants. The only division is
    # one of whole numbers, so that exact halves stay exact.
    base, fraction = _split((np.arange(size) * 2 + 1) * old / (2 * size) - 0.5, mode, np)
    first = base.astype(np.int32) - (1 if mode == "bicubic" else 0)
    total = None
    for k, weight in enumerate(kernel_taps(fraction, mode, np)):
        tap = jnp.take(image, np.clip(first + k, 0, old - 1), axis=axis, mode="clip")
        constant = jnp.asarray(weight.reshape(-1, *[1] * (-axis - 1)), image.dtype)
        constant = constant.reshape((1,) * (image.ndim - constant.ndim) + constant.shape)
        product = jnp.where(constant == 0, 0, constant * tap)
        total = product if total is None else total + product
    assert total is not None
    return total


@functools.partial(jax.jit, static_argnames=("size", "mode"))
def resize(
    image: Float[Array, "*b h w c"], size: tuple[int, int], mode: str = "bilinear"
) -> Float[Array, "*b h2 w2 c"]:
    """Resample to `size` = (H, W), with pixel centres aligned: `x_old = (x_new + 0.5) w / W - 0.5`.

    Borders repeat. Equals `torch.nn.functional.interpolate(align_corners=False)` for "bilinear" and
    "nearest-exact" for "nearest": halving takes the lower right pixel of each 2x2 block.

    Raises:
        JaxsrError: unknown mode, or a size below 1.
    """
    check_mode(mode)
    if min(size) < 1:
        raise JaxsrError("empty image", where="resize", expected="a size of at least 1 x 1", found=size)
    return _resize_axis(_resize_axis(image, size[0], -3, mode), size[1], -2, mode)


def _slice(image: Array, axis: int, start: Any, stop: Any) -> Array:
    return image[(..., slice(start, stop), *[slice(None)] * (-axis - 1))]


def _upsample_axis(image: Array, scale: int, axis: int, mode: str) -> Array:
    # Each of the `scale` phases is a fixed filter on slices of a padded image; there is no gather.
    pad = {"nearest": 0, "bilinear": 1, "bicubic": 2}[mode]
    first_pixel, last_pixel = _slice(image, axis, None, 1), _slice(image, axis, -1, None)
    padded = jnp.concatenate([first_pixel] * pad + [image] + [last_pixel] * pad, axis=axis)
    phases = []
    for phase in range(scale):
        base, fraction = _split(np.float64((phase + 0.5) / scale - 0.5), mode, np)
        first = int(base) - (1 if mode == "bicubic" else 0)
        total = None
        for k, weight in enumerate(kernel_taps(fraction, mode, np)):
            if weight == 0:
                continue
            start = first + k + pad
            product = _slice(padded, axis, start, start + image.shape[axis]) * float(weight)
            total = product if total is None else total + product
        assert total is not None
        phases.append(total)
    stacked = jnp.stack(phases, axis=axis)
    shape = list(image.shape)
    shape[axis] = shape[axis] * scale
    return stacked.reshape(shape)


@functools.partial(jax.jit, static_argnames=("scale", "mode"))
def upsample(
    image: Float[Array, "*b h w c"], scale: int, mode: str = "bilinear"
) -> Float[Array, "*b h2 w2 c"]:
    """`resize` to `scale` times the size, without gathers; it also traces with symbolic sizes for export.

    Raises:
        JaxsrError: unknown mode, or a scale below 1.
    """
    check_mode(mode)
    _check_scale(scale)
    if scale == 1:
        return image
    return _upsample_axis(_upsample_axis(image, scale, -3, mode), scale, -2, mode)


@functools.partial(jax.jit, static_argnames=("scale",))
def zero_upsample(
    image: Float[Array, "*b h w c"], scale: int, offset: Int[Array, "*b 2"] | None = None
) -> Float[Array, "*b h2 w2 c"]:
    """`O[y, x] = I[y / s, x / s]` where s divides both, else 0: each sample sits top left in its block.

    Args:
        image: any range, any number of channels; batch axes lead.
        scale: s, the size of a block.
        offset: (x, y) in [0, s), where in its block the sample sits instead, one per image; the values may be
            traced. `O[y, x] = I[(y - offset_y) / s, (x - offset_x) / s]`. Out of range, nothing is placed.

    Raises:
        JaxsrError: a scale below 1.
    """
    _check_scale(scale)
    *batch, height, width, channels = image.shape
    if offset is None:
        offset = jnp.zeros((*batch, 2), jnp.int32)
    place = offset[..., None] == jnp.arange(scale, dtype=offset.dtype).reshape((1,) * offset.ndim + (scale,))
    # [..., 1, dy, 1, dx, 1]. A select, because a scatter would not fuse and a product would spread NaN.
    here = place[..., 1, None, :, None, None, None] & place[..., 0, None, None, None, :, None]
    spread = jnp.where(here, image[..., :, None, :, None, :], jnp.zeros((), image.dtype))
    return spread.reshape(*batch, height * scale, width * scale, channels)


@functools.partial(jax.jit, static_argnames=("block",))
def pixel_unshuffle(image: Float[Array, "*b h w c"], block: int) -> Float[Array, "*b h2 w2 c2"]:
    """Each block of pixels becomes one pixel: `[H, W, C] -> [H / b, W / b, C b^2]`, b = `block`.

    Output channel `c b^2 + dy b + dx` is input channel c at (dy, dx) of the block, the order of PyTorch's
    `pixel_unshuffle`. `pixel_shuffle` is the inverse.

    Raises:
        JaxsrError: the size is no multiple of `block`.
    """
    _check_scale(block)
    *batch, height, width, channels = image.shape
    if height % block or width % block:
        raise JaxsrError(
            "the image is no whole number of blocks",
            where="pixel_unshuffle",
            expected=f"multiples of {block}",
            found=f"{height} x {width}",
        )
    blocks = image.reshape(*batch, height // block, block, width // block, block, channels)
    blocks = jnp.moveaxis(blocks, (-4, -2), (-2, -1))  # [h, w, c, dy, dx]
    return blocks.reshape(*batch, height // block, width // block, channels * block * block)


@functools.partial(jax.jit, static_argnames=("block",))
def pixel_shuffle(image: Float[Array, "*b h w c"], block: int) -> Float[Array, "*b h2 w2 c2"]:
    """The inverse of `pixel_unshuffle`, `[H, W, C b^2] -> [H b, W b, C]`: PyTorch's `pixel_shuffle`.

    Raises:
        JaxsrError: the channels are no multiple of `block` squared.
    """
    _check_scale(block)
    *batch, height, width, channels = image.shape
    if channels % (block * block):
        raise JaxsrError(
            "the channels do not fill blocks",
            where="pixel_shuffle",
            expected=f"a multiple of {block * block}",
            found=channels,
        )
    blocks = image.reshape(*batch, height, width, channels // (block * block), block, block)
    blocks = jnp.moveaxis(blocks, (-2, -1), (-4, -2))
    return blocks.reshape(*batch, height * block, width * block, channels // (block * block))


def _check_scale(scale: int) -> None:
    if scale < 1:
        raise JaxsrError("bad scale", where="scale", expected="a whole number of at least 1", found=scale)
