from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr import ops, srgb
from jaxsr.errors import JaxsrError
from jaxsr.ops.color import KINDS
from tests.reference import color as reference
from tests.reference import golden_ops
from tests.transforms import assert_jit_and_batch

GOLDEN = np.load(Path(__file__).parents[1] / "reference" / "golden_ops.npz")
HARD = np.array(
    [-np.inf, -3.0, -0.0, 0.0, 1e-30, 0.0031308, 0.04045, 1.0, 7.2416735, 50.0, 1e6, 1e30], np.float32
)
CURVES = [lambda x, k=k: ops.tone_map(x, k) for k in KINDS]
INVERSES = [lambda x, k=k: ops.inverse_tone_map(x, k) for k in KINDS]
OTHERS = [ops.srgb_from_linear, ops.linear_from_srgb, ops.to_display, ops.from_display]


def _values(seed, size):
    """Spread over twelve decades, with some zeros and negatives."""
    rng = np.random.default_rng(seed)
    values = 10.0 ** rng.uniform(-6, 6, (*size, 3)) * rng.choice([1, 1, 1, 0, -1], (*size, 3))
    return values.astype(np.float32)


@given(size=st.sampled_from([(1, 1), (3, 5)]), kind=st.sampled_from(KINDS), seed=st.integers(0, 10**6))
def test_curves_are_the_formulas(size, kind, seed):
    x = _values(seed, size)
    expected = np.vectorize(lambda v: reference.tone_map(v, kind))(x.astype(np.float64))
    np.testing.assert_allclose(ops.tone_map(x, kind), expected, rtol=2e-6)
    expected = np.vectorize(reference.srgb_from_linear)(x.astype(np.float64))
    np.testing.assert_allclose(ops.srgb_from_linear(x), expected, rtol=1e-5)
    expected = np.vectorize(lambda v: reference.to_display(v, 0.7))(x.astype(np.float64))
    np.testing.assert_allclose(ops.to_display(x, 0.7), expected, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_curves_invert(kind):
    x = np.float32(10) ** np.linspace(-6, 0.8, 200, dtype=np.float32)  # up to 6.3; ACES ends at 7.24
    # A little relative error of y is a larger one of x where the curve is flat.
    tolerance = {"aces": 2e-5, "reinhard": 3e-6, "log": 2e-6}[kind]
    np.testing.assert_allclose(ops.inverse_tone_map(ops.tone_map(x, kind), kind), x, rtol=tolerance)


def test_srgb_and_display_invert():
    x = np.linspace(0, 1, 401, dtype=np.float32)
    np.testing.assert_allclose(ops.linear_from_srgb(ops.srgb_from_linear(x)), x, atol=1e-6)
    np.testing.assert_allclose(ops.to_display(ops.from_display(x, 0.5), 0.5), x, atol=2e-5)
    bright = np.linspace(0, 6, 50, dtype=np.float32)
    np.testing.assert_allclose(ops.from_display(ops.to_display(bright)), bright, rtol=2e-4, atol=1e-6)


def test_known_values():
    np.testing.assert_allclose(ops.tone_map(np.ones(1, np.float32)), 2.54 / 3.16, rtol=1e-6)
    np.testing.assert_allclose(ops.tone_map(np.array([7.2416735, 8.0, np.inf], np.float32)), 1.0, rtol=1e-6)
    np.testing.assert_allclose(ops.inverse_tone_map(np.ones(1, np.float32)), 7.2416735, rtol=1e-5)
    np.testing.assert_allclose(ops.luminance(np.array([[0.2, 0.5, 0.9]], np.float32)), [[0.46510]], rtol=1e-5)


def test_srgb_and_ycocg_are_colour_science():
    rgb = golden_ops.rgb()
    np.testing.assert_allclose(ops.srgb_from_linear(rgb), GOLDEN["srgb"], atol=1e-6)
    np.testing.assert_allclose(ops.linear_from_srgb(rgb), GOLDEN["linear"], atol=1e-6)
    np.testing.assert_allclose(ops.ycocg_from_rgb(rgb), GOLDEN["ycocg"], atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_srgb_in_numpy(dtype):
    """IEC 61966-2-1: the two pieces meet at 0.04045, and 0.5 decodes to 0.21404."""
    x = np.array([-1.0, 0.0, 0.04045, 0.5, 1.0, 1.5, np.nan], dtype)
    linear = srgb.linear_from_srgb(x)
    np.testing.assert_allclose(linear[:5], [0, 0, 0.0031308, 0.2140411, 1], atol=1e-6)
    assert linear.dtype == srgb.srgb_from_linear(x).dtype == dtype
    np.testing.assert_allclose(srgb.srgb_from_linear(linear)[1:], x[1:], atol=1e-6)
    expected = [reference.srgb_from_linear(float(v)) for v in x[:-1]]
    np.testing.assert_allclose(srgb.srgb_from_linear(x)[:-1], expected, rtol=1e-6)
    assert np.isnan(srgb.srgb_from_linear(x)[-1])


@given(size=st.sampled_from([(1, 1), (3, 5)]), seed=st.integers(0, 10**6))
def test_ycocg_and_luminance(size, seed):
    rgb = np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32)
    np.testing.assert_allclose(ops.rgb_from_ycocg(ops.ycocg_from_rgb(rgb)), rgb, atol=1e-6)
    for y, x in np.ndindex(size):
        expected = reference.luminance(*(float(v) for v in rgb[y, x]))
        assert float(ops.luminance(rgb)[y, x, 0]) == pytest.approx(expected, abs=1e-6)
    grey = np.full((2, 3), 0.37, np.float32)
    np.testing.assert_allclose(ops.ycocg_from_rgb(grey), [[0.37, 0, 0]] * 2, atol=1e-7)


@pytest.mark.parametrize("curve", CURVES + OTHERS[:1] + OTHERS[2:3])
def test_curves_rise(curve):
    x = np.concatenate([[0], 10.0 ** np.linspace(-8, 8, 500)]).astype(np.float32)
    y = np.asarray(curve(x))
    assert np.all(np.diff(y) >= -1e-6 * y[1:])
    assert np.all(np.diff(y[x < 1]) > 0)


@pytest.mark.parametrize("curve", CURVES + INVERSES + OTHERS)
def test_hard_inputs_have_finite_values_and_gradients(curve):
    x = HARD[HARD < 1e16] if curve is OTHERS[1] else HARD  # squares of linear_from_srgb overflow above
    assert np.isfinite(curve(x)).all()
    gradient = np.asarray(jax.vmap(jax.grad(lambda v: curve(v[None])[0]))(jnp.asarray(x)))
    assert np.isfinite(gradient).all()
    assert np.all(gradient[x < 0] == 0)  # -0.0 is not below 0
    assert np.all(gradient[x == 0] > 0)
    negative = curve(np.array([-1.0], np.float32))
    np.testing.assert_array_equal(negative, curve(np.zeros(1, np.float32)))


@pytest.mark.parametrize("curve", CURVES + INVERSES + OTHERS)
def test_nan_is_seen_and_stays_in_its_pixel(curve):
    x = np.array([0.5, np.nan, 0.25], np.float32)
    np.testing.assert_array_equal(np.isnan(curve(x)), [False, True, False])
    gradient = jax.grad(lambda v: jnp.where(jnp.isnan(v), 0, curve(v)).sum())(x)
    assert np.isfinite(gradient[jnp.array([0, 2])]).all()


@pytest.mark.parametrize("curve", CURVES + INVERSES + OTHERS)
def test_gradients_are_the_differences(curve):
    x = jnp.asarray([0.002, 0.02, 0.3, 0.6, 0.9], jnp.float32)
    step = 1e-3
    difference = (np.asarray(curve(x + step * x), np.float64) - np.asarray(curve(x - step * x))) / (
        2 * step * x
    )
    gradient = jax.vmap(jax.grad(lambda v: curve(v[None])[0]))(x)
    np.testing.assert_allclose(gradient, difference, rtol=5e-3)


def test_display_is_the_chain_and_stays_in_range():
    x = _values(0, (5, 7))
    display = np.asarray(ops.to_display(x, 2.0))
    assert display.min() >= 0
    assert display.max() <= 1
    np.testing.assert_allclose(display, ops.srgb_from_linear(ops.tone_map(x * 2, "aces")), atol=1e-6)


def test_jit_and_batch():
    x = np.abs(_values(1, (2, 3, 4))).clip(0, 3)
    functions = [*CURVES, *INVERSES, *OTHERS, ops.ycocg_from_rgb, ops.rgb_from_ycocg, ops.luminance]
    assert_jit_and_batch(lambda v: [f(v) for f in functions], x)


@pytest.mark.parametrize("fn", [ops.tone_map, ops.inverse_tone_map])
def test_unknown_kind_is_named(fn):
    with pytest.raises(JaxsrError, match="aces"):
        fn(jnp.zeros((2, 2, 3)), "filmic")
