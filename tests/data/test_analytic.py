"""The analytic scene is the ground truth of other tests, so its own buffers are checked first."""

import numpy as np
import pytest

from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from tests.reference import geometry as reference

SIZE = (48, 27)


def _cast(time, x, y):
    view = analytic.camera(time, SIZE)
    origin = view.world_from_view[:3, 3]
    rays = np.array([reference.ray(view, SIZE[::-1], pixel) for pixel in zip(x.flat, y.flat, strict=True)])
    rays = rays.reshape(*x.shape, 3)
    distance, index = analytic._nearest(analytic.scene(), origin, rays, time)
    return origin + distance[..., None] * rays, index


@pytest.mark.parametrize("time", [0, 1, 5])
def test_motion_leads_to_the_same_surface_point(time):
    layers = analytic.render(time, SIZE)
    visible = layers["visible_before"][..., 0] > 0
    index = layers["object_id"][..., 0].astype(int) - 1
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    points, before = _cast(time - 1, x - layers["motion"][..., 0], y - layers["motion"][..., 1])
    assert visible.mean() > 0.8
    # float32 motion may fall just beside a silhouette: allow a handful of pixels.
    assert np.mean(before[visible] != index[visible]) < 0.005
    for i, item in enumerate(analytic.scene()):
        mask = visible & (index == i) & (before == i)
        if mask.any():
            now = item.to_local(layers["position"].astype(float)[mask], time)
            np.testing.assert_allclose(item.to_local(points[mask], time - 1), now, atol=2e-3)


def test_a_hidden_point_is_behind_something_or_out_of_view():
    layers = analytic.render(4, SIZE)
    hidden = (layers["visible_before"][..., 0] == 0) & (layers["object_id"][..., 0] > 0)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    px, py = x - layers["motion"][..., 0], y - layers["motion"][..., 1]
    outside = (px < -0.5) | (px > SIZE[0] - 0.5) | (py < -0.5) | (py > SIZE[1] - 0.5)
    _, before = _cast(3, px, py)
    same = before == layers["object_id"][..., 0].astype(int) - 1
    assert hidden.sum() > 10
    # A sphere may hide its own point; everything else that is hidden shows another object.
    assert np.mean((same & ~outside)[hidden]) < 0.1


def test_jitter_shifts_the_image_by_whole_pixels_exactly():
    plain = analytic.render(2, SIZE)
    moved = analytic.render(2, SIZE, jitter_px=(1.0, 0.0))
    for name in ("color", "depth", "motion", "normal"):
        np.testing.assert_allclose(moved[name][:, :-1], plain[name][:, 1:], rtol=1e-5, atol=1e-5)


def test_still_and_frozen_has_no_motion_and_everything_visible():
    layers = analytic.render(7, SIZE, still=True, frozen=True)
    np.testing.assert_allclose(layers["motion"], 0.0, atol=1e-6)
    assert layers["visible_before"].all()


def test_frame_hides_the_colour_of_unrendered_frames():
    hidden, truth = analytic.frame(1, SIZE, 3, (0.25, -0.25), rendered=False)
    assert not hidden.color_linear.any()
    assert truth.any()
    assert hidden.scale == 3


@pytest.mark.parametrize(("size", "scale"), [((48, 26), 3), ((47, 27), 3), ((48, 27), 0)])
def test_frame_wants_whole_multiples(size, scale):
    with pytest.raises(JaxsrError, match="multiples of"):
        analytic.frame(0, size, scale, (0.0, 0.0))
