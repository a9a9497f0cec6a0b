"""What a method keeps of the last frame that it made, and the plain way to make the next one from it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.frames import Camera, Frame, GBuffer
from jaxsr.methods.base import Net
from jaxsr.ops import backward_warp


class History(NamedTuple):
    """The last output, and of its frame what later steps compare with. What a method does not use is None."""

    image: Float[Array, "H W 3"]
    """HR linear colour."""
    depth_linear: Float[Array, "H W 1"] | None = None
    base_color: Float[Array, "H W 3"] | None = None
    normal: Float[Array, "H W 3"] | None = None
    camera: Camera | None = None
    jitter_px: Float[Array, "2"] | None = None

    @property
    def gbuffer(self) -> GBuffer:
        """The buffers as a G-buffer without motion."""
        return GBuffer(
            depth_linear=self.depth_linear,  # type: ignore[arg-type]
            normal=self.normal,
            base_color=self.base_color,
        )


def no_image(frame: Frame) -> Float[Array, "H W 3"]:
    """A black image of the size of the output."""
    return jnp.zeros((*frame.size, 3), frame.color_linear.dtype)


class Extrapolation(NamedTuple):
    """A way to make frames that were not rendered from the last output alone."""

    needs: frozenset[str]
    init: Callable[[Frame], Any]
    """The empty history."""
    keep: Callable[[Float[Array, "H W 3"], Frame], Any]
    """The history after an output."""
    extrapolate: Callable[[Net, Any, Frame], tuple[Any, Array]]
    """The step of a method for a frame that was not rendered."""


def plain_warp() -> Extrapolation:
    """The last output, warped backward along the HR motion (bilinear)."""

    def keep(image: Array, frame: Frame) -> History:
        return History(image)

    def extrapolate(net: Net, history: History, frame: Frame) -> tuple[History, Array]:
        image = backward_warp(history.image, frame.hr.motion_px)
        return keep(image, frame), image

    return Extrapolation(frozenset({"hr.motion"}), lambda frame: History(no_image(frame)), keep, extrapolate)
