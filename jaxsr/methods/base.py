"""What a method is: a pure step over a sequence, and what it needs to take that step."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.frames import Frame, Window

State = Any
"""A pytree of arrays; constant in size whatever the length of the clip."""
Net = Any
"""A pytree of parameters (an `nnx.State`); None for methods that learn nothing."""
Step = Callable[[Net, State, Frame], tuple[State, Float[Array, "H W 3"]]]
Loss = Callable[[nnx.Module, Window], tuple[Float[Array, ""], dict[str, Float[Array, ""]]]]


class Method(NamedTuple):
    """A name, two pure functions and a list of needs.

    `step(net, state, frame) -> state, image` makes the HR linear colour of one frame; it serves streaming,
    `jax.lax.scan`, evaluation and export alike. It never sees the truth. Where `frame.reset` is set it
    ignores the state; where `frame.rendered` is not, it extrapolates and ignores `frame.color_linear`.
    Nothing can be made of a frame that is both a reset and not rendered: whoever schedules the frames renders
    the first one of a shot.
    """

    name: str
    summary: str
    init: Callable[[Frame], State]
    """The empty state for frames of this shape."""
    step: Step
    needs: frozenset[str]
    """Buffers by size and name, for instance "lr.color" or "hr.normal"."""
    new_net: Callable[[nnx.Rngs], nnx.Module] | None = None
    """A fresh network, whose `nnx.state` is what `step` takes as `net`; None where nothing is learned."""
    loss: Loss | None = None
    """`loss(net, window) -> total, parts` on a batch of windows, in the net's training mode."""
    window: int = 1
    """Consecutive frames that `loss` wants in a window."""
    arguments: Mapping[str, Any] = MappingProxyType({})
    """What a file of weights must record to build this method again: `methods.build(name, arguments)`."""


def by_rendered(
    init: Callable[[Frame], State],
    upscale: Callable[[Net, State, Frame], tuple[State, Array]],
    extrapolate: Callable[[Net, State, Frame], tuple[State, Array]],
) -> Step:
    """A step that upscales rendered frames, extrapolates the others, and starts anew at a cut."""

    def step(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        state = jax.tree.map(lambda new, old: jnp.where(frame.reset, new, old), init(frame), state)
        return jax.lax.cond(frame.rendered, upscale, extrapolate, net, state, frame)

    return step
