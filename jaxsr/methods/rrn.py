"""RRN (Isobe et al., BMVC 2020; METHODS 6): a recurrent network makes each frame from colour and its past.

    O_J,t, h_t = net(I_J,t-1, I_J,t, h_{t-1}, O_J,t-1)      `jaxsr.nets.RRN`; colours as in `_color`

What it feeds back is its own output as it is, neither warped, nor clipped, nor with the jitter taken out, as
published. At a cut h and O are 0, and the frame counts as its own predecessor, for there is no other.

The network sees rendered frames alone: the previous one of them, however long ago. A frame that was not
rendered is the last picture shown, warped backward by the HR motion: all that it needs besides colour.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window
from jaxsr.methods._color import ColorOptions, check_scale, color_input, shown, to_linear
from jaxsr.methods._network import check_options, image_loss, last_output
from jaxsr.methods.base import Loss, Method, Net, by_rendered
from jaxsr.nets import RRN
from jaxsr.nets.blocks import check_counts
from jaxsr.nets.rrn import check_sizes
from jaxsr.ops import to_display


@dataclass(frozen=True)
class Options(ColorOptions):
    """What is fixed when a network is made; recorded in its file of weights."""

    blocks: int = 10
    """Residual blocks: 10 in the paper's larger network, 5 in its smaller one."""
    features: int = 128
    """Channels, of the hidden state as well."""
    frames: int = 4
    """Of a window in training; the loss is the mean over all of them, the first of which has no past."""


class Past(NamedTuple):
    """What the network remembers, display-referred: I_J,t-1, h_{t-1} and O_J,t-1."""

    color: Float[Array, "*b h w 3"]
    hidden: Float[Array, "*b h w n"]
    output: Float[Array, "*b H W 3"]


class State(NamedTuple):
    """The network's past, and the last picture, for frames that were not rendered."""

    past: Past
    last: Any


def beginning(frames: Frame, options: Options) -> Past:
    """The past of a first frame, or of many."""
    color = color_input(frames)
    hidden = jnp.zeros((*color.shape[:-1], options.features), jnp.float32)
    return Past(color, hidden, jnp.zeros((*frames.hr.depth_linear.shape[:-1], 3), jnp.float32))


def displayed(
    net: Callable[..., Any], past: Past, frames: Frame, options: Options
) -> tuple[Past, Float[Array, "b H W 3"]]:
    """A batch of frames through the network: what it remembers then, and O_N.

    Raises:
        JaxsrError: frames of another scale.
    """
    check_scale(frames, options)
    color = color_input(frames)
    output, hidden = net(past.color, color, past.hidden, past.output)
    return Past(color, hidden, output), shown(output, frames.jitter_px, options)


def loss_of(options: Options) -> Loss:
    """L1 on display-referred colour, and what else is asked for, over all frames of the window."""

    def loss(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), window.frames)  # time leads
        past = beginning(jax.tree.map(lambda x: x[0], frames), options)
        _, images = jax.lax.scan(lambda past, now: displayed(net, past, now, options), past, frames)
        truth = to_display(window.truth_linear * window.frames.exposure[..., None, None, None])
        images, truth = (x.reshape(-1, *x.shape[2:]) for x in (jnp.moveaxis(images, 0, 1), truth))
        return image_loss(images, truth, options)

    return loss


def method(options: Options | None = None) -> Method:
    """The network of these options as a method.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o = options or Options()
    check_options(o)
    check_sizes(o.scale, o.blocks, o.features)
    check_counts(frames=o.frames)
    init_last, keep, extrapolate_last = last_output(False)

    def new_net(rngs: nnx.Rngs) -> nnx.Module:
        return RRN(scale=o.scale, blocks=o.blocks, features=o.features, dtype=jnp.dtype(o.compute), rngs=rngs)

    def init(frame: Frame) -> State:
        return State(beginning(frame, o), init_last(frame))

    def upscale(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        if frame.scale == 1:
            return State(state.past, keep(frame.color_linear, frame)), frame.color_linear
        model = nnx.merge(nnx.graphdef(nnx.eval_shape(lambda: new_net(nnx.Rngs(0)))), net)
        past, one = jax.tree.map(lambda x: jnp.asarray(x)[None], (state.past, frame))
        past, made = displayed(model, past, one, o)
        # A broken pixel is seen once: in the past, NaN would stay and spread until the next cut.
        past = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x[0]), x[0], 0), past)
        image = to_linear(made, one.exposure)[0]
        return State(past, keep(image, frame)), image

    def extrapolate(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        last, image = extrapolate_last(net, state.last, frame)
        return State(state.past, last), image

    return Method(
        "rrn",
        "recurrent network: the colour of two frames; plain backward warp where nothing was rendered",
        init,
        by_rendered(init, upscale, extrapolate),
        frozenset({"lr.color", "hr.motion"}),
        new_net=new_net,
        loss=loss_of(o),
        window=o.frames,
        arguments=asdict(o),
    )
