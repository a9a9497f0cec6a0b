"""G-buffer-guided reprojection (ExtraSS, METHODS 3): frames that were never rendered, without a network.

Rendered frames are upscaled by TAAU, so that against plain TAAU only the extrapolation differs. A frame that
has only its G-buffer is made from the previous output I_{t-1}:

    L_{t-1} = I_{t-1} / a_{t-1}                  demodulate: lighting without texture, a = base colour
    L_t     = f_g(L_{t-1})                       four best matches of 33 candidates, guide g = (a, normal)
    I_t     = L_t a_t                            modulate: texture at full sharpness

Disocclusions are filled from the nearest surface with like colour and orientation instead of the occluder.
The output is also the next history, worth less where the match was poor.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.frames import Frame, GBuffer
from jaxsr.methods import taau
from jaxsr.methods._method import Method, by_rendered
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


def guide(gbuffer: GBuffer) -> Float[Array, "H W 6"]:
    """g: base colour and normal."""
    assert gbuffer.base_color is not None  # promised by `needs`
    assert gbuffer.normal is not None
    return jnp.concatenate([gbuffer.base_color, gbuffer.normal], -1)


def method(options: Options | None = None, taau_options: taau.Options | None = None) -> Method:
    """Guided reprojection on top of TAAU."""
    o = options or Options()
    upscaler = taau.method(taau_options)

    def init(frame: Frame) -> State:
        empty = jnp.zeros_like(frame.hr.base_color)
        return State(taau.init(frame), empty, empty)

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        history, image = upscaler.step(net, state.history, frame)
        return State(history, frame.hr.base_color, frame.hr.normal), image

    def extrapolate(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        previous = GBuffer(state.history.depth_linear, frame.hr.motion_px, state.normal, state.base_color)
        lighting, confidence = reproject(
            demodulate(state.history.image, state.base_color),
            frame.hr.motion_px,
            guide(frame.hr),
            guide(previous),
            sigma_guide=o.sigma_guide,
            sigma_space=o.sigma_space,
            strides=o.strides,
            radius=o.radius,
            count=o.count,
        )
        image = modulate(lighting, frame.hr.base_color)
        weight = backward_warp(state.history.weight, frame.hr.motion_px) * confidence
        history = taau.State(image, weight, frame.hr.depth_linear)
        return State(history, frame.hr.base_color, frame.hr.normal), image

    return Method(
        "guided",
        "TAAU; G-buffer-guided reprojection of the lighting where nothing was rendered",
        init,
        by_rendered(init, upscale, extrapolate),
        upscaler.needs | {"hr.base_color", "hr.normal"},
    )
