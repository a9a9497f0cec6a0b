"""Guided temporal upsampling: HR G-buffers say how the light of the LR samples falls on each HR pixel.

Classical TAAU (`jaxsr.methods.taau`) has one sample per LR pixel and frame. HR G-buffers give one per HR
pixel: demodulation and joint bilateral weights, as ExtraSS has them (METHODS 3), carry the light of the LR
samples to it. Two histories are accumulated, both as `jaxsr.methods.accumulation` describes. The first is
that of the lighting:

    L(q)  = I(q) / a_lr(q)                          demodulate the LR samples by the LR base colour
    k(q)  = G(d | kernel_sigma) G(g_hr(p) - g_lr(q) | sigma_guide) G(z_hr(p) - z_lr(q) | slope)
    C     = TAAU of L with kernel k, times a_hr(p)  texture comes from the HR base colour

with g = (base colour, normal) and z = 1 / depth. A sample of another surface weighs next to nothing, so light
does not leak across edges, and textures are as sharp as the G-buffer. But C is what lies at the centre of
each pixel: it is as aliased as the G-buffer. The second history, that of the image, removes this:

    c     = mean of C(q) and I(q') near p           q: the 3 x 3 HR pixels around p, at q + J_hr
                                                    q': the nearest LR sample, at its place in the HR image
    beta  = the sum of their weights                Gaussians of `pixel_sigma`, and of `sample_sigma`
    b     = mean of C with `smooth_sigma`

The samples lie beside p, and so does the centre m of their weights: c is moved to p by the slope of b, c - b'
m.

The HR buffers are best jittered themselves, by J_hr (`Frame.hr_jitter_px`), as those of an engine are that
renders them with the jittered projection: then also an image at rest is sampled at many places in each pixel.
What the filter gets wrong (highlights, light that changes within few pixels) the LR samples put right over
time.

Where nothing was rendered, C is made by guided reprojection (`jaxsr.methods.guided`) of the last C, and
enters the history of the image in the same way. No network, no training.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer
from jaxsr.methods import accumulation, guided, taau
from jaxsr.methods.accumulation import (
    Accumulation,
    Estimate,
    accumulate,
    fetch_history,
    from_working,
    is_moving,
    same_light,
    slope,
    to_working,
)
from jaxsr.methods.base import Method, Needs
from jaxsr.methods.history import History, no_image
from jaxsr.methods.options import check_options
from jaxsr.ops import backward_warp

BUFFERS = frozenset(
    f"{place}.{layer}" for place in ("lr", "hr") for layer in ("depth", "base_color", "normal")
)
"""What the weights of the samples compare."""


@dataclass(frozen=True)
class Upsampling:
    """Constants of the joint bilateral upsampling of one frame, within 0.15 dB of the best that
    `experiments/tune_classical.py` finds."""

    kernel_sigma: float = 0.5
    """Reconstruction kernel, in LR pixels."""
    sigma_guide: float = 0.3
    """Standard deviation of the difference of base colour and normal between an HR pixel and an LR sample."""
    depth_tolerance: float = 0.05
    """Relative difference of 1 / depth between an HR pixel and an LR sample of the same surface."""
    eps: float = 0.02
    """Smallest base colour that the colour of a surface is divided by."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        check_options(self)
        for name in ("kernel_sigma", "sigma_guide", "depth_tolerance", "eps"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)


@dataclass(frozen=True)
class Antialiasing(Accumulation):
    """Constants of the history of the image."""

    pixel_sigma: float = 0.32
    """How near to a pixel an HR sample must fall to count in full, in HR pixels."""
    smooth_sigma: float = 0.69
    """The wider kernel, in HR pixels."""
    sample_weight: float = 4.0
    """Of an LR sample that falls on a pixel; an HR sample has 1."""
    sample_sigma: float = 0.55
    floor: float = 0.001
    memory: float = 5.0
    rest_memory: float = 3.0
    box: float = 1.4
    rest_box: float = 8.0
    smooth: float = 2.0
    centred: float = 1.0
    """Share of the slope of b that moves the mean of the samples from their place to that of the pixel."""
    depth_tolerance: float = 0.05
    dilated: bool = True

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        super().check()
        for name in ("pixel_sigma", "smooth_sigma"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)


@dataclass(frozen=True)
class Options:
    """Constants of the method."""

    upsampling: Upsampling = Upsampling(kernel_sigma=0.4)
    """Of each frame."""
    temporal: Accumulation = Accumulation(  # noqa: RUF009 (frozen)
        sample_sigma=1.05, floor=0.006, memory=0.5, box=1.6, light_tolerance=0.1
    )
    """Of the lighting, over time."""
    antialiasing: Antialiasing = Antialiasing()
    """Of the image, over time."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        for part in (self.upsampling, self.temporal, self.antialiasing):
            part.check()


class State(NamedTuple):
    """Both histories."""

    last: History
    """C, with its surface, its camera, and the jitter of its HR buffers, in HR pixels."""
    weight: Float[Array, "H W 1"]
    """What the lighting of C is worth."""
    image: Float[Array, "H W 3"]
    """The history of the image, linear."""
    worth: Float[Array, "H W 1"]
    """What it is worth."""


def same_surface(gbuffer: GBuffer, options: Upsampling) -> taau.Alike:
    """How alike the surfaces of an HR pixel and of a sample are, from base colour, normal and 1 / depth."""
    inverse = 1 / gbuffer.depth_linear
    tolerance = options.depth_tolerance * inverse + 2 * slope(inverse) + 1e-6
    features = guided.guide(gbuffer)
    scale = jnp.concatenate([jnp.full_like(features, 1 / options.sigma_guide), 1 / tolerance], -1)
    own = jnp.concatenate([features, inverse], -1)

    def alike(sample: Float[Array, "H W 7"]) -> Float[Array, "H W 1"]:
        squares = ((sample - own) * scale) ** 2
        # Written out: a reduction over so few channels is slow on CPUs.
        total = squares[..., :1]
        for i in range(1, squares.shape[-1]):
            total = total + squares[..., i : i + 1]
        return -0.5 * total

    return alike


def samples(frame: Frame, options: Upsampling) -> Float[Array, "h w 3"]:
    """The LR lighting of a frame, in working space."""
    return to_working(guided.lighting_of(frame.color_linear, frame.lr, options.eps), frame.exposure)


def estimate(frame: Frame, options: Upsampling, sample_sigma: float = 0.7) -> Estimate:
    """What one frame says of the lighting that each HR pixel of the G-buffer sees, in working space.

    Args:
        frame: a rendered frame.
        options: of the upsampling.
        sample_sigma: only the confidence of the estimate depends on it.
    """
    lr = frame.lr
    features = jnp.concatenate([samples(frame, options), guided.guide(lr), 1 / lr.depth_linear], -1)
    return taau.estimate(
        features,
        frame.jitter_px - frame.hr_jitter_px / frame.scale,
        frame.scale,
        same_surface(frame.hr, options),
        kernel_sigma=options.kernel_sigma,
        sample_sigma=sample_sigma,
    )


def keep(image: Float[Array, "H W 3"], frame: Frame) -> History:
    """The history after C."""
    return guided.keep(image, frame)._replace(jitter_px=frame.hr_jitter_px)


def init(frame: Frame) -> State:
    """Empty histories."""
    nothing = no_image(frame)
    last = jax.tree.map(jnp.zeros_like, keep(nothing, frame))
    return State(last, nothing[..., :1], nothing, nothing[..., :1])


def between_jittered(frame: Frame, last: History) -> Frame:
    """The frame with the motion that leads from its HR samples to those of the history."""
    assert last.jitter_px is not None
    motion = frame.hr.motion_px + (last.jitter_px - frame.hr_jitter_px)[None, None]
    return frame._replace(hr=frame.hr._replace(motion_px=motion))


def lit(state: State, frame: Frame, options: Options) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"]]:
    """C of a rendered frame, linear, and what its lighting is worth."""
    u, o, last = options.upsampling, options.temporal, state.last
    now = estimate(frame, u, o.sample_sigma)
    lighting = guided.lighting_of(last.image, last.gbuffer, u.eps)
    before, weight = fetch_history(
        to_working(lighting, frame.exposure),
        accumulation.State(last, state.weight),
        between_jittered(frame, last),
        o,
    )
    weight = weight * same_light(samples(frame, u), before, weight, o)
    blended, weight, _ = accumulate(before, weight, now, o)
    return guided.color_of(from_working(blended, frame.exposure), frame.hr, u.eps), weight


def pixels(
    color: Float[Array, "H W 3"],
    frame: Frame,
    options: Antialiasing,
    trust: Float[Array, "H W 1"] | None = None,
) -> Estimate:
    """What the HR samples, and in a rendered frame the LR samples, say of each pixel of the output.

    Args:
        color: C, linear.
        frame: of it.
        options: constants.
        trust: what each HR sample is worth, 1 by default.
    """
    color = to_working(color, frame.exposure)
    jitter = frame.hr_jitter_px - jnp.round(frame.hr_jitter_px)
    shift = -jnp.round(frame.hr_jitter_px).astype(jnp.int32)
    total, sum_, wide, smooth = (jnp.zeros_like(x) for x in (color[..., :1], color, color[..., :1], color))
    offset = jnp.zeros_like(color[..., :2])
    low, high = jnp.full_like(color, jnp.inf), jnp.full_like(color, -jnp.inf)
    values = color if trust is None else jnp.concatenate([color, trust], -1)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            tap = _shifted(values, dy + shift[1], dx + shift[0])
            sample, worth = tap[..., :3], 1.0 if trust is None else tap[..., 3:]
            squared = (dx + jitter[0]) ** 2 + (dy + jitter[1]) ** 2
            near = worth * jnp.exp(-squared / (2 * options.pixel_sigma**2))
            total, sum_ = total + near, sum_ + near * sample
            offset = offset + near * jnp.stack([dx + jitter[0], dy + jitter[1]])[None, None]
            near = jnp.exp(-squared / (2 * options.smooth_sigma**2))
            wide, smooth = wide + near, smooth + near * sample
            low, high = jnp.minimum(low, sample), jnp.maximum(high, sample)
    smooth = smooth / wide
    if trust is None:
        sample, weight, away = nearest_sample(frame, options)
        total, sum_, offset = total + weight, sum_ + weight * sample, offset + weight * away
    if options.centred:
        slope_x, slope_y = _slopes(smooth)
        sum_ = sum_ - options.centred * (slope_x * offset[..., :1] + slope_y * offset[..., 1:])
    color = jnp.where(total > 1e-6, sum_ / jnp.maximum(total, 1e-6), smooth)
    return Estimate(color, low, high, total, smooth)


def nearest_sample(
    frame: Frame, options: Antialiasing
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"], Float[Array, "H W 2"]]:
    """The LR sample nearest to each HR pixel, in working space, its weight, and its way from the pixel."""
    image, scale = to_working(frame.color_linear, frame.exposure), frame.scale

    def nearest(axis: int) -> tuple[Array, Array]:  # index of the sample, and square of its distance
        at = (jnp.arange(frame.size[axis], dtype=image.dtype) + 0.5) / scale - 0.5 - frame.jitter_px[1 - axis]
        index = jnp.clip(jnp.round(at), 0, image.shape[axis] - 1)
        return index.astype(jnp.int32), scale * (index - at)

    (rows, down), (columns, right) = nearest(0), nearest(1)
    away = jnp.stack(jnp.meshgrid(right, down), -1)
    squared = jnp.sum(away**2, -1, keepdims=True)
    weight = options.sample_weight * jnp.exp(-squared / (2 * options.sample_sigma**2))
    return image[rows][:, columns], weight, away


def antialiased(
    color: Float[Array, "H W 3"],
    weight: Float[Array, "H W 1"],
    state: State,
    frame: Frame,
    options: Antialiasing,
    trust: Float[Array, "H W 1"] | None = None,
) -> tuple[State, Float[Array, "H W 3"]]:
    """The next state and the output, from C and what its lighting is worth; `trust` is for `pixels`."""
    last = state.last._replace(image=state.image)
    before, count = fetch_history(
        to_working(state.image, frame.exposure), accumulation.State(last, state.worth), frame, options
    )
    now = pixels(color, frame, options, trust)
    history, count, image = accumulate(before, count, now, options, is_moving(frame.hr.motion_px))
    kept = from_working(history, frame.exposure)
    return State(keep(color, frame), weight, kept, count), from_working(image, frame.exposure)


def _slopes(image: Float[Array, "H W c"]) -> tuple[Float[Array, "H W c"], Float[Array, "H W c"]]:
    """Change per pixel along x and y, by central differences."""
    across = jnp.pad(image, ((0, 0), (1, 1), (0, 0)), mode="edge")
    along = jnp.pad(image, ((1, 1), (0, 0), (0, 0)), mode="edge")
    slopes = 0.5 * (across[:, 2:] - across[:, :-2]), 0.5 * (along[2:] - along[:-2])
    return jnp.nan_to_num(slopes[0]), jnp.nan_to_num(
        slopes[1]
    )  # a broken pixel has no slope for its neighbours


def _shifted(image: Float[Array, "H W c"], dy: Array, dx: Array) -> Float[Array, "H W c"]:
    """The pixel at p + (dx, dy); beyond the border the last one."""
    h, w = image.shape[:2]
    rows = jnp.clip(jnp.arange(h) + dy, 0, h - 1)
    columns = jnp.clip(jnp.arange(w) + dx, 0, w - 1)
    return image[rows][:, columns]


def method(options: Options | None = None, reprojection: guided.Options | None = None) -> Method:
    """Guided temporal upsampling, and guided reprojection where nothing was rendered.

    Raises:
        JaxsrError: an option out of range.
    """
    o, r = options or Options(), reprojection or guided.Options()
    o.check()
    r.check()

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        if frame.scale == 1:
            image, full = frame.color_linear, jnp.ones_like(frame.hr.depth_linear)
            light, count = o.temporal.memory * full, o.antialiasing.memory * full
            return State(keep(image, frame), light, image, count), image
        color, weight = lit(state, frame, o)
        return antialiased(color, weight, state, frame, o.antialiasing)

    def extrapolate(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        moved = between_jittered(frame, state.last)
        color, trust = guided.reprojected(state.last, moved, r)
        weight = backward_warp(state.weight, moved.hr.motion_px) * trust
        if frame.scale == 1:
            return State(keep(color, frame), weight, color, weight), color
        return antialiased(color, weight, state, frame, o.antialiasing, trust)

    return Method(
        "guided-taau",
        "TAAU with one guided sample per HR pixel; guided reprojection where nothing was rendered",
        Needs(BUFFERS | {"lr.color", "hr.motion"}, guided.BUFFERS, hr_jitter=True),
        init,
        upscale,
        extrapolate,
    )
