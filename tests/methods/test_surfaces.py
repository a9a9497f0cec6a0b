"""Methods that divide colour by base colour: black paint, sky, and what poor matches are worth."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr.data import analytic
from jaxsr.methods import METHODS, accumulation, guided, guided_taau
from jaxsr.methods.history import History
from jaxsr.ops import jitter_sequence, to_display
from jaxsr.runtime.load import find_method
from jaxsr.runtime.stream import stream

SIZE = (96, 64)
METHODS_AND_SCALES = [("guided", 4), ("guided-taau", 4), ("fusion-sr", 2)]


@functools.cache
def compiled(name, scale):
    """`run(frames)`: images of a still clip. Every clip here has the same shapes, so it compiles once."""
    ready = find_method(name, scale)
    init, upscale = jax.jit(ready.method.init), jax.jit(ready.method.upscale)

    def run(frames):
        state = init(frames[0])
        for frame in frames:
            state, image = upscale(ready.net, state, frame)
        return np.asarray(image)

    return run


def points(scale, jitter=None):
    """Where the pixels of the HR image, or of a jittered LR one, lie in the scene: x and y in LR pixels."""
    factor = scale if jitter is None else 1
    width, height = (n if jitter is None else n // scale for n in SIZE)
    shift = (0.0, 0.0) if jitter is None else jitter
    x = (np.arange(width) + 0.5) / factor - 0.5 + shift[0]
    y = (np.arange(height) + 0.5) / factor - 0.5 + shift[1]
    return np.broadcast_arrays(x[None, :], y[:, None])


def image(values):
    return np.broadcast_to(np.asarray(values, np.float32)[..., None], (*np.shape(values), 3)).copy()


def still_clip(scene, scale, count=5):
    """Frames of a still wall that faces the camera, and the truth of all of them.

    Args:
        scene: `scene(x, y) -> base colour, colour, depth` in grey, at places in LR pixels.
    """
    frames = []
    for t, jitter in enumerate(np.asarray(jitter_sequence(count))):
        frame, _ = analytic.frame(0, SIZE, scale, tuple(map(float, jitter)))
        made = {}
        for place, (x, y) in {"lr": points(scale, jitter), "hr": points(scale)}.items():
            base, color, depth = (np.asarray(v, np.float32) for v in scene(x, y))
            before = getattr(frame, place)
            toward = np.where(np.isfinite(depth)[..., None], np.float32([0, -1, 0]), np.float32(0))
            made[place] = before._replace(
                depth_linear=depth[..., None],
                motion_px=np.zeros_like(before.motion_px),
                base_color=image(base),
                normal=toward,
                roughness=np.full_like(before.roughness, 0.5),
                metallic=np.zeros_like(before.metallic),
            )
            if place == "lr":
                lr_color = image(color)
            else:
                truth = image(color)
        frame = frame._replace(color_linear=lr_color, reset=np.asarray(t == 0), **made)
        frames.append(jax.tree.map(jnp.asarray, frame))
    return frames, truth


def checker(x, y, side=2.5):
    return (np.floor(x / side) + np.floor(y / side)) % 2 == 0


def psnr(made, truth):
    error = np.asarray(to_display(jnp.asarray(made))) - np.asarray(to_display(jnp.asarray(truth)))
    return -10 * np.log10(np.mean(error**2))


@pytest.mark.parametrize(("name", "scale"), METHODS_AND_SCALES)
def test_ink_that_is_exactly_black_is_as_good_as_dark_ink(name, scale):
    """Grey paint with a checker of ink under smooth light."""

    def printed(ink):
        def scene(x, y):
            base = np.where(checker(x, y), ink, 0.5)
            return base, base * (1 + 0.5 * np.sin(0.4 * x + 0.3 * y)), 0 * x + 5

        return scene

    found = [psnr(compiled(name, scale)(frames), truth) for frames, truth in
             (still_clip(printed(ink), scale) for ink in (0.0005, 0.0))]  # fmt: skip
    assert found[0] > 12
    assert found[1] > found[0] - 1


@pytest.mark.parametrize(("name", "scale"), METHODS_AND_SCALES)
def test_a_uniform_colour_on_black_and_dark_tiles_is_uniform(name, scale):
    """Only the base colour differs from tile to tile, as where all light is a reflection."""
    frames, truth = still_clip(
        lambda x, y: (np.where(checker(x, y), 0.0, 0.004), 0 * x + 0.05, 0 * x + 5), scale
    )
    off = np.abs(compiled(name, scale)(frames) / truth - 1).max(-1)
    assert np.mean(off > 0.2) < 0.01
    if name != "fusion-sr":  # a network is only about right
        np.testing.assert_allclose(off, 0, atol=1e-4)


@pytest.mark.parametrize(("name", "scale"), METHODS_AND_SCALES)
def test_sky_keeps_its_colour_beside_black_surfaces(name, scale):
    """Bright sky above a dim black wall: neither takes the light of the other."""

    def scene(x, y):
        sky = y < 0.5 * SIZE[1] / scale
        return 0 * x, np.where(sky, 0.6, 0.01), np.where(sky, np.inf, 5.0)

    frames, truth = still_clip(scene, scale)
    made = compiled(name, scale)(frames)
    inside = np.abs(np.arange(SIZE[1]) - SIZE[1] / 2) > 2 * scale
    if name == "fusion-sr":
        assert psnr(made[inside], truth[inside]) > 30
    else:
        np.testing.assert_allclose(made[inside], truth[inside], rtol=1e-3)


@pytest.mark.parametrize("name", ["guided", "guided-taau"])
def test_extrapolated_sky_and_black_surfaces_keep_their_colour(name):
    def scene(x, y):
        sky = y < 8
        return (
            np.where(sky, 0.0, np.where(x < 12, 0.0, 0.4)),
            np.where(sky, 0.6, 0.02),
            np.where(sky, np.inf, 5),
        )

    frames, truth = still_clip(scene, 4, count=3)
    last = frames[2]._replace(rendered=jnp.asarray(False), color_linear=0 * frames[2].color_linear)
    *_, rendered, extrapolated = (out.image for out in stream(METHODS[name], [*frames[:2], last]))
    inside = np.ix_(np.abs(np.arange(SIZE[1]) - 32) > 12, np.abs(np.arange(SIZE[0]) - 47.5) > 8)
    np.testing.assert_allclose(extrapolated[inside], rendered[inside], rtol=0.02)
    np.testing.assert_allclose(extrapolated[inside], truth[inside], rtol=0.02)


# What the history is worth after a frame that was not rendered.


def extrapolated_weight(name, change):
    """The weight of the history, 1 before, after one extrapolated frame; `change(frame)` is that frame."""
    frames, _ = still_clip(lambda x, y: (0 * x + 0.5, 0 * x + 0.3, 0 * x + 5), 2, count=1)
    frame, method = frames[0], METHODS[name]
    last = guided.keep(jnp.full((*SIZE[::-1], 3), 0.3), frame)
    if name == "taau":
        last = History(last.image, last.depth_linear)
    weight = jnp.ones((*SIZE[::-1], 1))
    weight = weight.at[:, :8].set(0.25)
    state: Any = accumulation.State(last, weight)
    if name == "guided-taau":
        last = guided_taau.keep(last.image, frame)
        state = guided_taau.State(last, weight, last.image, weight)
    state, _ = jax.jit(method.extrapolate)(None, state, change(frame))
    return np.asarray(state.weight)[..., 0]


@pytest.mark.parametrize("name", ["guided", "guided-taau"])
def test_a_history_is_worth_less_where_the_match_was_poor(name):
    right = jnp.arange(SIZE[0])[None, :, None] >= SIZE[0] // 2

    def turned(frame):
        """The right half now shows a surface of another colour and direction, which no frame had shown."""
        hr = frame.hr
        base = jnp.where(right, 1.0, hr.base_color)
        normal = jnp.where(right, jnp.array([1.0, 0, 0]), hr.normal)
        return frame._replace(hr=hr._replace(base_color=base, normal=normal))

    weight = extrapolated_weight(name, turned)
    np.testing.assert_allclose(weight[:, 10:40], 1, atol=0.05)
    np.testing.assert_allclose(weight[:, 56:], 0, atol=0.05)


def test_a_plain_warp_is_worth_nothing_where_another_surface_was():
    right = jnp.arange(SIZE[0])[None, :, None] >= SIZE[0] // 2

    def behind(frame):
        return frame._replace(
            hr=frame.hr._replace(depth_linear=jnp.where(right, 9.0, 5.0) + 0 * frame.hr.depth_linear)
        )

    weight = extrapolated_weight("taau", behind)
    np.testing.assert_allclose(weight[:, 10:44], 1, atol=1e-5)
    np.testing.assert_allclose(weight[:, 50:], 0, atol=1e-5)


@pytest.mark.parametrize("name", ["taau", "guided", "guided-taau"])
def test_what_a_history_is_worth_moves_with_it(name):
    def moved(frame):
        motion = frame.hr.motion_px.at[..., 0].set(4.0)
        return frame._replace(hr=frame.hr._replace(motion_px=motion))

    weight = extrapolated_weight(name, moved)
    np.testing.assert_allclose(weight[:, 5:11], 0.25, atol=0.02)  # columns 1 to 6 of the frame before
    np.testing.assert_allclose(weight[:, 20:80], 1, atol=0.05)
