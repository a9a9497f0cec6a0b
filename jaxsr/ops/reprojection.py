"""G-buffer-guided reprojection: ExtraSS's joint bilateral a-trous gather, differentiable, for any guide.

The paper's symbols, used throughout (Wu et al. 2023, "ExtraSS", section on guided warping):

    xbar      = x - motion(x)                        where pixel x was in the previous frame
    N(xbar)   = { [xbar] + (k s, l s) }              k, l in -r..r, s in the strides; equal offsets count once
    w_x(y)    = G(g_t(x) - g_{t-1}(y) | 0, sigma_0) G(xbar - y | 0, sigma_1)
    f(i)[x]   = sum over the `count` heaviest y of w_x(y) i(y), divided by the sum of those w_x(y)

[xbar] is `x - round(motion)`, and the distance xbar - y keeps the sub-pixel part. Weights are formed as
logarithms relative to a perfect match at [xbar], so that no sigma, however small, gives 0/0.

Layout `[H, W, C]` or `[B, H, W, C]`; motion as in `jaxsr.frames`; previous values of any range. Guides are
whatever the caller scales them to: they must be finite where they are to count (give depth as its inverse
or logarithm, sky is +inf). Demodulation, masks and blending are left to the caller.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxsr.errors import JaxsrError
from jaxsr.ops._batch import over_batch

DEFAULT_SIGMA_GUIDE = 0.15
"""Standard deviation of guide differences: base colour, unit normals (experiments/tune_classical.py)."""
DEFAULT_SIGMA_SPACE = 2.0
"""Standard deviation of the distance to xbar, in pixels (likewise)."""

_TINY_SIGMA = 1e-9  # keeps 1/sigma finite
_CLIP = 1e12  # bound of scaled guides: squares of their differences are far below _NOWHERE
_NOWHERE = 1e28  # distances above it are those to pixels that do not count
_FAR = 1e15  # scaled guide of a pixel that does not count: its distance is far above _NOWHERE, and finite
_NORMAL = 1e-12  # keeps keys out of the denormal numbers, which some processors flush to 0

T = TypeVar("T")
Batching = Literal["map", "vmap"]
Fence = Literal["cond", "barrier", "none"]


@functools.partial(jax.jit, static_argnames=("strides", "radius", "count"))
def reproject(
    previous: Float[Array, "*b h w c"],
    motion_px: Float[Array, "*b h w 2"],
    guide: Float[Array, "*b h w g"],
    previous_guide: Float[Array, "*b h w g"],
    *,
    sigma_guide: Float[Array, "..."] | float = DEFAULT_SIGMA_GUIDE,
    sigma_space: Float[Array, ""] | float = DEFAULT_SIGMA_SPACE,
    strides: tuple[int, ...] = (1, 3, 5, 9),
    radius: int = 1,
    count: int = 4,
) -> tuple[Float[Array, "*b h w c"], Float[Array, "*b h w 1"]]:
    """Bring `previous` to the current frame, choosing among the pixels around the motion's end by guide.

    The selection of the `count` heaviest candidates is constant for gradients; everything after it is
    differentiable in `previous`, both guides, the sub-pixel part of `motion_px`, and both sigmas.

    A candidate weighs 0 if it lies outside the frame or has a guide that is not finite. Where no candidate
    is left, or the pixel's own guide or motion is not finite, the result is the previous pixel at [xbar],
    clamped to the frame (for NaN motion: at x), and the confidence is 0.

    The confidence is `max over y of w_x(y) / G(xbar - [xbar] | 0, sigma_1)`, in [0, 1]: the weight of the
    best candidate relative to a perfect match at [xbar]. It is 1 where the guide at the motion's end agrees
    with the current one, and falls with the guide difference or the distance at which a match was found:
    low values are disocclusions. It underflows to 0 while the image still shows the best match there is.

    Candidates are compared as float32 log-weights of which the last bits carry the candidate's number (6
    bits for the default 33): those within a relative 2^-17 of each other count as equal, and then the
    smaller stride wins, in row order. Such near-ties apart, the choice is exact.

    Args:
        previous: values of the previous frame, any range.
        motion_px: backward motion (x, y) in pixels.
        guide: features of the current frame, for instance base colour and normal.
        previous_guide: the same features of the previous frame.
        sigma_guide: standard deviation of guide differences, one for all or one per channel `[g]`; positive.
        sigma_space: standard deviation of the distance, in pixels; positive.
        strides: spacings s of the a-trous levels, in pixels.
        radius: r; each level has (2 r + 1)^2 candidates.
        count: how many candidates are kept.

    Returns:
        The reprojected values in the dtype of `previous`, and the confidence.

    Raises:
        JaxsrError: sizes, channels, sigmas, strides, radius or count that make no sense.
    """
    _check(previous, motion_px, guide, previous_guide, jnp.shape(sigma_guide), strides, radius, count)
    return _reproject(
        (previous, motion_px, guide, previous_guide),
        (sigma_guide, sigma_space),
        candidate_offsets(strides, radius),
        count,
        batching="map" if jax.default_backend() == "cpu" and jax.device_count() == 1 else "vmap",
        fence="cond",
    )


def _reproject(
    arrays: tuple[Array, Array, Array, Array],
    sigmas: tuple[Array | float, Array | float],
    offsets: Int[np.ndarray, "n 2"],
    count: int,
    *,
    batching: Batching,
    fence: Fence,
) -> tuple[Array, Array]:
    """`reproject` in one of several forms that give equal results; `benchmarks/reproject.py` times them.

    Args:
        arrays: previous values, motion, guide, previous guide.
        sigmas: of the guide, of the distance.
        offsets: of the candidates.
        count: how many candidates are kept.
        batching: "map" takes one image after the other. On a CPU this needs a tenth of the memory and half
            the time of "vmap"; on a GPU it is several times slower. On several devices it would gather a
            batch that is sharded over them; "vmap" keeps the sharding.
        fence: see `_fenced`.
    """
    dtype = functools.reduce(np.promote_types, (a.dtype for a in arrays[1:]), np.dtype(np.float32))
    scale = jnp.broadcast_to(_inverse_sigma(sigmas[0], dtype), arrays[2].shape[-1:])
    scale_space = _inverse_sigma(sigmas[1], dtype)
    count = min(count, len(offsets))

    def one(value: Array, motion: Array, g: Array, g_prev: Array) -> tuple[Array, Array]:
        there = _padded(g_prev, scale, pad=2 * int(np.abs(offsets).max()) + 1)
        near = _Neighbourhood(motion, g, there, scale, scale_space)
        words = _fenced(lambda: _select(jax.lax.stop_gradient(near), offsets, count), fence)
        distance = _fenced(lambda: _distances(near, words, offsets, count), fence)
        return _filter(value, near, words, distance, offsets)

    if batching == "vmap":
        return over_batch(one, *arrays)

    def images(*arrays: Array) -> tuple[Array, Array]:
        return one(*arrays) if arrays[0].ndim == 3 else jax.lax.map(lambda xs: images(*xs), arrays)

    return images(*arrays)


def _fenced(compute: Callable[[], T], fence: Fence) -> T:
    """The result of `compute`, which XLA must not copy into each of its readers.

    "cond" puts `compute` behind a condition on an opaque True, a constant that XLA cannot see through. The
    conditional boundary stops XLA from making copies. "barrier" is an optimisation barrier, "none" trusts the
    compiler. With copies everything takes five times as long on a CPU, and twice as long on a GPU, where the
    barrier does not help (benchmarks/README.md).
    """
    if fence == "none":
        return compute()
    if fence == "barrier":
        return jax.lax.optimization_barrier(compute())
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(compute))
    return jax.lax.cond(jax.lax.optimization_barrier(jnp.asarray(True)), compute, lambda: blank)


def candidate_offsets(strides: Sequence[int], radius: int) -> Int[np.ndarray, "n 2"]:
    """The distinct offsets (dx, dy) of N(xbar) from [xbar]: the centre, then by stride, in row order."""
    steps = range(-radius, radius + 1)
    offsets = {(0, 0): None} | {(k * s, l * s): None for s in strides for l in steps for k in steps}
    return np.array(list(offsets), dtype=np.int32)


def _check(
    previous: ArrayLike,
    motion: ArrayLike,
    guide: ArrayLike,
    previous_guide: ArrayLike,
    sigma_shape: tuple[int, ...],
    strides: tuple[int, ...],
    radius: int,
    count: int,
) -> None:
    def fail(what: str, expected: object, found: object) -> None:
        raise JaxsrError(what, where="reproject", expected=expected, found=found)

    shapes = [jnp.shape(a) for a in (previous, motion, guide, previous_guide)]
    if shapes[1][-1:] != (2,):
        fail("not a motion", "motion_px [.., H, W, 2]", list(shapes[1]))
    if len({s[:-1] for s in shapes}) != 1:
        fail("image sizes differ", "equal [.., H, W]", shapes)
    if 0 in shapes[0]:
        fail("empty image", "at least one pixel and channel", shapes[0])
    if shapes[2] != shapes[3] or shapes[2][-1] == 0:
        fail("guides differ", "the same channels, at least one", shapes[2:])
    if sigma_shape not in ((), (1,), shapes[2][-1:]):
        fail("sigma_guide does not fit", f"a scalar or [{shapes[2][-1]}]", list(sigma_shape))
    if not strides or min(strides) < 1 or radius < 0 or count < 1:
        fail("bad neighbourhood", "strides >= 1, radius >= 0, count >= 1", (strides, radius, count))


def _inverse_sigma(sigma: Array | float, dtype: DTypeLike) -> Array:
    """1 / (sqrt(2) sigma): squares of scaled differences are then minus the logarithm of the Gaussian."""
    return np.sqrt(0.5).item() / jnp.maximum(jnp.asarray(sigma, dtype), _TINY_SIGMA)


class _Neighbourhood(NamedTuple):
    """All that the weight of a candidate depends on. Weights are computed in the dtype of the scales."""

    motion: Float[Array, "h w 2"]
    guide: Float[Array, "h w g"]
    there: Float[Array, "hp wp g"]
    """The previous guide, scaled and padded."""
    scale: Float[Array, " g"]
    scale_space: Float[Array, ""]


def _padded(guide: Float[Array, "h w g"], scale: Float[Array, " g"], pad: int) -> Float[Array, "hp wp g"]:
    """The guide over sqrt(2) sigma_0, padded so widely that every candidate is a constant step from [xbar].

    Pixels outside the frame, and those whose guide is not finite, get the value `_FAR`, which differs so much
    from any guide that they need no test of their own.
    """
    finite = jnp.isfinite(guide).all(-1, keepdims=True)
    scaled = jnp.where(finite, guide, 0).astype(scale.dtype) * scale[None, None, :]
    scaled = jnp.where(finite, jnp.clip(scaled, -_CLIP, _CLIP), _FAR)
    return jnp.pad(scaled, ((pad, pad), (pad, pad), (0, 0)), constant_values=_FAR)


def _centre(near: _Neighbourhood) -> tuple[Array, Array, Array, Array]:
    """[xbar] as (x, y), at most one pixel out of reach of the frame, and [xbar] - xbar per axis."""
    parts = []
    for axis, padded in ((0, near.there.shape[1]), (1, near.there.shape[0])):
        size = near.motion.shape[1 - axis]
        reach = (padded - size) // 4
        m = jnp.where(_is_number(near.motion), near.motion[..., axis], 0).astype(near.scale.dtype)
        m = jnp.clip(m, -size - reach, size + reach)
        # Rounding the motion, not x - motion, keeps the fraction exact and a uniform motion uniform.
        whole = jax.lax.stop_gradient(jnp.round(m))
        grid = jnp.arange(size, dtype=jnp.int32)
        grid = grid[None, :] if axis == 0 else grid[:, None]
        parts.append((jnp.clip(grid - whole.astype(jnp.int32), -reach - 1, size + reach), m - whole))
    (x, fx), (y, fy) = parts
    return x, y, fx, fy


def _is_number(motion: Float[Array, "h w 2"]) -> Bool[Array, "h w"]:
    return ~(jnp.isnan(motion[..., 0]) | jnp.isnan(motion[..., 1]))


class _Pixel(NamedTuple):
    """What all candidates of a pixel share. It is cheap to compute, so that each loop does it again."""

    corner: Int[Array, "h w *k"]
    """Index of [xbar] in the padded guide."""
    fx: Float[Array, "h w *k"]
    fy: Float[Array, "h w *k"]
    here: list[Float[Array, "h w *k"]]
    usable: Bool[Array, "h w *k"]
    """False where the pixel's own guide or motion is not finite."""


def _pixel(near: _Neighbourhood) -> _Pixel:
    h, w, channels = near.guide.shape
    hp, wp, _ = near.there.shape
    x, y, fx, fy = _centre(near)
    planes = [near.guide[..., c] for c in range(channels)]
    usable = functools.reduce(jnp.logical_and, map(jnp.isfinite, planes)) & _is_number(near.motion)
    here = [
        jnp.clip(jnp.where(usable, plane, 0).astype(near.scale.dtype) * near.scale[c], -_CLIP, _CLIP)
        for c, plane in enumerate(planes)
    ]
    return _Pixel((y + (hp - h) // 2) * wp + x + (wp - w) // 2, fx, fy, here, usable)


def _distance(
    near: _Neighbourhood, pixel: _Pixel, dx: Array | int, dy: Array | int
) -> Float[Array, "h w *k"]:
    """Minus the logarithm of w_x(y) / G(xbar - [xbar]) for y = [xbar] + (dx, dy); never negative."""
    _, wp, channels = near.there.shape
    # Unsigned: a signed index would be tested for being negative.
    row = near.there.reshape(-1, channels).at[(pixel.corner + (dy * wp + dx)).astype(jnp.uint32)]
    there = row.get(mode="promise_in_bounds")
    # |xbar - y|^2 - |xbar - [xbar]|^2, free of cancellation.
    sx, sy = (jnp.asarray(d, near.scale.dtype) for d in (dx, dy))
    distance = (sx * (2 * pixel.fx + sx) + sy * (2 * pixel.fy + sy)) * jnp.square(near.scale_space)
    for c, here in enumerate(pixel.here):
        distance = distance + jnp.square(here - there[..., c])
    return distance


def _select(near: _Neighbourhood, offsets: Int[np.ndarray, "n 2"], count: int) -> list[UInt32[Array, "h w"]]:
    """Numbers of the `count` heaviest candidates, heaviest first, packed into as few words as they need.

    Keys are distances whose last bits are replaced by the candidate's number. One word is one output, which
    lets XLA compile everything here to one loop over pixels that keeps the candidates in registers; several
    outputs would each repeat the gathers.
    """
    bits = _tag_bits(offsets)
    pixel = _pixel(near)
    best = [jnp.full(near.motion.shape[:2], np.float32(3e38))] * count
    for number, (dx, dy) in enumerate(offsets.tolist()):
        distance = (_distance(near, pixel, dx, dy) + _NORMAL).astype(jnp.float32)
        key = jax.lax.bitcast_convert_type(distance, jnp.int32) >> bits << bits
        key = jax.lax.bitcast_convert_type(key | number, jnp.float32)
        for slot in range(count):  # insertion; where() is one instruction here, jnp.minimum is several
            closer = best[slot] < key
            best[slot], key = jnp.where(closer, best[slot], key), jnp.where(closer, key, best[slot])
    tags = [jax.lax.bitcast_convert_type(b, jnp.uint32) & np.uint32((1 << bits) - 1) for b in best]
    per_word = 32 // bits
    tags = [jnp.where(pixel.usable, tag, 0) << np.uint32(i % per_word * bits) for i, tag in enumerate(tags)]
    return [functools.reduce(jnp.bitwise_or, tags[i : i + per_word]) for i in range(0, count, per_word)]


def _unpack(
    words: list[UInt32[Array, "h w"]], offsets: Int[np.ndarray, "n 2"], count: int
) -> tuple[Int[Array, "h w k"], Int[Array, "h w k"]]:
    """The offsets (dx, dy) that the words stand for."""
    bits = _tag_bits(offsets)
    shifts = np.arange(32 // bits, dtype=np.uint32) * np.uint32(bits)
    tags = [(word[..., None] >> shifts[None, None, :]) & np.uint32((1 << bits) - 1) for word in words]
    number = jnp.concatenate(tags, -1)[..., :count] if len(tags) > 1 else tags[0][..., :count]
    return jnp.asarray(offsets[:, 0])[number], jnp.asarray(offsets[:, 1])[number]


def _tag_bits(offsets: Int[np.ndarray, "n 2"]) -> int:
    return max(1, (len(offsets) - 1).bit_length())


def _distances(
    near: _Neighbourhood, words: list[UInt32[Array, "h w"]], offsets: Int[np.ndarray, "n 2"], count: int
) -> Float[Array, "h w k"]:
    """The distances of the selected candidates, differentiable; `_NOWHERE` where the pixel is not usable."""
    pixel = jax.tree.map(lambda a: a[..., None], _pixel(near))
    return jnp.where(pixel.usable, _distance(near, pixel, *_unpack(words, offsets, count)), _NOWHERE)


def _filter(
    value: Float[Array, "h w c"],
    near: _Neighbourhood,
    words: list[UInt32[Array, "h w"]],
    distance: Float[Array, "h w k"],
    offsets: Int[np.ndarray, "n 2"],
) -> tuple[Float[Array, "h w c"], Float[Array, "h w 1"]]:
    """The normalised sum over the selected candidates, and the confidence. Plain differentiable code."""
    h, w, channels = value.shape
    count = distance.shape[-1]
    dtype = np.promote_types(value.dtype, distance.dtype)
    valid = distance[..., :1] < _NOWHERE
    # The first is the heaviest, near-ties apart. The limit only acts on near-ties whose weights are below
    # exp(-10^6). It is not 0, because minimum halves the gradient where both sides are equal.
    nearest = jax.lax.stop_gradient(distance[..., :1])
    weight = jnp.exp(jnp.minimum(nearest - distance, 10))
    weight = jnp.where(valid & (distance < _NOWHERE), weight, 0)
    # Where nothing is valid all distances are equal, so that the first candidate is the centre. Its clamped
    # pixel is the fallback.
    weight = jnp.where(valid | (np.arange(count) > 0)[None, None, :], weight, 1)

    pixels = value.reshape(h * w, channels)
    image, total = jnp.zeros(value.shape, dtype), jnp.zeros((h, w, 1), dtype)
    x, y, _, _ = _centre(near)
    dx, dy = _unpack(words, offsets, count)
    weight = weight.astype(dtype)
    for k in range(count):
        index = jnp.clip(y + dy[..., k], 0, h - 1) * w + jnp.clip(x + dx[..., k], 0, w - 1)
        pixel = pixels.at[index.astype(jnp.uint32)].get(mode="promise_in_bounds").astype(dtype)
        # A pixel of weight 0 may be NaN: where the guide is missing, the colour may be missing too.
        image = image + jnp.where(weight[..., k, None] > 0, pixel, 0) * weight[..., k, None]
        total = total + weight[..., k, None]
    confidence = jnp.where(valid, jnp.exp(-distance[..., :1]), 0)
    return (image / total).astype(value.dtype), confidence
