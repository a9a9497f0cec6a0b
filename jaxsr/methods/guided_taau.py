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

from jaxsr.frames import Frame, GBuffer
from jaxsr.methods import guided, taau
from jaxsr.methods.base import Method, by_rendered
from jaxsr.ops import demodulate, modulate


@dataclass(frozen=True)
class Options:
    """Constants, within 0.15 dB of the best that `experiments/tune_classical.py` finds."""

    sigma_guide: float = 0.3
    """Standard deviation of the difference of base colour and normal between an HR pixel and an LR sample."""
    temporal: taau.Options = taau.Options(  # noqa: RUF009 (frozen)
        kernel_sigma=0.5, sample_sigma=0.7, memory=2.0, box=1.0
    )


def same_surface(gbuffer: GBuffer, sigma_guide: float) -> taau.Alike:
    """How alike the surface of an HR pixel and a sample's are, from base colour, normal and 1 / depth."""
    inverse = 1 / gbuffer.depth_linear
    tolerance = 0.05 * inverse + 2 * taau.slope(inverse) + 1e-6
    scale = jnp.concatenate([jnp.full_like(guided.guide(gbuffer), 1 / sigma_guide), 1 / tolerance], -1)
    own = jnp.concatenate([guided.guide(gbuffer), inverse], -1)

    def alike(features: Float[Array, "H W 7"]) -> Float[Array, "H W 1"]:
        squares = ((features - own) * scale) ** 2
        # Written out: a reduction over so few channels is slow on CPUs.
        total = squares[..., :1]
        for i in range(1, squares.shape[-1]):
            total = total + squares[..., i : i + 1]
        return -0.5 * total

    return alike


def estimate(frame: Frame, options: Options) -> taau.Estimate:
    """What one frame says of the lighting of each HR pixel, in the working space of TAAU."""
    lr = frame.lr
    lighting = demodulate(frame.color_linear, guided.surface(lr)[0], surface=jnp.isfinite(lr.depth_linear))
    lighting = taau.to_working(lighting, frame.exposure)
    features = jnp.concatenate([lighting, guided.guide(lr), 1 / lr.depth_linear], -1)
    alike = same_surface(frame.hr, options.sigma_guide)
    return taau.estimate(features, frame.jitter_px, frame.scale, options.temporal, alike)


def method(options: Options | None = None, reprojection: guided.Options | None = None) -> Method:
    """Guided temporal upsampling, and guided reprojection where nothing was rendered."""
    o = options or Options()
    r = reprojection or guided.Options()

    def upscale(net: None, state: guided.State, frame: Frame) -> tuple[guided.State, Array]:
        hr = frame.hr
        if frame.scale == 1:
            image = frame.color_linear
            history = taau.State(image, jnp.full_like(hr.depth_linear, o.temporal.memory), hr.depth_linear)
            return guided.State(history, *guided.surface(hr)), image
        now = estimate(frame, o)
        previous = state.history
        lighting = demodulate(previous.image, state.base_color, surface=jnp.isfinite(previous.depth_linear))
        before, weight = taau.fetch_history(
            taau.to_working(lighting, frame.exposure),
            previous.weight,
            previous.depth_linear,
            frame,
            o.temporal,
        )
        blended, weight = taau.accumulate(before, weight, now, o.temporal)
        lighting = taau.from_working(blended, frame.exposure)
        image = modulate(lighting, guided.surface(hr)[0], surface=jnp.isfinite(hr.depth_linear))
        return guided.State(taau.State(image, weight, hr.depth_linear), *guided.surface(hr)), image

    return Method(
        "guided-taau",
        "TAAU of the lighting, weighted by HR G-buffers; guided reprojection where nothing was rendered",
        guided.init,
        by_rendered(guided.init, upscale, lambda net, state, frame: guided.extrapolate(r, state, frame)),
        frozenset(f"lr.{k}" for k in ("color", "depth", "base_color", "normal"))
        | frozenset(f"hr.{k}" for k in ("depth", "motion", "base_color", "normal")),
    )
