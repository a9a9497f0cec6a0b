"""Multiply-adds against loops that multiply and count; parameters against the published number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.methods import METHODS
from jaxsr.nets import FusionSR
from jaxsr.runtime.cost import count_multiply_adds, count_parameters
from jaxsr.runtime.load import find_method
from jaxsr.runtime.stream import stream
from tests.builders import make_sequence, random_weights


def shape(*sizes):
    return jax.ShapeDtypeStruct(sizes, jnp.float32)


def convolution(**options):
    given = {"window_strides": (1, 1), "padding": "SAME", "dimension_numbers": ("NHWC", "HWIO", "NHWC")}
    return lambda x, k: jax.lax.conv_general_dilated(x, k, **given | options)


def taps_by_loops(size, out, taps, stride, spread, dilation, before):
    """How often a tap of a kernel meets a sample or the padding, along one axis."""
    count = 0
    for o in range(out):
        for t in range(taps):
            at = o * stride + t * dilation - before
            count += at % spread == 0
    return count


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("spread", [1, 2, 3])
@pytest.mark.parametrize("dilation", [1, 2])
@pytest.mark.parametrize("padding", [(0, 0), (1, 2)])
def test_convolutions_are_the_loop(stride, spread, dilation, padding):
    fn = convolution(
        window_strides=(stride, 1),
        lhs_dilation=(spread, 1),
        rhs_dilation=(dilation, 1),
        padding=[padding, (1, 1)],
    )
    x, kernel = shape(2, 9, 5, 4), shape(3, 3, 4, 7)
    rows = jax.eval_shape(fn, x, kernel).shape[1]
    along = taps_by_loops(9, rows, 3, stride, spread, dilation, padding[0])
    assert count_multiply_adds(fn, x, kernel) == 2 * 4 * 7 * along * (5 * 3)


def test_known_layers():
    x = shape(1, 8, 8, 16)
    assert count_multiply_adds(convolution(), x, shape(3, 3, 16, 32)) == 64 * 9 * 16 * 32
    depthwise = convolution(feature_group_count=16)
    assert count_multiply_adds(depthwise, x, shape(3, 3, 1, 16)) == 64 * 9 * 16
    halved = convolution(window_strides=(2, 2))
    assert count_multiply_adds(halved, x, shape(3, 3, 16, 32)) == 16 * 9 * 16 * 32
    # A transposed convolution of kernel 2 and stride 2 multiplies each sample with each tap once.
    twice = lambda x, k: jax.lax.conv_transpose(x, k, (2, 2), "SAME")  # noqa: E731
    assert count_multiply_adds(twice, x, shape(2, 2, 16, 32)) == 64 * 4 * 16 * 32
    assert count_multiply_adds(lambda a, b: a @ b, shape(5, 6), shape(6, 7)) == 5 * 6 * 7
    batched = lambda a, b: jnp.einsum("bij,bjk->bik", a, b)  # noqa: E731
    assert count_multiply_adds(batched, shape(3, 5, 6), shape(3, 6, 7)) == 3 * 5 * 6 * 7
    assert count_multiply_adds(lambda a: jnp.sin(a) * a + 1, x) == 0


def test_programs_within_programs():
    a = shape(4, 4)
    one = 4 * 4 * 4

    def loop(a):
        return jax.lax.fori_loop(0, 5, lambda i, b: b @ a, a)

    def branch(a):
        return jax.lax.cond(a[0, 0] > 0, lambda a: a @ a @ a, lambda a: a @ a, a)

    def endless(a):
        return jax.lax.while_loop(lambda b: b[0, 0] > 0, lambda b: b @ a, a)

    assert count_multiply_adds(loop, a) == 5 * one
    assert count_multiply_adds(branch, a) == 2 * one
    assert count_multiply_adds(jax.jit(jax.checkpoint(lambda a: a @ a)), a) == one
    assert count_multiply_adds(jax.vmap(lambda a: a @ a), shape(3, 4, 4)) == 3 * one
    with pytest.raises(JaxsrError, match="unknown number of turns"):
        count_multiply_adds(endless, a)
    quiet = lambda a: jax.lax.while_loop(lambda b: b[0, 0] > 0, lambda b: b - 1, a)  # noqa: E731
    assert count_multiply_adds(quiet, a) == 0


def test_parameters_are_those_that_are_learned():
    net = nnx.eval_shape(lambda: FusionSR(rngs=nnx.Rngs(0)))
    state = nnx.state(net)
    learned = sum(np.size(x) for x in jax.tree.leaves(nnx.state(net, nnx.Param)))
    assert count_parameters(state) == learned
    assert learned < sum(np.size(x) for x in jax.tree.leaves(state))  # running averages of batch norm
    assert count_parameters(None) == 0


def test_a_stream_knows_its_cost(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=1)
    ready = find_method(str(random_weights(tmp_path / "w.safetensors", scale=2)), 2)
    (made,) = stream(ready.method, [sequence.frame(0, 2)], ready.net)
    assert made.cost.parameters == count_parameters(ready.net)
    assert 1e3 < made.cost.multiply_adds_per_px < 1e6
    (made,) = stream(METHODS["bilinear"], [sequence.frame(0, 2)])
    assert made.cost.parameters == 0
