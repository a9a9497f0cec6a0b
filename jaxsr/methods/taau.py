"""TAAU: temporal anti-aliasing upsampling, the classical method that needs no network (METHODS 1).

Jittered LR frames are accumulated into an HR history. Symbols:

    p       HR pixel,  x = (p + 0.5) / s - 0.5 - J  its place in the jittered LR frame (I_N(p) = I_J(p - J))
    q       the 3 x 3 LR pixels around x,  d = s (q - x)  their distance to p in HR pixels
    h       history at p - MV_N(p), Catmull-Rom                       (equation 2 of the jitter text)
    n       what h is worth: the sum of the weights it has collected, at most `memory`

    c       = sum_q k(d) I(q) / sum_q k(d),   k Gaussian of `kernel_sigma` LR pixels
    beta    = max_q exp(-|d|^2 / (2 sample_sigma^2)): near 1 where a sample falls on p
    h'      = h clipped to the box of the 3 x 3 samples in YCoCg
    n'      = n where depth agrees with the previous frame and p was in view, else 0
    out     = (n' h' + beta c) / (n' + beta),   n <- min(n' + beta, memory)

The average is taken of tone-mapped colour (Reinhard), so that one bright sample does not flicker. A frame
that was not rendered is the history warped backward, unclipped: the plain warp that guided reprojection must
beat.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.frames import Frame
from jaxsr.methods._method import Method, by_rendered
from jaxsr.ops import (
    backward_warp,
    inverse_tone_map,
    rgb_from_ycocg,
    sample,
    tone_map,
    ycocg_from_rgb,
)
from jaxsr.ops.resampling import pixel_grid


@dataclass(frozen=True)
class Options:
    """Constants of TAAU; the defaults are measured by `experiments/tune_classical.py`."""

    kernel_sigma: float = 0.35
    """Reconstruction kernel, in LR pixels."""
    sample_sigma: float = 0.35
    """How near to a pixel a sample must fall to count in full, in HR pixels."""
    floor: float = 0.02
    """Least weight of the current frame: a history is never final."""
    memory: float = 8.0
    """Greatest weight of the history."""
    box: float = 1.25
    """Half-width of the clipping box, in units of the neighbourhood's."""
    depth_tolerance: float = 0.02
    """Relative change of depth from frame to frame that counts as the same surface."""


class State(NamedTuple):
    """The history: linear colour, its weight, and the depth it was seen at."""

    image: Float[Array, "H W 3"]
    weight: Float[Array, "H W 1"]
    depth_linear: Float[Array, "H W 1"]


def init(frame: Frame) -> State:
    """An empty history."""
    depth = frame.hr.depth_linear
    return State(jnp.zeros((*depth.shape[:-1], 3), depth.dtype), jnp.zeros_like(depth), jnp.zeros_like(depth))


def gather_samples(
    image: Float[Array, "h w c"], jitter_px: Float[Array, "2"], scale: int
) -> tuple[Float[Array, "9 H W c"], Float[Array, "9 H W 1"]]:
    """The 3 x 3 LR pixels around each HR pixel, and their squared distance to it in LR pixels.

    Pixels outside the image repeat the border.
    """
    height, width = image.shape[0] * scale, image.shape[1] * scale
    position = (pixel_grid(height, width) + 0.5) / scale - 0.5 - jitter_px[None, None]
    center = jnp.floor(position + 0.5)
    offsets = [(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)]
    samples, distances = [], []
    for offset in offsets:
        at = center + jnp.array(offset, position.dtype)[None, None]
        samples.append(sample(image, at, mode="nearest", boundary="clamp"))
        distances.append(jnp.sum((at - position) ** 2, -1, keepdims=True))
    return jnp.stack(samples), jnp.stack(distances)


def accumulate(
    history: Float[Array, "H W c"],
    weight: Float[Array, "H W 1"],
    samples: Float[Array, "9 H W c"],
    kernel: Float[Array, "9 H W 1"],
    confidence: Float[Array, "H W 1"],
    options: Options,
) -> tuple[Float[Array, "H W c"], Float[Array, "H W 1"]]:
    """Blend the samples of one frame into the history; both are tone-mapped RGB.

    Args:
        weight: n', zero where the history is no good.
        kernel: weight of each sample in the current estimate; all zero is allowed.
        confidence: beta.

    Returns:
        The new history and its weight.
    """
    total = jnp.sum(kernel, 0)
    # With no sample of weight (all kernels underflow) the middle one stands in.
    current = jnp.where(total > 1e-12, jnp.sum(kernel * samples, 0) / jnp.maximum(total, 1e-12), samples[4])
    box = ycocg_from_rgb(samples)
    low, high = jnp.min(box, 0), jnp.max(box, 0)
    middle, half = 0.5 * (low + high), 0.5 * options.box * (high - low)
    clipped = rgb_from_ycocg(jnp.clip(ycocg_from_rgb(history), middle - half, middle + half))
    beta = jnp.maximum(confidence, options.floor)
    blended = (weight * clipped + beta * current) / (weight + beta)
    return blended, jnp.minimum(weight + beta, options.memory)


def fetch_history(
    state: State, frame: Frame, options: Options
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"]]:
    """The history at p - MV, from the taps that saw the same surface, and what it is worth.

    Catmull-Rom where all four bilinear taps agree in depth; their bilinear mean without the others where only
    some do, so that nothing bleeds across a silhouette; weight 0 where none does, out of view, or at a cut.
    Depths are compared as 1 / depth, which is linear across a plane: the tolerance is `depth_tolerance` of it
    plus what the slope of the surface changes it by in one pixel.
    """
    height, width, _ = state.image.shape
    position = pixel_grid(height, width) - frame.hr.motion_px
    base = jnp.floor(position)
    fraction = position - base
    inverse = 1 / frame.hr.depth_linear
    tolerance = options.depth_tolerance * inverse + _slope(inverse) + 1e-6
    packed = jnp.concatenate([state.image, state.weight, 1 / state.depth_linear], -1)
    total = jnp.zeros((height, width, 5), packed.dtype)
    agreeing = jnp.zeros((height, width, 1), packed.dtype)
    all_agree = jnp.ones((height, width, 1), bool)
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at = base + jnp.array((i, j), base.dtype)[None, None]
        tap = sample(packed, at, mode="nearest", boundary="clamp")
        inside = jnp.all(
            (at >= 0) & (at <= jnp.array((width - 1, height - 1), base.dtype)[None, None]), -1, keepdims=True
        )
        agrees = inside & (jnp.abs(tap[..., 4:] - inverse) <= tolerance)
        share = (fraction[..., :1] if i else 1 - fraction[..., :1]) * (
            fraction[..., 1:] if j else 1 - fraction[..., 1:]
        )
        share = jnp.where(agrees, share, 0)
        total = total + share * jnp.where(share > 0, tap, 0)  # an invalid history may hold anything
        agreeing = agreeing + share
        all_agree = all_agree & (agrees | (share == 0))
    some = total / jnp.maximum(agreeing, 1e-6)
    sharp = backward_warp(state.image, frame.hr.motion_px, mode="bicubic")
    image = jnp.where(all_agree & (agreeing > 0.999), sharp, some[..., :3])
    # A few agreeing taps far from p are worth less than four around it.
    return jnp.maximum(image, 0), some[..., 3:4] * agreeing


def _slope(inverse_depth: Float[Array, "H W 1"]) -> Float[Array, "H W 1"]:
    """How much 1 / depth changes from a pixel to the next on the same surface: the smaller of both sides."""
    change = jnp.zeros_like(inverse_depth)
    for axis in (0, 1):
        step = jnp.abs(jnp.diff(inverse_depth, axis=axis))
        ends = [(0, 0)] * 3
        before, after = list(ends), list(ends)
        before[axis], after[axis] = (1, 0), (0, 1)
        change = change + jnp.minimum(
            jnp.pad(step, before, constant_values=jnp.inf), jnp.pad(step, after, constant_values=jnp.inf)
        )
    return jnp.where(jnp.isfinite(change), change, 0)


def method(options: Options | None = None) -> Method:
    """TAAU with these options."""
    o = options or Options()

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        depth = frame.hr.depth_linear
        if frame.scale == 1:  # every pixel was sampled: nothing to accumulate
            image = frame.color_linear
            return State(image, jnp.full_like(depth, o.memory), depth), image
        samples, squared = gather_samples(
            tone_map(frame.color_linear, "reinhard"), frame.jitter_px, frame.scale
        )
        kernel = jnp.exp(-squared / (2 * o.kernel_sigma**2))
        nearest = jnp.min(squared, 0) * frame.scale**2
        confidence = jnp.exp(-nearest / (2 * o.sample_sigma**2))
        history, weight = fetch_history(state, frame, o)
        history = tone_map(history, "reinhard")
        blended, weight = accumulate(history, weight, samples, kernel, confidence, o)
        image = inverse_tone_map(jnp.clip(blended, 0, 0.9999), "reinhard")
        return State(image, weight, depth), image

    def extrapolate(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        image = jnp.maximum(backward_warp(state.image, frame.hr.motion_px, mode="bilinear"), 0)
        _, weight = fetch_history(state, frame, o)
        return State(image, weight, frame.hr.depth_linear), image

    return Method(
        "taau",
        "temporal upsampling of jittered frames; plain backward warp where nothing was rendered",
        init,
        by_rendered(init, upscale, extrapolate),
        frozenset({"lr.color", "hr.depth", "hr.motion"}),
    )
