"""One update of the weights, as one compiled function; batches are spread over the local devices.

Batch statistics and the loss are those of the whole batch: the compiler sees the batch as one array and adds
the communication that this takes.
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
from jaxsr.training.state import TrainState, optimizer, split


def shardings(batch: int, devices: list[jax.Device] | None = None) -> tuple[NamedSharding, NamedSharding]:
    """Shardings of the state (a whole copy on each device) and of a batch (in equal parts).

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
    network, tx = method.network, optimizer(config)

    def loss_of(params: Net, frozen: Net, rest: Net, window: Window):
        # A copy: new variables, which the loss may change while it is traced.
        net = nnx.merge(graphdef, params, frozen, rest, copy=True)
        total, parts = network.loss(net, window)
        return total, (parts, split(net, network.frozen)[2])

    def step(state: TrainState, window: Window):
        grad = jax.value_and_grad(loss_of, has_aux=True)
        (total, (parts, rest)), gradient = grad(state.params, state.frozen, state.rest, window)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = tx.update(gradient, state.optimizer, state.params)
            params = optax.apply_updates(state.params, updates)
        average = state.average
        if average is not None:
            average = averaged(average, nnx.merge_state(params, rest), config.ema, state.step)
        measured = {"loss": total, "grad_norm": optax.tree.norm(gradient)}
        measured |= {f"loss/{name}": value for name, value in parts.items()}
        return TrainState(state.step + 1, params, state.frozen, rest, opt, average), measured

    return jax.jit(step, donate_argnums=0, out_shardings=whole)


def averaged(average: Net, new: Net, decay: float, step: Array) -> Net:
    """`d average + (1 - d) new`, d = min(decay, (1 + t) / (10 + t)): the first weights are soon forgotten."""
    t = step.astype(jnp.float32)
    small = jnp.minimum(np.float32(decay), (1 + t) / (10 + t))

    def leaf(a: Array, b: Array) -> Array:
        if not jnp.issubdtype(b.dtype, jnp.floating):
            return b  # counters and random keys have no average
        d = small.astype(b.dtype)
        return d * a + (1 - d) * b

    return jax.tree.map(leaf, average, new)
