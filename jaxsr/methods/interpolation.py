"""Nearest, bilinear and bicubic upscaling of the current frame: what any better method must beat.

The jitter is taken out: the image is sampled at `x_lr = (x_hr + 0.5) / s - 0.5 - J`. A frame that was not
rendered repeats the last one, which is what a screen does. Linear colour in, linear colour out, not negative.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.frames import Frame
from jaxsr.methods.base import Method, by_rendered
from jaxsr.ops import sample_jittered


def method(mode: str) -> Method:
    """The method of one interpolation: "nearest", "bilinear" or "bicubic"."""

    def init(frame: Frame) -> Float[Array, "H W 3"]:
        return jnp.zeros((*frame.hr.depth_linear.shape[:-1], 3), frame.color_linear.dtype)

    def upscale(net: None, state: Array, frame: Frame) -> tuple[Array, Array]:
        size = frame.hr.depth_linear.shape[-3:-1]
        image = sample_jittered(frame.color_linear, frame.jitter_px, size, mode)
        image = jnp.maximum(image, 0)  # bicubic overshoots
        return image, image

    def hold(net: None, state: Array, frame: Frame) -> tuple[Array, Array]:
        return state, state

    summary = f"{mode} interpolation of the current frame; repeats it where nothing was rendered"
    return Method(mode, summary, init, by_rendered(init, upscale, hold), frozenset({"lr.color"}))
