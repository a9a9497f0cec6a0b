"""TAAU: temporal anti-aliasing upsampling, the classical method that needs no network (METHODS 1).

Jittered LR frames are accumulated into an HR history. Symbols:

    p       HR pixel,  x = (p + 0.5) / s - 0.5 - J  its place in the jittered LR frame   (equation 1)
    q       the 3 x 3 LR pixels around x,  d = q - x  their distance in LR pixels
    h       history at p - MV_N(p), Catmull-Rom                                         (equation 2)
    n       what h is worth: the sum of the weights it has collected, at most `memory`

    c       = sum_q k(d) I(q) / sum_q k(d),   k Gaussian of `kernel_sigma`
    beta    = max(max_q exp(-|s d|^2 / (2 sample_sigma^2)), floor): 1 where a sample falls on p
    h'      = h clipped to the box of the 3 x 3 samples in YCoCg
    n'      = n times the bilinear share of the taps at p - MV_N(p) whose depth agrees: 0 in disocclusions;
              times a factor that falls where the light has changed
    out     = (n' h' + beta c) / (n' + beta),   n <- min(n' + beta, memory)

Equations are those of `jaxsr.ops.jitter`; motion says where to look, depth whether to trust what is there.
A tap agrees if it has the depth that the point of p had in the previous view (`jaxsr.ops.previous_depth`), as
the two cameras tell. Where a camera is not known, or the object moves, its present depth will do as well.

Light that changes is seen as a ratio of means: of the luma of the current samples, and of the history in the
same block of LR pixels. Sampling noise averages out in each mean; in a mean of ratios it would not.

The average is taken of exposed, tone-mapped colour (Reinhard), so that one bright sample does not flicker,
and the unit of radiance does not matter. A frame that was not rendered is the history warped backward,
unclipped: the plain warp that guided reprojection must beat.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods.base import Method, Needs
from jaxsr.methods.history import History, no_image
from jaxsr.methods.options import check_options
from jaxsr.ops import (
    backward_warp,
    inverse_tone_map,
    previous_depth,
    rgb_from_ycocg,
    tone_map,
    ycocg_from_rgb,
)
from jaxsr.ops.resampling import gather_pixels, kernel_taps, pixel_grid, upsample


@dataclass(frozen=True)
class Accumulation:
    """Constants of the accumulation over time.

    `experiments/tune_classical.py` searches them. Those of light, and the tolerance of depth, were chosen on
    one clip of each scene of the training set.
    """

    sample_sigma: float = 0.4
    """How near to a pixel a sample must fall to count in full, in HR pixels."""
    floor: float = 0.02
    """Least weight of the current frame: a history is never final."""
    memory: float = 4.0
    """Greatest weight of the history."""
    box: float = 1.25
    """Half-width of the clipping box, in units of the neighbourhood's."""
    depth_tolerance: float = 0.01
    """Relative difference from the predicted depth that counts as the same surface."""
    light_block: int = 4
    """Half the side of the blocks in which light is compared, in LR pixels."""
    light_tolerance: float = 0.2
    """Change of the mean luma of a block, as a natural logarithm, that halves the weight of the history."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        check_options(self)
        for name in ("sample_sigma", "floor", "memory", "light_tolerance"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)


@dataclass(frozen=True)
class Options(Accumulation):
    """Constants of TAAU."""

    kernel_sigma: float = 0.35
    """Reconstruction kernel, in LR pixels."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        super().check()
        if not self.kernel_sigma > 0:
            raise JaxsrError("bad kernel_sigma", where="kernel_sigma", expected="a number above 0", found=0)


class State(NamedTuple):
    """The history, and what each of its pixels is worth."""

    last: History
    """The last output, and the depth that it was seen at; `guided` keeps its surface as well."""
    weight: Float[Array, "H W 1"]


def init(frame: Frame) -> State:
    """An empty history."""
    depth = jnp.zeros_like(frame.hr.depth_linear)
    camera = jax.tree.map(jnp.zeros_like, frame.camera)
    return State(History(no_image(frame), depth_linear=depth, camera=camera), depth)


def keep(image: Float[Array, "H W 3"], frame: Frame) -> History:
    """The history after an output."""
    return History(image, frame.hr.depth_linear, camera=frame.camera)


def to_working(color_linear: Float[Array, "H W 3"], exposure: Float[Array, ""]) -> Float[Array, "H W 3"]:
    """Where colours are averaged and clipped: YCoCg of exposed and tone-mapped colour."""
    return ycocg_from_rgb(tone_map(color_linear * exposure, "reinhard"))


def from_working(color: Float[Array, "H W 3"], exposure: Float[Array, ""]) -> Float[Array, "H W 3"]:
    """The inverse of `to_working`, not negative; exposed, at most 9999."""
    return inverse_tone_map(jnp.clip(rgb_from_ycocg(color), 0, 0.9999), "reinhard") / exposure


class Estimate(NamedTuple):
    """What one frame says of each HR pixel, in working space."""

    color: Float[Array, "H W 3"]
    low: Float[Array, "H W 3"]
    high: Float[Array, "H W 3"]
    """The box of the samples that count."""
    confidence: Float[Array, "H W 1"]
    """beta."""


Alike = Callable[[Float[Array, "H W g"]], Float[Array, "H W 1"]]


def estimate(
    image: Float[Array, "h w c"],
    jitter_px: Float[Array, "2"],
    scale: int,
    alike: Alike,
    *,
    kernel_sigma: float,
    sample_sigma: float,
) -> Estimate:
    """Reduce the 3 x 3 LR samples around each HR pixel; samples outside the image repeat the border.

    Args:
        image: colour in working space, then whatever `alike` wants to see of a sample.
        jitter_px: J in LR pixels.
        scale: HR size over LR size.
        alike: log of how likely a sample is to show the surface of the pixel, at most 0.
        kernel_sigma, sample_sigma: see `Options`.
    """
    (h, w), c = (image.shape[0] * scale, image.shape[1] * scale), 3
    y = (jnp.arange(h, dtype=image.dtype) + 0.5) / scale - 0.5 - jitter_px[1]
    x = (jnp.arange(w, dtype=image.dtype) + 0.5) / scale - 0.5 - jitter_px[0]
    middle_y, middle_x = jnp.floor(y + 0.5), jnp.floor(x + 0.5)

    def taps(values: Array, j: Array) -> Iterator[tuple[Array, Array]]:
        at_y = middle_y + j.astype(image.dtype)
        line = values[jnp.clip(at_y, 0, image.shape[0] - 1).astype(jnp.int32)]
        for i in (-1, 0, 1):
            columns = jnp.clip(middle_x + i, 0, image.shape[1] - 1).astype(jnp.int32)
            squared = ((at_y - y) ** 2)[:, None, None] + ((middle_x + i - x) ** 2)[None, :, None]
            yield line[:, columns], squared

    def log_kernel(squared: Array, log_alike: Array) -> Array:
        return log_alike - squared / (2 * kernel_sigma**2)

    # Loops over rows, not unrolled sums: XLA would gather anew for every result that uses a sample.
    def most(best: tuple[Array, Array], j: Array) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        found = []
        for features, squared in taps(image[..., c:], j):
            log_alike = alike(features)
            best = jnp.maximum(best[0], log_kernel(squared, log_alike)), jnp.maximum(best[1], log_alike)
            found.append(log_alike)
        return best, tuple(found)

    def add(carry: tuple[Array, ...], row: tuple[Array, Any]) -> tuple[tuple[Array, ...], None]:
        total, color, low, high, confidence = carry
        j, found = row
        for (values, squared), log_alike in zip(taps(image[..., :c], j), found, strict=True):
            # Relative to the best: where every sample is of another surface, the least bad one counts.
            weight = jnp.exp(log_kernel(squared, log_alike) - best)
            total, color = total + weight, color + weight * values
            counts = log_alike >= best_alike - 3.0
            low = jnp.minimum(low, jnp.where(counts, values, jnp.inf))
            high = jnp.maximum(high, jnp.where(counts, values, -jnp.inf))
            hit = jnp.exp(log_alike - squared * scale**2 / (2 * sample_sigma**2))
            confidence = jnp.maximum(confidence, hit)
        return (total, color, low, high, confidence), None

    rows = jnp.array((-1, 0, 1))
    one, three = jnp.zeros((h, w, 1), image.dtype), jnp.zeros((h, w, c), image.dtype)
    (best, best_alike), found = jax.lax.scan(most, (one - jnp.inf, one - jnp.inf), rows)
    start: tuple[Array, ...] = (one, three, three + jnp.inf, three - jnp.inf, one)
    total, color, low, high, confidence = jax.lax.scan(add, start, (rows, found))[0]
    return Estimate(color / total, low, high, confidence)


def accumulate(
    history: Float[Array, "H W 3"], weight: Float[Array, "H W 1"], now: Estimate, options: Accumulation
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"]]:
    """Blend the estimate of one frame into the history, which is worth `weight` (n'), in working space.

    A history that is NaN (a broken pixel came in) counts for nothing, so that it does not spread.

    Returns:
        The new history and its weight.
    """
    lost = jnp.any(jnp.isnan(history), -1, keepdims=True) | jnp.isnan(weight)
    history, weight = jnp.where(lost, now.color, history), jnp.where(lost, 0, weight)
    middle, half = 0.5 * (now.low + now.high), 0.5 * options.box * (now.high - now.low)
    clipped = jnp.clip(history, middle - half, middle + half)
    beta = jnp.maximum(now.confidence, options.floor)
    blended = (weight * clipped + beta * now.color) / (weight + beta)
    return blended, jnp.minimum(weight + beta, options.memory)


def fetch_history(
    history: Float[Array, "H W c"],
    state: State,
    frame: Frame,
    options: Accumulation,
) -> tuple[Float[Array, "H W c"], Float[Array, "H W 1"]]:
    """The history at p - MV, from the taps that saw the same surface, and what it is worth.

    Catmull-Rom where all four bilinear taps agree in depth; their bilinear mean without the others where only
    some do, so that nothing bleeds across a silhouette; weight 0 where none does or out of view. Depths are
    compared as 1 / depth, which is linear across a plane: the tolerance is `depth_tolerance` of it plus what
    the slope of the surface changes it by in one pixel.

    Args:
        history: the image of the state, in any space.
        state: what it is worth, and the depth and the camera of its frame.
        frame: the current one.
        options: of TAAU.
    """
    weight, before = state.weight, state.last
    assert before.depth_linear is not None
    height, width, channels = history.shape
    motion = frame.hr.motion_px
    position = pixel_grid(height, width) - jnp.nan_to_num(motion)
    base = jnp.clip(jnp.floor(position), -2, jnp.array((width, height), motion.dtype)[None, None])
    fraction = position - base
    inverse = 1 / frame.hr.depth_linear
    expected = frame.hr.depth_linear
    if frame.camera is not None and before.camera is not None:
        expected = previous_depth(expected, frame.camera, before.camera)
    expected = jnp.where(expected > 0, 1 / expected, inverse)  # it was behind the eye: no tap shows it
    tolerance = options.depth_tolerance * inverse + slope(inverse) + 1e-6
    packed = jnp.concatenate([history, weight, 1 / before.depth_linear], -1)

    weights_x = kernel_taps(fraction[..., :1], "bicubic")
    weights_y = jnp.stack(kernel_taps(fraction[..., 1:], "bicubic"))

    def add_row(carry: tuple[Array, ...], j: Array) -> tuple[tuple[Array, ...], None]:
        sharp, total, agreeing = carry
        at_y = base[..., 1] + j.astype(base.dtype)
        y = jnp.clip(at_y, 0, height - 1)
        hat_y = jnp.maximum(1 - jnp.abs(j.astype(base.dtype) - fraction[..., 1:]), 0)
        row = jnp.zeros_like(sharp)
        for i in range(-1, 3):
            at_x = base[..., 0] + i
            x = jnp.clip(at_x, 0, width - 1)
            tap = gather_pixels(packed, x.astype(jnp.int32), y.astype(jnp.int32))
            row = row + weights_x[i + 1] * tap[..., :channels]
            if i in (0, 1):
                inside = ((at_x == x) & (at_y == y))[..., None]
                off = jnp.minimum(jnp.abs(tap[..., -1:] - expected), jnp.abs(tap[..., -1:] - inverse))
                agrees = inside & (off <= tolerance)
                hat_x = fraction[..., :1] if i else 1 - fraction[..., :1]
                share = jnp.where(agrees, hat_x * hat_y, 0)
                total, agreeing = total + share * tap[..., :-1], agreeing + share
        return (sharp + weights_y[j + 1] * row, total, agreeing), None

    # A loop over rows, not an unrolled sum: XLA would gather anew for every channel of the result.
    start: tuple[Array, ...] = (
        jnp.zeros_like(history),
        jnp.zeros_like(packed[..., :-1]),
        jnp.zeros_like(weight),
    )
    sharp, total, agreeing = jax.lax.scan(add_row, start, jnp.arange(-1, 3))[0]
    some = total / jnp.maximum(agreeing, 1e-6)
    # A few agreeing taps far from p are worth less than four around it.
    return jnp.where(agreeing > 0.999, sharp, some[..., :-1]), some[..., -1:] * agreeing


def same_light(
    samples: Float[Array, "h w 3"],
    history: Float[Array, "H W 3"],
    weight: Float[Array, "H W 1"],
    options: Accumulation,
) -> Float[Array, "H W 1"]:
    """How far the history still has the light of the current samples: 1 where it has, towards 0 elsewhere.

    Args:
        samples: of the current frame, in working space.
        history: where the motion leads, in working space.
        weight: of the history; where it is 0 the pixel does not count.
        options: of TAAU.
    """
    h, w = samples.shape[:2]
    scale = history.shape[0] // h
    counts = ((weight > 0) & jnp.isfinite(history[..., :1])).astype(history.dtype)

    def cells(x: Array) -> Array:  # the mean over the HR pixels of each LR pixel
        return x.reshape(h, scale, w, scale, 1).mean((1, 3))

    def blocks(x: Array) -> Array:
        side = 2 * options.light_block + 1
        x = jax.lax.reduce_window(x, np.zeros((), x.dtype), jax.lax.add, (side, 1, 1), (1, 1, 1), "SAME")
        return jax.lax.reduce_window(x, np.zeros((), x.dtype), jax.lax.add, (1, side, 1), (1, 1, 1), "SAME")

    share = cells(counts)
    now = blocks(jnp.where(jnp.isfinite(samples[..., :1]), samples[..., :1], 0) * share)
    then = blocks(cells(jnp.where(counts > 0, history[..., :1], 0)))
    # The black level keeps the ratio of two dark blocks from being noise.
    black = 0.01 * blocks(share) + 1e-6
    change = jnp.log((now + black) / (then + black))
    return upsample(jnp.exp2(-((change / options.light_tolerance) ** 2)), scale, "bilinear")


def slope(inverse_depth: Float[Array, "H W 1"]) -> Float[Array, "H W 1"]:
    """Change of 1 / depth from a pixel to the next of its surface: per axis the smaller of both sides."""
    change = jnp.zeros_like(inverse_depth)
    for axis in (0, 1):
        step = jnp.abs(jnp.diff(inverse_depth, axis=axis))
        ends = [(0, 0)] * 3
        before, after = list(ends), list(ends)
        before[axis], after[axis] = (1, 0), (0, 1)
        least = jnp.minimum(
            jnp.pad(step, before, constant_values=jnp.inf), jnp.pad(step, after, constant_values=jnp.inf)
        )
        change = change + jnp.where(jnp.isfinite(least), least, 0)  # an axis of one pixel has no neighbours
    return change


def _all_alike(features: Float[Array, "H W g"]) -> Float[Array, "H W 1"]:
    return jnp.zeros((*features.shape[:2], 1), features.dtype)


def method(options: Options | None = None) -> Method:
    """TAAU with these options.

    Raises:
        JaxsrError: an option out of range.
    """
    o = options or Options()
    o.check()

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        depth = frame.hr.depth_linear
        if frame.scale == 1:  # every pixel was sampled: nothing to accumulate
            image = frame.color_linear
            return State(keep(image, frame), jnp.full_like(depth, o.memory)), image
        color = to_working(frame.color_linear, frame.exposure)
        now = estimate(
            color,
            frame.jitter_px,
            frame.scale,
            _all_alike,
            kernel_sigma=o.kernel_sigma,
            sample_sigma=o.sample_sigma,
        )
        before, weight = fetch_history(to_working(state.last.image, frame.exposure), state, frame, o)
        weight = weight * same_light(color, before, weight, o)
        blended, weight = accumulate(before, weight, now, o)
        image = from_working(blended, frame.exposure)
        return State(keep(image, frame), weight), image

    def extrapolate(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        image = backward_warp(state.last.image, frame.hr.motion_px, mode="bilinear")
        _, weight = fetch_history(state.last.image[..., :0], state, frame, o)
        return State(keep(image, frame), weight), image

    geometry = frozenset({"hr.depth", "hr.motion"})
    return Method(
        "taau",
        "temporal upsampling of jittered frames; plain backward warp where nothing was rendered",
        Needs(geometry | {"lr.color"}, geometry),
        init,
        upscale,
        extrapolate,
    )
