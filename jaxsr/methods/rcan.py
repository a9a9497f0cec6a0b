"""RCAN (Zhang et al., ECCV 2018; METHODS 6): a deep network makes each frame from its colour alone.

    O_J = net(I_J)          `jaxsr.nets.RCAN`; colours and jitter as in `jaxsr.methods._color`

What G-buffers and history are worth is seen against it. A frame that was not rendered is the last output
warped backward by the HR motion: all that it needs besides colour.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window
from jaxsr.methods._color import ColorOptions, check_scale, color_input, shown, to_linear
from jaxsr.methods._network import check_options, image_loss, last_output
from jaxsr.methods.base import Loss, Method, Net, by_rendered
from jaxsr.nets import RCAN
from jaxsr.nets.rcan import check_sizes
from jaxsr.ops import to_display


@dataclass(frozen=True)
class Options(ColorOptions):
    """What is fixed when a network is made; recorded in its file of weights."""

    groups: int = 10
    """Residual groups."""
    blocks: int = 20
    """Residual channel attention blocks of each group."""
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
    return shown(net(color_input(frames)), frames.jitter_px, options)


def loss_of(options: Options) -> Loss:
    """L1 on display-referred colour, and what else is asked for."""

    def loss(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames = jax.tree.map(lambda x: x[:, -1], window.frames)
        truth = to_display(window.truth_linear[:, -1] * frames.exposure[..., None, None, None])
        return image_loss(displayed(net, frames, options), truth, options)

    return loss


def method(options: Options | None = None) -> Method:
    """The network of these options as a method.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o = options or Options()
    check_options(o)
    sizes = {"groups": o.groups, "blocks": o.blocks, "features": o.features, "reduction": o.reduction}
    check_sizes(o.scale, **sizes)
    init, keep, extrapolate = last_output(False)

    def new_net(rngs: nnx.Rngs) -> nnx.Module:
        return RCAN(scale=o.scale, **sizes, dtype=jnp.dtype(o.compute), rngs=rngs)

    def upscale(net: Net, state: object, frame: Frame) -> tuple[object, Array]:
        if frame.scale == 1:
            return keep(frame.color_linear, frame), frame.color_linear
        model = nnx.merge(nnx.graphdef(nnx.eval_shape(lambda: new_net(nnx.Rngs(0)))), net)
        one = jax.tree.map(lambda x: jnp.asarray(x)[None], frame)
        image = to_linear(displayed(model, one, o), one.exposure)[0]
        return keep(image, frame), image

    return Method(
        "rcan",
        "network: the colour of the current frame alone; plain backward warp where nothing was rendered",
        init,
        by_rendered(init, upscale, extrapolate),
        frozenset({"lr.color", "hr.motion"}),
        new_net=new_net,
        loss=loss_of(o),
        arguments=asdict(o),
    )
