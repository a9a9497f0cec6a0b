"""RRN, the network: sizes, types, gradients. Parity with the published one is in tests/test_weights.py."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.nets import RRN
from jaxsr.ops import upsample
from tests.networks import drawn

small = functools.partial(RRN, blocks=2, features=8)


def count(**arguments):
    net = nnx.eval_shape(lambda: RRN(**arguments, rngs=nnx.Rngs(0)))
    return sum(p.size for p in jax.tree.leaves(nnx.state(net, nnx.Param)))


def inputs(seed=0, batch=1, size=(5, 7), scale=2, features=8):
    rng, (h, w) = np.random.default_rng(seed), size
    shapes = (h, w, 3), (h, w, 3), (h, w, features), (h * scale, w * scale, 3)
    return tuple(jnp.asarray(rng.random((batch, *shape), np.float32)) for shape in shapes)


def pure(net):
    graph, state = nnx.split(net)
    return jax.jit(lambda state, *inputs: nnx.merge(graph, state)(*inputs)), state


def test_the_published_sizes():
    assert count() == 3_364_400
    assert count(blocks=5) == 1_888_560


@pytest.mark.parametrize("scale", [2, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (5, 7)])
def test_any_size_and_scale(scale, size):
    graph, state = nnx.split(nnx.eval_shape(lambda: small(scale=scale, rngs=nnx.Rngs(0))))
    run = lambda state, *inputs: nnx.merge(graph, state)(*inputs)  # noqa: E731
    made, hidden = jax.eval_shape(run, state, *inputs(batch=2, size=size, scale=scale))
    assert made.shape == (2, size[0] * scale, size[1] * scale, 3)
    assert hidden.shape == (2, *size, 8)
    assert made.dtype == hidden.dtype == jnp.float32


def test_jit_is_eager_and_batches_are_videos():
    net = drawn(functools.partial(small, scale=2))
    run, state = pure(net)
    both = inputs(batch=2)
    batch = run(state, *both)
    with jax.disable_jit():
        single = net(*(x[1:] for x in both))
    for whole, one in zip(batch, single, strict=True):
        assert np.asarray(whole).std() > 1e-3
        np.testing.assert_allclose(whole[1:], one, atol=1e-5)


def test_without_weights_it_is_bilinear():
    net = drawn(functools.partial(small, scale=2))
    nnx.update(net, jax.tree.map(jnp.zeros_like, nnx.state(net)))
    given = inputs()
    made, hidden = net(*given)
    np.testing.assert_allclose(made, upsample(given[1], 2), atol=1e-6)
    np.testing.assert_array_equal(hidden, 0)


def test_it_begins_near_bilinear():
    net = small(scale=2, rngs=nnx.Rngs(0))
    _, color, hidden, output = inputs()
    made, _ = net(color, color, 0 * hidden, 0 * output)
    assert 0 < np.abs(made - upsample(color, 2)).max() < 0.05


@pytest.mark.parametrize("which", range(4))
def test_it_sees_all_of_its_inputs(which):
    net, given = drawn(functools.partial(small, scale=2)), list(inputs())
    before, _ = net(*given)
    given[which] = given[which] + 0.1
    assert np.abs(net(*given)[0] - before).max() > 1e-3


def test_gradients_are_finite_and_reach_everything():
    graph, params = nnx.split(drawn(functools.partial(small, scale=2), 1))

    @jax.jit
    def gradient(params, given):
        def loss(params, given):
            made, hidden = nnx.merge(graph, params)(*given)
            return jnp.mean(made**2) + jnp.mean(hidden)

        return jax.grad(loss, argnums=(0, 1))(params, given)

    previous, color, hidden, output = inputs(1, batch=2)
    grads = gradient(params, (previous, color.at[0].set(0), hidden, output))
    for path, leaf in jax.tree_util.tree_leaves_with_path(grads):
        assert np.all(np.isfinite(leaf)), path
        assert np.any(leaf != 0), path


def test_bfloat16_computes_close_by():
    run, state = pure(drawn(functools.partial(small, scale=2)))
    run_half, half = pure(drawn(functools.partial(small, scale=2, dtype=jnp.bfloat16)))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(half))
    for exact, close in zip(run(state, *inputs()), run_half(half, *inputs()), strict=True):
        assert close.dtype == jnp.float32
        assert 0 < np.abs(np.asarray(close - exact)).max() / np.abs(exact).max() < 0.03


def test_it_learns_what_only_the_past_shows():
    """A pattern that the first of two steps is given and the second must make."""
    rng = np.random.default_rng(0)
    seen, blank = jnp.asarray(rng.random((1, 6, 6, 3), np.float32)), jnp.full((1, 6, 6, 3), 0.5)
    truth = upsample(seen, 2, "nearest")
    graph, params = nnx.split(drawn(functools.partial(small, scale=2)))
    optimizer = optax.adam(1e-2)

    @jax.jit
    def step(params, opt):
        def loss(params):
            net = nnx.merge(graph, params)
            made, hidden = net(seen, seen, jnp.zeros((1, 6, 6, 8)), jnp.zeros((1, 12, 12, 3)))
            return jnp.mean(jnp.abs(net(blank, blank, hidden, made)[0] - truth))

        error, grads = jax.value_and_grad(loss)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(grads, opt)
        return optax.apply_updates(params, updates), opt, error

    opt, errors = optimizer.init(params), []
    for _ in range(150):
        params, opt, error = step(params, opt)
        errors.append(float(error))
    assert errors[-1] < 0.05 < 0.2 < errors[0]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"scale": 1}, "scale: bad scale; expected a whole number of at least 2; found 1"),
        ({"blocks": 0}, "blocks: bad blocks; expected a whole number of at least 1; found 0"),
        ({"features": 0}, "features"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    with pytest.raises(JaxsrError, match=match):
        RRN(**arguments, rngs=nnx.Rngs(0))
