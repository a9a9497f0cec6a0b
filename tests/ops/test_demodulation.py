import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr import ops
from jaxsr.errors import JaxsrError
from tests.reference import demodulation as reference
from tests.transforms import assert_jit_and_batch


def _scene(seed, size):
    """Colour, base colour with black and NaN pixels and black channels, surface, specular, metallic."""
    rng = np.random.default_rng(seed)
    base = (
        rng.uniform(0, 1, (*size, 3))
        * rng.choice([0, 1, 1], (*size, 3))
        * rng.choice([0, 1, 1, np.nan], (*size, 1))
    )
    color = 10.0 ** rng.uniform(-3, 3, (*size, 3))
    surface = jnp.asarray(rng.choice([True, True, False], (*size, 1)))
    color, base, specular, metallic = (
        jnp.asarray(a, jnp.float32) for a in (color, base, *rng.uniform(0, 1, (2, *size, 1)))
    )
    return color, base, surface, specular, metallic


@given(
    size=st.sampled_from([(1, 1), (4, 5)]),
    seed=st.integers(0, 10**6),
    names=st.sampled_from([(), ("specular",), ("specular", "metallic")]),
    sky=st.sampled_from([None, bool, float]),
)
def test_divisor_is_the_loop_and_modulate_inverts(size, seed, names, sky):
    color, base, surface, specular, metallic = _scene(seed, size)
    values = {"specular": specular, "metallic": metallic}
    extra = {name: values[name] for name in names}
    divisor = reference.divisor(
        base, None if sky is None else surface, extra.get("specular"), extra.get("metallic"), 0.02
    )
    if sky is not None:
        extra["surface"] = surface.astype(sky)
    lighting = ops.demodulate(color, base, **extra)
    np.testing.assert_allclose(ops.demodulation_divisor(base, **extra), divisor, rtol=1e-6)
    np.testing.assert_allclose(lighting, np.asarray(color) / divisor, rtol=1e-6)
    np.testing.assert_allclose(ops.modulate(lighting, base, **extra), color, rtol=3e-7)


def test_sky_keeps_its_colour_whatever_its_base_colour():
    color = jnp.asarray([[[5.0, 6.0, 7.0], [1.0, 2.0, 3.0], [4.0, jnp.inf, 1.0]]])
    base = jnp.asarray([[[0.0, 0.0, 0.0], [jnp.nan, jnp.nan, jnp.nan], [0.7, 0.1, 0.3]]])
    sky = jnp.isfinite(jnp.full((1, 3, 1), jnp.inf))
    np.testing.assert_array_equal(ops.demodulate(color, base, surface=sky), color)
    np.testing.assert_array_equal(ops.modulate(color, base, surface=sky), color)


@pytest.mark.parametrize("surface", [None, jnp.ones((1, 3, 1), bool)])
def test_lighting_does_not_jump_at_exactly_black(surface):
    """Black ink beside nearly black ink under one light: the lighting of both has one scale."""
    base = jnp.asarray([0.0, 0.0001, jnp.nan], jnp.float32)[None, :, None] * jnp.ones((1, 1, 3))
    lighting = ops.demodulate(jnp.full((1, 3, 3), 0.05), base, surface=surface)
    np.testing.assert_allclose(lighting, 2.5, rtol=1e-6)


def test_texture_leaves_the_lighting():
    rng = np.random.default_rng(0)
    base = jnp.asarray(rng.uniform(0.05, 1, (6, 7, 3)), jnp.float32)
    lighting = jnp.full((6, 7, 3), 1.7, jnp.float32)
    np.testing.assert_allclose(ops.demodulate(base * lighting, base), lighting, rtol=1e-6)


def test_a_float_is_a_constant_specular_and_metal_has_none():
    color, base, _, specular, _ = _scene(1, (2, 3))
    constant = ops.demodulate(color, base, specular=jnp.full_like(specular, 0.5))
    np.testing.assert_allclose(ops.demodulate(color, base, specular=0.5), constant, rtol=1e-6)
    metal = ops.demodulate(color, base, specular=0.5, metallic=jnp.ones_like(specular))
    np.testing.assert_allclose(metal, ops.demodulate(color, base), rtol=1e-6)


@pytest.mark.parametrize("fn", [ops.demodulate, ops.modulate])
def test_gradients_are_finite_and_bounded(fn):
    color, base, surface, specular, metallic = _scene(2, (6, 6))
    base = base.at[0].set(0).at[1, :, 1].set(0).at[2].set(0.02)
    metallic, specular = metallic.at[3].set(jnp.nan), specular.at[4].set(jnp.nan)

    def total(c, b, s, m):
        return fn(c, b, surface=surface, specular=s, metallic=m).sum()

    gradients = jax.grad(total, argnums=(0, 1, 2, 3))(color, base, specular, metallic)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
    for gradient in gradients[1:]:
        np.testing.assert_array_equal(np.where(surface, 0, gradient), 0)
    assert np.abs(gradients[0]).max() <= (50.01 if fn is ops.demodulate else 1.2)


def test_gradient_is_the_quotient_rule():
    color, base = jnp.asarray([[[2.0, 3.0, 4.0]]]), jnp.asarray([[[0.5, 0.01, 0.25]]])
    gradient = jax.grad(lambda b: ops.demodulate(color, b).sum())(base)
    # The middle channel sits on the guard: constant.
    np.testing.assert_allclose(gradient[0, 0], [-2.0 / 0.25, 0.0, -4.0 / 0.0625], rtol=1e-6)


def test_jit_and_batch():
    arrays = _scene(3, (2, 3, 4))
    assert_jit_and_batch(
        lambda c, b, f, s, m: ops.demodulate(c, b, surface=f, specular=s, metallic=m), *arrays
    )
    assert_jit_and_batch(ops.modulate, *arrays[:2])


def test_bad_guard_is_named():
    color, base, *_ = _scene(4, (1, 1))
    for eps in (0.0, -1.0, float("nan")):
        with pytest.raises(JaxsrError, match="positive"):
            ops.demodulate(color, base, eps=eps)


def test_the_divisor_does_not_jump_between_dark_surfaces():
    """Lighting that a filter carries from a dark surface to a darker one must not flare up."""
    base = jnp.repeat(jnp.linspace(0.0, 0.05, 200)[:, None, None], 3, -1)
    divisor = np.asarray(ops.demodulation_divisor(base))[:, 0, 0]
    assert (divisor[1:] / divisor[:-1]).max() < 1.1
    assert divisor[0] == pytest.approx(0.02)
    tint = jnp.array([[[0.0, 0.019, 0.0]]])  # one dark channel is a surface too
    np.testing.assert_allclose(ops.demodulation_divisor(tint), 0.02)
