import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsr import ops
from jaxsr.errors import JaxsrError
from jaxsr.ops.resampling import MODES
from tests.reference import jitter as reference
from tests.reference import resampling
from tests.transforms import assert_jit_and_batch

SIZE = (10, 14)


@given(index=st.integers(0, 10**6), base=st.sampled_from([2, 3, 5, 7]))
def test_halton_is_the_fraction(index, base):
    assert ops.halton(index, base) == pytest.approx(reference.halton(index, base), abs=1e-15)


def test_halton_known_values():
    np.testing.assert_allclose(
        ops.halton(np.arange(1, 8), 2), [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8, 7 / 8]
    )
    np.testing.assert_allclose(ops.halton(np.arange(1, 6), 3), [1 / 3, 2 / 3, 1 / 9, 4 / 9, 7 / 9])


def test_sequence_repeats_stays_inside_and_covers_the_pixel():
    sequence = ops.jitter_sequence(70, length=32)
    assert sequence.dtype == np.float32
    assert np.abs(sequence).max() < 0.5
    np.testing.assert_array_equal(sequence[:32], sequence[32:64])
    np.testing.assert_allclose(sequence[0], [0.0, 1 / 3 - 0.5], atol=1e-7)
    assert len(np.unique(sequence[:32], axis=0)) == 32
    assert np.abs(sequence[:32].mean(0)).max() < 0.05
    assert ops.jitter_sequence(0).shape == (0, 2)


@pytest.mark.parametrize(
    "call",
    [
        lambda: ops.halton(-1, 2),
        lambda: ops.halton(3, 1),
        lambda: ops.jitter_sequence(-1),
        lambda: ops.jitter_sequence(4, 0),
    ],
)
def test_bad_arguments_are_named(call):
    with pytest.raises(JaxsrError, match="expected"):
        call()


def _setup(scale):
    """The pattern, both jitters, LR positions of the output pixels, and I_N,1 there."""
    pattern = reference.MovingPattern()
    now, before = np.array([0.31, -0.42]), np.array([-0.27, 0.18])
    y, x = np.mgrid[: SIZE[0] * scale, : SIZE[1] * scale]
    p = (np.stack([x, y], -1) + 0.5) / scale - 0.5
    return pattern, now, before, p, pattern.image(p, 1)


def _check(positions, scale):
    pattern, now, before, _, expected = _setup(scale)
    current, previous, output = (np.asarray(q, np.float64) for q in positions)
    np.testing.assert_allclose(pattern.jittered_image(current, 1, now), expected, atol=1e-5)
    np.testing.assert_allclose(pattern.jittered_image(previous, 0, before), expected, atol=1e-5)
    # The recurrent output is I_N,0 on its own pixels.
    np.testing.assert_allclose(pattern.image((output + 0.5) / scale - 0.5, 0), expected, atol=1e-5)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_first_shader_fetches_the_same_values(scale):
    pattern, now, before, p, _ = _setup(scale)
    # An engine that counts jitter as motion writes, at the pixel p - J_t of the jittered frame, MV_J (6).
    motion = pattern.motion(p) + before - now
    args = (jnp.asarray(a, jnp.float32) for a in (motion, now, before))
    _check(ops.positions_from_jittered_motion(*args, scale=scale), scale)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_second_shader_fetches_the_same_values(scale):
    pattern, now, before, p, _ = _setup(scale)
    args = (jnp.asarray(a, jnp.float32) for a in (pattern.motion(p), now, before))
    positions = ops.positions_from_motion(*args, scale=scale)
    _check(positions, scale)
    current = ops.current_positions(jnp.asarray(now, jnp.float32), (SIZE[0] * scale, SIZE[1] * scale), scale)
    np.testing.assert_allclose(current, positions.current, atol=1e-6)


def test_printed_equation_8_is_wrong():
    pattern, now, before, p, expected = _setup(1)
    motion_j = pattern.motion(p) + before - now
    args = (jnp.asarray(a, jnp.float32) for a in (motion_j, now, before))
    ours = np.asarray(ops.positions_from_jittered_motion(*args).previous_output, np.float64)
    printed = p - now - motion_j + before - now
    np.testing.assert_allclose(ours - printed, np.broadcast_to(now, p.shape), atol=1e-5)
    np.testing.assert_allclose(pattern.image(ours, 0), expected, atol=1e-5)
    assert np.abs(pattern.image(printed, 0) - expected).max() > 0.1


@pytest.mark.parametrize("scale", [1, 2])
def test_the_motion_buffer_belongs_to_the_jittered_frame(scale):
    # What a renderer writes at q is the motion of what it sees there, q + J: to be read at p - J.
    pattern, now, before, p, expected = _setup(scale)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    buffer = jnp.asarray(pattern.motion(np.stack([x, y], -1) + now), jnp.float32)
    now32, before32 = jnp.asarray(now, jnp.float32), jnp.asarray(before, jnp.float32)

    def errors(read_at):
        motion = ops.sample(buffer, read_at, mode="bicubic")
        positions = ops.positions_from_motion(motion, now32, before32, scale)
        previous, output = (np.asarray(a, np.float64) for a in positions[1:])
        fetched = pattern.jittered_image(previous, 0, before), pattern.image((output + 0.5) / scale - 0.5, 0)
        inner = slice(3 * scale, -3 * scale)  # the buffer ends at its border
        return [np.abs(values - expected)[inner, inner].max() for values in fetched]

    right = errors(ops.current_positions(now32, p.shape[:2], scale))
    wrong = errors(jnp.asarray(p, jnp.float32))
    assert max(right) < 1e-3
    assert min(wrong) > 10 * max(right)


@pytest.mark.parametrize("mode", MODES)
def test_sample_jittered_is_the_loop(mode):
    image = np.random.default_rng(0).standard_normal((5, 3, 2)).astype(np.float32)
    jitter = np.array([0.375, -0.25], np.float32)
    result = ops.sample_jittered(image, jitter, (10, 6), mode)
    np.testing.assert_allclose(result, resampling.resize(image, (10, 6), mode, jitter), atol=2e-6)


def test_sample_jittered_undoes_the_jitter_of_a_ramp():
    # A linear image is reproduced by interpolation: x_lr of the unjittered image comes back.
    jitter = np.array([0.3, -0.4], np.float32)
    jittered = np.asarray(ops.pixel_grid(6, 7)) + jitter  # I_J(p) = I_N(p + J), I_N(p) = p
    result = ops.sample_jittered(jittered, jitter, (12, 14), "bicubic")
    expected = (np.asarray(ops.pixel_grid(12, 14)) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(result[5:-5, 5:-5], expected[5:-5, 5:-5], atol=1e-5)


def test_sample_jittered_wants_one_scale():
    with pytest.raises(JaxsrError, match="same scale"):
        ops.sample_jittered(jnp.zeros((5, 3, 2)), jnp.zeros(2), (10, 9))


def test_jittered_motion_follows_the_jittered_image():
    pattern, now, before, p, _ = _setup(1)
    motion_n = jnp.asarray(pattern.motion(p + now), jnp.float32)  # the buffer of the jittered frame
    j, j_prev = jnp.asarray(now, jnp.float32), jnp.asarray(before, jnp.float32)
    motion_j = ops.jittered_motion(motion_n, j, j_prev)
    origin = p - np.asarray(motion_j, np.float64)
    expected = pattern.jittered_image(p, 1, now)
    np.testing.assert_allclose(pattern.jittered_image(origin, 0, before), expected, atol=1e-5)
    np.testing.assert_allclose(ops.unjittered_motion(motion_j, j, j_prev), motion_n, atol=1e-6)


@given(size=st.sampled_from([(1, 1), (2, 3)]), scale=st.sampled_from([1, 2]), seed=st.integers(0, 10**6))
def test_both_shaders_agree(size, scale, seed):
    rng = np.random.default_rng(seed)
    motion = jnp.asarray(rng.uniform(-9, 9, (*size, 2)), jnp.float32)
    now, before = jnp.asarray(rng.uniform(-0.5, 0.5, (2, 2)), jnp.float32)
    first = ops.positions_from_jittered_motion(ops.jittered_motion(motion, now, before), now, before, scale)
    second = ops.positions_from_motion(motion, now, before, scale)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_jit_batch_and_gradients():
    rng = np.random.default_rng(0)
    motion, jitters = rng.normal(size=(2, 3, 4, 2)), rng.uniform(-0.5, 0.5, (2, 2, 2))
    args = [jnp.asarray(a, jnp.float32) for a in (motion, jitters[0], jitters[1])]
    assert_jit_and_batch(ops.jittered_motion, *args)
    assert_jit_and_batch(ops.unjittered_motion, *args)
    assert_jit_and_batch(lambda *a: ops.positions_from_motion(*a, scale=2), *args)
    assert_jit_and_batch(lambda *a: ops.positions_from_jittered_motion(*a, scale=2), *args)
    assert_jit_and_batch(lambda j: ops.current_positions(j, (3, 4), 2), args[1])
    assert_jit_and_batch(lambda x, j: ops.sample_jittered(x, j, (6, 8)), args[0], args[1])
    gradient = jax.grad(
        lambda m: ops.positions_from_motion(m, args[1][0], args[2][0], 2).previous_output.sum()
    )
    np.testing.assert_allclose(gradient(args[0][0]), -2.0)
