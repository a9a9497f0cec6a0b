import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr import ops
from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from tests.reference import masks as reference
from tests.transforms import assert_jit_and_batch

SIZES = [(1, 1), (4, 6)]


def _f32(x):
    return jnp.asarray(x, jnp.float32)


def _camera(time, size):
    return Camera(*map(_f32, analytic.camera(time, (size[1], size[0]))))


def _normals(rng, shape):
    """Unit normals, a third of them nearly equal, some missing."""
    normal = rng.normal(size=(*shape, 3)) + rng.choice([0, 20], (*shape, 1)) * np.array([0.0, 0.6, -0.8])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return _f32(normal * rng.choice([0, 1, 1, 1], (*shape, 1)))


def _depths(rng, shape):
    """Depths around 5, within a few percent of each other or far apart, some sky."""
    depth = rng.choice([5.0, 5.1, 5.4, 9.0, np.inf], (*shape, 1))
    return _f32(depth * rng.uniform(0.999, 1.001, depth.shape))


def _motion(rng, shape):
    """Sixteenths, so that neither taps nor the frame's edge are a matter of rounding; also out of frame."""
    return _f32(rng.integers(-16 * 3, 16 * 3, (*shape, 2)) / 16 + 1 / 32)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_normal_and_stencil_masks_are_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    normal, warped = _normals(rng, size), _normals(rng, size) * 0.7  # interpolation shortens normals
    np.testing.assert_array_equal(
        ops.normal_mask(normal, warped, 0.95), reference.normal_mask(normal, warped, 0.95)
    )
    a, b = (_f32(rng.integers(0, 3, (*size, 1))) for _ in range(2))
    np.testing.assert_array_equal(ops.stencil_mask(a, b), np.asarray(a) == np.asarray(b))


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_depth_mask_is_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    depth, previous, motion = _depths(rng, size), _depths(rng, size), _motion(rng, size)
    expected = reference.depth_mask(*(np.asarray(a) for a in (depth, previous, motion)), 0.05)
    np.testing.assert_array_equal(ops.depth_mask(depth, previous, motion, tolerance=0.05), expected)


@given(
    size=st.sampled_from(SIZES), shift=st.sampled_from([(0.0, 0.0), (0.4, -0.25)]), seed=st.integers(0, 10**6)
)
def test_position_mask_is_the_loop(size, shift, seed):
    rng = np.random.default_rng(seed)
    depth, previous, motion = _depths(rng, size), _depths(rng, size), _motion(rng, size)
    normal, now, before = _normals(rng, size), _camera(3, size), _camera(2, size)
    now, before = now._replace(lens_shift=_f32(shift)), before._replace(lens_shift=_f32(shift))
    jitter, jitter_before = _f32(rng.uniform(-0.5, 0.5, (2, 2)))
    result = ops.position_mask(depth, previous, normal, motion, now, before, jitter, jitter_before)
    pixel = 2 * np.max(np.asarray(now.tan_half_fov) / [size[1], size[0]])
    expected = reference.position_mask(
        *(np.asarray(a) for a in (depth, previous, normal, motion)),
        np.asarray(ops.world_position(depth, now, jitter)),
        np.asarray(ops.world_position(previous, before, jitter_before)),
        np.asarray(ops.view_directions(now, size, jitter)),
        pixel,
        1.5,
    )
    np.testing.assert_array_equal(result, expected)


@given(
    size=st.sampled_from(SIZES),
    scale=st.sampled_from([1, 2]),
    d2=st.sampled_from([0.1, 0.9]),
    seed=st.integers(0, 10**6),
)
def test_blend_mask_is_the_loop(size, scale, d2, seed):
    rng = np.random.default_rng(seed)
    high = (size[0] * scale, size[1] * scale)
    low_image = _f32(rng.uniform(0, 1, (*size, 3)) * rng.choice([0, 1, 1], (*size, 1)))
    image = np.kron(low_image, np.ones((scale, scale, 1))) + rng.choice([0, 0.01, 1], (*high, 1))
    arrays = (
        low_image,
        _f32(image),
        _f32(rng.uniform(0, 1, (*size, 3))),
        _f32(rng.uniform(0, 1, (*high, 3))),
        _normals(rng, size),
        _normals(rng, high),
    )
    result = ops.blend_mask(*arrays, delta_similar=0.1, delta_different=d2)
    np.testing.assert_array_equal(result, reference.blend_mask(*map(np.asarray, arrays), 0.1, d2))


def test_blend_mask_cases():
    ones, up = jnp.ones((1, 1, 3)), _f32([[[0, 0, 1.0]]])
    sky = jnp.zeros((1, 1, 3))

    def mask(low=ones, image=2 * ones, low_base=ones, base=ones, low_normal=up, normal=up):
        return float(ops.blend_mask(low, image, low_base, base, low_normal, normal)[0, 0, 0])

    assert mask() == 1
    assert mask(image=ones * 1.01) == 0  # not different enough to repair
    assert mask(normal=-up) == 0  # another surface
    assert mask(base=jnp.zeros((1, 1, 3))) == 0  # black against white
    assert mask(low_normal=sky, normal=sky) == 1  # sky on both sides passes
    assert mask(low_normal=sky) == 0  # sky against a surface does not
    assert mask(low=sky, image=sky) == 0  # nothing against nothing: no division
    assert mask(low=ones * jnp.nan) == 0


def test_sky_matches_sky_and_nothing_else():
    size = (2, 3)
    near, sky = jnp.full((*size, 1), 4.0), jnp.full((*size, 1), jnp.inf)
    still, camera = jnp.zeros((*size, 2)), _camera(0, size)
    for current, previous, expected in [(sky, sky, 1), (near, sky, 0), (sky, near, 0), (near, near, 1)]:
        np.testing.assert_array_equal(ops.depth_mask(current, previous, still), expected)
        result = ops.position_mask(current, previous, None, still, camera, camera)
        np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("motion", [40.0, -40.0, jnp.nan, jnp.inf, -1e20])
def test_outside_the_previous_frame_is_a_hole(motion):
    size = (2, 3)
    depth, camera = jnp.full((*size, 1), 4.0), _camera(0, size)
    motion = jnp.zeros((*size, 2)).at[..., 0].set(motion)
    np.testing.assert_array_equal(ops.depth_mask(depth, depth, motion), 0)
    np.testing.assert_array_equal(ops.position_mask(depth, depth, None, motion, camera, camera), 0)


def test_a_change_of_lens_shift_is_a_shift_of_the_image():
    # The same wall through a lens that moved by a whole number of pixels: `ndc = x / z - lens_shift`.
    size, pixels = (8, 10), np.array([3, -2])
    camera, depth = _camera(0, size), jnp.full((8, 10, 1), 4.0)
    moved = camera._replace(lens_shift=_f32(2 * pixels / [10, 8]))
    motion = jnp.broadcast_to(_f32(-pixels), (8, 10, 2))  # the current lens is `moved`: p_prev = p + pixels
    valid = ops.position_mask(depth, depth, None, motion, moved, camera, tolerance=0.1)
    x, y = np.moveaxis(np.asarray(ops.pixel_grid(*size)), -1, 0)
    inside = (x + 3 <= 9) & (y - 2 >= 0)
    np.testing.assert_array_equal(valid[..., 0], inside)
    np.testing.assert_array_equal(ops.position_mask(depth, depth, None, motion, camera, camera), 0)


def _two_frames(time, size, jitters, frozen):
    """Layers of two frames of the analytic scene, their G-buffers, cameras and jitters."""
    layers = [
        analytic.render(t, size, jitter_px=j, frozen=frozen)
        for t, j in zip((time, time - 1), jitters, strict=True)
    ]
    buffers = [jax.tree.map(jnp.asarray, analytic.gbuffer(x)) for x in layers]
    cameras = [_camera(t, (size[1], size[0])) for t in (time, time - 1)]
    return layers[0]["visible_before"] > 0, (*buffers, *cameras, *(_f32(j) for j in jitters))


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize(
    ("jitters", "agreement", "false_holes"),
    [
        (((0.0, 0.0), (0.0, 0.0)), 0.985, 0.015),
        # Jittered frames sample silhouettes at different points: along them nearest objects differ.
        (((0.3, -0.2), (-0.4, 0.3)), 0.97, 0.03),
    ],
)
def test_disocclusion_mask_finds_what_was_hidden(jitters, agreement, false_holes, frozen):
    visible, arguments = _two_frames(9, (160, 90), jitters, frozen)
    valid = np.asarray(ops.disocclusion_mask(*arguments)) > 0
    assert 0.01 < np.mean(~visible) < 0.1
    assert np.mean(valid == visible) > agreement
    assert np.mean(~valid[visible]) < false_holes
    assert np.mean(valid[~visible]) < 0.10
    # With wrong motion the mask must say so.
    gbuffer, *rest = arguments
    wrong = gbuffer._replace(motion_px=gbuffer.motion_px + 6)
    assert np.mean(np.asarray(ops.disocclusion_mask(wrong, *rest))) < np.mean(valid) - 0.1


def test_missing_buffers_leave_their_tests_out():
    visible, (now, before, *cameras) = _two_frames(9, (48, 32), ((0.0, 0.0), (0.0, 0.0)), False)
    bare = [b._replace(normal=None, object_id=None) for b in (now, before)]
    full = np.asarray(ops.disocclusion_mask(now, before, *cameras[:2]))
    less = np.asarray(ops.disocclusion_mask(*bare, *cameras[:2]))
    assert np.mean((less > 0) == visible) > 0.9
    assert np.mean(less) > np.mean(full)


def test_masks_carry_no_gradient():
    rng = np.random.default_rng(0)
    _, arguments = _two_frames(2, (12, 8), ((0.1, 0.2), (0.0, 0.0)), False)
    gradients = jax.grad(lambda a: ops.disocclusion_mask(*a).sum())(arguments)
    for gradient in jax.tree.leaves(gradients):
        np.testing.assert_array_equal(gradient, 0)
    arrays = [_f32(rng.uniform(0, 1, (2, 3, 3))).at[0].set(0) for _ in range(6)]
    for gradient in jax.grad(lambda a: ops.blend_mask(*a).sum())(arrays):
        np.testing.assert_array_equal(gradient, 0)


def test_jit_and_batch():
    rng = np.random.default_rng(1)
    size = (2, 4, 6)
    depth, previous, motion = _depths(rng, size), _depths(rng, size), _motion(rng, size)
    normal, warped = _normals(rng, size), _normals(rng, size)
    assert_jit_and_batch(ops.depth_mask, depth, previous, motion)
    assert_jit_and_batch(ops.normal_mask, normal, warped)
    pairs = [_two_frames(t, (12, 8), ((0.1, 0.2), (-0.3, 0.4)), False)[1] for t in (2, 3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *pairs)
    assert_jit_and_batch(ops.disocclusion_mask, *stacked, eager=False)
    depths, cameras = [b.depth_linear for b in stacked[:2]], stacked[2:4]
    assert_jit_and_batch(
        ops.position_mask, *depths, stacked[0].normal, stacked[0].motion_px, *cameras, eager=False
    )
    low, high = (_f32(rng.uniform(0, 1, (3, 2, *s, 3))) for s in ((2, 3), (4, 6)))
    assert_jit_and_batch(ops.blend_mask, low[0], high[0], low[1], high[1], low[2], high[2])


def test_bad_arguments_are_named():
    low, high = jnp.zeros((2, 3, 3)), jnp.zeros((5, 6, 3))
    with pytest.raises(JaxsrError, match="whole multiple"):
        ops.blend_mask(low, high, low, high, low, high)
    _, (now, before, *rest) = _two_frames(2, (12, 8), ((0.1, 0.2), (0.0, 0.0)), False)
    with pytest.raises(JaxsrError, match="jitter"):
        ops.disocclusion_mask(now, before, rest[0], rest[1], rest[2])
