"""Every method: pure steps, honest about what it sees, and worth its cost where it should be."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, Frame
from jaxsr.methods import METHODS, accumulation, taau
from jaxsr.methods.base import step
from jaxsr.methods.history import History
from jaxsr.ops import camera_motion, jitter_sequence, to_display, upsample
from jaxsr.runtime.stream import stream

SIZE = (96, 54)
NAMES = sorted(name for name, method in METHODS.items() if method.network is None)
"""Those that learn nothing; tests/test_fusion_sr.py has the others."""


@functools.cache
def clip(scale: int, count: int, every: int = 1, still: bool = False) -> tuple[list[Frame], list[np.ndarray]]:
    jitters = np.asarray(jitter_sequence(count))
    frames, truths = [], []
    for t in range(count):
        rendered = t % every == 0
        frame, truth = analytic.frame(
            0 if still else t, SIZE, scale, (float(jitters[t, 0]), float(jitters[t, 1])), rendered=rendered
        )
        if still:
            none = np.zeros_like
            frame = frame._replace(
                hr=frame.hr._replace(motion_px=none(frame.hr.motion_px)),
                lr=frame.lr._replace(motion_px=none(frame.lr.motion_px)),
                reset=np.asarray(t == 0),
            )
        frames.append(frame)
        truths.append(truth)
    return frames, truths


@functools.cache
def outputs(name: str, scale: int, count: int, every: int = 1) -> list[np.ndarray]:
    return [made.image for made in stream(METHODS[name], clip(scale, count, every)[0])]


def psnr(image, truth) -> float:
    error = to_display(jnp.asarray(image)) - to_display(jnp.asarray(truth))
    return float(-10 * jnp.log10(jnp.mean(error**2)))


def stacked(frames: list[Frame]) -> Frame:
    return jax.tree.map(lambda *xs: jnp.stack([jnp.asarray(x) for x in xs]), *frames)


@pytest.mark.parametrize("name", NAMES)
def test_streaming_equals_scan(name):
    """One step serves both; XLA may fuse the loop body otherwise, so equal up to rounding."""
    frames, _ = clip(2, 4, 2)
    method = METHODS[name]
    state = method.init(jax.tree.map(jnp.asarray, frames[0]))
    _, images = jax.jit(lambda s, fs: jax.lax.scan(functools.partial(step(method), None), s, fs))(
        state, stacked(frames)
    )
    np.testing.assert_allclose(np.stack(outputs(name, 2, 4, 2)), images, rtol=2e-4, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bilinear", "taau", "guided", "guided-taau"])
def test_jit_equals_eager(name):
    frames, _ = clip(2, 4, 2)
    method, compiled = METHODS[name], outputs(name, 2, 4, 2)
    with jax.disable_jit():
        state = method.init(jax.tree.map(jnp.asarray, frames[0]))
        for frame, expected in zip(frames[:2], compiled, strict=False):
            state, image = step(method)(None, state, jax.tree.map(jnp.asarray, frame))
            np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_an_extrapolated_frame_never_sees_its_colour(name):
    frames, _ = clip(2, 4, 2)
    poisoned = [
        f if f.rendered else f._replace(color_linear=np.full_like(f.color_linear, np.nan)) for f in frames
    ]
    for made, expected in zip(stream(METHODS[name], poisoned), outputs(name, 2, 4, 2), strict=True):
        np.testing.assert_array_equal(made.image, expected)


@pytest.mark.parametrize("name", NAMES)
def test_a_reset_drops_the_history(name):
    frames, _ = clip(2, 4)
    alone = [made.image for made in stream(METHODS[name], frames[3:])]
    broken = [frames[0], frames[1], frames[3]._replace(reset=np.asarray(True))]
    # Even a broken history must not reach through a reset.
    broken[1] = broken[1]._replace(color_linear=np.full_like(broken[1].color_linear, np.nan))
    after = [made.image for made in stream(METHODS[name], broken)]
    np.testing.assert_array_equal(after[2], alone[0])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("every", [1, 2])
def test_a_grey_world_stays_grey(name, every):
    frames, _ = clip(2, 4, every)

    def painted(gbuffer):  # no sky: sky has no paint, and its light is another
        depth = np.minimum(gbuffer.depth_linear, np.float32(1e3))
        return gbuffer._replace(base_color=np.full_like(gbuffer.base_color, 0.5), depth_linear=depth)

    grey = [
        f._replace(color_linear=np.full_like(f.color_linear, 0.25), hr=painted(f.hr), lr=painted(f.lr))
        for f in frames
    ]
    for made in stream(METHODS[name], grey):
        np.testing.assert_allclose(made.image, 0.25, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_full_size_frames_pass_unchanged(name):
    frame, truth = analytic.frame(0, SIZE, 1, (0.0, 0.0))
    for made in stream(METHODS[name], [frame, frame._replace(reset=np.asarray(False))]):
        np.testing.assert_allclose(made.image, truth, rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(2, 2), (6, 2), (10, 14)])
def test_tiny_frames(name, size):
    frames = [analytic.frame(t, size, 2, (0.3, -0.2), rendered=t != 1)[0] for t in range(3)]
    for made in stream(METHODS[name], frames):
        assert made.image.shape == (size[1], size[0], 3)
        assert np.isfinite(made.image).all()
        assert (made.image >= 0).all()


@pytest.mark.parametrize("scale", [2, 3])
def test_taau_gathers_detail_over_time_in_a_still_scene(scale):
    frames, _ = clip(scale, 3 * scale**2, still=True)
    (w, h), fine = SIZE, 4  # what many samples per pixel show: TAAU converges to an anti-aliased image
    samples = analytic.render(0, (fine * w, fine * h))["color"]
    truth = samples.reshape(h, fine, w, fine, 3).mean((1, 3))
    made = [m.image for m in stream(METHODS["taau"], frames)]
    bilinear = [m.image for m in stream(METHODS["bilinear"], frames)]
    assert psnr(made[-1], truth) > psnr(made[0], truth) + 2.0
    assert psnr(made[-1], truth) > psnr(bilinear[-1], truth) + 3.0


def test_taau_beats_bilinear_in_motion():
    _, truths = clip(2, 8)
    gain = [
        psnr(a, t) - psnr(b, t)
        for a, b, t in zip(outputs("taau", 2, 8), outputs("bilinear", 2, 8), truths, strict=True)
    ]
    assert np.mean(gain[2:]) > 0.5


def test_guided_beats_plain_warp_where_it_extrapolates():
    _, truths = clip(2, 8, 2)
    pairs = zip(outputs("guided", 2, 8, 2), outputs("taau", 2, 8, 2), truths, strict=True)
    gain = [psnr(guided, t) - psnr(warp, t) for guided, warp, t in pairs]
    assert min(gain[1::2]) > 0.3
    assert gain[0] == 0.0  # the first frame has no history: both upscale alike


@pytest.mark.parametrize("dilated", [False, True])
def test_taau_history_does_not_bleed_across_a_silhouette(dilated):
    """A pixel whose bilinear taps straddle two depths takes the tap of its own surface only."""
    frames, _ = clip(2, 2)
    frame = jax.tree.map(jnp.asarray, frames[1])
    h, w = frame.hr.depth_linear.shape[:2]
    left = jnp.arange(w)[None, :, None] < w // 2
    depth = jnp.broadcast_to(jnp.where(left, 2.0, 10.0), (h, w, 1))
    image = jnp.broadcast_to(jnp.where(left, 1.0, 5.0), (h, w, 3))
    motion = jnp.full((h, w, 2), 0.5)
    here = frame._replace(
        hr=frame.hr._replace(depth_linear=depth, motion_px=motion), reset=jnp.asarray(False)
    )
    state = accumulation.State(History(image, depth), jnp.ones((h, w, 1)))
    options = accumulation.Accumulation(dilated=dilated)
    history, weight = accumulation.fetch_history(image, state, here, options)
    edge = w // 2 + dilated  # a dilated silhouette is one pixel wider, on both sides of the step
    right_edge = history[2:-1, edge]  # its left tap lies on the near surface
    np.testing.assert_allclose(right_edge, 5.0, rtol=1e-6)
    assert (weight[2:-1, edge] < 1).all()
    assert (weight[2:-1, edge] > 0).all()


def test_stream_names_what_is_wrong():
    frames, _ = clip(2, 4, 2)
    with pytest.raises(JaxsrError, match="first frame is not rendered"):
        list(stream(METHODS["taau"], frames[1:]))
    other, _ = analytic.frame(1, (48, 54), 2, (0.0, 0.0))
    with pytest.raises(JaxsrError, match=r"frame 1: .*change within the sequence"):
        list(stream(METHODS["taau"], [frames[0], other]))


def test_guided_taau_is_worth_its_buffers():
    for every in (1, 2):
        _, truths = clip(2, 8, every)
        pairs = zip(outputs("guided-taau", 2, 8, every), outputs("guided", 2, 8, every), truths, strict=True)
        assert np.mean([psnr(a, t) - psnr(b, t) for a, b, t in pairs]) > 1.0


@pytest.mark.parametrize("name", ["guided", "guided-taau"])
def test_dark_surfaces_have_no_specks(name):
    """Base colours around the guard of the demodulation: light must keep its scale from one to the next."""
    frames, truths = clip(2, 6, 2)
    k = np.float32(0.03)
    dark = [
        f._replace(
            color_linear=f.color_linear * k,
            lr=f.lr._replace(base_color=f.lr.base_color * k),
            hr=f.hr._replace(base_color=f.hr.base_color * k),
        )
        for f in frames
    ]
    brightest = max(t.max() for t in truths) * k
    for made in stream(METHODS[name], dark):
        assert made.image.max() < 2 * brightest


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_the_unit_of_radiance_does_not_matter(name, unit):
    frames, _ = clip(2, 4, 2)
    others = [
        f._replace(color_linear=f.color_linear * np.float32(unit), exposure=f.exposure / np.float32(unit))
        for f in frames
    ]
    for made, expected in zip(stream(METHODS[name], others), outputs(name, 2, 4, 2), strict=True):
        np.testing.assert_allclose(made.image / unit, expected, rtol=1e-3, atol=1e-4)


def test_taau_forgets_light_that_went_out():
    """The clipping box: a history that the frame contradicts is dropped at once, not averaged away."""
    frames, truths = clip(2, 8, still=True)
    frames = [
        f if t < 6 else f._replace(color_linear=f.color_linear * np.float32(0.2))
        for t, f in enumerate(frames)
    ]
    made = [m.image for m in stream(METHODS["taau"], frames)]
    assert np.abs(made[6] - 0.2 * truths[0]).mean() < 0.1


@pytest.mark.parametrize("name", ["taau", "guided", "guided-taau"])
def test_a_broken_pixel_does_not_spread(name):
    frames, _ = clip(2, 6, still=True)
    color = frames[2].color_linear.copy()
    color[10, 20] = np.nan
    frames = [*frames[:2], frames[2]._replace(color_linear=color), *frames[3:]]
    broken = [int(np.isnan(m.image).any(-1).sum()) for m in stream(METHODS[name], frames)]
    assert broken[:2] == [0, 0]
    assert 0 < broken[2] <= 64  # seen once: nobody should miss it
    assert broken[3:] == [0, 0, 0]


@pytest.mark.parametrize("change", ["depth", "motion", "infinite motion"])
def test_history_counts_for_nothing_in_disocclusions(change):
    frames, _ = clip(2, 2)
    frame = jax.tree.map(jnp.asarray, frames[1])
    h, w = frame.hr.depth_linear.shape[:2]
    depth = jnp.full((h, w, 1), 5.0)
    motion = jnp.full((h, w, 2), {"depth": 0.25, "motion": 300.0, "infinite motion": jnp.inf}[change])
    here = frame._replace(hr=frame.hr._replace(depth_linear=depth, motion_px=motion))
    image, before = jnp.ones((h, w, 3)), depth * (2 if change == "depth" else 1)
    state = accumulation.State(History(image, before), jnp.ones((h, w, 1)))
    _, weight = accumulation.fetch_history(image, state, here, taau.Options())
    np.testing.assert_allclose(weight, 0.0, atol=1e-6)


def walk(step, known=True):
    """A frame of a camera that walks towards a wall, and the state of the frame before it.

    The wall is 10 units away, then `10 (1 - step)`; both are seen head-on.
    """
    frame = jax.tree.map(jnp.asarray, clip(2, 2)[0][1])
    h, w = frame.hr.depth_linear.shape[:2]
    before = Camera(jnp.eye(4), jnp.array([0.6, 0.4]), jnp.zeros(2))
    now = before._replace(world_from_view=jnp.eye(4).at[2, 3].set(10 * step))
    depth, far = jnp.full((h, w, 1), 10 * (1 - step)), jnp.full((h, w, 1), 10.0)
    hr = frame.hr._replace(depth_linear=depth, motion_px=camera_motion(depth, now, before))
    state = accumulation.State(
        History(jnp.ones((h, w, 3)), far, camera=before if known else None), jnp.ones((h, w, 1))
    )
    return frame._replace(hr=hr, camera=now if known else None), state


@pytest.mark.parametrize("step", [0.005, 0.03, 0.2, 0.5, -0.5])
def test_a_camera_that_walks_towards_a_wall_keeps_its_history(step):
    frame, state = walk(step)
    options = accumulation.Accumulation()
    _, weight = accumulation.fetch_history(state.last.image, state, frame, options)
    inside = slice(16, -16), slice(28, -28)  # walking backwards, the border comes into view
    np.testing.assert_allclose(weight[inside], 1.0, atol=1e-5)
    if step > 0.02:  # nothing but the camera tells
        frame, state = walk(step, known=False)
        _, weight = accumulation.fetch_history(state.last.image, state, frame, options)
        np.testing.assert_allclose(weight, 0.0, atol=1e-6)


@pytest.mark.parametrize("factor", [0.25, 0.9, 1.0, 1.1, 4.0])
def test_light_that_changes_is_a_ratio_of_means(factor):
    """Against loops over the blocks; noise of the samples averages out."""
    rng = np.random.default_rng(0)
    options = taau.Options(light_block=1, light_tolerance=0.2)
    samples = rng.random((4, 6, 3)).astype(np.float32)
    history = np.repeat(np.repeat(samples, 2, 0), 2, 1) * np.float32(factor)
    weight = (rng.random((8, 12, 1)) > 0.3).astype(np.float32)
    share = weight.reshape(4, 2, 6, 2).mean((1, 3))
    expected = np.zeros((4, 6, 1), np.float32)
    for y in range(4):
        for x in range(6):
            block = slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2)
            now = (samples[..., 0] * share)[block].sum()
            black = 0.01 * share[block].sum() + 1e-6
            change = np.log((now + black) / (factor * now + black))
            expected[y, x] = 2 ** -((change / 0.2) ** 2)
    light = accumulation.same_light(*map(jnp.asarray, (samples, history, weight)), options)
    np.testing.assert_allclose(light, upsample(jnp.asarray(expected), 2, "bilinear"), atol=1e-5)
    nothing = accumulation.same_light(
        jnp.asarray(samples), jnp.asarray(history), jnp.zeros((8, 12, 1)), options
    )
    assert np.isfinite(nothing).all()  # no history: nothing to compare with


def test_the_slope_of_one_row_is_that_of_its_columns():
    inverse = jnp.array([1.0, 0.9, 0.8, 0.7])[None, :, None]
    np.testing.assert_allclose(accumulation.slope(inverse), 0.1, rtol=1e-5)
    np.testing.assert_allclose(accumulation.slope(jnp.ones((1, 1, 1))), 0.0)
