"""jaxsr.io.geometry: pixels to the image plane and back, and the same camera as that of jaxsr.ops."""

import numpy as np
import pytest

from jaxsr import ops
from jaxsr.frames import Camera
from jaxsr.io.geometry import image_plane, to_pixels, world_position
from tests.builders import frame_info


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (16, 9)])
@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.25, -0.375)])
def test_pixels_come_back(size, jitter):
    camera = Camera(np.eye(4), np.array([0.6, 0.3]), np.array([0.1, -0.2]))
    p, xy = image_plane(size, camera, jitter)
    assert p.shape == xy.shape == (size[1], size[0], 2)
    np.testing.assert_array_equal(p[0, 0], jitter)
    np.testing.assert_array_equal(p[-1, -1], np.array(size) - 1 + jitter)
    z = np.random.default_rng(0).uniform(0.1, 100, (*xy.shape[:2], 1))
    np.testing.assert_allclose(to_pixels(xy * z, z, camera, size), p, atol=1e-9)


def test_the_corners_of_the_image_are_half_a_pixel_outside():
    camera = Camera(np.eye(4), np.array([0.5, 0.25]), np.zeros(2))
    corners = np.array([[-0.5, -0.25], [0.5, 0.25]]) * 3
    np.testing.assert_allclose(
        to_pixels(corners, np.full((2, 1), 3.0), camera, (8, 4)), [[-0.5] * 2, [7.5, 3.5]]
    )


def test_it_is_the_camera_of_ops():
    info, jitter = frame_info(5, (16, 10)), (0.25, -0.125)
    depth = np.random.default_rng(0).uniform(1, 20, (10, 16, 1)).astype(np.float32)
    depth[2, 3] = np.inf
    expected = ops.world_position(depth, info.camera, np.float32(jitter))
    found = world_position(depth, info, jitter)
    np.testing.assert_allclose(found, np.where(np.isfinite(depth), expected, 0), atol=1e-4)
    assert found.dtype == np.float32
    assert not found[2, 3].any()
