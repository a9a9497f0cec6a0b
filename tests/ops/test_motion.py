"""Depth and motion that are derived from LR: the loop, invariants, and the analytic scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from jaxsr import ops
from jaxsr.data import analytic
from jaxsr.ops.motion import hr_from_lr_on_host
from tests.reference import motion as reference
from tests.transforms import assert_jit_and_batch

SIZES = [(1, 1), (1, 4), (5, 3), (4, 6)]


def example(rng, size):
    """Few depths, so that many are equally near; some sky; motion of which no two are alike."""
    depth = rng.choice(np.float32([1, 2, 3, np.inf]), (*size, 1))
    return depth, rng.normal(size=(*size, 2)).astype(np.float32)


@given(size=st.sampled_from(SIZES), seed=st.integers(0, 10**6))
def test_dilation_is_the_loop(size, seed):
    depth, motion = example(np.random.default_rng(seed), size)
    for made, expected in zip(
        ops.dilate_motion(*map(jnp.asarray, (depth, motion))),
        reference.dilate_motion(depth, motion),
        strict=True,
    ):
        np.testing.assert_array_equal(made, expected)


@given(
    size=st.sampled_from(SIZES),
    seed=st.integers(0, 10**6),
    scale=st.sampled_from([2, 3]),
    jitter=st.tuples(*[st.sampled_from([-0.47, -0.2, 0.01, 0.31, 0.49])] * 2),
)
def test_hr_from_lr_is_the_loop_in_numpy_and_in_jax(size, seed, scale, jitter):
    depth, motion = example(np.random.default_rng(seed), size)
    expected = reference.hr_from_lr(depth, motion, jitter, scale)
    compiled = ops.hr_from_lr(jnp.asarray(depth), jnp.asarray(motion), jnp.float32(jitter), scale)
    for made in (hr_from_lr_on_host(depth, motion, jitter, scale), compiled):
        for x, y in zip(made, expected, strict=True):
            assert x.dtype == np.float32
            np.testing.assert_allclose(x, y, rtol=1e-6)


def test_jit_and_batch():
    rng = np.random.default_rng(0)
    depth, motion = (np.stack(x) for x in zip(*(example(rng, (4, 5)) for _ in range(2)), strict=True))
    jitter = np.float32([[0.3, -0.2], [-0.4, 0.1]])
    assert_jit_and_batch(ops.dilate_motion, depth, motion)
    assert_jit_and_batch(lambda d, m, j: ops.hr_from_lr(d, m, j, 2), depth, motion, jitter)


def test_the_border_of_what_is_near_grows_by_one_pixel():
    depth, motion = np.full((5, 7, 1), np.inf, np.float32), np.zeros((5, 7, 2), np.float32)
    depth[2, 3], motion[2, 3] = 2, (1, -1)
    nearest, dilated = ops.dilate_motion(jnp.asarray(depth), jnp.asarray(motion))
    near = np.isfinite(np.asarray(nearest))[..., 0]
    assert near.sum() == 9
    assert near[1:4, 2:5].all()
    np.testing.assert_array_equal(np.asarray(dilated)[near], np.tile(np.float32([1, -1]), (9, 1)))
    assert not np.asarray(dilated)[~near].any()


def test_gradients_go_to_the_motion_that_is_read():
    rng = np.random.default_rng(1)
    depth, motion = (jnp.asarray(x) for x in example(rng, (3, 4)))
    jitter = jnp.zeros(2)
    grad = jax.grad(lambda m: ops.hr_from_lr(depth, m, jitter, 2)[1].sum())(motion)
    assert np.isfinite(grad).all()
    assert float(grad.sum()) == 2 * 3 * 4 * 2 * 2 * 2  # each HR value is twice one LR value


@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.4, -0.3), (-0.45, 0.45)])
@pytest.mark.parametrize("scale", [2, 4])
def test_motion_of_the_analytic_scene_is_right_off_silhouettes(scale, jitter):
    """Within what motion changes over two LR pixels; dilation reads up to one pixel beside the place."""
    size = (192, 128)
    lr = analytic.render(3, (size[0] // scale, size[1] // scale), jitter_px=jitter)
    hr = analytic.render(3, size)
    ids, reach = hr["object_id"][..., 0], 3 * scale
    same = maximum_filter(ids, 2 * reach + 1) == minimum_filter(ids, 2 * reach + 1)
    inside = same & np.isfinite(hr["depth"])[..., 0]
    assert inside.sum() > 1000

    def off(depth, stated):
        depth, motion = hr_from_lr_on_host(depth, lr["motion"], stated, scale)
        return np.abs(motion - hr["motion"]).max(-1)[inside], depth

    motion_off, depth = off(lr["depth"], jitter)
    assert motion_off.max() < 0.25 * scale
    assert motion_off.mean() < 0.05 * np.linalg.norm(hr["motion"], axis=-1)[inside].mean()
    assert np.median(np.abs(depth[inside, 0] / hr["depth"][inside, 0] - 1)) < 0.02 * scale
    if any(jitter):  # where all is equally near, nothing is dilated: the sign of the jitter shows
        flat = np.ones_like(lr["depth"])
        assert off(flat, jitter)[0].mean() < 0.7 * off(flat, (-jitter[0], -jitter[1]))[0].mean()
