"""Ops are written for one image; leading batch axes are mapped away here."""

from collections.abc import Callable
from typing import Any

import jax


def over_batch(fn: Callable[..., Any], *arrays: Any, ndim: int = 3) -> Any:
    """Apply `fn` to unbatched arrays, or map it over the leading axis of all of them.

    Args:
        fn: function of arrays whose first one has `ndim` axes.
        *arrays: arrays (or pytrees) that either all have batch axes or all have none; None is passed through.
        ndim: number of axes of the first array without batch.
    """
    if arrays[0].ndim == ndim:
        return fn(*arrays)
    return jax.vmap(lambda *xs: over_batch(fn, *xs, ndim=ndim))(*arrays)
