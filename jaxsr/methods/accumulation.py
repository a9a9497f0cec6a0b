"""Accumulation of jittered frames over time: what TAAU and the guided methods share (METHODS 1).

What one frame says of each HR pixel (`Estimate`) is blended into the history. Symbols:

    h       history at p - MV(p), Catmull-Rom; n what it is worth, the sum of the weights it has collected
    c, beta the colour of the current samples that fall on p, and their weight
    b       the mean of the samples around p under a wider kernel, free of aliasing but soft
    h'      = h clipped to the box of the samples around p, in YCoCg
    n'      = n times the bilinear share of the taps at p - MV(p) whose depth agrees: 0 in disocclusions;
              times a factor that falls where the light has changed

    new     = (n' h' + beta c) / (n' + beta),     n <- min(n' + beta, memory)
    image   = (n new + smooth b) / (n + smooth)

The history is `new`. The image is softened by b as far as the history is worth little, so that a pixel with
few samples is smooth instead of jagged. b never enters the history, which therefore converges.

Every step along a motion reads the history between its pixels, and light and visibility change on the way: so
memory is short where the image moves. At rest it may be long, and the box wide.

A tap agrees if it has the depth that the point of p had in the previous view (`jaxsr.ops.previous_depth`), as
the two cameras tell. Where a camera is not known, or the object moves, its present depth will do as well.

Light that changes is seen as a ratio of means: of the luma of the current samples, and of the history in the
same block of LR pixels. Sampling noise averages out in each mean; in a mean of ratios it would not.

The average is taken of exposed, tone-mapped colour (Reinhard), so that one bright sample does not flicker,
and the unit of radiance does not matter.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods.history import History
from jaxsr.methods.options import check_options
from jaxsr.ops import (
    dilate_motion,
    inverse_tone_map,
    previous_depth,
    rgb_from_ycocg,
    tone_map,
    ycocg_from_rgb,
)
from jaxsr.ops.resampling import gather_pixels, kernel_taps, pixel_grid, upsample

MOVING_PX = 0.5
"""Motion in HR pixels from which an image counts as moving; between it and 0 it is at rest in part."""


@dataclass(frozen=True)
class Accumulation:
    """Constants of the accumulation over time; `experiments/tune_classical.py` searches them."""

    sample_sigma: float = 0.4
    """How near to a pixel a sample must fall to count in full, in HR pixels."""
    floor: float = 0.02
    """Least weight of the current frame: a history is never final."""
    memory: float = 4.0
    """Greatest weight of the history where the image moves."""
    rest_memory: float = 1.0
    """Factor on `memory` at rest."""
    box: float = 1.25
    """Half-width of the clipping box, in units of the neighbourhood's, where the image moves."""
    rest_box: float = 1.0
    """Factor on `box` at rest."""
    smooth: float = 0.0
    """Weight of the mean under the wider kernel in the image."""
    depth_tolerance: float = 0.01
    """Relative difference from the predicted depth that counts as the same surface."""
    dilated: bool = False
    """Whether the history follows the nearest surface of the 3 x 3 pixels around p, as silhouettes must
    that are mixed with what lies behind them."""
    light_block: int = 4
    """Half the side of the blocks in which light is compared, in LR pixels."""
    light_tolerance: float = 0.2
    """Change of the mean luma of a block, as a natural logarithm, that halves the weight of the history."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        check_options(self)
        for name in ("sample_sigma", "floor", "memory", "rest_memory", "rest_box", "light_tolerance"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)


class State(NamedTuple):
    """The history, and what each of its pixels is worth."""

    last: History
    """The last output, and the depth that it was seen at; `guided` keeps its surface as well."""
    weight: Float[Array, "H W 1"]


class Estimate(NamedTuple):
    """What one frame says of each HR pixel, in working space."""

    color: Float[Array, "H W 3"]
    low: Float[Array, "H W 3"]
    high: Float[Array, "H W 3"]
    """The box of the samples that count."""
    confidence: Float[Array, "H W 1"]
    """beta."""
    smooth: Float[Array, "H W 3"]
    """b."""


def to_working(color_linear: Float[Array, "H W 3"], exposure: Float[Array, ""]) -> Float[Array, "H W 3"]:
    """Where colours are averaged and clipped: YCoCg of exposed and tone-mapped colour."""
    return ycocg_from_rgb(tone_map(color_linear * exposure, "reinhard"))


def from_working(color: Float[Array, "H W 3"], exposure: Float[Array, ""]) -> Float[Array, "H W 3"]:
    """The inverse of `to_working`, not negative; exposed, at most 9999."""
    return inverse_tone_map(jnp.clip(rgb_from_ycocg(color), 0, 0.9999), "reinhard") / exposure


def accumulate(
    history: Float[Array, "H W 3"],
    weight: Float[Array, "H W 1"],
    now: Estimate,
    options: Accumulation,
    moving: Float[Array, "H W 1"] | float = 1.0,
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"], Float[Array, "H W 3"]]:
    """Blend the estimate of one frame into the history, which is worth `weight` (n'), in working space.

    A history that is NaN (a broken pixel came in) counts for nothing, so that it does not spread.

    Args:
        history, weight: h and n', as `fetch_history` gives them.
        now: of the current frame.
        options: constants.
        moving: 0 at rest to 1, as `is_moving` tells.

    Returns:
        The new history, its weight, and the image.
    """
    lost = jnp.any(jnp.isnan(history), -1, keepdims=True) | jnp.isnan(weight)
    history, weight = jnp.where(lost, now.color, history), jnp.where(lost, 0, weight)
    at_rest = 1 - moving
    box = options.box * (1 + (options.rest_box - 1) * at_rest)
    memory = options.memory * (1 + (options.rest_memory - 1) * at_rest)
    middle, half = 0.5 * (now.low + now.high), 0.5 * box * (now.high - now.low)
    clipped = jnp.clip(history, middle - half, middle + half)
    beta = jnp.maximum(now.confidence, options.floor)
    blended = (weight * clipped + beta * now.color) / (weight + beta)
    weight = jnp.minimum(weight + beta, memory)
    image = (weight * blended + options.smooth * now.smooth) / (weight + options.smooth)
    return blended, weight, image


def is_moving(motion_px: Float[Array, "H W 2"]) -> Float[Array, "H W 1"]:
    """0 where the image is at rest, 1 where it moves by `MOVING_PX` or more."""
    square = jnp.sum(jnp.nan_to_num(motion_px) ** 2, -1, keepdims=True)
    return jnp.clip(jnp.sqrt(square + 1e-12) / MOVING_PX, 0, 1)


def followed(frame: Frame, last: History, options: Accumulation) -> tuple[Frame, History]:
    """Frame and history with the depth and motion that the history follows: dilated, or as they are."""
    if not options.dilated:
        return frame, last
    assert last.depth_linear is not None
    depth, motion = dilate_motion(frame.hr.depth_linear, frame.hr.motion_px)
    before, _ = dilate_motion(last.depth_linear, jnp.zeros_like(motion))
    hr = frame.hr._replace(depth_linear=depth, motion_px=motion)
    return frame._replace(hr=hr), last._replace(depth_linear=before)


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
        options: constants.
    """
    frame, before = followed(frame, state.last, options)
    weight = state.weight
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
        options: constants.
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
