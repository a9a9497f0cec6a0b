"""Edges and disocclusions against loops, and against what the analytic scene knows of itself."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr.data import analytic
from jaxsr.evaluation.regions import disocclusions, edges, regions
from jaxsr.frames import GBuffer
from jaxsr.report.results import BEND, REGIONS


def of_depth(depth):
    depth = np.asarray(depth, np.float32)
    return GBuffer(jnp.asarray(depth)[..., None], jnp.zeros((*depth.shape, 2)))


def edges_by_loops(depth):
    found = np.zeros(depth.shape, bool)
    for y, x in np.ndindex(depth.shape):
        for dy, dx in ((1, 0), (0, 1)):
            if min(y - dy, x - dx) < 0 or y + dy == depth.shape[0] or x + dx == depth.shape[1]:
                continue
            v = [1 / depth[y + k * dy, x + k * dx] for k in (-1, 0, 1)]
            found[y, x] |= abs(v[0] + v[2] - 2 * v[1]) > BEND * max(v)
    return found


@given(size=st.sampled_from([(1, 1), (2, 5), (6, 7)]), seed=st.integers(0, 10**6))
def test_edges_are_the_loop(size, seed):
    rng = np.random.default_rng(seed)
    depth = np.float32(rng.choice([1.0, 1.02, 1.5, np.inf], size))
    np.testing.assert_array_equal(edges(of_depth(depth)), edges_by_loops(depth))


def test_an_edge_is_an_outline_and_no_slant():
    y, x = np.mgrid[0:12, 0:16]
    slanted = 1 / (0.02 + 0.05 * x + 0.03 * y)  # a plane seen in perspective
    assert not edges(of_depth(slanted)).any()
    step = np.where(x < 8, slanted, np.inf)  # before the sky
    expected = np.zeros(step.shape, bool)
    expected[:, 7:9] = True
    np.testing.assert_array_equal(edges(of_depth(step)), expected)
    assert not edges(of_depth(np.full((5, 5), np.inf))).any()  # sky alone


def test_disocclusions_are_what_was_hidden():
    frame, previous = (analytic.frame(t, (160, 90), 1, (0.0, 0.0))[0] for t in (9, 8))
    hidden = analytic.render(9, (160, 90))["visible_before"][..., 0] == 0
    found = disocclusions(frame, previous)
    assert found.dtype == bool
    assert np.mean(found == hidden) > 0.97
    assert np.mean(found[hidden]) > 0.9
    assert not disocclusions(frame, None).any()
    assert not disocclusions(frame._replace(reset=np.asarray(True)), previous).any()


@pytest.mark.parametrize("unknown", [(True, True), (False, True)])
def test_disocclusions_without_a_camera(unknown):
    frames = [analytic.frame(t, (160, 90), 1, (0.0, 0.0))[0] for t in (9, 8)]
    frame, previous = (f._replace(camera=None) if u else f for f, u in zip(frames, unknown, strict=True))
    hidden = analytic.render(9, (160, 90))["visible_before"][..., 0] == 0
    found = disocclusions(frame, previous)
    assert np.mean(found == hidden) > 0.99
    assert np.mean(found[hidden]) > 0.65


@pytest.mark.parametrize("scale", [1, 2])
def test_regions_are_of_the_size_of_the_output_and_see_no_colour(scale):
    frame, previous = (analytic.frame(t, (64, 40), scale, (0.2, -0.3))[0] for t in (3, 2))
    found = regions(frame, previous)
    assert list(found) == list(REGIONS)
    assert all(mask.shape == (40, 64) and mask.any() and not mask.all() for mask in found.values())
    blind = frame._replace(color_linear=np.full_like(frame.color_linear, np.nan))
    for name, mask in regions(blind, previous).items():
        np.testing.assert_array_equal(mask, found[name])
