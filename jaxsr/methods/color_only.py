"""What networks share that see nothing but colour: display-referred images, one scale, the jitter.

    I_J = sRGB(ACES(exposure I))       colour of the jittered LR frame, in [0, 1]         `color_input`
    O_J = net(I_J, ...)                the network knows of no jitter: jittered as I_J is
    O_N(p) = O_J(p - s J)              equation 1 of `jaxsr.ops.jitter`, in HR pixels     `unjittered`

The loss compares O_N with the truth, so the network is trained through that shift. Scene-linear colour is
O_N clipped to [0, 1] and turned back, at most 7.24 / exposure: such networks know no brighter lights.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.ops import from_display, to_display
from jaxsr.ops.resampling import kernel_taps


@dataclass(frozen=True)
class ColorOptions:
    """Settings of such methods."""

    scale: int = 4
    """HR size over LR size, which the layers depend on; `jaxsr train` takes that of the training."""
    unjitter: bool = True
    """Take the jitter out of what the network makes."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions; parameters and losses are float32."""


def color_input(frames: Frame) -> Float[Array, "*b h w 3"]:
    """I_J of one frame, or of many."""
    return to_display(frames.exposed)


def check_scale(frames: Frame, options: ColorOptions) -> None:
    """Raise JaxsrError unless the frames have the scale of the network."""
    if frames.scale != options.scale:
        raise JaxsrError(
            "the network is made for another scale",
            expected=f"frames of scale {options.scale}",
            found=f"scale {frames.scale}",
            fix="choose other weights, or another scale",
        )


def unjittered(
    output: Float[Array, "b H W 3"], jitter_px: Float[Array, "b 2"], options: ColorOptions
) -> Float[Array, "b H W 3"]:
    """O_N, not clipped.

    Args:
        output: O_J.
        jitter_px: J in LR pixels.
        options: of the method.
    """
    if not options.unjitter:
        return output
    return without_jitter(output, options.scale * jitter_px, -(-options.scale // 2))


def without_jitter(
    image: Float[Array, "b H W c"], jitter_px: Float[Array, "b 2"], reach: int
) -> Float[Array, "b H W c"]:
    """`sample_jittered(image, jitter_px, (H, W), "bicubic")`, for jitters of at most `reach` pixels.

    All pixels of an image move by the same amount. So the result is a sum of shifted images along each axis,
    which is faster than a gather, and its gradient much faster than a scatter.
    """
    for axis, shift in ((1, -jitter_px[:, 1]), (2, -jitter_px[:, 0])):
        base = jnp.floor(shift)
        taps = kernel_taps(shift - base, "bicubic")
        width = [(0, 0)] * 4
        width[axis] = (reach + 1, reach + 2)
        padded, total = jnp.pad(image, width, mode="edge"), jnp.zeros_like(image)
        for offset in range(-reach - 1, reach + 3):
            weight = jnp.zeros_like(shift)
            for k, tap in enumerate(taps):
                weight = jnp.where(base + k - 1 == offset, tap, weight)
            first = offset + reach + 1
            moved = jax.lax.slice_in_dim(padded, first, first + image.shape[axis], axis=axis)
            total = total + weight[:, None, None, None] * moved
        image = total
    return image


def to_linear(display: Float[Array, "*b H W 3"], exposure: Float[Array, "*b"]) -> Float[Array, "*b H W 3"]:
    """Scene-linear colour of display-referred colour, clipped to [0, 1]."""
    return from_display(jnp.clip(display, 0, 1)) / exposure[..., None, None, None]
