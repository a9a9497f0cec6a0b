"""TAAU: temporal anti-aliasing upsampling, the classical method that needs no network (METHODS 1).

Jittered LR frames are accumulated into an HR history, as `jaxsr.methods.accumulation` describes. Here

    p       HR pixel,  x = (p + 0.5) / s - 0.5 - J  its place in the jittered LR frame   (equation 1)
    q       the 3 x 3 LR pixels around x,  d = q - x  their distance in LR pixels

    c       = sum_q k(d) I(q) / sum_q k(d),   k Gaussian of `kernel_sigma`
    beta    = max(max_q exp(-|s d|^2 / (2 sample_sigma^2)), floor): 1 where a sample falls on p
    b       = c with `smooth_sigma` instead

Equations are those of `jaxsr.ops.jitter`; motion says where to look, depth whether to trust what is there.
A frame that was not rendered is the history warped backward, unclipped: the plain warp that guided
reprojection must beat.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods.accumulation import (
    Accumulation,
    Estimate,
    State,
    accumulate,
    fetch_history,
    from_working,
    is_moving,
    same_light,
    to_working,
)
from jaxsr.methods.base import Method, Needs
from jaxsr.methods.history import History, no_image
from jaxsr.ops import backward_warp

ALIKE = -3.0
"""Log of the likeness from which a sample shows the surface of a pixel."""
ANY = 10.0
"""Beyond all colours in working space: a box from -ANY to ANY clips nothing."""


@dataclass(frozen=True)
class Options(Accumulation):
    """Constants of TAAU."""

    sample_sigma: float = 0.6
    memory: float = 8.0
    rest_memory: float = 2.0
    box: float = 1.6
    rest_box: float = 5.0
    smooth: float = 0.1
    depth_tolerance: float = 0.05
    dilated: bool = True
    kernel_sigma: float = 0.28
    """Reconstruction kernel, in LR pixels."""
    smooth_sigma: float = 0.6
    """The wider kernel, in LR pixels."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        super().check()
        for name in ("kernel_sigma", "smooth_sigma"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)


def init(frame: Frame) -> State:
    """An empty history."""
    depth = jnp.zeros_like(frame.hr.depth_linear)
    camera = jax.tree.map(jnp.zeros_like, frame.camera)
    return State(History(no_image(frame), depth_linear=depth, camera=camera), depth)


def keep(image: Float[Array, "H W 3"], frame: Frame) -> History:
    """The history after an output."""
    return History(image, frame.hr.depth_linear, camera=frame.camera)


Alike = Callable[[Float[Array, "H W g"]], Float[Array, "H W 1"]]


def estimate(
    image: Float[Array, "h w c"],
    jitter_px: Float[Array, "2"],
    scale: int,
    alike: Alike,
    *,
    kernel_sigma: float,
    sample_sigma: float,
    smooth_sigma: float = 0.5,
) -> Estimate:
    """Reduce the 3 x 3 LR samples around each HR pixel; samples outside the image repeat the border.

    Args:
        image: colour in working space, then whatever `alike` wants to see of a sample.
        jitter_px: J in LR pixels.
        scale: HR size over LR size.
        alike: log of how likely a sample is to show the surface of the pixel, at most 0.
        kernel_sigma, sample_sigma, smooth_sigma: see `Options`.
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
        total, color, low, high, confidence, wide, smooth = carry
        j, found = row
        for (values, squared), log_alike in zip(taps(image[..., :c], j), found, strict=True):
            # Relative to the best: where every sample is of another surface, the least bad one counts.
            weight = jnp.exp(log_kernel(squared, log_alike) - best)
            total, color = total + weight, color + weight * values
            weight = jnp.exp(log_alike - best_alike - squared / (2 * smooth_sigma**2))
            wide, smooth = wide + weight, smooth + weight * values
            counts = log_alike >= best_alike + ALIKE
            low = jnp.minimum(low, jnp.where(counts, values, jnp.inf))
            high = jnp.maximum(high, jnp.where(counts, values, -jnp.inf))
            hit = jnp.exp(log_alike - squared * scale**2 / (2 * sample_sigma**2))
            confidence = jnp.maximum(confidence, hit)
        return (total, color, low, high, confidence, wide, smooth), None

    rows = jnp.array((-1, 0, 1))
    one, three = jnp.zeros((h, w, 1), image.dtype), jnp.zeros((h, w, c), image.dtype)
    (best, best_alike), found = jax.lax.scan(most, (one - jnp.inf, one - jnp.inf), rows)
    start: tuple[Array, ...] = (one, three, three + jnp.inf, three - jnp.inf, one, one, three)
    total, color, low, high, confidence, wide, smooth = jax.lax.scan(add, start, (rows, found))[0]
    # Where no sample shows the surface of the pixel, they say nothing against its history.
    strange = best_alike < ALIKE
    low, high = jnp.where(strange, -ANY, low), jnp.where(strange, ANY, high)
    return Estimate(color / total, low, high, confidence, smooth / wide)


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
            smooth_sigma=o.smooth_sigma,
        )
        before, weight = fetch_history(to_working(state.last.image, frame.exposure), state, frame, o)
        weight = weight * same_light(color, before, weight, o)
        history, weight, image = accumulate(before, weight, now, o, is_moving(frame.hr.motion_px))
        kept = from_working(history, frame.exposure)
        return State(keep(kept, frame), weight), from_working(image, frame.exposure)

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
