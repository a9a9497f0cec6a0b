"""What training carries from step to step, and how it begins: a pytree of arrays and nothing else."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Int

from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.training.config import TrainConfig


class TrainState(NamedTuple):
    """The state after `step` updates."""

    step: Int[Array, ""]
    params: Net
    """What is learned, float32."""
    rest: Net
    """Batch statistics, and the random streams of networks that draw (dropout)."""
    optimizer: Any
    """Of optax."""
    average: Net | None
    """Moving averages of `params` and batch statistics; None where they are not wanted."""


def schedule(config: TrainConfig) -> optax.Schedule:
    """Learning rate of step t = 0, 1, ..."""
    if config.schedule == "cosine":
        return optax.cosine_decay_schedule(config.learning_rate, config.steps)
    if config.schedule == "constant":
        return optax.constant_schedule(config.learning_rate)
    return optax.exponential_decay(config.learning_rate, config.steps, 0.98**100)


def optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Adam (0.9, 0.999), after clipping where that is asked for."""
    adam = optax.adam(schedule(config))
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), adam) if config.clip_norm else adam


def begin(method: Method, config: TrainConfig, weights: Net | None = None) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure in training mode, and the state before the first step.

    Args:
        weights: all of the network's state, to start from; fresh ones by the seed by default.
    """
    assert method.network is not None
    net = method.network.new(nnx.Rngs(config.seed))
    if weights is not None:
        nnx.update(net, weights)
    net.train()
    params, rest = nnx.state(net, nnx.Param, ...)
    # A copy: the step donates its input, and no buffer can be donated twice.
    average = jax.tree.map(jnp.copy, nnx.merge_state(params, rest)) if config.ema else None
    return nnx.graphdef(net), TrainState(
        jnp.zeros((), jnp.int32), params, rest, optimizer(config).init(params), average
    )


def inference_net(state: TrainState) -> Net:
    """What a method's step takes as `net` and a file of weights holds: the averages, if there are any."""
    return nnx.merge_state(state.params, state.rest) if state.average is None else state.average
