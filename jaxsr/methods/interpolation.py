"""Nearest, bilinear and bicubic upscaling of the current frame: what any better method must beat.

The jitter is taken out: the image is sampled at `x_lr = (x_hr + 0.5) / s - 0.5 - J`. What is interpolated is
exposed colour under a tone map (`jaxsr.ops.encoding.compress_lighting`), as an image is resized for the eye:
in linear light one bright sample would outshine its neighbours. A frame that was not rendered repeats the
last one, which is what a screen does. Linear colour in, linear colour out, not negative.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxsr.frames import Frame
from jaxsr.methods.base import Method, Needs
from jaxsr.methods.history import no_image
from jaxsr.ops import sample_jittered
from jaxsr.ops.encoding import compress_lighting, expand_lighting


def method(mode: str) -> Method:
    """The method of one interpolation: "nearest", "bilinear" or "bicubic"."""

    def upscale(net: None, state: Array, frame: Frame) -> tuple[Array, Array]:
        if frame.scale == 1:
            return frame.color_linear, frame.color_linear
        toned = sample_jittered(compress_lighting(frame.exposed), frame.jitter_px, frame.size, mode)
        image = expand_lighting(jnp.maximum(toned, 0)) / frame.exposure  # bicubic overshoots
        return image, image

    def hold(net: None, state: Array, frame: Frame) -> tuple[Array, Array]:
        return state, state

    return Method(
        mode,
        f"{mode} interpolation of the current frame; repeats it where nothing was rendered",
        Needs(frozenset({"lr.color"})),
        no_image,
        upscale,
        hold,
    )
