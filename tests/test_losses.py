"""Losses: loops in NumPy, invariants, and gradients that are finite wherever images are degenerate."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxsr import losses, metrics
from jaxsr.errors import JaxsrError
from jaxsr.nets import vgg as perceptual
from tests.reference import losses as reference

needs_weights = pytest.mark.skipif(not perceptual.installed(), reason="needs the extra `perceptual`")

SIZES = [(11, 11), (13, 17), (16, 12)]
PIXELWISE = {
    "charbonnier": losses.charbonnier,
    "census": losses.census,
    "feature_census": losses.feature_census,
    "hard_l1": losses.hard_l1,
    "ssim_loss": losses.ssim_loss,
    "temporal_l1": losses.temporal_l1,
    "hole_l1": lambda a, b: losses.hole_l1(a, b, jnp.zeros((*a.shape[:-1], 1), jnp.float32)),
}
each_loss = pytest.mark.parametrize("loss", PIXELWISE.values(), ids=PIXELWISE)


def _images(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).random((2, *shape), dtype=np.float32))


def _numbers(*arrays):
    return [np.asarray(a) for a in arrays]


def _of(loss, *arrays):
    """The value, compiled: eager, the tests take four times as long."""
    return float(jax.jit(loss)(*arrays))


@given(st.sampled_from(SIZES), st.integers(0, 10**6))
def test_charbonnier_is_the_loop(size, seed):
    pred, target = _images(seed, 2, *size, 3)
    assert _of(losses.charbonnier, pred, target) == pytest.approx(
        reference.charbonnier(*_numbers(pred, target)), rel=1e-5
    )


@given(st.sampled_from([(7, 7), (8, 11)]), st.integers(0, 10**6))
def test_census_is_the_loop(size, seed):
    pred, target = _images(seed, 1, *size, 3)
    assert _of(losses.census, pred, target) == pytest.approx(
        reference.census(*_numbers(pred, target)), rel=1e-4
    )


@given(st.sampled_from([(3, 3), (5, 4)]), st.sampled_from([1, 4]), st.integers(0, 10**6))
def test_feature_census_is_the_loop(size, channels, seed):
    a, b = 10 * _images(seed, 2, *size, channels)
    assert _of(losses.feature_census, a, b) == pytest.approx(
        reference.feature_census(*_numbers(a, b)), rel=1e-4
    )


@given(st.sampled_from([(1, 1), (4, 6)]), st.floats(0, 1), st.integers(0, 10**6))
def test_hole_l1_is_the_loop(size, share, seed):
    pred, target = _images(seed, 2, *size, 3)
    mask = jnp.asarray(np.random.default_rng(seed).random((2, *size, 1)) > share, jnp.float32)
    expected = reference.hole_l1(*_numbers(pred, target, mask))
    assert _of(losses.hole_l1, pred, target, mask) == pytest.approx(expected, abs=1e-6)


@given(st.sampled_from([(1, 1), (4, 6)]), st.sampled_from([0.01, 0.1, 0.5, 1.0]), st.integers(0, 10**6))
def test_hard_l1_is_the_loop(size, fraction, seed):
    pred, target = _images(seed, 2, *size, 3)
    expected = reference.hard_l1(*_numbers(pred, target), fraction)
    assert float(losses.hard_l1(pred, target, fraction)) == pytest.approx(expected, rel=1e-5)


@given(st.sampled_from([(11, 11), (13, 12)]), st.integers(0, 10**6))
def test_ssim_is_the_loop_and_the_metric(size, seed):
    pred, target = _images(seed, 2, *size, 3)
    found = 1 - _of(losses.ssim_loss, pred, target)
    assert found == pytest.approx(reference.ssim(*_numbers(pred, target)), abs=2e-6)
    of_metric = np.mean([metrics.ssim(a, b) for a, b in zip(pred, target, strict=True)])
    assert found == pytest.approx(of_metric, abs=2e-6)


def test_known_values():
    black, grey = jnp.zeros((1, 16, 16, 3)), jnp.full((1, 16, 16, 3), 0.5)
    assert _of(losses.charbonnier, black, black) == pytest.approx(1e-3, rel=1e-5)
    assert _of(losses.charbonnier, grey, black) == pytest.approx((0.25 + 1e-6) ** 0.5)
    assert _of(losses.census, grey, black) == pytest.approx(0, abs=1e-7)  # a shift in brightness
    assert _of(losses.temporal_l1, grey, black) == pytest.approx(0.5)
    assert _of(losses.hard_l1, grey, black) == pytest.approx(0.5)
    # Constant images: structure 1, luminance C1 / (a^2 + C1).
    assert _of(losses.ssim_loss, grey, black) == pytest.approx(1 - 1e-4 / (0.25 + 1e-4), rel=1e-5)


def test_a_census_patch_that_differs_in_one_neighbour():
    a = jnp.zeros((1, 3, 3, 1))
    b = a.at[0, 0, 1, 0].set(
        0.9
    )  # n = 0.9 / sqrt(0.81 + 0.81), n^2 = 1/2; one of 9 places, of one pixel in 9
    assert _of(losses.feature_census, a, b) == pytest.approx(0.5 / 0.6 / 81, rel=1e-5)


def test_holes_alone_count():
    pred, target = _images(1, 1, 6, 6, 3)
    mask = jnp.ones((1, 6, 6, 1))
    assert float(losses.hole_l1(pred, target, mask)) == 0
    mask = mask.at[0, 2, 3].set(0)
    expected = float(jnp.abs(pred - target)[0, 2, 3].mean())
    assert float(losses.hole_l1(pred, target, mask)) == pytest.approx(expected, rel=1e-6)
    gradient = jax.grad(losses.hole_l1)(pred, target, mask)
    assert np.count_nonzero(gradient) == 3
    assert np.abs(gradient).sum() == pytest.approx(1.0, rel=1e-6)


def test_hard_l1_pushes_the_worst_pixels_alone():
    pred, target = _images(2, 1, 10, 10, 2)
    gradient = np.asarray(jax.grad(losses.hard_l1)(pred, target))[0]
    error = np.abs(np.asarray(pred - target))[0]
    for c in range(2):
        moved = gradient[..., c] != 0
        assert moved.sum() == 10
        assert error[moved, c].min() > error[~moved, c].max()


@each_loss
@given(seed=st.integers(0, 10**6))
def test_identical_images_are_the_least(loss, seed):
    pred, target = _images(seed, 1, 16, 16, 3)
    least = _of(loss, target, target)
    assert least == pytest.approx(1e-3 if loss is losses.charbonnier else 0, abs=1e-6)
    assert _of(loss, pred, target) > least + 1e-3


@each_loss
@given(seed=st.integers(0, 10**6))
def test_symmetric_and_mirrored(loss, seed):
    pred, target = _images(seed, 2, 16, 16, 3)
    found = _of(loss, pred, target)
    assert _of(loss, target, pred) == pytest.approx(found, rel=1e-5)
    assert _of(loss, pred[:, :, ::-1], target[:, :, ::-1]) == pytest.approx(found, rel=1e-5)
    assert _of(loss, pred.swapaxes(1, 2), target.swapaxes(1, 2)) == pytest.approx(found, rel=1e-5)


@each_loss
def test_a_batch_is_the_mean_of_its_images_and_jit_is_eager(loss):
    pred, target = _images(3, 2, 16, 16, 3)
    found = float(jax.jit(loss)(pred, target))
    with jax.disable_jit():
        eager = float(loss(pred, target))
    assert found == pytest.approx(eager, rel=1e-5)
    one_by_one = [_of(loss, a, b) for a, b in zip(pred, target, strict=True)]
    assert found == pytest.approx(np.mean(one_by_one), rel=1e-5)


@each_loss
@pytest.mark.parametrize(
    ("pred", "target"),
    [(0.0, 0.0), (1.0, 1.0), (0.5, 0.5), (0.0, 1.0), (-3.0, 1.0), (1e4, 0.0), ("noise", "noise")],
)
def test_gradients_are_finite_where_images_are_degenerate(loss, pred, target):
    noise = _images(4, 1, 16, 16, 3)[0]
    pred, target = (noise if v == "noise" else jnp.full(noise.shape, v) for v in (pred, target))
    value, gradients = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(pred, target)
    assert np.isfinite(value)
    assert all(np.isfinite(g).all() for g in gradients)


@each_loss
@pytest.mark.parametrize("types", [("float64", "float64"), ("float32", "float64"), ("float64", "float32")])
def test_double_precision(loss, types):
    """Of images of two types the wider is the loss's, and each gradient has the type of its image."""
    with jax.enable_x64(True):
        pair = [jax.ShapeDtypeStruct((1, 16, 16, 3), kind) for kind in types]
        value, gradients = jax.eval_shape(jax.value_and_grad(loss, argnums=(0, 1)), *pair)
    assert (value.dtype, *(g.dtype for g in gradients)) == ("float64", *types)


def test_a_loss_of_doubles_has_their_digits():
    with jax.enable_x64(True):
        d = jnp.full((4, 4, 1), 1e-9, jnp.float64)
        value = losses.temporal_l1(1 + d, jnp.ones_like(d))
    assert float(value) == pytest.approx(1e-9, rel=1e-6)


def test_no_holes_have_no_gradient():
    pred, target = _images(5, 1, 4, 4, 3)
    gradient = jax.grad(losses.hole_l1)(pred, target, jnp.ones((1, 4, 4, 1)))
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.parametrize("name", ["census", "feature_census", "ssim_loss"])
def test_gradients_are_the_slopes(name):
    pred, target = _images(6, 1, 12, 13, 3)
    # Scaled: a mean over so many pixels has a slope too small for single precision.
    check_grads(
        jax.jit(lambda a, b: 100 * PIXELWISE[name](a, b)),
        (pred, target),
        order=1,
        modes=["rev"],
        atol=2e-2,
        rtol=2e-2,
        eps=1e-2,
    )


def test_the_gradient_of_charbonnier_turns_within_a_thousandth():
    d = jnp.array([-0.5, -1e-3, -1e-5, 0.0, 1e-3, 0.2])[None, :, None]
    gradient = jax.grad(losses.charbonnier)(0.3 + d, jnp.full_like(d, 0.3))
    np.testing.assert_allclose(6 * gradient, d / np.sqrt(d * d + 1e-6), atol=1e-4)


@given(seed=st.integers(0, 10**6))
def test_the_gradient_of_the_window_is_its_adjoint(seed):
    image, weights = _images(seed, 1, 24, 13, 2)
    weights = weights[:, :14, :3]
    found, pull = jax.vjp(losses.gaussian_window, image)
    assert float(jnp.vdot(found, weights)) == pytest.approx(
        float(jnp.vdot(pull(weights)[0], image)), rel=1e-5
    )


def test_temporal_l1_moves_both_frames():
    now, before = _images(7, 1, 4, 4, 3)
    gradients = jax.grad(losses.temporal_l1, argnums=(0, 1))(now, before)
    np.testing.assert_allclose(gradients[0], -gradients[1])
    assert np.abs(gradients[0]).sum() == pytest.approx(1.0, rel=1e-5)


@needs_weights
def test_vgg_l1():
    pred, target = _images(8, 2, 16, 16, 3)
    params = perceptual.load_params("vgg")

    @jax.jit
    def run(pred, target, params):
        value, gradients = jax.value_and_grad(losses.vgg_l1, argnums=(0, 1))(pred, target, params)
        return value, gradients, [perceptual.features(x, "vgg", params) for x in (pred, target)]

    value, gradients, layers = run(pred, target, params)
    expected = np.mean([np.abs(a - b).mean() for a, b in zip(*layers, strict=True)])
    assert float(value) == pytest.approx(expected, rel=1e-5)
    assert np.isfinite(gradients[0]).all()
    assert np.abs(gradients[0]).max() > 0
    np.testing.assert_array_equal(gradients[1], 0)
    same, (gradient, _), _ = run(target, target, params)
    assert float(same) == 0
    assert np.isfinite(gradient).all()


def test_lpips_is_here_too():
    assert inspect.unwrap(losses.lpips) is inspect.unwrap(perceptual.lpips)
    assert set(losses.__all__) <= set(dir(losses))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda x: losses.census(x[:6], x[:6]),
            "smaller than the census patch; expected at least 7x7; found 6x",
        ),
        (lambda x: losses.feature_census(x[:2], x[:2]), "expected at least 3x3"),
        (lambda x: losses.ssim_loss(x[:, :10], x[:, :10]), "smaller than the SSIM window.*found 16x10"),
        (lambda x: losses.hard_l1(x, x, 0.0), r"hard_l1: bad fraction; expected in \(0, 1\]; found 0"),
        (lambda x: losses.hard_l1(x, x, 1.5), "found 1.5"),
    ],
)
def test_refusals(call, words):
    with pytest.raises(JaxsrError, match=words):
        call(jnp.zeros((16, 16, 3)))
