"""RCAN (Zhang et al., ECCV 2018; METHODS 6): a deep network makes each frame from its colour alone.

    O_J = net(I_J)          `jaxsr.nets.RCAN`; colours and jitter as in `jaxsr.methods.color_only`

It shows what G-buffers and history are worth. A frame that was not rendered is the last output, warped
backward along the HR motion, which is all that the method needs besides colour.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window
from jaxsr.methods.base import Method, Needs, Net, Network, last_frames, module_maker, one_image
from jaxsr.methods.color_only import ColorOptions, check_scale, color_input, to_linear, unjittered
from jaxsr.methods.history import plain_warp
from jaxsr.methods.image_loss import ImageLoss, L1Loss, check_loss, image_loss
from jaxsr.methods.options import check_options, to_json
from jaxsr.nets import RCAN
from jaxsr.nets.rcan import check_sizes
from jaxsr.ops import to_display


@dataclass(frozen=True)
class Options(ColorOptions):
    """Settings of the network; the published ones by default."""

    groups: int = 10
    """Residual groups."""
    blocks: int = 20
    """Residual channel attention blocks per group."""
    features: int = 64
    """Channels."""
    reduction: int = 16
    """Channels over those in the middle of the attention."""


def displayed(net: Callable[..., Array], frames: Frame, options: Options) -> Float[Array, "b H W 3"]:
    """O_N of a batch of frames.

    Raises:
        JaxsrError: frames of another scale.
    """
    check_scale(frames, options)
    return unjittered(net(color_input(frames)), frames.jitter_px, options)


def method(options: Options | None = None, loss: ImageLoss | None = None) -> Method:
    """The network of these settings as a method.

    Args:
        options: of the network.
        loss: weights of the training's loss, L1 by default.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o, weights = options or Options(), loss or L1Loss()
    check_options(o)
    check_loss(weights)
    sizes = {"groups": o.groups, "blocks": o.blocks, "features": o.features, "reduction": o.reduction}
    check_sizes(o.scale, **sizes)

    def new(rngs: nnx.Rngs) -> nnx.Module:
        return RCAN(scale=o.scale, **sizes, dtype=jnp.dtype(o.dtype), rngs=rngs)

    def loss_of(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames, truth = last_frames(window)
        truth = to_display(truth * frames.exposure[..., None, None, None])
        return image_loss(displayed(net, frames, o), truth, weights)

    module, warp = module_maker(new), plain_warp()

    def upscale(net: Net, state: object, frame: Frame) -> tuple[object, Array]:
        if frame.scale == 1:
            return warp.keep(frame.color_linear, frame), frame.color_linear
        one = one_image(frame)
        image = to_linear(displayed(module(net), one, o), one.exposure)[0].astype(frame.color_linear.dtype)
        return warp.keep(image, frame), image

    return Method(
        "rcan",
        "network: the colour of the current frame alone; plain backward warp where nothing was rendered",
        Needs(frozenset({"lr.color"}), warp.needs),
        warp.init,
        upscale,
        warp.extrapolate,
        Network(new, loss_of, settings=to_json(o), loss_settings=to_json(weights)),
    )
