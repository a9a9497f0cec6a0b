from fractions import Fraction
from math import floor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxsr import ops
from jaxsr.errors import JaxsrError
from jaxsr.ops.resampling import BOUNDARIES, MODES
from tests.reference import golden_ops
from tests.reference import resampling as reference
from tests.transforms import assert_jit_and_batch

SIZES = [(1, 1), (1, 4), (5, 3)]
GOLDEN = np.load(Path(__file__).parents[1] / "reference" / "golden_ops.npz")


def _random(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@given(
    size=st.sampled_from(SIZES),
    mode=st.sampled_from(MODES),
    boundary=st.sampled_from(BOUNDARIES),
    seed=st.integers(0, 10**6),
)
def test_sample_is_the_loop(size, mode, boundary, seed):
    image = _random(seed, *size, 2)
    # Eighths are exact, and halves and whole numbers come up often.
    steps = np.random.default_rng(seed).integers(-40, 8 * max(size) + 40, (3, 4, 2))
    positions = (steps / 8).astype(np.float32)
    result = ops.sample(image, positions, mode=mode, boundary=boundary)
    np.testing.assert_allclose(result, reference.sample(image, positions, mode, boundary), atol=2e-6)


@given(
    size=st.sampled_from(SIZES),
    new=st.sampled_from([(1, 1), (4, 2), (5, 9)]),
    mode=st.sampled_from(MODES),
    seed=st.integers(0, 10**6),
)
def test_resize_is_the_loop(size, new, mode, seed):
    image = _random(seed, *size, 2)
    result = ops.resize(image, new, mode)
    np.testing.assert_allclose(result, reference.resize(image, new, mode), atol=2e-6)


# Sizes of which a new pixel lies exactly half way between two old ones, where floats go wrong easily.
@pytest.mark.parametrize(("old", "new"), [(2, 49), (10, 49), (6, 98), (14, 49), (3, 4), (7, 3), (1, 5)])
def test_nearest_is_the_exact_rational(old, new):
    half = Fraction(1, 2)
    positions = [(x + half) * old / new - half for x in range(new)]
    nearest = [min(max(floor(p + half), 0), old - 1) for p in positions]
    row = jnp.arange(old, dtype=jnp.float32)[None, :, None]
    np.testing.assert_array_equal(ops.resize(row, (1, new), "nearest")[0, :, 0], nearest)
    linear = [float(min(max(p, Fraction(0)), Fraction(old - 1))) for p in positions]
    np.testing.assert_allclose(ops.resize(row, (1, new))[0, :, 0], linear, atol=1e-5)


@given(
    size=st.sampled_from(SIZES),
    scale=st.sampled_from([1, 2, 3, 4]),
    mode=st.sampled_from(MODES),
    seed=st.integers(0, 10**6),
)
def test_upsample_is_the_loop(size, scale, mode, seed):
    image = _random(seed, *size, 2)
    expected = reference.resize(image, (size[0] * scale, size[1] * scale), mode)
    np.testing.assert_allclose(ops.upsample(image, scale, mode), expected, atol=2e-6)


@pytest.mark.parametrize("name", ["nearest_3x11", "nearest_10x14", "nearest_2x4", "bilinear_3x11"])
@pytest.mark.parametrize("batch", [False, True])
def test_resize_is_pytorch(name, batch):
    golden, image = GOLDEN[name], golden_ops.image(5, 7, 3)
    result = ops.resize(image[None] if batch else image, golden.shape[:2], name.split("_")[0])
    np.testing.assert_allclose(result[0] if batch else result, golden, atol=1e-6)


@pytest.mark.parametrize("name", ["bilinear_10x14", "bicubic_15x21"])
def test_upsample_is_pytorch(name):
    golden, image = GOLDEN[name], golden_ops.image(5, 7, 3)
    result = ops.upsample(image, golden.shape[0] // 5, name.split("_")[0])
    np.testing.assert_allclose(result, golden, atol=3e-6)


@pytest.mark.parametrize("mode", ["nearest", "bilinear"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_sample_is_pytorch(mode, boundary):
    image, positions = golden_ops.image(5, 7, 3), golden_ops.positions(40, 5, 7)
    result = ops.sample(image, positions, mode=mode, boundary=boundary)
    np.testing.assert_allclose(result, GOLDEN[f"sample_{mode}_{boundary}"], atol=1e-6)


def test_bicubic_reproduces_quadratics():
    def quadratic(p):
        x, y = p[..., 0:1], p[..., 1:2]
        return 0.3 * x * x - 0.2 * x * y + 0.1 * y * y + x - 2

    positions = _random(1, 20, 2) + 4
    result = ops.sample(quadratic(np.asarray(ops.pixel_grid(9, 9))), positions, mode="bicubic")
    np.testing.assert_allclose(result, quadratic(positions), atol=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_sky_does_not_spread(mode):
    depth = np.full((4, 4, 1), 3.0, np.float32)
    depth[:, 2:] = np.inf
    on_pixels = ops.sample(depth, ops.pixel_grid(4, 4), mode=mode)
    np.testing.assert_array_equal(on_pixels, depth)
    np.testing.assert_array_equal(ops.resize(depth, (8, 8), "nearest")[:, :4], 3.0)
    gradient = jax.grad(lambda p: jnp.where(depth < 9, ops.sample(depth, p, mode=mode), 0).sum())(
        ops.pixel_grid(4, 4)
    )
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("mode", MODES)
def test_permuting_channels_commutes(mode):
    image, positions, order = _random(10, 5, 3, 3), 5 * _random(11, 4, 6, 2), [2, 0, 1]
    result = ops.sample(image, positions, mode=mode)
    np.testing.assert_array_equal(ops.sample(image[..., order], positions, mode=mode), result[..., order])


@pytest.mark.parametrize("mode", MODES)
def test_half_precision_is_summed_in_single(mode):
    image, positions = jnp.asarray(_random(12, 5, 3, 2), jnp.float16), 3 + 2 * _random(13, 7, 2)
    result = ops.sample(image, positions, mode=mode)
    assert result.dtype == jnp.float16
    expected = ops.sample(image.astype(jnp.float32), positions, mode=mode)
    np.testing.assert_array_equal(result, expected.astype(jnp.float16))


@pytest.mark.parametrize("mode", ["nearest", "bicubic"])
def test_far_and_nan_positions_are_outside(mode):
    image = _random(2, 3, 4, 2)
    far = np.array([[1e20, 1.0], [-np.inf, 1.0], [1.0, np.inf], [np.nan, np.nan]], np.float32)
    assert np.all(ops.sample(image, far, mode=mode, boundary="zero") == 0)
    expected = np.stack([image[1, 3], image[1, 0], image[2, 1], image[0, 0]])
    np.testing.assert_allclose(ops.sample(image, far, mode=mode), expected, atol=1e-6)
    gradient = jax.grad(lambda p: ops.sample(image, p, mode=mode).sum())(far)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(
    ("mode", "boundary"), [("bilinear", "clamp"), ("bilinear", "zero"), ("bicubic", "zero")]
)
def test_sample_gradients(mode, boundary):
    image = _random(3, 4, 5, 2)
    # Off the pixel centres, where bilinear weights have a kink; also outside.
    positions = np.array([[0.3, 1.6], [3.7, 2.4], [-0.4, 0.3], [4.6, 3.6], [7.3, -5.2]], np.float32)
    check_grads(
        lambda i, p: ops.sample(i, p, mode=mode, boundary=boundary),
        (image, positions),
        order=1,
        modes=["rev"],
        atol=1e-2,
        rtol=1e-2,
    )


def test_gradient_at_pixel_centres_is_the_right_sided_one():
    image = _random(4, 1, 4, 1)
    positions = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]], np.float32)
    gradient = jax.grad(lambda p: ops.sample(image, p).sum())(positions)
    row = image[0, :, 0]
    np.testing.assert_allclose(gradient[:, 0], [row[1] - row[0], row[2] - row[1], 0.0], atol=1e-6)


def test_resize_gradient_is_the_adjoint():
    image, weights = _random(5, 4, 3, 1), _random(6, 7, 9, 1)
    gradient = jax.grad(lambda x: jnp.sum(ops.resize(x, (7, 9), "bicubic") * weights))(image)
    np.testing.assert_allclose(
        np.sum(np.asarray(gradient) * image),
        np.sum(ops.resize(image, (7, 9), "bicubic") * weights),
        rtol=1e-4,
    )


@given(size=st.sampled_from(SIZES), scale=st.sampled_from([1, 2, 3]), seed=st.integers(0, 10**6))
def test_rearrangements_are_the_loops(size, scale, seed):
    image = _random(seed, *size, 2)
    np.testing.assert_array_equal(ops.zero_upsample(image, scale), reference.zero_upsample(image, scale))
    large = _random(seed, size[0] * scale, size[1] * scale, 2)
    packed = ops.pixel_unshuffle(large, scale)
    np.testing.assert_array_equal(packed, reference.pixel_unshuffle(large, scale))
    np.testing.assert_array_equal(ops.pixel_shuffle(packed, scale), large)


@given(size=st.sampled_from(SIZES), scale=st.sampled_from([1, 2, 3]), seed=st.integers(0, 10**6))
def test_zero_upsample_follows_the_offset(size, scale, seed):
    images = _random(seed, 2, *size, 2)
    offset = np.random.default_rng(seed).integers(0, scale, (2, 2)).astype(np.int32)
    result = ops.zero_upsample(images, scale, offset)
    expected = [reference.zero_upsample(i, scale, o) for i, o in zip(images, offset, strict=True)]
    np.testing.assert_array_equal(result, np.stack(expected))


def test_zero_upsample_keeps_type_and_does_not_spread():
    image = jnp.asarray([[[jnp.inf], [1.0]]], jnp.bfloat16)
    spread = ops.zero_upsample(image, 2, jnp.array([1, 0]))
    assert spread.dtype == jnp.bfloat16
    np.testing.assert_array_equal(spread[..., 0].astype(jnp.float32), [[0, np.inf, 0, 1], [0, 0, 0, 0]])
    assert not np.any(ops.zero_upsample(image, 2, jnp.array([2, 0])))  # beyond the block: nowhere


def test_zero_upsample_gradient_is_the_adjoint():
    image, weights, offset = _random(5, 3, 2, 1), _random(6, 9, 6, 1), jnp.array([2, 1])
    gradient = jax.grad(lambda x: jnp.sum(ops.zero_upsample(x, 3, offset) * weights))(image)
    np.testing.assert_array_equal(gradient, weights[1::3, 2::3])


def test_pixel_unshuffle_is_pytorch():
    np.testing.assert_array_equal(ops.pixel_unshuffle(golden_ops.image(4, 6, 3), 2), GOLDEN["unshuffle"])


def test_jit_and_batch():
    image, small = _random(7, 2, 4, 6, 4), _random(8, 2, 3, 3, 2)
    assert_jit_and_batch(lambda x: ops.zero_upsample(x, 2), image)
    assert_jit_and_batch(lambda x, o: ops.zero_upsample(x, 3, o), image, np.array([[0, 2], [1, 1]], np.int32))
    assert_jit_and_batch(lambda x: ops.pixel_shuffle(ops.pixel_unshuffle(x, 2), 2), image)
    assert_jit_and_batch(lambda x: ops.resize(x, (5, 5)), image)
    assert_jit_and_batch(lambda x: ops.upsample(x, 2), image)
    assert_jit_and_batch(ops.sample, image, small)


def test_upsample_traces_with_symbolic_sizes():
    h, w = jax.export.symbolic_shape("h, w")
    shape = jax.ShapeDtypeStruct((1, h, w, 3), jnp.float32)
    exported = jax.export.export(jax.jit(lambda x: ops.upsample(x, 2, "bilinear")))(shape)
    image = _random(9, 1, 3, 4, 3)
    np.testing.assert_allclose(exported.call(image), ops.upsample(image, 2, "bilinear"), atol=1e-6)


@pytest.mark.parametrize(
    "call",
    [
        lambda x: ops.sample(x, x[..., :2], mode="cubic"),
        lambda x: ops.sample(x, x[..., :2], boundary="wrap"),
        lambda x: ops.resize(x, (2, 2), "area"),
        lambda x: ops.resize(x, (0, 2)),
        lambda x: ops.upsample(x, 0),
        lambda x: ops.zero_upsample(x, 0),
        lambda x: ops.pixel_unshuffle(x, 2),
        lambda x: ops.pixel_shuffle(x, 2),
    ],
)
def test_bad_arguments_are_named(call):
    with pytest.raises(JaxsrError, match="expected"):
        call(jnp.zeros((3, 3, 2)))
