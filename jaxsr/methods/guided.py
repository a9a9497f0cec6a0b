"""G-buffer-guided reprojection (ExtraSS, METHODS 3): frames that were never rendered, without a network.

Rendered frames are upscaled by TAAU, so that against plain TAAU only the extrapolation differs. A frame that
has only its G-buffer is made from the previous output I_{t-1}:

    L_{t-1} = I_{t-1} / a_{t-1}                  demodulate: lighting without texture, a = base colour
    L_t     = f_g(L_{t-1})                       four best matches of 33 candidates, guide g = (a, normal)
    I_t     = L_t a_t                            modulate: texture at full sharpness

Disocclusions are filled from the nearest surface with like colour and orientation instead of the occluder.
The output is also the next history, worth less where the match was poor.
"""

from dataclasses import asdict, dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.frames import Frame, GBuffer
from jaxsr.methods import taau
from jaxsr.methods.base import Method, by_rendered
from jaxsr.ops import backward_warp, demodulate, modulate, reproject
from jaxsr.ops.reprojection import DEFAULT_SIGMA_GUIDE, DEFAULT_SIGMA_SPACE


@dataclass(frozen=True)
class Options:
    """Constants of the reprojection; sigmas are measured by `experiments/tune_classical.py`."""

    sigma_guide: float = DEFAULT_SIGMA_GUIDE
    sigma_space: float = DEFAULT_SIGMA_SPACE
    strides: tuple[int, ...] = (1, 3, 5, 9)
    radius: int = 1
    count: int = 4


class State(NamedTuple):
    """The history of TAAU, and the HR buffers that its image was made with."""

    history: taau.State
    base_color: Float[Array, "H W 3"]
    normal: Float[Array, "H W 3"]


def surface(gbuffer: GBuffer) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 3"]]:
    """Base colour and normal; `needs` promised that they are there."""
    assert gbuffer.base_color is not None
    assert gbuffer.normal is not None
    return gbuffer.base_color, gbuffer.normal


def guide(gbuffer: GBuffer) -> Float[Array, "H W 6"]:
    """g: base colour and normal."""
    return jnp.concatenate(surface(gbuffer), -1)


def init(frame: Frame) -> State:
    """An empty history."""
    return State(taau.init(frame), *map(jnp.zeros_like, surface(frame.hr)))


def extrapolate(options: Options, state: State, frame: Frame) -> tuple[State, Array]:
    """A frame from its G-buffer and the history alone."""
    previous = GBuffer(state.history.depth_linear, frame.hr.motion_px, state.normal, state.base_color)
    lighting, confidence = reproject(
        demodulate(state.history.image, state.base_color, surface=jnp.isfinite(previous.depth_linear)),
        frame.hr.motion_px,
        guide(frame.hr),
        guide(previous),
        **asdict(options),
    )
    image = modulate(lighting, surface(frame.hr)[0], surface=jnp.isfinite(frame.hr.depth_linear))
    weight = backward_warp(state.history.weight, frame.hr.motion_px) * confidence
    history = taau.State(image, weight, frame.hr.depth_linear)
    return State(history, *surface(frame.hr)), image


def method(options: Options | None = None, taau_options: taau.Options | None = None) -> Method:
    """Guided reprojection on top of TAAU."""
    o = options or Options()
    upscaler = taau.method(taau_options)

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        history, image = upscaler.step(net, state.history, frame)
        return State(history, *surface(frame.hr)), image

    return Method(
        "guided",
        "TAAU; G-buffer-guided reprojection of the lighting where nothing was rendered",
        init,
        by_rendered(init, upscale, lambda net, state, frame: extrapolate(o, state, frame)),
        upscaler.needs | {"hr.base_color", "hr.normal"},
    )
