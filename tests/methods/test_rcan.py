"""RCAN, the network: sizes, types, gradients. Parity with the published one is in tests/test_weights.py."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.nets import RCAN
from jaxsr.nets.rcan import MEAN
from tests.networks import drawn

small = functools.partial(RCAN, groups=2, blocks=2, features=8, reduction=4)


def count(**arguments):
    net = nnx.eval_shape(lambda: RCAN(**arguments, rngs=nnx.Rngs(0)))
    return sum(p.size for p in jax.tree.leaves(nnx.state(net, nnx.Param)))


def colors(seed=0, batch=1, size=(5, 7)):
    return jnp.asarray(np.random.default_rng(seed).random((batch, *size, 3), np.float32))


def pure(net):
    graph, state = nnx.split(net)
    return jax.jit(lambda state, color: nnx.merge(graph, state)(color)), state


def test_the_published_size():
    assert count() == 15_592_355
    few = {"groups": 1, "blocks": 1}
    up = 64 * 256 * 9 + 256
    assert count(**few) - count(scale=2, **few) == up
    assert count(scale=8, **few) - count(**few) == up
    assert count(scale=3, **few) - count(scale=2, **few) == 64 * 576 * 9 + 576 - up


@pytest.mark.parametrize("scale", [2, 3, 4, 8])
@pytest.mark.parametrize("size", [(1, 1), (5, 7)])
def test_any_size_and_scale(scale, size):
    graph, state = nnx.split(nnx.eval_shape(lambda: small(scale=scale, rngs=nnx.Rngs(0))))
    run = lambda state, color: nnx.merge(graph, state)(color)  # noqa: E731
    out = jax.eval_shape(run, state, colors(batch=2, size=size))
    assert out.shape == (2, size[0] * scale, size[1] * scale, 3)
    assert out.dtype == jnp.float32


def test_jit_is_eager_and_batches_are_images():
    net = drawn(functools.partial(small, scale=2))
    run, state = pure(net)
    batch = run(state, colors(batch=2))
    assert np.asarray(batch).std() > 1e-3
    with jax.disable_jit():
        single = net(colors(batch=2)[1:])
    np.testing.assert_allclose(batch[1:], single, atol=1e-5)


def test_without_a_tail_it_makes_the_mean():
    """Which was taken off at the head, and is no parameter."""
    net = drawn(functools.partial(small, scale=2))
    net.tail.kernel[...] = jnp.zeros_like(net.tail.kernel[...])
    np.testing.assert_allclose(net(colors())[0, 3, 4], MEAN, rtol=1e-6)
    mean = jnp.broadcast_to(jnp.array(MEAN), (1, 5, 7, 3))
    np.testing.assert_allclose(drawn(functools.partial(small, scale=2))(mean), jnp.tile(mean, (1, 2, 2, 1)))


def test_gradients_are_finite_and_reach_everything():
    graph, params = nnx.split(drawn(functools.partial(small, scale=3), 1))
    black = colors(1, batch=2).at[0].set(0)
    grads = jax.jit(
        jax.grad(lambda params, color: jnp.mean(nnx.merge(graph, params)(color) ** 2), argnums=(0, 1))
    )(params, black)
    for path, leaf in jax.tree_util.tree_leaves_with_path(grads):
        assert np.all(np.isfinite(leaf)), path
        assert np.any(leaf != 0), path


@pytest.mark.slow
def test_it_begins_tame():
    """Sixty blocks deep, as the published one begins: activations do not grow from block to block."""
    net = small(scale=2, groups=3, blocks=20, features=16, rngs=nnx.Rngs(0))
    image = jax.jit(lambda net, color: net(color))(net, colors())
    assert 1e-3 < np.std(np.asarray(image) - np.array(MEAN)) < 1


def test_bfloat16_computes_close_by():
    run, state = pure(drawn(functools.partial(small, scale=2)))
    run_half, half = pure(drawn(functools.partial(small, scale=2, dtype=jnp.bfloat16)))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(half))
    exact, close = run(state, colors()), run_half(half, colors())
    assert close.dtype == jnp.float32
    assert 0 < np.abs(np.asarray(close - exact)).max() / np.abs(exact).max() < 0.03


def test_it_learns_one_image():
    y, x = jnp.mgrid[:16, :16].astype(jnp.float32) / 16
    truth = jnp.stack([x, y, (x > y).astype(jnp.float32)], -1)[None]
    graph, params = nnx.split(drawn(functools.partial(small, scale=2)))
    optimizer = optax.adam(3e-3)

    @jax.jit
    def step(params, opt):
        def loss(params):
            return jnp.mean(jnp.abs(nnx.merge(graph, params)(truth[:, ::2, ::2]) - truth))

        error, grads = jax.value_and_grad(loss)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(grads, opt)
        return optax.apply_updates(params, updates), opt, error

    opt, errors = optimizer.init(params), []
    for _ in range(150):
        params, opt, error = step(params, opt)
        errors.append(float(error))
    assert errors[-1] < 0.03 < 0.15 < errors[0]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"scale": 5}, r"scale: bad scale; expected 2 \| 3 \| 4 \| 8; found 5"),
        ({"scale": 1}, "scale"),
        ({"groups": 0}, "groups: bad groups; expected a whole number of at least 1; found 0"),
        ({"blocks": -1}, "blocks"),
        ({"features": 0}, "features"),
        ({"reduction": 0}, "reduction"),
        ({"features": 8, "reduction": 16}, "reduction: bad reduction; expected at most 8; found 16"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    with pytest.raises(JaxsrError, match=match):
        RCAN(**arguments, rngs=nnx.Rngs(0))
