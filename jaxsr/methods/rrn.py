"""RRN (Isobe et al., BMVC 2020; METHODS 6): a recurrent network makes each frame from colour and its past.

    O_J,t, h_t = net(I_J,t-1, I_J,t, h_{t-1}, O_J,t-1)      `jaxsr.nets.RRN`; colours as in `color_only`

What it feeds back is its own output as it is, neither warped, nor clipped, nor with the jitter taken out, as
published. At a reset h and O are 0, and the frame counts as its own predecessor, since there is no other.

The network sees only rendered frames: the previous one of them, however long ago. A frame that was not
rendered is the last output, warped backward along the HR motion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window
from jaxsr.methods.base import Method, Needs, Net, Network, Windows, module_maker, one_image
from jaxsr.methods.color_only import ColorOptions, check_scale, color_input, to_linear, unjittered
from jaxsr.methods.history import History, plain_warp
from jaxsr.methods.image_loss import ImageLoss, L1Loss, check_loss, image_loss
from jaxsr.methods.options import check_options, to_json
from jaxsr.nets import RRN
from jaxsr.nets.blocks import check_counts
from jaxsr.nets.rrn import check_sizes
from jaxsr.ops import to_display


@dataclass(frozen=True)
class Options(ColorOptions):
    """Settings of the network; the published ones by default."""

    blocks: int = 10
    """Residual blocks: 10 in the paper's larger network, 5 in its smaller one."""
    features: int = 128
    """Channels, of the hidden state as well."""


@dataclass(frozen=True)
class Loss(L1Loss):
    """The published loss: L1 over all frames of a window."""

    frames: int = 4
    """Frames per window; the loss is the mean over all of them. The first has no past."""


class Past(NamedTuple):
    """What the network remembers, display-referred: I_J,t-1, h_{t-1} and O_J,t-1."""

    color: Float[Array, "*b h w 3"]
    hidden: Float[Array, "*b h w n"]
    output: Float[Array, "*b H W 3"]


class State(NamedTuple):
    """The network's past, and the last output, for frames that were not rendered."""

    past: Past
    last: History


def first_past(frames: Frame, options: Options) -> Past:
    """The past of a first frame, or of a batch of them."""
    color = color_input(frames).astype(jnp.float32)
    hidden = jnp.zeros((*color.shape[:-1], options.features), jnp.float32)
    return Past(color, hidden, jnp.zeros((*color.shape[:-3], *frames.size, 3), jnp.float32))


def displayed(
    net: Callable[..., Any], past: Past, frames: Frame, options: Options
) -> tuple[Past, Float[Array, "b H W 3"]]:
    """A batch of frames through the network: what it remembers then, and O_N.

    Raises:
        JaxsrError: frames of another scale.
    """
    check_scale(frames, options)
    color = color_input(frames).astype(jnp.float32)
    output, hidden = net(past.color, color, past.hidden, past.output)
    jitter_px = frames.jitter_px.astype(jnp.float32)
    return Past(color, hidden, output), unjittered(output, jitter_px, options)


def method(options: Options | None = None, loss: ImageLoss | None = None) -> Method:
    """The network of these settings as a method.

    Args:
        options: of the network.
        loss: weights of the training's loss, and the length of its windows.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o, weights = options or Options(), loss or Loss()
    check_options(o)
    check_loss(weights)
    check_sizes(o.scale, o.blocks, o.features)
    length = getattr(weights, "frames", Loss.frames)
    check_counts(frames=length)

    def new(rngs: nnx.Rngs) -> nnx.Module:
        return RRN(scale=o.scale, blocks=o.blocks, features=o.features, dtype=jnp.dtype(o.dtype), rngs=rngs)

    def loss_of(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), window.frames)  # time leads
        past = first_past(jax.tree.map(lambda x: x[0], frames), o)
        _, images = jax.lax.scan(lambda past, now: displayed(net, past, now, o), past, frames)
        truth = to_display(window.truth_linear * window.frames.exposure[..., None, None, None])
        images, truth = (x.reshape(-1, *x.shape[2:]) for x in (jnp.moveaxis(images, 0, 1), truth))
        return image_loss(images, truth, weights)

    module, warp = module_maker(new), plain_warp()

    def init(frame: Frame) -> State:
        return State(first_past(frame, o), warp.init(frame))

    def upscale(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        if frame.scale == 1:
            return State(state.past, warp.keep(frame.color_linear, frame)), frame.color_linear
        past, one = one_image((state.past, frame))
        past, shown = displayed(module(net), past, one, o)
        # A broken pixel is seen once: in the past, NaN would stay and spread until the next reset.
        past = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x[0]), x[0], 0), past)
        image = to_linear(shown, one.exposure)[0].astype(frame.color_linear.dtype)
        return State(past, warp.keep(image, frame)), image

    def extrapolate(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        last, image = warp.extrapolate(net, state.last, frame)
        return State(state.past, last), image

    windows = Windows(length, made=None)
    return Method(
        "rrn",
        "recurrent network: the colour of two frames; plain backward warp where nothing was rendered",
        Needs(frozenset({"lr.color"}), warp.needs),
        init,
        upscale,
        extrapolate,
        Network(new, loss_of, windows, to_json(o), to_json(weights)),
    )
