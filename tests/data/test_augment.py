"""Crops and flips of the analytic scene still obey every convention of `jaxsr.frames`."""

import functools
import itertools
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr import ops
from jaxsr.data.augment import crop, flip, random_crop
from jaxsr.data.windows import NEEDS, WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, GBuffer
from jaxsr.layers import LAYERS
from jaxsr.methods import Needs, Windows
from jaxsr.ops.pinhole import world_from_depth
from tests.builders import make_sequence

SIZE = (96, 60)
FLIPS = [(False, False), (True, False), (False, True), (True, True)]


@functools.cache
def scene(scale=2):
    """A window of two frames in which only the camera moves, everything stored as float32."""
    with tempfile.TemporaryDirectory() as folder:
        seq = make_sequence(
            Path(folder) / "s",
            size=SIZE,
            scales=(2, 3),
            frozen=True,
            precision=dict.fromkeys(LAYERS, "float"),
        )
        windows = Windows(2, made=None, lr_truth=True)
        source = WindowSource([seq.path], Needs(NEEDS), windows, scale=scale, cache=Path(folder) / "c")
        window = jax.tree.map(np.array, source[1])
    return window


def unbatch(window):
    """As training sees it: float32, without the batch axis."""
    return jax.tree.map(lambda x: jnp.asarray(x[0]), stack([window]))


def at(window, t):
    frame = jax.tree.map(lambda x: x[t], window.frames)
    return frame, window.truth_linear[t]


@st.composite
def cropped(draw):
    """Scale, a crop of the scene and the flips on top of it."""
    scale = draw(st.sampled_from([2, 3]))
    w, h = (scale * draw(st.integers(12 // scale, n // scale)) for n in SIZE)
    x, y = (scale * draw(st.integers(0, (n - size) // scale)) for n, size in zip(SIZE, (w, h), strict=True))
    return scale, (x, y, w, h), draw(st.sampled_from(FLIPS))


def changed(case):
    scale, (x, y, w, h), (horizontal, vertical) = case
    window = crop(scene(scale), x, y, (h, w))
    return unbatch(flip(window, horizontal=horizontal, vertical=vertical))


WHOLE = (0, 0, *SIZE)
CASES = [(2, WHOLE, flips) for flips in FLIPS] + [(3, (18, 12, 60, 42), flips) for flips in FLIPS]


@given(cropped())
def test_the_camera_sees_the_same_points_in_the_crop(case):
    """World positions from the cropped depth and camera are the cropped (and mirrored) positions."""
    scale, (x, y, w, h), (horizontal, vertical) = case
    whole, part = (
        scene(scale),
        flip(crop(scene(scale), x, y, (h, w)), horizontal=horizontal, vertical=vertical),
    )
    mirror = np.array([-1 if horizontal != vertical else 1, 1, 1])
    for t, (place, s) in itertools.product(range(2), (("hr", 1), ("lr", scale))):

        def positions(window, t=t, place=place, s=s):
            frame, _ = at(window, t)
            jitter = (0.0, 0.0) if s == 1 else tuple(frame.jitter_px.tolist())
            return world_from_depth(getattr(frame, place).depth_linear, frame.camera, jitter, np)

        expected = positions(whole)[y // s : (y + h) // s, x // s : (x + w) // s]
        expected = expected[:: -1 if vertical else 1, :: -1 if horizontal else 1] * mirror
        np.testing.assert_allclose(positions(part), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.2)])
@given(cropped())
def test_the_camera_is_the_projection_rule(shift, case):
    """In float64, from the definition: ndc = (x, y) / (z tan) - shift, p = (ndc + 1) / 2 (W, H) - 0.5."""
    scale, (x, y, w, h), (horizontal, vertical) = case
    window = scene(scale)
    camera = window.frames.camera._replace(lens_shift=np.tile(shift, (2, 1)))
    window = window._replace(frames=window.frames._replace(camera=camera))
    part = flip(crop(window, x, y, (h, w)), horizontal=horizontal, vertical=vertical).frames.camera
    assert all(a.dtype == np.float64 for a in part)

    def pixels(c: Camera, points, size):
        local = np.linalg.inv(c.world_from_view[0]) @ np.append(points, 1.0)
        ndc = local[:2] / (local[2] * c.tan_half_fov[0]) - c.lens_shift[0]
        return (ndc + 1) / 2 * np.array(size) - 0.5

    rng = np.random.default_rng(0)
    for _ in range(3):
        view = np.array([*rng.uniform(-1, 1, 2), rng.uniform(1, 9), 1])
        world = (camera.world_from_view[0] @ view)[:3]
        px, py = pixels(camera, world, SIZE) - (x, y)
        expected = (w - 1 - px if horizontal else px, h - 1 - py if vertical else py)
        mirror = np.array([-1 if horizontal != vertical else 1, 1, 1])
        np.testing.assert_allclose(pixels(part, world * mirror, (w, h)), expected, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_cameras_stay_rigid(case):
    matrix = np.asarray(changed(case).frames.camera.world_from_view)
    for m in matrix:
        np.testing.assert_allclose(m[:3, :3] @ m[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(m[:3, :3]) == pytest.approx(1, abs=1e-6)
        np.testing.assert_array_equal(m[3], [0, 0, 0, 1])


@pytest.mark.parametrize("case", CASES)
def test_motion_is_that_of_the_camera(case):
    """Nothing else moves, so that camera and depth alone must give the motion that was mirrored."""
    (before, _), (now, _) = (at(changed(case), t) for t in range(2))
    for buffers, jitter in ((now.hr, None), (now.lr, now.jitter_px)):
        expected = ops.camera_motion(buffers.depth_linear, now.camera, before.camera, jitter)
        assert np.abs(np.asarray(expected)).max() > 0.5
        np.testing.assert_allclose(buffers.motion_px, expected, atol=5e-3)


@pytest.mark.parametrize("case", CASES)
def test_warping_the_frame_before_gives_this_one(case):
    window = changed(case)
    truth, motion = window.truth_linear[1], np.asarray(window.frames.hr.motion_px[1])
    h, w = truth.shape[:2]

    def error(signs):
        moved = motion * np.array(signs, np.float32)
        p = np.asarray(ops.pixel_grid(h, w)) - moved
        inside = (p >= 0).all(-1) & (p <= np.array([w - 1, h - 1])).all(-1)
        warped = ops.backward_warp(window.truth_linear[0], moved)
        return np.mean(np.abs(np.asarray(warped - truth))[inside])

    assert error([[[1, 1]]]) < 0.03  # disocclusions, and edges without anti-aliasing
    assert error([[[-1, 1]]]) > 1.5 * error([[[1, 1]]])
    assert error([[[-1, -1]]]) > 1.5 * error([[[1, 1]]])


@pytest.mark.parametrize("case", CASES)
def test_normals_are_those_of_the_surface(case):
    frame, _ = at(changed(case), 1)
    world = np.asarray(ops.world_position(frame.hr.depth_linear, frame.camera), np.float64)
    right, down = world[:-1, 1:] - world[:-1, :-1], world[1:, :-1] - world[:-1, :-1]
    # x right and y down in the image, z away: right x down points away from the eye.
    estimate = -np.cross(right, down)
    estimate /= np.linalg.norm(estimate, axis=-1, keepdims=True) + 1e-12
    normal = np.asarray(frame.hr.normal)[:-1, :-1]
    ids = np.asarray(frame.hr.object_id)[..., 0]
    flat = (ids[:-1, :-1] == ids[:-1, 1:]) & (ids[:-1, :-1] == ids[1:, :-1]) & (ids[:-1, :-1] > 0)
    cosine = np.sum(estimate * normal, -1)[flat]
    assert flat.mean() > 0.4
    assert np.percentile(cosine, 5) > 0.99


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("t", [0, 1])
def test_the_jittered_image_shows_what_the_unjittered_one_has_there(case, t):
    """I_J(p) = I_N(p + J), with I_N the high-resolution images read between their pixels."""
    frame, _ = at(changed(case), t)
    h, w = frame.lr.depth_linear.shape[:2]

    def error(signs):
        p = (np.asarray(ops.pixel_grid(h, w)) + np.asarray(frame.jitter_px) * signs + 0.5) * frame.scale - 0.5
        read = ops.sample(frame.hr.base_color, p.astype(np.float32))
        return np.median(np.abs(np.asarray(read - frame.lr.base_color)))

    x, y = np.abs(np.asarray(frame.jitter_px))
    assert x > 0.2
    assert error([1, 1]) < 0.012
    assert error([-1, 1]) > 3 * error([1, 1])
    if y > 0.2:
        assert error([1, -1]) > 3 * error([1, 1])


@given(cropped())
def test_flipping_twice_is_nothing(case):
    scale, (x, y, w, h), (horizontal, vertical) = case
    part = crop(scene(scale), x, y, (h, w))
    twice = flip(
        flip(part, horizontal=horizontal, vertical=vertical), horizontal=horizontal, vertical=vertical
    )
    jax.tree.map(np.testing.assert_array_equal, twice, part)
    one_by_one = flip(flip(part, horizontal=horizontal), vertical=vertical)
    both = flip(part, horizontal=horizontal, vertical=vertical)
    jax.tree.map(np.testing.assert_array_equal, one_by_one, both)


@given(cropped())
def test_crops_of_crops_are_crops(case):
    scale, (x, y, w, h), _ = case
    outer = crop(scene(scale), x, y, (h, w))
    inner = crop(outer, scale, scale, (h - scale, w - scale))
    once = crop(scene(scale), x + scale, y + scale, (h - scale, w - scale))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), inner, once)
    assert inner.frames.scale == scale


def test_colours_and_flags_are_only_moved():
    window = scene()
    mirrored = flip(window, horizontal=True)
    np.testing.assert_array_equal(mirrored.truth_linear, window.truth_linear[:, :, ::-1])
    for name in ("base_color", "roughness", "metallic", "object_id", "depth_linear"):
        a, b = getattr(mirrored.frames.lr, name), getattr(window.frames.lr, name)
        np.testing.assert_array_equal(a, b[:, :, ::-1])
        assert np.shares_memory(a, b)
    np.testing.assert_array_equal(mirrored.frames.reset, window.frames.reset)


def test_what_is_none_stays_none():
    """Buffers, all of them, the camera and the LR truth."""
    window = scene()
    bare = window.frames._replace(hr=GBuffer(), lr=window.frames.lr._replace(normal=None), camera=None)
    window = window._replace(frames=bare, lr_truth_linear=None)
    part = flip(crop(window, 4, 4, (8, 8)), horizontal=True, vertical=True)
    assert part.frames.hr == GBuffer()
    assert part.frames.lr.normal is None
    assert part.frames.camera is None
    assert part.lr_truth_linear is None
    assert part.frames.lr.motion_px.shape == (2, 4, 4, 2)


@given(cropped())
def test_lr_truth_goes_with_the_lr_colour(case):
    """Here every frame is rendered and is to be made, so that both are the same images."""
    scale, (x, y, w, h), (horizontal, vertical) = case
    part = flip(crop(scene(scale), x, y, (h, w)), horizontal=horizontal, vertical=vertical)
    assert part.lr_truth_linear.shape == (2, h // scale, w // scale, 3)
    np.testing.assert_array_equal(part.lr_truth_linear, part.frames.color_linear)


def test_random_crops_reach_every_place_and_mirror_half_of_them():
    window, rng = scene(3), np.random.default_rng(0)
    seen, mirrored = set(), 0
    for _ in range(300):
        part = random_crop(window, rng, crop_px=54, flips=True)
        matrix = part.frames.camera.world_from_view
        mirrored += bool(matrix[0, 0, 3] != window.frames.camera.world_from_view[0, 0, 3])
        shift = np.abs(part.frames.camera.lens_shift[0] * 54 + 54)  # 2 x + w - W + w
        seen.add((int(np.rint(shift[0])), int(np.rint(shift[1]))))
        assert part.truth_linear.shape == (2, 54, 54, 3)
    assert len({y for _, y in seen}) == 3  # 0, 3, 6
    assert 100 < mirrored < 200
    plain = random_crop(window, np.random.default_rng(5), crop_px=54)
    again = random_crop(window, np.random.default_rng(5), crop_px=54, flips=True, vertical_flips=True)
    np.testing.assert_array_equal(np.sort(plain.truth_linear, None), np.sort(again.truth_linear, None))


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((1, 0, 12, 12), "multiples of 2.*12x12 at x=1 y=0"),
        ((0, 0, 12, 13), "multiples of 2"),
        ((0, 0, 98, 12), "within 96x60"),
        ((90, 0, 12, 12), "within 96x60"),
        ((-2, 0, 12, 12), "within 96x60"),
        ((0, 0, 0, 12), "within 96x60"),
    ],
)
def test_bad_crops_are_named(box, message):
    x, y, w, h = box
    with pytest.raises(JaxsrError, match=message):
        crop(scene(2), x, y, (h, w))


@pytest.mark.parametrize(("horizontal", "vertical"), FLIPS)
def test_jitter_of_hr_buffers_is_mirrored_like_that_of_the_image(horizontal, vertical):
    window = scene()
    jitter = np.float32([[0.5, -0.25], [0.125, 1.0]])
    window = window._replace(frames=window.frames._replace(hr_jitter_px=jitter))
    part = flip(crop(window, 4, 4, (8, 8)), horizontal=horizontal, vertical=vertical)
    signs = [-1 if horizontal else 1, -1 if vertical else 1]
    np.testing.assert_array_equal(part.frames.hr_jitter_px, jitter * signs)
