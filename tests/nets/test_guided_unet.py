"""The U-Net of guided-unet: sizes, what it starts from, what it sees, and that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.methods.guided_unet import CHANNELS
from jaxsr.nets.guided_unet import GuidedUNet
from jaxsr.runtime.cost import count_parameters
from tests.networks import drawn

SMALL = (8, 8, 16)


def small(rngs=None):
    return GuidedUNet(5, SMALL, rngs=rngs or nnx.Rngs(0))


def noise(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def test_number_of_parameters():
    net = nnx.eval_shape(lambda: GuidedUNet(CHANNELS, rngs=nnx.Rngs(0)))
    assert count_parameters(nnx.state(net)) == 555_084


def test_it_begins_by_correcting_nothing():
    np.testing.assert_array_equal(small()(noise(1, 16, 24, 5)), 0)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (8, 8), (17, 30)])
def test_any_size(size):
    net = drawn(lambda rngs: small(rngs))
    made = net(noise(2, *size, 5))
    assert made.shape == (2, *size, 3)
    assert made.dtype == jnp.float32
    assert np.isfinite(made).all()
    assert np.abs(made).max() > 0


def test_jit_equals_eager():
    net = drawn(lambda rngs: small(rngs))
    x = noise(1, 24, 16, 5)
    graph, state = nnx.split(net)
    compiled = jax.jit(lambda state, x: nnx.merge(graph, state)(x))(state, x)
    np.testing.assert_allclose(compiled, net(x), rtol=1e-5, atol=1e-6)


def test_a_crop_makes_a_crop_of_the_output():
    net = drawn(lambda rngs: small(rngs))
    x = noise(1, 176, 160, 5)
    crop = net(x[:, 8:168, 16:160])
    np.testing.assert_allclose(crop[:, 64:-64, 64:-64], net(x)[:, 72:104, 80:96], atol=1e-5)


def test_it_learns_one_picture():
    """The first steps are large, and do not kill it: see the module."""
    net = small()
    graph, state = nnx.split(net)
    x = noise(1, 16, 16, 5)
    target = 0.2 * jnp.sin(3 * x[..., :3])
    tx = optax.adam(2e-3)

    def loss(state):
        return jnp.mean(jnp.abs(nnx.merge(graph, state)(x) - target))

    @jax.jit
    def step(state, opt):
        value, grad = jax.value_and_grad(loss)(state)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = tx.update(grad, opt)
            return optax.apply_updates(state, updates), opt, value

    opt, values = tx.init(state), []
    for _ in range(250):
        state, opt, value = step(state, opt)
        values.append(float(value))
    assert values[-1] < 0.35 * values[0]


@pytest.mark.parametrize(
    "arguments", [{"widths": (8,) * 6}, {"widths": (0, 8)}, {"widths": ()}, {"widths": (4096,)}]
)
def test_bad_numbers_are_refused(arguments):
    with pytest.raises(JaxsrError, match=r"bad|too many"):
        GuidedUNet(5, **arguments, rngs=nnx.Rngs(0))


def test_another_number_of_channels_is_refused():
    with pytest.raises(JaxsrError, match="wrong number of channels"):
        small()(noise(1, 8, 8, 4))
