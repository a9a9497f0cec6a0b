"""Checks that every op passes: compiled equals eager, and a batch equals its images one by one."""

from typing import Any

import jax
import numpy as np


def assert_jit_and_batch(fn: Any, *arrays: Any, atol: float = 1e-5, rtol: float = 1e-5) -> None:
    """`fn` of `arrays` agrees with itself without jit, and on a batch of two with a loop.

    Args:
        fn: function of arrays or pytrees of arrays, with or without batch.
        *arrays: arguments with a leading batch axis of length 2.
    """
    arrays = jax.tree.map(jax.numpy.asarray, arrays)
    batched = fn(*arrays)
    with jax.disable_jit():
        eager = fn(*arrays)
    loop = [fn(*jax.tree.map(lambda x, i=i: x[i], arrays)) for i in range(2)]

    def close(a: Any, b: Any) -> None:
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=atol, rtol=rtol)

    jax.tree.map(close, batched, eager)
    jax.tree.map(lambda b, *rows: close(b, np.stack(rows)), batched, *loop)
