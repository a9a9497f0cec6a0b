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
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jaxsr.errors import JaxsrError
from jaxsr.ops._batch import over_batch

DEFAULT_SIGMA_GUIDE = 0.1
"""Standard deviation of guide differences; for guides in [0, 1] or unit normals."""
DEFAULT_SIGMA_SPACE = 1.0
"""Standard deviation of the distance to xbar, in pixels."""

_TINY_SIGMA = 1e-12  # keeps 1/sigma finite
_FAR = 1e15  # guide value of what is not there; its square is finite and beats every clipped difference
_CLIP = 1e12  # scaled guides stay far below _FAR


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
    clamped to the frame (NaN motion: at x), and the confidence is 0.

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
    offsets = candidate_offsets(strides, radius)
    dtype = jnp.promote_types(guide.dtype, jnp.float32)
    inverse_guide = jnp.broadcast_to(_inverse_sigma(sigma_guide, dtype), guide.shape[-1:])
    inverse_space = _inverse_sigma(sigma_space, dtype)

    # Saving what the second pass gathers would cost `count` copies of everything; gathering again is cheap.
    @jax.checkpoint
    def filter_kept(
        value: Array, motion: Array, g: Array, g_prev: Array, words: list[Array]
    ) -> tuple[Array, Array]:
        kept = _unpack(words, len(offsets), min(count, len(offsets)))
        return _filter(value, motion, g.astype(dtype), g_prev.astype(dtype), kept, offsets, scales)

    scales = inverse_guide, inverse_space

    def one(value: Array, motion: Array, g: Array, g_prev: Array) -> tuple[Array, Array]:
        fixed = jax.lax.stop_gradient((motion, g, g_prev, *scales))
        words = _select(*fixed, offsets=offsets, count=min(count, len(offsets)))
        return filter_kept(value, motion, g, g_prev, words)

    return over_batch(one, previous, motion_px, guide, previous_guide)


def candidate_offsets(strides: Sequence[int], radius: int) -> Int[np.ndarray, "n 2"]:
    """The distinct offsets (dx, dy) of N(xbar) from [xbar]: the centre, then stride by stride in row order."""
    steps = range(-radius, radius + 1)
    offsets = {(0, 0): None} | {(k * s, l * s): None for s in strides for l in steps for k in steps}
    return np.array(list(offsets), dtype=np.int32)


def _check(
    previous: Array,
    motion: Array,
    guide: Array,
    previous_guide: Array,
    sigma_shape: tuple[int, ...],
    strides: tuple[int, ...],
    radius: int,
    count: int,
) -> None:
    def fail(what: str, expected: object, found: object) -> None:
        raise JaxsrError(what, where="reproject", expected=expected, found=found)

    shapes = [a.shape for a in (previous, motion, guide, previous_guide)]
    if len({s[:-1] for s in shapes}) != 1:
        fail("image sizes differ", "equal [.., H, W]", shapes)
    if guide.shape != previous_guide.shape or guide.shape[-1] == 0:
        fail("guides differ", "the same channels, at least one", [guide.shape, previous_guide.shape])
    if sigma_shape not in ((), (1,), guide.shape[-1:]):
        fail("sigma_guide does not fit", f"a scalar or [{guide.shape[-1]}]", list(sigma_shape))
    if not strides or min(strides) < 1 or radius < 0 or count < 1:
        fail("bad neighbourhood", "strides >= 1, radius >= 0, count >= 1", (strides, radius, count))


def _inverse_sigma(sigma: Array | float, dtype: jnp.dtype) -> Array:
    """1 / (sqrt(2) sigma): squares of scaled differences are then minus the logarithm of the Gaussian."""
    return np.sqrt(0.5).item() / jnp.maximum(jnp.asarray(sigma, dtype), _TINY_SIGMA)


def _whole_and_fraction(
    motion: Float[Array, "h w 2"], reach: int
) -> tuple[Int[Array, "h w"], Int[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]:
    """[xbar] as (x, y), at most one pixel out of reach of the frame, and [xbar] - xbar per axis.

    Rounding the motion, not x - motion, keeps the fraction exact and a uniform motion uniform.
    """
    h, w, _ = motion.shape
    wholes, fractions = [], []
    for axis, size in ((0, w), (1, h)):
        m = motion[..., axis]
        m = jnp.clip(jnp.where(jnp.isnan(m), 0, m), -(size + reach), size + reach)
        whole = jax.lax.stop_gradient(jnp.round(m))
        grid = jnp.arange(size)[None, :] if axis == 0 else jnp.arange(size)[:, None]
        wholes.append(jnp.clip(grid - whole.astype(jnp.int32), -reach - 1, size + reach))
        fractions.append(m - whole)
    return wholes[0], wholes[1], fractions[0], fractions[1]


def _excess(offset: Array | int, fraction: Array, scale: Array) -> Array:
    """(|xbar - y|^2 - |xbar - [xbar]|^2) / (2 sigma_1^2) along one axis, y = [xbar] + offset; never negative."""
    return (offset * (2 * fraction + offset)) * jnp.square(scale)


def _select(
    motion: Float[Array, "h w 2"],
    guide: Float[Array, "h w g"],
    previous_guide: Float[Array, "h w g"],
    inverse_guide: Float[Array, " g"],
    inverse_space: Float[Array, ""],
    *,
    offsets: Int[np.ndarray, "n 2"],
    count: int,
) -> list[UInt32[Array, "h w"]]:
    """Numbers of the `count` heaviest candidates, heaviest first, packed into as few words as they need.

    One word has one consumer, so XLA makes a single loop over pixels of everything here and keeps the
    candidates in registers; with several outputs it would repeat the gathers for each. What is padded
    around the frame is so far from any guide that no candidate needs a bounds test.
    """
    h, w, channels = guide.shape
    reach = int(np.abs(offsets).max())
    pad, stride = 2 * reach + 1, w + 2 * (2 * reach + 1)
    x, y, fx, fy = _whole_and_fraction(motion.astype(jnp.float32), reach)

    scale = inverse_guide.astype(jnp.float32)
    here = jnp.moveaxis(_finite(guide.astype(jnp.float32), 0.0) * scale[None, None, :], -1, 0)
    there = _finite(previous_guide.astype(jnp.float32), jnp.inf) * scale[None, None, :]
    here, there = (
        jnp.clip(here, -_CLIP, _CLIP),
        jnp.where(there < jnp.inf, jnp.clip(there, -_CLIP, _CLIP), _FAR),
    )
    there = jnp.pad(there, ((pad, pad), (pad, pad), (0, 0)), constant_values=_FAR).reshape(-1, channels)

    # Unsigned: signed indices are tested for being negative at every gather.
    corner = ((y + reach + 1) * stride + (x + reach + 1)).astype(jnp.uint32)
    # The added constant keeps keys out of the denormal numbers, which some processors flush to 0.
    along_x = {dx: _excess(dx, fx, inverse_space.astype(jnp.float32)) + 1e-12 for dx in _distinct(offsets, 0)}
    along_y = {dy: _excess(dy, fy, inverse_space.astype(jnp.float32)) for dy in _distinct(offsets, 1)}
    tag_bits = _tag_bits(len(offsets))

    best = [jnp.full((h, w), np.float32(3e38))] * count
    for number, (dx, dy) in enumerate(offsets.tolist()):
        rows = there.at[corner + np.uint32((dy + reach) * stride + dx + reach)].get(mode="promise_in_bounds")
        distance = along_x[dx] + along_y[dy]
        for c in range(channels):
            distance = distance + jnp.square(here[c] - rows[..., c])
        bits = jax.lax.bitcast_convert_type(distance, jnp.int32)
        key = jax.lax.bitcast_convert_type((bits >> tag_bits << tag_bits) | number, jnp.float32)
        for slot in range(count):  # insertion; a selected comparison is one instruction, jnp.minimum is not
            closer = best[slot] < key
            best[slot], key = jnp.where(closer, best[slot], key), jnp.where(closer, key, best[slot])

    tags = [jax.lax.bitcast_convert_type(b, jnp.uint32) & np.uint32((1 << tag_bits) - 1) for b in best]
    per_word = 32 // tag_bits
    return [
        functools.reduce(
            jnp.bitwise_or, [t << np.uint32(i * tag_bits) for i, t in enumerate(tags[at : at + per_word])]
        )
        for at in range(0, count, per_word)
    ]


def _unpack(words: list[UInt32[Array, "h w"]], candidates: int, count: int) -> list[Int[Array, "h w"]]:
    tag_bits = _tag_bits(candidates)
    per_word, mask = 32 // tag_bits, np.uint32((1 << tag_bits) - 1)
    shifts = [(words[i // per_word], np.uint32(i % per_word * tag_bits)) for i in range(count)]
    return [((word >> shift) & mask).astype(jnp.int32) for word, shift in shifts]


def _filter(
    value: Float[Array, "h w c"],
    motion: Float[Array, "h w 2"],
    guide: Float[Array, "h w g"],
    previous_guide: Float[Array, "h w g"],
    kept: list[Int[Array, "h w"]],
    offsets: Int[np.ndarray, "n 2"],
    scales: tuple[Float[Array, " g"], Float[Array, ""]],
) -> tuple[Float[Array, "h w c"], Float[Array, "h w 1"]]:
    """The normalised sum over the kept candidates, and the confidence. Plain differentiable code."""
    h, w, channels = guide.shape
    inverse_guide, inverse_space = scales
    x, y, fx, fy = _whole_and_fraction(motion.astype(guide.dtype), int(np.abs(offsets).max()))
    usable = jnp.isfinite(guide).all(-1) & ~jnp.isnan(motion).any(-1)
    here = _finite(guide, 0.0)
    values, guides = value.reshape(h * w, -1), previous_guide.reshape(h * w, channels)

    def candidate(number: Array) -> tuple[Array, Array, Array]:
        dx, dy = jnp.asarray(offsets[:, 0])[number], jnp.asarray(offsets[:, 1])[number]
        inside = (x + dx >= 0) & (x + dx < w) & (y + dy >= 0) & (y + dy < h)
        index = jnp.clip(y + dy, 0, h - 1) * w + jnp.clip(x + dx, 0, w - 1)
        row = guides.at[index].get(mode="promise_in_bounds")
        valid = inside & usable & jnp.isfinite(row).all(-1)
        difference = jnp.where(valid[..., None], here - row, 0) * inverse_guide[None, None, :]
        distance = _excess(dx.astype(fx.dtype), fx, inverse_space) + _excess(
            dy.astype(fy.dtype), fy, inverse_space
        )
        for c in range(channels):
            distance = distance + jnp.square(difference[..., c])
        return index, valid, jnp.minimum(distance, 1e30)

    # Where nothing is valid the first slot holds the centre, whose clamped pixel is the fallback.
    kept = [jnp.where(usable, kept[0], 0), *kept[1:]]
    indices, valids, distances = zip(*map(candidate, kept), strict=True)
    any_valid = functools.reduce(jnp.logical_or, valids)
    least = functools.reduce(
        jnp.minimum, [jnp.where(v, d, 1e30) for v, d in zip(valids, distances, strict=True)]
    )
    shift = jax.lax.stop_gradient(least)
    weights = [
        jnp.where(v, jnp.exp(jnp.minimum(shift - d, 0)), 0) for v, d in zip(valids, distances, strict=True)
    ]
    weights[0] = jnp.where(any_valid, weights[0], 1)
    total = functools.reduce(jnp.add, weights)

    image = jnp.zeros(value.shape, total.dtype)
    for weight, valid, index in zip(weights, valids, indices, strict=True):
        row = values.at[index].get(mode="promise_in_bounds").astype(total.dtype)
        used = valid | ~any_valid  # a pixel without a guide may have no colour either: 0 * NaN
        image = image + jnp.where(used[..., None], row, 0) * (weight / total)[..., None]
    confidence = jnp.where(any_valid, jnp.exp(-least), 0)
    return image.astype(value.dtype), confidence[..., None].astype(value.dtype)


def _finite(guide: Float[Array, "h w g"], otherwise: float) -> Float[Array, "h w g"]:
    """A pixel with any channel that is not finite has no guide."""
    return jnp.where(jnp.isfinite(guide).all(-1, keepdims=True), guide, otherwise)


def _distinct(offsets: Int[np.ndarray, "n 2"], axis: int) -> list[int]:
    return sorted(set(offsets[:, axis].tolist()))


def _tag_bits(candidates: int) -> int:
    return max(1, (candidates - 1).bit_length())
