"""Networks with random weights for tests, without the time that drawing them in JAX takes."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

SMALL: dict[str, dict[str, int]] = {
    "rcan": {"groups": 1, "blocks": 2, "features": 8, "reduction": 4},
    "rrn": {"blocks": 1, "features": 8},
}
"""Options of methods whose networks are large by default."""


def drawn(make: Callable[..., Any], seed: int = 0) -> Any:
    """`make(rngs=...)` as it starts: Xavier kernels, drawn by NumPy, biases 0, scales 1.

    JAX compiles a generator for every shape. What a constructor does to single layers is lost.
    """
    graph, state = nnx.split(nnx.eval_shape(lambda: make(rngs=nnx.Rngs(0))))
    rng, flat = np.random.default_rng(seed), []
    for path, variable in nnx.to_flat_state(state):
        shape = variable.get_value().shape
        if path[-1] == "kernel":
            bound = np.sqrt(6 / (np.prod(shape[-4:-2]) * sum(shape[-2:])))  # stacked layers have more axes
            value = rng.uniform(-bound, bound, shape)
        else:
            value = np.full(shape, path[-1] in ("scale", "var"))
        flat.append((path, variable.replace(jnp.asarray(value, jnp.float32))))
    return nnx.merge(graph, nnx.from_flat_state(flat))
