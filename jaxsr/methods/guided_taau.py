"""Guided temporal upsampling: TAAU of the lighting, with HR G-buffers to say which samples belong together.

The classical TAAU of `jaxsr.methods.taau` with the demodulation and the joint bilateral weights of ExtraSS
(METHODS 3), applied to super-resolution as well:

    L(q)  = I(q) / a_lr(q)                          demodulate the LR samples by the LR base colour
    k(q)  = G(d | kernel_sigma) G(g_hr(p) - g_lr(q) | sigma_guide) G(z_hr(p) - z_lr(q) | slope)
    out   = TAAU of L with kernel k, times a_hr(p)  texture comes from the HR base colour

with g = (base colour, normal) and z = 1 / depth. A sample of another surface weighs next to nothing, so light
does not leak across edges, and textures are as sharp as the G-buffer. Where nothing was rendered it
extrapolates as `jaxsr.methods.guided` does. No network, no training.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer
from jaxsr.methods import guided, taau
from jaxsr.methods.base import Method, Needs
from jaxsr.methods.options import check_options

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
class Options:
    """Constants of the method."""

    upsampling: Upsampling = Upsampling()
    """Of each frame."""
    temporal: taau.Accumulation = taau.Accumulation(  # noqa: RUF009 (frozen)
        sample_sigma=0.7, memory=2.0, box=1.0, light_tolerance=0.1
    )
    """Over time."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        self.upsampling.check()
        self.temporal.check()


def same_surface(gbuffer: GBuffer, options: Upsampling) -> taau.Alike:
    """How alike the surfaces of an HR pixel and of a sample are, from base colour, normal and 1 / depth."""
    inverse = 1 / gbuffer.depth_linear
    tolerance = options.depth_tolerance * inverse + 2 * taau.slope(inverse) + 1e-6
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
    """The LR lighting of a frame, in the working space of TAAU."""
    return taau.to_working(guided.lighting_of(frame.color_linear, frame.lr, options.eps), frame.exposure)


def estimate(frame: Frame, options: Upsampling, sample_sigma: float = 0.7) -> taau.Estimate:
    """What one frame says of the lighting of each HR pixel, in the working space of TAAU.

    Args:
        frame: a rendered frame.
        options: of the upsampling.
        sample_sigma: only the confidence of the estimate depends on it.
    """
    lr = frame.lr
    features = jnp.concatenate([samples(frame, options), guided.guide(lr), 1 / lr.depth_linear], -1)
    return taau.estimate(
        features,
        frame.jitter_px,
        frame.scale,
        same_surface(frame.hr, options),
        kernel_sigma=options.kernel_sigma,
        sample_sigma=sample_sigma,
    )


def method(options: Options | None = None, reprojection: guided.Options | None = None) -> Method:
    """Guided temporal upsampling, and guided reprojection where nothing was rendered.

    Raises:
        JaxsrError: an option out of range.
    """
    o, r = options or Options(), reprojection or guided.Options()
    o.check()
    r.check()
    u = o.upsampling

    def upscale(net: None, state: taau.State, frame: Frame) -> tuple[taau.State, Array]:
        if frame.scale == 1:
            image = frame.color_linear
            weight = jnp.full_like(frame.hr.depth_linear, o.temporal.memory)
            return taau.State(guided.keep(image, frame), weight), image
        last = state.last
        assert last.depth_linear is not None
        now = estimate(frame, u, o.temporal.sample_sigma)
        lighting = guided.lighting_of(last.image, last.gbuffer, u.eps)
        before, weight = taau.fetch_history(
            taau.to_working(lighting, frame.exposure), state, frame, o.temporal
        )
        weight = weight * taau.same_light(samples(frame, u), before, weight, o.temporal)
        blended, weight = taau.accumulate(before, weight, now, o.temporal)
        image = guided.color_of(taau.from_working(blended, frame.exposure), frame.hr, u.eps)
        return taau.State(guided.keep(image, frame), weight), image

    return Method(
        "guided-taau",
        "TAAU of the lighting, weighted by HR G-buffers; guided reprojection where nothing was rendered",
        Needs(BUFFERS | {"lr.color", "hr.motion"}, guided.BUFFERS),
        guided.init,
        upscale,
        lambda net, state, frame: guided.extrapolate(r, state, frame),
    )
