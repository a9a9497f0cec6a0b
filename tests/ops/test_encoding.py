"""What networks are given: normalised depth, compressed lighting."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsr.ops.encoding import compress_lighting, expand_lighting, normalized_depth


def random_depth(seed=0, size=(9, 7)):
    return jnp.asarray(np.exp(np.random.default_rng(seed).normal(1, 1, (*size, 1))), jnp.float32)


def test_depth_is_free_of_the_scene_s_scale():
    depth = random_depth().at[:2].set(jnp.inf)
    found = normalized_depth(depth)
    for scale in (1e-3, 100.0):
        np.testing.assert_allclose(normalized_depth(scale * depth), found, atol=1e-6)
    np.testing.assert_array_equal(found[:2], 1)
    solid = np.asarray(depth[2:])
    expected = 0.5 + np.log2(solid / np.exp(np.log(solid).mean())) / 16
    np.testing.assert_allclose(found[2:], expected, atol=1e-6)


def test_a_crop_shifts_depth_by_a_constant():
    depth = random_depth(1).at[3, 3].set(jnp.inf)
    solid = np.isfinite(np.asarray(depth[2:8, 1:5]))
    shift = np.asarray(normalized_depth(depth)[2:8, 1:5] - normalized_depth(depth[2:8, 1:5]))[solid]
    np.testing.assert_allclose(shift, shift[0], atol=1e-6)
    assert abs(shift[0]) > 1e-4
    batch = jnp.stack([depth, 3 * depth])  # each image has a mean of its own
    np.testing.assert_allclose(normalized_depth(batch)[1], normalized_depth(depth), atol=1e-6)


def test_depths_beyond_the_range_and_skies():
    depth = jnp.array([1e-12, 1.0, 1.0, 1.0, 1.0, 1.0, 1e12, jnp.inf, 0.0, jnp.nan])[None, :, None]
    found = np.asarray(normalized_depth(depth))[0, :, 0]
    assert found[0] == 0
    np.testing.assert_allclose(found[1:6], 0.5, atol=1e-6)
    np.testing.assert_array_equal(found[6:], 1)
    np.testing.assert_array_equal(normalized_depth(jnp.full((3, 2, 1), jnp.inf)), 1)  # nothing but sky


def test_lighting_is_compressed_and_expanded():
    lighting = jnp.array([0, 1e-6, 1e-3, 0.1, 1.0, 10.0, 400.0])
    compressed = compress_lighting(lighting)
    assert (np.diff(compressed) > 0).all()
    assert (compressed < 1).all()
    np.testing.assert_allclose(expand_lighting(compressed), lighting, rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(expand_lighting(jnp.array([1.0, 7.0])), 499.25, rtol=1e-4)
    for function in (compress_lighting, expand_lighting):
        slope = jax.vmap(jax.grad(function))(jnp.array([0.0, 0.5, 0.9995, 1.0, 3.0]))
        assert np.isfinite(slope).all()
