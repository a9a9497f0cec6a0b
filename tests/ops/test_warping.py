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
from jaxsr.ops.warping import (
    backward_warp,
    compose_motion,
    forward_splat,
    occlusion_motion,
    warp_zero_upsampled,
)
from tests.reference import golden_warping
from tests.reference import warping as reference
from tests.transforms import assert_jit_and_batch

SIZES = [(1, 1), (1, 5), (6, 4)]
MODES = ["bilinear", "nearest", "bicubic"]
BOUNDARIES = ["clamp", "zero"]
GOLDEN = np.load(Path(golden_warping.__file__).with_suffix(".npz"))


def _image(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def _motion(seed, h, w):
    """Eighths of a pixel, to twice the image's size: halves, whole numbers and the outside come up often."""
    steps = np.random.default_rng(seed).integers(-16 * max(h, w), 16 * max(h, w) + 1, (h, w, 2))
    return (steps / 8).astype(np.float32)


def _scene(seed, h, w):
    """Motion of at most three pixels and few distinct depths: many collisions, many ties."""
    rng = np.random.default_rng(seed)
    motion = (rng.integers(-24, 25, (h, w, 2)) / 8).astype(np.float32)
    return motion, rng.choice(np.array([1, 2, 3, np.inf], np.float32), (h, w, 1))


@given(
    size=st.sampled_from(SIZES),
    mode=st.sampled_from(MODES),
    boundary=st.sampled_from(BOUNDARIES),
    seed=st.integers(0, 10**6),
)
def test_warp_is_the_loop(size, mode, boundary, seed):
    image, motion = _image(seed, *size, 2), _motion(seed, *size)
    result = backward_warp(image, motion, mode=mode, boundary=boundary)
    np.testing.assert_allclose(result, reference.backward_warp(image, motion, mode, boundary), atol=2e-6)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_splat_and_occlusion_motion_are_the_loops(size, seed):
    motion, depth = _scene(seed, *size)
    values, mask, _ = reference.forward_splat(_image(seed, *size, 2), motion, depth)
    splatted, landed = forward_splat(_image(seed, *size, 2), motion, depth)
    np.testing.assert_array_equal(splatted, values.astype(np.float32))
    np.testing.assert_array_equal(landed, mask)
    np.testing.assert_array_equal(occlusion_motion(motion, depth), reference.occlusion_motion(motion, depth))


@given(
    size=st.sampled_from(SIZES),
    scale=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10**6),
    data=st.data(),
)
def test_warp_of_zero_upsampled_samples_is_the_loop(size, scale, seed, data):
    image, motion = _image(seed, *size, 2), _motion(seed, *(scale * n for n in size))
    offset = data.draw(st.tuples(*2 * [st.integers(0, scale - 1)]))
    result = warp_zero_upsampled(image, motion, scale, jnp.array(offset, jnp.int32))
    expected = reference.warp_zero_upsampled(image, motion, scale, offset)
    np.testing.assert_allclose(result, expected, atol=2e-6)
    if offset == (0, 0):
        np.testing.assert_array_equal(warp_zero_upsampled(image, motion, scale), result)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_composed_motion_is_the_loop(size, seed):
    motion, before = _motion(seed, *size), [_motion(seed + k, *size) for k in (1, 2)]
    result = compose_motion(motion, np.concatenate(before, -1))
    expected = np.concatenate([reference.compose_motion(motion, b) for b in before], -1)
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("library", ["opencv", "pytorch"])
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_warp_is_the_libraries(library, mode, boundary):
    result = backward_warp(golden_warping.image(), golden_warping.motion(), mode=mode, boundary=boundary)
    np.testing.assert_allclose(result, GOLDEN[f"{library}_{mode}_{boundary}"], atol=2e-6)


@pytest.mark.parametrize(("phase_y", "phase_x"), [(0, 1), (3, 2)])
def test_bicubic_is_pytorchs_antialiased_one(phase_y, phase_x):
    image = golden_warping.image()
    motion = np.empty((*image.shape[:2], 2), np.float32)
    motion[..., 0] = golden_warping.constant_motion(phase_x)
    motion[..., 1] = golden_warping.constant_motion(phase_y)
    result = backward_warp(image, motion, mode="bicubic")
    golden = GOLDEN[f"pytorch_bicubic_{phase_y}{phase_x}"]
    # At the border the libraries leave taps out where we repeat pixels.
    np.testing.assert_allclose(result[2:-2, 2:-2], golden[2:-2, 2:-2], atol=2e-6)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_whole_motion_is_an_exact_shift(mode, boundary):
    image = _image(3, 6, 4, 2)
    still = np.zeros((6, 4, 2), np.float32)
    np.testing.assert_array_equal(backward_warp(image, still, mode=mode, boundary=boundary), image)
    shifted = backward_warp(image, still + np.float32([1, -2]), mode=mode, boundary=boundary)
    np.testing.assert_array_equal(shifted[:-2, 1:], image[2:, :-1])
    outside = 0 if boundary == "zero" else image[-1:, :-1]
    np.testing.assert_array_equal(shifted[-2:, 1:], np.broadcast_to(outside, (2, 3, 2)))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_whole_motion_shifts_infinite_and_nan_pixels(mode, boundary):
    depth = np.float32([2, 2, np.inf, np.inf, -np.inf, 7, np.nan, 3])
    image = np.tile(depth[None, :, None], (5, 1, 2))
    image[3:, :, 1] = 1
    still = np.zeros((*image.shape[:2], 2), np.float32)
    np.testing.assert_array_equal(backward_warp(image, still, mode=mode, boundary=boundary), image)
    sampled = ops.sample(image, ops.pixel_grid(*image.shape[:2]), mode=mode, boundary=boundary)
    np.testing.assert_array_equal(sampled, image)
    shifted = backward_warp(image, still + np.float32([2, -1]), mode=mode, boundary=boundary)
    np.testing.assert_array_equal(shifted[:-1, 2:], image[1:, :-2])
    # Rounded up to a whole fraction: -1e-9 lies a whole pixel past the one before.
    np.testing.assert_array_equal(backward_warp(image, still + np.float32(1e-9), mode=mode), image)
    # A fraction along one axis only is none along the other.
    row = np.tile(np.float32([1, np.inf, 5])[None, :, None], (4, 1, 1))
    slid = backward_warp(row, np.tile(np.float32([0, 0.25]), (4, 3, 1)), mode=mode, boundary="clamp")
    if mode != "bicubic":  # whose weights of both signs make NaN of infinity
        np.testing.assert_array_equal(slid, row)
    np.testing.assert_array_equal(slid[:, ::2], row[:, ::2])


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_infinite_pixels_leave_finite_gradients_where_they_have_no_weight(mode):
    image = np.tile(np.float32([2, 3, np.inf, 4])[None, :, None], (3, 1, 1))

    def finite_sum(image, motion):
        warped = backward_warp(image, motion, mode=mode)
        return jnp.where(jnp.isfinite(warped), warped, 0).sum()

    gradients = jax.grad(finite_sum, (0, 1))(image, np.zeros((3, 4, 2), np.float32))
    assert all(np.isfinite(g).all() for g in gradients)
    # The right-sided derivative of x - motion at a pixel centre: a zero weight has a slope.
    flat = np.tile(np.float32([2, 3, 5, 4])[None, :, None], (3, 1, 1))
    slope = jax.grad(lambda m: backward_warp(flat, m, mode="bilinear").sum())(np.zeros((3, 4, 2), np.float32))
    np.testing.assert_array_equal(slope[1, :, 0], [-1, -2, 1, 0])


@pytest.mark.parametrize("mode", MODES)
def test_permuting_channels_commutes(mode):
    image, motion, order = _image(12, 6, 4, 3), _motion(12, 6, 4), [2, 0, 1]
    result = backward_warp(image, motion, mode=mode)
    np.testing.assert_array_equal(backward_warp(image[..., order], motion, mode=mode), result[..., order])


@pytest.mark.parametrize("mode", MODES)
def test_constants_stay_and_far_motion_is_harmless(mode):
    image = _image(4, 6, 4, 2)
    still = np.zeros((6, 4, 2), np.float32)
    constant = np.full((6, 4, 2), 0.7, np.float32)
    np.testing.assert_allclose(
        backward_warp(constant, _motion(5, 6, 4), mode=mode), constant, rtol=0, atol=3e-7
    )
    for far in ([np.inf, np.inf], [1e30, 1e30], [40, 40]):
        motion = still + np.float32(far)
        assert np.all(backward_warp(image, motion, mode=mode, boundary="zero") == 0)
        np.testing.assert_allclose(
            backward_warp(image, motion, mode=mode), np.broadcast_to(image[0, 0], image.shape), atol=1e-6
        )
    unknown = still + np.float32(np.nan)
    np.testing.assert_array_equal(backward_warp(image, unknown, mode=mode), image)
    gradients = jax.grad(lambda i, m: backward_warp(i, m, mode=mode).sum(), (0, 1))(image, unknown)
    assert all(np.isfinite(g).all() for g in gradients)
    assert np.all(gradients[1] == 0)


def test_a_uniform_motion_is_uniform_far_from_the_origin():
    # x - motion would round away the fraction at x = 4000; the motion itself keeps it.
    row = np.tile(np.float32([0, 1]), 2100)[None, :, None]
    motion = np.broadcast_to(np.float32([1e-5, 0]), (1, 4200, 2))
    result = np.asarray(backward_warp(row, motion))[0, 1:, 0]
    np.testing.assert_array_equal(np.unique(result[::2]), result[:1])


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradients_are_finite_differences(mode, boundary):
    rng = np.random.default_rng(6)
    image = _image(6, 6, 4, 2)
    # Off the whole numbers, where bilinear has its kinks; the outside and the border are in.
    motion = (rng.integers(-5, 6, (6, 4, 2)) + rng.uniform(0.2, 0.8, (6, 4, 2))).astype(np.float32)
    check_grads(
        lambda i, m: backward_warp(i, m, mode=mode, boundary=boundary),
        (image, motion),
        order=1,
        modes=["fwd", "rev"],
        atol=2e-2,
        rtol=2e-2,
        eps=1e-2,
    )


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_gradients_of_zero_upsampled_samples_are_those_of_the_plain_warp(scale):
    image, motion = _image(13, 4, 3, 2), _motion(13, 4 * scale, 3 * scale)  # whole and half motion are in
    offset = jnp.array([scale - 1, 0], jnp.int32)
    cotangent = _image(14, *motion.shape[:2], 2)

    def plain(image, motion):
        return backward_warp(ops.zero_upsample(image, scale, offset), motion, boundary="zero")

    found, expected = (
        jax.grad(lambda i, m, warp=warp: (warp(i, m) * cotangent).sum(), (0, 1))(image, motion)
        for warp in (lambda i, m: warp_zero_upsampled(i, m, scale, offset), plain)
    )
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_zero_upsampled_samples_are_shifted_with_what_they_hold():
    image = np.float32([[np.inf, 2], [np.nan, 4]])[..., None]
    still = np.zeros((4, 4, 2), np.float32)
    offset = jnp.array([1, 0], jnp.int32)
    spread = ops.zero_upsample(image, 2, offset)
    np.testing.assert_array_equal(warp_zero_upsampled(image, still, 2, offset), spread)
    shifted = warp_zero_upsampled(image, still + np.float32([1, -2]), 2, offset)
    np.testing.assert_array_equal(shifted[:-2, 1:], spread[2:, :-1])
    np.testing.assert_array_equal(warp_zero_upsampled(image, still + np.inf, 2, offset), 0)
    np.testing.assert_array_equal(warp_zero_upsampled(image, still * np.nan, 2, offset), spread)


def test_composed_gradients_are_finite_differences():
    rng = np.random.default_rng(15)
    motion, before = (
        (rng.integers(-5, 6, (6, 4, c)) + rng.uniform(0.2, 0.8, (6, 4, c))).astype(np.float32) for c in (2, 4)
    )
    check_grads(
        compose_motion, (motion, before), order=1, modes=["fwd", "rev"], atol=2e-2, rtol=2e-2, eps=1e-2
    )


def test_composed_unknown_and_infinite_motion_stay_numbers():
    motion, before = _motion(16, 6, 4), _motion(17, 6, 4)
    motion[0, 0], motion[1, 1], motion[2, 2] = np.nan, np.inf, -np.inf
    before[3, 3], before[4, 1], before[5, 2] = np.nan, np.inf, -np.inf
    composed = before
    for _ in range(5):
        composed = compose_motion(motion, composed)
        assert np.isfinite(composed).all()
    assert np.all(composed[1, 1] > 9e5)
    np.testing.assert_array_equal(composed[0, 0], before[0, 0])  # unknown counts as none, five times
    gradients = jax.grad(lambda m, b: compose_motion(m, b).sum(), (0, 1))(motion, before)
    assert all(np.isfinite(g).all() for g in gradients)


def test_composed_uniform_motion_adds_up():
    first, second = (np.broadcast_to(np.float32(m), (5, 7, 2)) for m in ([0.25, -3], [1.5, 0.5]))
    np.testing.assert_allclose(compose_motion(first, second), first + second, atol=1e-6)
    np.testing.assert_array_equal(compose_motion(first, np.zeros_like(first)), first)


def test_composed_motion_leads_to_the_same_point():
    """Three frames back in the analytic scene: what does not move has the position there that it has here."""
    size = (96, 64)
    layers = [analytic.render(t, size) for t in range(4)]
    path, seen = np.zeros_like(layers[0]["motion"]), np.ones((64, 96, 1), np.float32)
    for now in layers[1:]:
        path = compose_motion(now["motion"], path)
        seen = now["visible_before"] * backward_warp(seen, now["motion"], mode="nearest")
    there = backward_warp(layers[0]["position"], path)
    ids = backward_warp(layers[0]["object_id"], path)
    still = np.isin(layers[3]["object_id"], (1, 2, 4)) & (ids == layers[3]["object_id"]) & (seen == 1)
    assert still.mean() > 0.5
    off = np.linalg.norm(there - layers[3]["position"], axis=-1, keepdims=True) / layers[3]["depth"]
    pixel = 2 * 0.62 / size[0]
    assert np.quantile(off[still], 0.5) < 0.02 * pixel
    assert np.quantile(off[still], 0.95) < 0.5 * pixel
    moved = np.linalg.norm(path, axis=-1, keepdims=True)[still]
    assert np.median(moved) > 2


def test_splat_gradient_goes_to_the_winners():
    motion, depth = _scene(7, 6, 4)
    values = _image(7, 6, 4, 2)
    _, mask, winner = reference.forward_splat(values, motion, depth)
    cotangent = _image(8, 6, 4, 2)
    expected = np.zeros((6, 4, 2))
    for y, x in zip(*np.nonzero(mask[..., 0]), strict=True):
        expected[tuple(winner[y, x])] += cotangent[y, x]
    gradient = jax.grad(lambda v: (forward_splat(v, motion, depth)[0] * cotangent).sum())(values)
    np.testing.assert_allclose(gradient, expected, atol=1e-6)


def test_splat_is_the_inverse_of_a_whole_pixel_warp():
    image = _image(9, 6, 4, 2)
    motion = np.broadcast_to(np.float32([1, -2]), (6, 4, 2))
    warped = backward_warp(image, motion, mode="nearest", boundary="zero")
    splatted, mask = forward_splat(warped, motion, np.ones((6, 4, 1), np.float32))
    np.testing.assert_array_equal(np.where(mask, splatted, 0), np.where(mask, image, 0))
    assert int(mask.sum()) == 4 * 3


def test_occlusion_motion_fills_a_hole_with_background():
    # A near bar moves 3 pixels to the right over a still gradient; behind it lies what was never seen.
    h, w, step = 4, 16, 3
    background = np.broadcast_to(np.linspace(0.1, 0.9, w, dtype=np.float32)[None, :, None], (h, w, 1))
    previous, motion = background.copy(), np.zeros((h, w, 2), np.float32)
    depth = np.full((h, w, 1), np.inf, np.float32)
    previous[:, 5:8] = 5.0
    motion[:, 8:11, 0], depth[:, 8:11] = step, 1.0
    ghost = backward_warp(previous, motion)
    filled = backward_warp(previous, occlusion_motion(motion, depth))
    assert np.all(ghost[:, 5:8] == 5)
    np.testing.assert_allclose(filled[:, 5:8], background[:, 2:5])  # what lay before the bar
    elsewhere = np.r_[0:5, 8:w]
    np.testing.assert_array_equal(filled[:, elsewhere], ghost[:, elsewhere])


def test_unknown_depth_is_behind_and_unknown_motion_is_none():
    motion = np.zeros((1, 3, 2), np.float32)
    motion[0, 0, 0], motion[0, 2] = -1, np.nan
    values = np.float32([[[1], [2], [3]]])
    depth = np.float32([[[np.nan], [9], [1]]])
    splatted, mask = forward_splat(values, motion, depth)
    np.testing.assert_array_equal(splatted[0, :, 0], [0, 2, 3])
    np.testing.assert_array_equal(mask[0, :, 0], [False, True, True])
    depth[0, 1] = np.inf  # a tie: the first in row order
    np.testing.assert_array_equal(forward_splat(values, motion, depth)[0][0, :, 0], [0, 1, 3])


def test_jit_and_batch():
    image, depth = _image(10, 2, 6, 4, 2), np.stack([_scene(s, 6, 4)[1] for s in (1, 2)])
    motion = np.stack([_scene(s, 6, 4)[0] for s in (1, 2)])
    for mode in MODES:
        assert_jit_and_batch(lambda i, m, mode=mode: backward_warp(i, m, mode=mode), image, motion)
    assert_jit_and_batch(forward_splat, image, motion, depth)
    assert_jit_and_batch(occlusion_motion, motion, depth)
    assert_jit_and_batch(compose_motion, motion, image)
    offsets = np.array([[0, 1], [2, 0]], np.int32)
    assert_jit_and_batch(
        lambda i, m, o: warp_zero_upsampled(i, m, 3, o), image[:, ::3, :1], motion[:, :, :3], offsets
    )


@pytest.mark.parametrize("mode", MODES)
def test_half_precision_stays(mode):
    image, motion = jnp.asarray(_image(11, 6, 4, 2), jnp.float16), _motion(11, 6, 4)
    result = backward_warp(image, motion, mode=mode)
    assert result.dtype == jnp.float16
    expected = backward_warp(image.astype(jnp.float32), motion, mode=mode)
    np.testing.assert_array_equal(result, expected.astype(jnp.float16))


def test_bad_arguments():
    image, motion = np.zeros((4, 5, 2), np.float32), np.zeros((4, 5, 2), np.float32)
    with pytest.raises(JaxsrError, match="unknown mode"):
        backward_warp(image, motion, mode="cubic")
    with pytest.raises(JaxsrError, match="unknown boundary"):
        backward_warp(image, motion, boundary="wrap")
    with pytest.raises(JaxsrError, match="image sizes differ"):
        forward_splat.__wrapped__.__wrapped__(image, motion[:-1], motion[..., :1])
    with pytest.raises(JaxsrError, match="scale: bad scale"):
        warp_zero_upsampled(image, motion, 0)
    with pytest.raises(JaxsrError, match=r"expected motion_px \[.., 8, 10, 2\]; found \[4, 5, 2\]"):
        warp_zero_upsampled(image, motion, 2)
    with pytest.raises(JaxsrError, match="expected pairs of channels"):
        compose_motion(motion, image[..., :1])


def test_motion_has_two_channels():
    image, depth = jnp.ones((4, 5, 3)), jnp.ones((4, 5, 1))
    for channels in (1, 3):
        motion = np.zeros((4, 5, channels), np.float32)
        with pytest.raises(JaxsrError, match="not a motion; expected motion_px"):
            backward_warp.__wrapped__.__wrapped__(image, motion)
        with pytest.raises(JaxsrError, match="not a motion; expected motion_px"):
            occlusion_motion.__wrapped__.__wrapped__(motion, depth)
        with pytest.raises(JaxsrError, match="not a motion; expected motion_px"):
            ops.reproject.__wrapped__.__wrapped__(image, motion, image, image)
