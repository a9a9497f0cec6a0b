"""A check that every op passes: the compiled batch equals its images one by one without compilation."""

from typing import Any

import jax
import numpy as np


def assert_jit_and_batch(
    fn: Any, *arrays: Any, atol: float = 1e-5, rtol: float = 1e-5, eager: bool = True
) -> None:
    """`fn` of a batch of two, under jit, agrees with `fn` of each image under `jax.disable_jit`.

    Args:
        fn: function of arrays or pytrees of arrays, with or without batch.
        *arrays: arguments with a leading batch axis of length 2.
        eager: False compares with compiled single images: compositions take long without jit.
    """
    arrays = jax.tree.map(jax.numpy.asarray, arrays)
    batched = fn(*arrays)
    with jax.disable_jit(eager):
        loop = [fn(*jax.tree.map(lambda x, i=i: x[i], arrays)) for i in range(2)]

    def close(batch: Any, *images: Any) -> None:
        np.testing.assert_allclose(np.asarray(batch), np.stack(images), atol=atol, rtol=rtol)

    jax.tree.map(close, batched, *loop)
