"""What training carries from step to step, and how it begins: a pytree of arrays and nothing else.

The state of the network is split in three: what is learned, what is frozen (`Network.frozen`), and the rest
(batch statistics, random streams). A module all of whose parameters are frozen runs in evaluation mode, with
its own batch statistics and without dropout, and all below it is frozen: nothing of it changes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Int

from jaxsr.errors import JaxsrError
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.training.config import TrainConfig


class TrainState(NamedTuple):
    """The state after `step` updates."""

    step: Int[Array, ""]
    params: Net
    """What is learned, float32."""
    frozen: Net
    """What stays as it is; it has no gradient, no moments and no averages."""
    rest: Net
    """Batch statistics, and the random streams of networks that draw (dropout)."""
    optimizer: Any
    """Of optax, of `params` alone."""
    average: Net | None
    """Moving averages of `params` and batch statistics; None where they are not wanted."""


def schedule(config: TrainConfig) -> optax.Schedule:
    """Learning rate of step t = 0, 1, ...: `learning_rate` for `hold_steps`, then as `config.schedule` says.

    "cosine" goes down to `end_rate` and "exponential" by a factor 0.98**100, both at t = `steps`, where
    training has ended: the last update has t = `steps` - 1.
    """
    rate, after = config.learning_rate, config.steps - config.hold_steps
    if config.schedule == "constant":
        return optax.constant_schedule(rate)
    if config.schedule == "cosine":
        falling = optax.cosine_decay_schedule(rate, after, alpha=config.end_rate / rate)
    else:
        falling = optax.exponential_decay(rate, after, 0.98**100)
    if not config.hold_steps:
        return falling
    return optax.join_schedules([optax.constant_schedule(rate), falling], [config.hold_steps])


def optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Adam (0.9, 0.999), after clipping where that is asked for."""
    adam = optax.adam(schedule(config))
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), adam) if config.clip_norm else adam


def split(net: nnx.Module, frozen: Any) -> tuple[Net, Net, Net]:
    """The state of a network as what is learned, what is frozen, and the rest.

    Args:
        net: the network.
        frozen: an NNX filter, as `Network.frozen`; what lies in wholly frozen modules is frozen as well.
    """
    inside = _frozen_modules(net, frozen)

    def stays(path: tuple[Any, ...], variable: Any) -> bool:
        return any(path[: len(module)] == module for module in inside)

    kept, params, rest = nnx.state(net, nnx.Any(frozen, stays), nnx.Param, ...)
    return params, kept, rest


def training_mode(net: nnx.Module, frozen: Any) -> None:
    """Put a network into training mode, but for its wholly frozen modules."""
    net.train()
    inside = _frozen_modules(net, frozen)
    for path, module in nnx.iter_modules(net):
        if path in inside:
            module.eval()


def _frozen_modules(net: nnx.Module, frozen: Any) -> set[tuple[Any, ...]]:
    """Paths of the modules that have parameters, all of them frozen."""
    every = [path for path, _ in nnx.to_flat_state(nnx.state(net, nnx.Param))]
    kept = {path for path, _ in nnx.to_flat_state(nnx.state(net, nnx.All(nnx.Param, frozen)))}
    found = set()
    for place, _ in nnx.iter_modules(net):
        below = [path for path in every if path[: len(place)] == place]
        if below and kept.issuperset(below):
            found.add(place)
    return found


def begin(method: Method, config: TrainConfig, weights: Net | None = None) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure in training mode, and the state before the first step.

    Args:
        method: with a network.
        config: of the training.
        weights: state of the network, or of parts of it, to start from; what it lacks is drawn by the seed.

    Raises:
        JaxsrError: all of the network is frozen.
    """
    assert method.network is not None
    frozen = method.network.frozen
    net = method.network.new(nnx.Rngs(config.seed))
    if weights is not None:
        nnx.update(net, weights)
    training_mode(net, frozen)
    params, kept, rest = split(net, frozen)
    if not jax.tree.leaves(params):
        raise JaxsrError(f"all of the network of {method.name!r} is frozen", expected="something to learn")
    # A copy: the step donates its input, and no buffer can be donated twice.
    average = jax.tree.map(jnp.copy, nnx.merge_state(params, rest)) if config.ema else None
    step = jnp.zeros((), jnp.int32)
    return nnx.graphdef(net), TrainState(step, params, kept, rest, optimizer(config).init(params), average)


def inference_net(state: TrainState) -> Net:
    """What a method's steps take as `net` and a file of weights holds: the averages, if there are any."""
    learned = (state.params, state.rest) if state.average is None else (state.average,)
    return nnx.merge_state(*learned, state.frozen)
