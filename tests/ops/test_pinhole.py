"""jaxsr.ops.pinhole in NumPy: float64, and the same camera as that of the compiled ops and of the loops."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr import ops
from jaxsr.data import analytic
from jaxsr.frames import Camera
from jaxsr.ops import pinhole
from tests.builders import frame_info
from tests.reference import geometry as reference

SIZE = (10, 16)
NOW, BEFORE = (frame_info(t, SIZE[::-1]) for t in (5, 4))
JITTER = (0.25, -0.125)
LENS = Camera(np.eye(4), np.array([0.6, 0.3]), np.array([0.1, -0.2]))


def depth_with_sky():
    depth = np.random.default_rng(0).uniform(1, 20, (*SIZE, 1)).astype(np.float32)
    depth[2, 3] = np.inf
    return depth


@pytest.mark.parametrize("size", [(1, 1), (3, 7), (9, 16)])
@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.25, -0.375)])
def test_pixels_come_back(size, jitter):
    p = pinhole.unjittered_positions(size, jitter, np.float64, np)
    assert p.shape == (*size, 2)
    np.testing.assert_array_equal(p[0, 0], jitter)
    np.testing.assert_array_equal(p[-1, -1], np.array(size[::-1]) - 1 + jitter)
    rays = pinhole.view_rays(p, LENS, size, np)
    z = np.random.default_rng(0).uniform(0.1, 100, (*size, 1))
    np.testing.assert_allclose(pinhole.pixels_from_view(rays * z, LENS, size, np), p, atol=1e-9)


def test_the_corners_of_the_image_are_half_a_pixel_outside():
    camera = Camera(np.eye(4), np.array([0.5, 0.25]), np.zeros(2))
    corners = np.array([[-0.5, -0.25, 1], [0.5, 0.25, 1]]) * 3
    found = pinhole.pixels_from_view(corners, camera, (4, 8), np)
    np.testing.assert_allclose(found, [[-0.5] * 2, [7.5, 3.5]])


@pytest.mark.parametrize("jitter", [None, JITTER])
def test_it_is_the_camera_of_the_compiled_ops(jitter):
    depth = depth_with_sky()
    jax_jitter = None if jitter is None else np.float32(jitter)
    position = pinhole.world_from_depth(depth, NOW, jitter, np)
    assert position.dtype == np.float64
    assert not position[2, 3].any()
    np.testing.assert_allclose(ops.world_position(depth, NOW.camera, jax_jitter), position, atol=1e-4)
    cameras = NOW.camera, BEFORE.camera
    motion = pinhole.still_motion(depth, NOW, BEFORE, jitter, np)
    np.testing.assert_allclose(ops.camera_motion(depth, *cameras, jax_jitter), motion, atol=1e-4)
    before = pinhole.still_depth(depth, NOW, BEFORE, jitter, np)
    np.testing.assert_allclose(ops.previous_depth(depth, *cameras, jax_jitter), before, atol=1e-4)
    assert motion.dtype == before.dtype == np.float64
    pixels, z = pinhole.pixels_from_world(position, NOW, SIZE, np)
    found = ops.project(jnp.asarray(position, jnp.float32), NOW.camera, SIZE)
    np.testing.assert_allclose(found[0], pixels, atol=1e-3)
    np.testing.assert_allclose(found[1], z, atol=1e-4)


def test_it_is_the_loop_in_double_precision():
    depth = depth_with_sky()
    depth[2, 3] = 1e9  # what the loops take for sky
    now, before = (analytic.camera(t, SIZE[::-1]) for t in (5, 4))
    expected = reference.world_position(depth, now, JITTER)
    np.testing.assert_allclose(pinhole.world_from_depth(depth, now, JITTER, np), expected, rtol=1e-12)
    expected = reference.camera_motion(depth, now, before, JITTER)
    np.testing.assert_allclose(pinhole.still_motion(depth, now, before, JITTER, np), expected, atol=1e-9)
    expected = reference.previous_depth(depth, now, before, JITTER)
    np.testing.assert_allclose(pinhole.still_depth(depth, now, before, JITTER, np), expected, rtol=1e-12)


def test_behind_the_eye():
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1.0, 1.0, 1e-9]])
    pixels, depth = pinhole.pixels_from_world(points, LENS, (3, 3), np)
    np.testing.assert_array_equal(pixels, pinhole.BEHIND_PX)
    np.testing.assert_array_equal(depth, points[:, 2:])
