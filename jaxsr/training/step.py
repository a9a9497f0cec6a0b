"""One update of the weights, as one compiled function; batches are spread over the local devices.

Batch statistics and the loss are those of the whole batch: the compiler sees the batch as one array and adds
what communication that takes.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array

from jaxsr.errors import JaxsrError
from jaxsr.frames import Window
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.training.config import TrainConfig
from jaxsr.training.state import TrainState, optimizer


def shardings(batch: int, devices: list[jax.Device] | None = None) -> tuple[NamedSharding, NamedSharding]:
    """How the state lies on the devices (whole, on each) and how a batch does (in equal parts).

    Args:
        devices: all local ones by default.

    Raises:
        JaxsrError: the batch cannot be shared out.
    """
    devices = jax.local_devices() if devices is None else devices
    if batch % len(devices):
        raise JaxsrError(
            "the batch cannot be shared out equally",
            where="--batch",
            expected=f"a multiple of the {len(devices)} devices",
            found=batch,
        )
    mesh = jax.make_mesh((len(devices),), ("batch",), axis_types=(AxisType.Auto,), devices=devices)
    return NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("batch"))


def make_step(method: Method, graphdef: nnx.GraphDef, config: TrainConfig, whole: NamedSharding) -> Any:
    """`step(state, window) -> state, measured`, jitted; it consumes the state that it is given.

    `measured` holds "loss", its parts as "loss/<name>", and "grad_norm" before clipping.
    """
    assert method.network is not None
    loss, tx = method.network.loss, optimizer(config)

    def loss_of(params: Net, rest: Net, window: Window):
        net = nnx.merge(graphdef, params, rest, copy=True)  # new variables, that this trace may change
        total, parts = loss(net, window)
        return total, (parts, nnx.state(net, nnx.Param, ...)[1])

    def step(state: TrainState, window: Window):
        grad = jax.value_and_grad(loss_of, has_aux=True)
        (total, (parts, rest)), gradient = grad(state.params, state.rest, window)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = tx.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        average = state.average
        if average is not None:
            average = averaged(average, nnx.merge_state(params, rest), config.ema, state.step)
        measured = {
            "loss": total,
            "grad_norm": jnp.sqrt(sum(jnp.sum(g * g) for g in jax.tree.leaves(gradient))),
        }
        measured |= {f"loss/{name}": value for name, value in parts.items()}
        return TrainState(state.step + 1, params, rest, opt, average), measured

    return jax.jit(step, donate_argnums=0, out_shardings=whole)


def averaged(average: Net, new: Net, decay: float, step: Array) -> Net:
    """`d average + (1 - d) new`, d = min(decay, (1 + t) / (10 + t)): the first weights are soon forgotten."""
    t = step.astype(jnp.float32)
    d = jnp.minimum(np.float32(decay), (1 + t) / (10 + t))

    def leaf(a: Array, b: Array) -> Array:
        # Counters and random keys have no average.
        return d * a + (1 - d) * b if jnp.issubdtype(b.dtype, jnp.floating) else b

    return jax.tree.map(leaf, average, new)
