"""All ops with `JAX_ENABLE_X64=1`: the dtype of the input is that of the result, values and gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.ops.examples import examples, floats, total

NAMES = sorted(examples())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", NAMES)
def test_the_dtype_stays(name, dtype):
    example = examples(dtype)[name]
    with jax.enable_x64(True):
        results = jax.eval_shape(example.fn, *example.arguments)
    assert floats(results)
    assert {a.dtype for a in floats(results)} == {np.dtype(dtype)}


@pytest.mark.parametrize("name", [name for name in NAMES if examples()[name].differentiable])
def test_gradients_are_finite_differences_in_double_precision(name):
    """At a step of 1e-6 a single rounding to float32 anywhere would be an error of ten percent."""
    example = examples(np.float64)[name]
    rng = np.random.default_rng(1)
    moved = [example.arguments[i] for i in example.differentiable]
    direction = jax.tree.map(lambda a: rng.normal(size=a.shape), moved)

    with jax.enable_x64(True):
        moved, direction = jax.tree.map(jnp.asarray, (moved, direction))

        @jax.jit
        def at(step):
            """The total after a step in the direction, and its slope there by the gradient."""
            value, gradient = jax.value_and_grad(functools.partial(total, example))(
                jax.tree.map(lambda a, d: a + step * d, moved, direction)
            )
            return value, sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient, direction)))

        (low, _), (_, slope), (high, _) = at(-1e-6), at(0.0), at(1e-6)
        assert low.dtype == jnp.float64
        np.testing.assert_allclose(slope, (high - low) / 2e-6, rtol=1e-5, atol=1e-6)
