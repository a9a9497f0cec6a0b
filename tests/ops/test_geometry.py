from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxsr import ops
from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from jaxsr.ops.pinhole import BEHIND_PX
from tests.reference import geometry as reference
from tests.reference import golden_ops
from tests.transforms import assert_jit_and_batch

GOLDEN = np.load(Path(__file__).parents[1] / "reference" / "golden_ops.npz")
SIZES = [(1, 1), (4, 6)]


def _rotation(axis, angle):
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _camera(rng, near=None):
    """A random camera, or one a small step away from `near`."""
    matrix = np.eye(4)
    if near is None:
        matrix[:3, :3] = _rotation(rng.normal(size=3), rng.uniform(0, 3))
        matrix[:3, 3] = rng.normal(size=3) * 10
        lens = rng.uniform(0.3, 1.2, 2), rng.uniform(-0.2, 0.2, 2)
    else:
        matrix = np.array(near.world_from_view, np.float64)
        matrix[:3, :3] = matrix[:3, :3] @ _rotation(rng.normal(size=3), 0.03)
        matrix[:3, 3] += rng.normal(size=3) * 0.05
        lens = near.tan_half_fov, near.lens_shift
    return Camera(*(jnp.asarray(v, jnp.float32) for v in (matrix, *lens)))


def _depth(rng, size):
    depth = 10.0 ** rng.uniform(0.2, 3, (*size, 1))
    return jnp.asarray(np.where(rng.uniform(size=depth.shape) < 0.2, np.inf, depth), jnp.float32)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_rays_and_positions_are_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    camera, depth = _camera(rng), _depth(rng, size)
    jitter = jnp.asarray(rng.uniform(-0.5, 0.5, 2), jnp.float32)
    directions = np.asarray(ops.view_directions(camera, size, jitter))
    for y, x in np.ndindex(size):
        np.testing.assert_allclose(directions[y, x], reference.ray(camera, size, (x, y), jitter), atol=1e-6)
    expected = reference.world_position(np.asarray(depth), camera, np.asarray(jitter))
    np.testing.assert_allclose(ops.world_position(depth, camera, jitter), expected, rtol=1e-5, atol=1e-4)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_camera_motion_is_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    camera, depth = _camera(rng), _depth(rng, size)
    before, jitter = _camera(rng, near=camera), jnp.asarray(rng.uniform(-0.5, 0.5, 2), jnp.float32)
    expected = reference.camera_motion(np.asarray(depth), camera, before, np.asarray(jitter))
    np.testing.assert_allclose(ops.camera_motion(depth, camera, before, jitter), expected, atol=2e-4)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_previous_depth_is_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    camera, depth = _camera(rng), _depth(rng, size)
    before, jitter = _camera(rng, near=camera), jnp.asarray(rng.uniform(-0.5, 0.5, 2), jnp.float32)
    expected = reference.previous_depth(np.asarray(depth), camera, before, np.asarray(jitter))
    found = ops.previous_depth(depth, camera, before, jitter)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_previous_depth_of_a_step_forward_is_the_step_more():
    """Towards a wall: one unit of the way makes all depths one smaller, whatever the distance and pixel."""
    identity = Camera(jnp.eye(4), jnp.ones(2), jnp.zeros(2))
    advanced = identity._replace(world_from_view=jnp.eye(4).at[2, 3].set(1.0))
    depth = jnp.asarray([[[0.5], [3.0]], [[1e4], [jnp.inf]]])
    np.testing.assert_allclose(ops.previous_depth(depth, advanced, identity), depth + 1)
    found = ops.previous_depth(depth, identity, advanced)
    np.testing.assert_allclose(found, depth - 1)  # the nearest point was behind the eye
    slope = jax.grad(lambda d: jnp.where(jnp.isfinite(d), ops.previous_depth(d, identity, advanced), 0).sum())
    np.testing.assert_allclose(slope(depth), [[[1], [1]], [[1], [0]]])


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_projection_is_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    camera = _camera(rng)
    offsets = rng.normal(size=(5, 2, 3)) * 3
    world = jnp.asarray(np.asarray(camera.world_from_view)[:3, 3] + offsets, jnp.float32)
    pixels, depth = ops.project(world, camera, size)
    for i in np.ndindex(5, 2):
        expected, z = reference.project(camera, size, np.asarray(world[i], np.float64))
        np.testing.assert_allclose(depth[i], [z], atol=1e-5)
        if abs(z) > 0.05:  # nearer ones are ill-conditioned
            np.testing.assert_allclose(pixels[i], expected, rtol=1e-4, atol=1e-3)


def test_projection_is_opencv():
    camera = Camera(
        *(
            jnp.asarray(v, jnp.float32)
            for v in (
                np.linalg.inv(GOLDEN["view_from_world"]),
                golden_ops.TAN_HALF_FOV,
                golden_ops.LENS_SHIFT,
            )
        )
    )
    pixels, _ = ops.project(golden_ops.points(), camera, golden_ops.SIZE)
    np.testing.assert_allclose(pixels, GOLDEN["projected"], atol=2e-4)


def test_position_and_projection_invert():
    rng = np.random.default_rng(0)
    size = (6, 7)
    camera = _camera(rng)
    depth = jnp.asarray(rng.uniform(1, 50, (*size, 1)), jnp.float32)
    jitter = jnp.asarray([0.3, -0.45])
    pixels, z = ops.project(ops.world_position(depth, camera, jitter), camera, size)
    np.testing.assert_allclose(pixels, np.asarray(ops.pixel_grid(*size)) + np.asarray(jitter), atol=1e-4)
    np.testing.assert_allclose(z, depth, rtol=1e-5)


@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.35, -0.2)])
def test_the_analytic_scene_agrees(jitter):
    size = (48, 32)
    layers = analytic.render(4, size, jitter_px=jitter, frozen=True)
    now, before = (Camera(*(jnp.asarray(v, jnp.float32) for v in analytic.camera(t, size))) for t in (4, 3))
    depth, j = jnp.asarray(layers["depth"]), jnp.asarray(jitter, jnp.float32)
    np.testing.assert_allclose(ops.world_position(depth, now, j), layers["position"], atol=1e-5)
    np.testing.assert_allclose(ops.camera_motion(depth, now, before, j), layers["motion"], atol=1e-4)


def test_a_still_camera_moves_nothing_and_translation_spares_the_sky():
    rng = np.random.default_rng(2)
    camera, depth = _camera(rng), _depth(rng, (5, 6)).at[0].set(jnp.inf)
    np.testing.assert_allclose(ops.camera_motion(depth, camera, camera), 0, atol=1e-5)
    moved = camera._replace(
        world_from_view=camera.world_from_view.at[:3, 3].add(jnp.asarray([1.0, 2.0, 3.0]))
    )
    motion = ops.camera_motion(depth, camera, moved)
    np.testing.assert_allclose(np.asarray(motion)[0], 0, atol=1e-5)
    assert np.abs(np.asarray(motion)[np.isfinite(depth[..., 0])]).min() > 1e-3


def test_far_from_the_origin_of_the_world_nothing_changes():
    """Float32 numbers near 65536 are 1/128 apart: differences are taken before anything is rotated."""
    rng = np.random.default_rng(7)
    depth = jnp.asarray(rng.uniform(1, 3, (4, 6, 1)), jnp.float32)
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = _rotation(np.array([1.0, 2.0, -1.0]), 0.8)
    step, far = np.array([2, -1, 3]) / 128, np.array([65536, -32768, 65536])

    def camera(position):
        moved = matrix.copy()
        moved[:3, 3] = position
        return Camera(jnp.asarray(moved), jnp.asarray([0.8, 0.6]), jnp.zeros(2))

    near_by, far_off = ((camera(origin + step), camera(origin)) for origin in (np.zeros(3), far))
    for op in (ops.camera_motion, ops.previous_depth):
        np.testing.assert_allclose(op(depth, *far_off), op(depth, *near_by), atol=1e-5)
    points = jnp.asarray(matrix[:3, 2] * 2 + step, jnp.float32)
    points = jnp.round(points * 128) / 128
    found = ops.project(points + jnp.asarray(far, jnp.float32), far_off[1], (4, 6))
    for value, expected in zip(found, ops.project(points, near_by[1], (4, 6)), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-5)


def test_behind_the_eye_is_outside_every_image():
    identity = Camera(jnp.eye(4), jnp.ones(2), jnp.zeros(2))
    points = jnp.asarray([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1.0, 1.0, 1e-9]])
    pixels, depth = ops.project(points, identity, (3, 3))
    np.testing.assert_array_equal(pixels, BEHIND_PX)
    np.testing.assert_array_equal(depth, points[:, 2:])
    gradient = jax.grad(lambda p: ops.project(p, identity, (3, 3))[0].sum())(points)
    np.testing.assert_array_equal(gradient, 0)


def test_sky_gives_finite_values_and_gradients():
    rng = np.random.default_rng(3)
    camera = _camera(rng)
    before = _camera(rng, near=camera)
    depth = jnp.asarray([[[5.0], [jnp.inf]], [[jnp.inf], [0.0]], [[jnp.nan], [1e30]]])

    def total(depth, camera, before):
        position = ops.world_position(jnp.where(depth < 1e20, depth, jnp.inf), camera)
        then = ops.previous_depth(jnp.where(depth < 1e20, depth, jnp.inf), camera, before)
        still = ops.camera_motion(depth, camera, before)
        return position.sum() + still.sum() + jnp.where(jnp.isfinite(then), then, 0).sum()

    value, gradients = jax.value_and_grad(total, argnums=(0, 1, 2))(depth, camera, before)
    assert np.isfinite(value)
    for gradient in jax.tree.leaves(gradients):
        assert np.isfinite(gradient).all()
    assert gradients[0][0, 0, 0] != 0
    assert gradients[0][0, 1, 0] == 0


def test_gradients_are_the_differences():
    rng = np.random.default_rng(4)
    camera = _camera(rng)
    before = _camera(rng, near=camera)
    depth = jnp.asarray(rng.uniform(2, 4, (2, 3, 1)), jnp.float32)
    arguments = {"order": 1, "modes": ["rev"], "atol": 2e-2, "rtol": 2e-2}
    check_grads(lambda d, b: ops.camera_motion(d, camera, b), (depth, before), **arguments)
    check_grads(lambda d, b: ops.previous_depth(d, camera, b), (depth, before), **arguments)
    check_grads(ops.world_position, (depth, camera), **arguments)


def test_jit_and_batch():
    rng = np.random.default_rng(5)
    pairs = [(c, _camera(rng, near=c)) for c in (_camera(rng), _camera(rng))]
    now, before = (jax.tree.map(lambda *x: jnp.stack(x), *cameras) for cameras in zip(*pairs, strict=True))
    depth = _depth(rng, (2, 3, 4))
    jitter = jnp.asarray(rng.uniform(-0.5, 0.5, (2, 2)), jnp.float32)
    world = jnp.asarray(rng.normal(size=(2, 5, 3)), jnp.float32)
    check = {"atol": 1e-3, "rtol": 1e-4}
    assert_jit_and_batch(lambda c, j: ops.view_directions(c, (3, 4), j), now, jitter)
    assert_jit_and_batch(ops.world_position, depth, now, jitter, **check)
    assert_jit_and_batch(ops.camera_motion, depth, now, before, jitter, **check)
    assert_jit_and_batch(ops.previous_depth, depth, now, before, jitter, **check)
    assert_jit_and_batch(lambda w, c: ops.project(w, c, (3, 4)), world, now, **check)


def test_bad_sizes_are_named():
    camera = _camera(np.random.default_rng(6))
    with pytest.raises(JaxsrError, match="view_directions"):
        ops.view_directions(camera, (0, 4))
    with pytest.raises(JaxsrError, match="project"):
        ops.project(jnp.zeros((1, 3)), camera, (4, 0))
