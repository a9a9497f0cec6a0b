import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxsr.errors import JaxsrError
from jaxsr.ops.reprojection import candidate_offsets, reproject
from tests.reference import reprojection as reference
from tests.transforms import assert_jit_and_batch

SIZES = [(1, 1), (2, 5), (23, 21)]
SIGMAS = {"sigma_guide": 0.3, "sigma_space": 2.0}
# Log-weights nearer than this (keys keep 2^-17, float32 sums lose a little more) may swap.
NEAR_TIE = 2.0**-15


def _inputs(seed, h, w, c=3, g=4, reach=4.0):
    """Rough images and guides; motion of `reach` pixels, some of it far out of the frame."""
    rng = np.random.default_rng(seed)
    motion = rng.normal(0, reach, (h, w, 2))
    motion[rng.random((h, w)) < 0.03] += 60
    arrays = rng.random((h, w, c)), motion, rng.random((h, w, g)), rng.random((h, w, g))
    return tuple(a.astype(np.float32) for a in arrays)


def _assert_is(result, expected, atol):
    """Equal off the near-ties; returns the share of pixels that are near-ties."""
    clear = expected.margin > NEAR_TIE
    image, confidence = (np.asarray(r) for r in result)
    np.testing.assert_allclose(image[clear], expected.image[clear], atol=atol)
    np.testing.assert_allclose(confidence, expected.confidence, atol=atol)
    return 1 - clear.mean()


@given(
    size=st.sampled_from(SIZES),
    seed=st.integers(0, 10**6),
    sigma_guide=st.floats(0.02, 3.0),
    sigma_space=st.floats(0.3, 20.0),
)
def test_reproject_is_the_loop(size, seed, sigma_guide, sigma_space):
    inputs = _inputs(seed, *size)
    sigmas = np.float32(sigma_guide), np.float32(sigma_space)
    expected = reference.reproject(*inputs, *sigmas)
    result = reproject(*inputs, sigma_guide=sigmas[0], sigma_space=sigmas[1])
    # Distances of 100 and more have rounding errors of 1e-5; weights inherit them.
    assert _assert_is(result, expected, atol=2e-4) < 0.02


@pytest.mark.parametrize(
    ("strides", "radius", "count"),
    [((1,), 0, 4), ((2,), 1, 1), ((1, 3, 5, 9), 1, 9), pytest.param((1, 4), 3, 5, marks=pytest.mark.slow)],
)
def test_any_neighbourhood_is_the_loop(strides, radius, count):
    inputs = _inputs(count, 17, 19)
    sigma_guide = np.float32([0.2, 0.4, 1.0, 5.0])
    where = {"strides": strides, "radius": radius, "count": count}
    expected = reference.reproject(*inputs, sigma_guide, 3.0, **where)
    result = reproject(*inputs, sigma_guide=sigma_guide, sigma_space=3.0, **where)
    assert _assert_is(result, expected, atol=2e-4) < 0.02


@pytest.mark.slow
def test_reproject_is_the_plain_jax_form_with_its_gradients():
    inputs = tuple(jnp.asarray(a) for a in _inputs(1, 23, 21))
    cotangents = _inputs(2, 23, 21)[0], _inputs(3, 23, 21, c=1)[0]
    sigmas = jnp.float32([0.3, 0.2, 0.5, 0.4]), jnp.float32(2.0)
    near_tie = reference.reproject(*inputs, *sigmas).margin <= NEAR_TIE
    assert near_tie.mean() < 0.02
    cotangents = tuple(np.where(near_tie[..., None], np.float32(0), c) for c in cotangents)

    def loss(fn, sigma_guide, sigma_space, *arrays):
        image, confidence = fn(*arrays, sigma_guide=sigma_guide, sigma_space=sigma_space)
        return (image * cotangents[0]).sum() + (confidence * cotangents[1]).sum()

    both = [
        jax.jit(jax.value_and_grad(functools.partial(loss, fn), argnums=range(6)))(*sigmas, *inputs)
        for fn in (reproject, reference.reproject_plain)
    ]
    for ours, plain in zip(*map(jax.tree.leaves, both), strict=True):
        assert np.isfinite(ours).all()
        np.testing.assert_allclose(ours, plain, rtol=2e-4, atol=2e-4 * np.abs(plain).max())


def test_gradients_are_finite_differences():
    # Few candidates far apart in weight, so that steps of 1e-2 never change the selection.
    previous, _, guide, _ = _inputs(5, 3, 4, g=2)
    motion = np.full((3, 4, 2), 0.2, np.float32)
    previous_guide = guide + np.float32(0.1) * _inputs(6, 3, 4, g=2)[2]

    def fn(previous, motion, guide, previous_guide, sigma_guide, sigma_space):
        sigmas = {"sigma_guide": sigma_guide, "sigma_space": sigma_space}
        return reproject(previous, motion, guide, previous_guide, strides=(1,), count=9, **sigmas)

    arguments = previous, motion, guide, previous_guide, np.float32([0.7, 0.9]), np.float32(1.5)
    check_grads(fn, arguments, order=1, modes=["fwd", "rev"], atol=2e-2, rtol=2e-2, eps=1e-2)


def test_distinct_guides_and_a_small_sigma_give_the_identity():
    previous, _, guide, _ = _inputs(7, 23, 21)
    still = np.zeros((23, 21, 2), np.float32)
    image, confidence = reproject(previous, still, guide, guide, sigma_guide=1e-3)
    np.testing.assert_array_equal(image, previous)
    np.testing.assert_array_equal(confidence, 1)


def test_the_guide_finds_what_the_motion_missed():
    # The motion is wrong by (3, -3): the matching guide is a candidate of stride 3.
    previous, _, guide, _ = _inputs(8, 23, 21)
    still = np.zeros((23, 21, 2), np.float32)
    moved = np.roll(guide, (3, -3), (0, 1))  # moved[y, x] = guide[y - 3, x + 3]
    image, confidence = reproject(previous, still, moved, guide, sigma_guide=1e-2, sigma_space=4.0)
    np.testing.assert_allclose(image[3:, :-3], previous[:-3, 3:], atol=1e-6)
    np.testing.assert_allclose(confidence[3:, :-3], np.exp(-18 / 32), rtol=1e-4)
    assert np.median(confidence[:3]) < 0.1


def test_whole_motion_is_an_exact_shift():
    previous, _, _, _ = _inputs(9, 23, 21)
    motion = np.broadcast_to(np.float32([2, -3]), (23, 21, 2))
    flat = np.ones((23, 21, 1), np.float32)
    image, confidence = reproject(previous, motion, flat, flat, sigma_space=0.05)
    np.testing.assert_array_equal(image[:-3, 2:], previous[3:, :-2])
    np.testing.assert_array_equal(confidence[:-3, 2:], 1)
    assert np.all(confidence[-3:] < 1e-6)


def test_equal_guides_keep_the_nearest_candidates():
    previous = np.zeros((23, 21, 1), np.float32)
    previous[10, 10:12], previous[11, 10:12] = [[1], [2]], [[4], [8]]
    flat = np.zeros((23, 21, 2), np.float32)
    motion = np.full((23, 21, 2), -0.25, np.float32)  # xbar is a quarter past the pixel, down and right
    image, _ = reproject(previous, motion, flat, flat, sigma_space=1.0)
    near, far = np.exp(-(0.25**2) / 2), np.exp(-(0.75**2) / 2)
    weights = np.float32([near * near, near * far, near * far, far * far])
    np.testing.assert_allclose(image[10, 10, 0], weights @ [1, 2, 4, 8] / weights.sum(), rtol=1e-5)


def test_constants_stay_and_weights_sum_to_one():
    _, motion, guide, previous_guide = _inputs(10, 23, 21)
    constant = np.full((23, 21, 2), 0.7, np.float32)
    image, _ = reproject(constant, motion, guide, previous_guide, **SIGMAS)
    np.testing.assert_allclose(image, constant, rtol=1e-6)
    # The gradient of the sum is how much each previous pixel weighs: one for every pixel of the image.
    weights = jax.grad(lambda p: reproject(p, motion, guide, previous_guide, **SIGMAS)[0].sum())(constant)
    np.testing.assert_allclose(weights.sum(), constant.size, rtol=1e-5)


def test_channels_do_not_mix():
    previous, motion, guide, previous_guide = _inputs(11, 23, 21)
    image, confidence = reproject(previous, motion, guide, previous_guide, **SIGMAS)
    order, guides = [2, 0, 1], [3, 1, 0, 2]
    permuted, same = reproject(
        previous[..., order], motion, guide[..., guides], previous_guide[..., guides], **SIGMAS
    )
    np.testing.assert_allclose(same, confidence, atol=1e-5)
    differing = np.abs(permuted - image[..., order]).max(-1) > 1e-4
    assert differing.mean() < 0.01  # sums of squares in another order: near-ties may swap


@pytest.mark.parametrize("sigma", [1e-12, 1e-4, 1e4])
def test_any_sigma_is_finite(sigma):
    inputs = _inputs(12, 2, 5)

    def total(sigma_guide, sigma_space, *arrays):
        image, confidence = reproject(*arrays, sigma_guide=sigma_guide, sigma_space=sigma_space)
        return image.sum() + confidence.sum()

    arguments = np.float32(sigma), np.float32(sigma), *inputs
    value, gradients = jax.value_and_grad(total, argnums=range(6))(*arguments)
    assert all(np.isfinite(g).all() for g in (value, *gradients))
    image, confidence = reproject(*inputs, sigma_guide=sigma, sigma_space=sigma)
    assert image.min() >= 0
    assert image.max() <= 1
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_confidence_underflows_before_the_match_is_lost():
    previous, _, guide, previous_guide = _inputs(13, 23, 21)
    still = np.zeros((23, 21, 2), np.float32)
    image, confidence = reproject(previous, still, guide, previous_guide, sigma_guide=1e-3, count=1)
    assert np.all(confidence == 0)
    expected = reference.reproject(previous, still, guide, previous_guide, 1e-3, 1.0, count=1)
    clear = expected.margin > NEAR_TIE
    np.testing.assert_array_equal(np.asarray(image)[clear], expected.image.astype(np.float32)[clear])


def test_what_is_not_finite_poisons_nothing():
    previous, motion, guide, previous_guide = _inputs(14, 23, 21)
    motion[4, 4], motion[5, 5], motion[6, 6, 0] = np.nan, np.inf, -np.inf
    guide[7, 7, 1], guide[8, 8, 0] = np.nan, np.inf
    for y, x, bad in ((9, 9, np.nan), (10, 12, np.inf), (20, 3, -np.inf)):
        previous_guide[y, x, 2], previous[y, x] = bad, np.nan
    expected = reference.reproject(previous, motion, guide, previous_guide, 0.3, 2.0)
    image, confidence = reproject(previous, motion, guide, previous_guide, **SIGMAS)
    # The fallback of a pixel that was left without candidates may be one of the previous NaNs.
    assert np.isnan(expected.image).any(-1).sum() <= 3
    assert _assert_is((image, confidence), expected, atol=2e-4) < 0.02
    for y, x in ((4, 4), (5, 5), (6, 6), (7, 7), (8, 8)):
        assert confidence[y, x, 0] == 0
    np.testing.assert_array_equal(image[4, 4], previous[4, 4])

    def total(*arrays):
        image, confidence = reproject(*arrays, **SIGMAS)
        return jnp.where(jnp.isnan(image), 0, image).sum() + confidence.sum()

    gradients = jax.grad(total, argnums=(0, 1, 2, 3))(previous, motion, guide, previous_guide)
    assert all(np.isfinite(g).all() for g in gradients)


def test_where_nothing_is_in_the_frame_the_clamped_centre_is_shown():
    previous, _, guide, previous_guide = _inputs(15, 2, 5)
    motion = np.broadcast_to(np.float32([-100, 40]), (2, 5, 2))
    image, confidence = reproject(previous, motion, guide, previous_guide)
    np.testing.assert_array_equal(image, np.broadcast_to(previous[0, -1], image.shape))
    np.testing.assert_array_equal(confidence, 0)


def test_jit_and_batch():
    pair = [_inputs(seed, 2, 5) for seed in (16, 17)]
    batch = tuple(np.stack(arrays) for arrays in zip(*pair, strict=True))
    assert_jit_and_batch(lambda *a: reproject(*a, **SIGMAS, strides=(1,)), *batch)


def test_a_pixel_without_a_guide_needs_no_colour():
    """Fewer candidates count than are kept: the others have no weight, and their NaN must not be seen."""
    previous = jnp.ones((1, 3, 2)).at[0, 2].set(jnp.nan)
    flat, still = jnp.zeros((1, 3, 1)), jnp.zeros((1, 3, 2))
    guide = flat.at[0, 2].set(jnp.nan)

    def total(previous):
        image, confidence = reproject(previous, still, flat, guide, strides=(1,), count=9)
        return image.sum(), (image, confidence)

    (_, (image, confidence)), gradient = jax.value_and_grad(total, has_aux=True)(previous)
    np.testing.assert_allclose(image, 1)
    assert (confidence > 0).all()
    np.testing.assert_array_equal(gradient[0, 2], 0)
    np.testing.assert_allclose(gradient.sum(), 6, rtol=1e-6)


def test_memory_stays_far_below_a_gather_of_all_candidates():
    # Also guards the speed: where the compiler copies the selection into its readers, memory shows it first.
    inputs = _inputs(20, 64, 96, g=6)
    compiled = jax.jit(reproject).lower(*inputs).compile()
    temporary = compiled.memory_analysis().temp_size_in_bytes / (64 * 96)
    assert temporary < 250  # bytes per pixel, 100 of them the padding; all candidates' guides alone are 800


def test_half_precision_values_stay():
    previous, motion, guide, previous_guide = _inputs(18, 2, 5)
    image, confidence = reproject(jnp.asarray(previous, jnp.float16), motion, guide, previous_guide)
    assert image.dtype == jnp.float16
    assert confidence.dtype == jnp.float32
    np.testing.assert_allclose(
        image.astype(jnp.float32), reproject(previous, motion, guide, previous_guide)[0], atol=2e-3
    )


def test_candidates_are_those_of_the_paper():
    offsets = [tuple(o) for o in candidate_offsets((1, 3, 5, 9), 1)]
    assert len(offsets) == 33
    assert offsets == reference.offsets((1, 3, 5, 9), 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"strides": ()}, "bad neighbourhood"),
        ({"strides": (0, 1)}, "bad neighbourhood"),
        ({"radius": -1}, "bad neighbourhood"),
        ({"count": 0}, "bad neighbourhood"),
        ({"sigma_guide": np.ones(3, np.float32)}, "sigma_guide does not fit"),
        ({"previous_guide": np.zeros((2, 5, 3), np.float32)}, "guides differ"),
        ({"motion_px": np.zeros((2, 4, 2), np.float32)}, "image sizes differ"),
    ],
)
def test_bad_arguments(change, message):
    names = ("previous", "motion_px", "guide", "previous_guide")
    arguments = dict(zip(names, _inputs(19, 2, 5), strict=True)) | change
    with pytest.raises(JaxsrError, match=message):
        reproject.__wrapped__.__wrapped__(**arguments)
