"""What a method is: two pure steps, the buffers that they need, and the network behind them if it has one."""

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window
from jaxsr.needs import Needs, Windows

__all__ = [
    "Loss", "Method", "Needs", "Net", "Network", "State", "Step", "Windows", "last_frames", "module_maker",
    "one_image", "step",
]  # fmt: skip

State = Any
"""A pytree of arrays; its size does not depend on the length of the clip."""
Net = Any
"""A pytree of parameters (an `nnx.State`); None for methods that learn nothing."""
Step = Callable[[Net, State, Frame], tuple[State, Float[Array, "H W 3"]]]
Loss = Callable[[nnx.Module, Window], tuple[Float[Array, ""], dict[str, Float[Array, ""]]]]


class Network(NamedTuple):
    """The part of a method that learns."""

    new: Callable[[nnx.Rngs], nnx.Module]
    """A fresh module, which may hold several networks. Its `nnx.state` is what the steps take as `net`."""
    loss: Loss
    """`loss(module, window) -> total, parts` of a batch of windows, with the module in training mode."""
    windows: Windows = Windows()
    settings: Mapping[str, Any] = MappingProxyType({})
    """All that the output depends on besides the parameters, as JSON values: `methods.build(name, settings)`
    makes the method again. A file of weights records them."""
    loss_settings: Mapping[str, Any] = MappingProxyType({})
    """Weights and other settings of the loss, as JSON values: a training records them."""
    frozen: Any = False
    """An NNX filter of the parameters that training leaves as they are: `nnx.PathContains("frnet")`."""


class Method(NamedTuple):
    """A method: two pure step functions, the buffers that they need, and its network if it has one.

    Both steps are `(net, state, frame) -> state, image`: the image is the HR linear colour of one frame.
    `upscale` makes a rendered frame, `extrapolate` one that has only its G-buffers and ignores
    `frame.color_linear`. Streaming, `jax.lax.scan`, evaluation and export all run these same functions. They
    never see the truth. Whoever runs them drops the state at a reset, by calling `init` again; `step` does.
    """

    name: str
    summary: str
    needs: Needs
    init: Callable[[Frame], State]
    """The empty state for frames of this shape."""
    upscale: Step
    extrapolate: Step
    network: Network | None = None
    """None where nothing is learned."""


def step(method: Method) -> Step:
    """Both steps as one, for `jax.lax.scan`: it looks at `frame.rendered`, and starts anew at a reset.

    Nothing can be made of a frame that is both a reset and not rendered: whoever schedules the frames renders
    the first one of a shot.
    """

    def step(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        state = jax.tree.map(lambda new, old: jnp.where(frame.reset, new, old), method.init(frame), state)
        return jax.lax.cond(frame.rendered, method.upscale, method.extrapolate, net, state, frame)

    return step


def module_maker(new: Callable[[nnx.Rngs], nnx.Module]) -> Callable[[Net], Any]:
    """`make(net)`: the module with these parameters, in evaluation mode. Its graph is built only once.

    `net` may lack random streams (of dropout), as that of a file of weights does: evaluation does not draw.
    """

    @functools.cache
    def graph() -> tuple[Any, Any]:
        module = nnx.eval_shape(lambda: new(nnx.Rngs(0)))
        module.eval()
        return nnx.graphdef(module), nnx.state(module, nnx.RngState)

    def make(net: Net) -> Any:
        graphdef, streams = graph()
        if not jax.tree.leaves(streams):
            return nnx.merge(graphdef, net)
        return nnx.merge(
            graphdef, jax.tree.map(_unused, streams), nnx.filter_state(net, nnx.Not(nnx.RngState))
        )

    return make


def _unused(stream: Any) -> Array:
    """Some value for a random stream, or its count, that nothing draws from."""
    if jax.dtypes.issubdtype(stream.dtype, jax.dtypes.prng_key):
        return jax.random.split(jax.random.key(0), stream.shape)
    return jnp.zeros(stream.shape, stream.dtype)


def last_frames(window: Window) -> tuple[Frame, Float[Array, "b H W 3"]]:
    """The last frame of each window of a batch, and its truth: for networks that see one frame."""
    return jax.tree.map(lambda x: x[:, -1], window.frames), window.truth_linear[:, -1]


def one_image(tree: Any) -> Any:
    """A pytree of arrays as a batch of one."""
    return jax.tree.map(lambda x: jnp.asarray(x)[None], tree)
