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

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer, surface
from jaxsr.methods import taau
from jaxsr.methods.accumulation import State
from jaxsr.methods.base import Method, Needs, Net
from jaxsr.methods.history import Extrapolation, History, no_image
from jaxsr.methods.options import check_options
from jaxsr.ops import backward_warp, demodulate, modulate, reproject
from jaxsr.ops.reprojection import DEFAULT_SIGMA_GUIDE, DEFAULT_SIGMA_SPACE

BUFFERS = frozenset({"hr.depth", "hr.motion", "hr.base_color", "hr.normal"})
"""What guided reprojection reads of both frames; depth says what is sky."""
MAX_REACH, MAX_CANDIDATES = 256, 1024
"""Bounds of the neighbourhood: a file of weights could else ask for work without end."""


@dataclass(frozen=True)
class Options:
    """Constants of the reprojection; `experiments/tune_classical.py` measures the sigmas."""

    sigma_guide: float = DEFAULT_SIGMA_GUIDE
    """Standard deviation of differences of base colour and normal."""
    sigma_space: float = DEFAULT_SIGMA_SPACE
    """Standard deviation of the distance to the end of the motion, in pixels."""
    strides: tuple[int, ...] = (1, 3, 5, 9)
    """Spacings of the candidates, in pixels."""
    radius: int = 1
    """Candidates per direction and stride."""
    count: int = 4
    """Candidates that are kept."""
    eps: float = 0.02
    """Smallest base colour that the colour of a surface is divided by."""

    def check(self) -> None:
        """Raise JaxsrError for an option out of range."""
        check_options(self)
        for name in ("sigma_guide", "sigma_space", "count", "eps"):
            if not getattr(self, name) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=0)
        if not self.strides or min(self.strides) < 1:
            raise JaxsrError("bad strides", where="strides", expected="spacings from 1", found=self.strides)
        reach, candidates = self.radius * max(self.strides), len(self.strides) * (2 * self.radius + 1) ** 2
        if reach > MAX_REACH or candidates > MAX_CANDIDATES:
            raise JaxsrError(
                "the neighbourhood is too large",
                where="strides, radius",
                expected=f"at most {MAX_REACH} pixels and {MAX_CANDIDATES} candidates",
                found=f"{reach} and {candidates}",
            )


def surface_of(gbuffer: GBuffer) -> tuple[Float[Array, "*b H W 3"], Float[Array, "*b H W 3"]]:
    """Base colour and normal; the needs of the method promise that they are there."""
    assert gbuffer.base_color is not None
    assert gbuffer.normal is not None
    return gbuffer.base_color, gbuffer.normal


def guide(gbuffer: GBuffer) -> Float[Array, "H W 6"]:
    """g: base colour and normal."""
    return jnp.concatenate(surface_of(gbuffer), -1)


def lighting_of(
    color_linear: Float[Array, "*b H W 3"], gbuffer: GBuffer, eps: float
) -> Float[Array, "*b H W 3"]:
    """Colour over base colour; sky keeps its colour."""
    base_color = gbuffer.base_color
    assert base_color is not None  # as in `surface_of`; normals are not needed here
    return demodulate(color_linear, base_color, surface=surface(gbuffer.depth_linear), eps=eps)


def color_of(lighting: Float[Array, "*b H W 3"], gbuffer: GBuffer, eps: float) -> Float[Array, "*b H W 3"]:
    """The inverse of `lighting_of`."""
    base_color = gbuffer.base_color
    assert base_color is not None
    return modulate(lighting, base_color, surface=surface(gbuffer.depth_linear), eps=eps)


def keep(image: Float[Array, "H W 3"], frame: Frame) -> History:
    """The history after an output: the image and its HR surface, where the frame has one."""
    return History(image, frame.hr.depth_linear, frame.hr.base_color, frame.hr.normal, frame.camera)


def reprojected(
    last: History, frame: Frame, options: Options
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 1"]]:
    """The frame from its G-buffer and the last output alone, and how good the matches were (0 to 1)."""
    settings = asdict(options)
    eps = settings.pop("eps")
    lighting, confidence = reproject(
        lighting_of(last.image, last.gbuffer, eps),
        frame.hr.motion_px,
        guide(frame.hr),
        guide(last.gbuffer),
        **settings,
    )
    return color_of(lighting, frame.hr, eps), confidence


def reprojection(options: Options) -> Extrapolation:
    """Frames that were not rendered by guided reprojection of the last output, for any method."""

    def extrapolate(net: Net, last: History, frame: Frame) -> tuple[History, Array]:
        image, _ = reprojected(last, frame, options)
        return keep(image, frame), image

    return Extrapolation(BUFFERS, no_history, keep, extrapolate)


def no_history(frame: Frame) -> History:
    """The history before the first output."""
    return jax.tree.map(jnp.zeros_like, keep(no_image(frame), frame))


def init(frame: Frame) -> State:
    """An empty history with a surface."""
    last = no_history(frame)
    assert last.depth_linear is not None
    return State(last, last.depth_linear)


def extrapolate(options: Options, state: State, frame: Frame) -> tuple[State, Array]:
    """`reprojected` as the step of a method that has a weighted history: poor matches are worth less."""
    image, confidence = reprojected(state.last, frame, options)
    weight = backward_warp(state.weight, frame.hr.motion_px) * confidence
    return State(keep(image, frame), weight), image


def method(options: Options | None = None, taau_options: taau.Options | None = None) -> Method:
    """Guided reprojection on top of TAAU.

    Raises:
        JaxsrError: an option out of range.
    """
    o = options or Options()
    o.check()
    upscaler = taau.method(taau_options)

    def upscale(net: None, state: State, frame: Frame) -> tuple[State, Array]:
        state, image = upscaler.upscale(net, state, frame)
        return State(keep(state.last.image, frame), state.weight), image

    return Method(
        "guided",
        "TAAU; G-buffer-guided reprojection of the lighting where nothing was rendered",
        Needs(upscaler.needs.rendered, BUFFERS),
        init,
        upscale,
        lambda net, state, frame: extrapolate(o, state, frame),
    )
