"""The history of the image: what the samples of a frame say of each pixel, and where it converges to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods import METHODS, accumulation, guided_taau
from jaxsr.ops import jitter_sequence, to_display
from jaxsr.runtime.stream import stream

SIZE = (32, 24)
OPTIONS = guided_taau.Antialiasing()


def frame_at(hr_jitter=(0.0, 0.0), jitter=(0.25, -0.375), scale=2, size=SIZE) -> Frame:
    frame, _ = analytic.frame(3, size, scale, jitter, hr_jitter_px=hr_jitter)
    return jax.tree.map(jnp.asarray, frame)


def pixels_by_loop(color, frame, options, trust=None):
    """`guided_taau.pixels`, one pixel after the other."""
    color = np.asarray(accumulation.to_working(color, frame.exposure), np.float64)
    low_res = np.asarray(accumulation.to_working(frame.color_linear, frame.exposure), np.float64)
    (h, w), scale = color.shape[:2], frame.scale
    hr_jitter, jitter = np.asarray(frame.hr_jitter_px, float), np.asarray(frame.jitter_px, float)
    whole = np.round(hr_jitter).astype(int)
    out, centres = [np.zeros((h, w, n)) for n in (3, 3, 3, 1, 3)], np.zeros((h, w, 2))
    for y in range(h):
        for x in range(w):
            total, wide, centre = 0.0, 0.0, np.zeros(2)
            color_sum, smooth, box = np.zeros(3), np.zeros(3), []
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    # The sample at q shows the place q + J.
                    q = x + dx - whole[0], y + dy - whole[1]
                    away = np.array(q) + hr_jitter - (x, y)
                    at = np.clip(q[1], 0, h - 1), np.clip(q[0], 0, w - 1)
                    worth = 1.0 if trust is None else float(trust[at][0])
                    near = worth * np.exp(-(away @ away) / (2 * options.pixel_sigma**2))
                    total, color_sum = total + near, color_sum + near * color[at]
                    centre = centre + near * away
                    near = np.exp(-(away @ away) / (2 * options.smooth_sigma**2))
                    wide, smooth = wide + near, smooth + near * color[at]
                    box.append(color[at])
            if trust is None:
                place = (np.array([x, y]) + 0.5) / scale - 0.5 - jitter
                index = np.clip(np.round(place), 0, [w // scale - 1, h // scale - 1])
                away = scale * (index - place)
                near = options.sample_weight * np.exp(-(away @ away) / (2 * options.sample_sigma**2))
                total, centre = total + near, centre + near * away
                color_sum = color_sum + near * low_res[int(index[1]), int(index[0])]
            smooth = smooth / wide
            for image, value in zip(
                out, (color_sum, np.min(box, 0), np.max(box, 0), total, smooth), strict=True
            ):
                image[y, x] = value
            centres[y, x] = centre
    smooth = np.pad(out[4], ((1, 1), (1, 1), (0, 0)), mode="edge")
    slope_x = 0.5 * (smooth[1:-1, 2:] - smooth[1:-1, :-2])
    slope_y = 0.5 * (smooth[2:, 1:-1] - smooth[:-2, 1:-1])
    total = np.maximum(out[3], 1e-6)
    moved = (out[0] - slope_x * centres[..., :1] - slope_y * centres[..., 1:]) / total
    out[0] = np.where(out[3] > 1e-6, moved, out[4])
    return out


@pytest.mark.parametrize("hr_jitter", [(0.0, 0.0), (0.3, -0.45), (-0.9, 0.7)])
@pytest.mark.parametrize("trusted", [False, True])
def test_pixels_equal_the_loop(hr_jitter, trusted):
    frame = frame_at(hr_jitter)
    rng = np.random.default_rng(0)
    color = jnp.asarray(rng.gamma(1.0, 0.5, (*frame.size, 3)), jnp.float32)
    trust = jnp.asarray(rng.uniform(0, 1, (*frame.size, 1)), jnp.float32) if trusted else None
    found = jax.jit(guided_taau.pixels, static_argnames="options")(color, frame, OPTIONS, trust)
    wanted = pixels_by_loop(color, frame, OPTIONS, None if trust is None else np.asarray(trust))
    names = ("color", "low", "high", "confidence", "smooth")
    for name, expected in zip(names, wanted, strict=True):
        np.testing.assert_allclose(getattr(found, name), expected, rtol=2e-5, atol=2e-6, err_msg=name)


def wall(scale: int, jittered: bool, count: int = 12) -> list[Frame]:
    """A wall at rest with stripes of 0.9 periods per HR pixel, under constant light: its mean is 0.5."""

    def stripes(size, step, jitter):
        x = (np.arange(size[0]) + 0.5 + jitter[0]) * step - 0.5
        row = 0.5 + 0.4 * np.sin(2 * np.pi * 0.9 * x)
        return np.broadcast_to(row[None, :, None], (size[1], size[0], 3)).astype(np.float32)

    frames = []
    for t, jitter in enumerate(np.asarray(jitter_sequence(count, count))):
        own = tuple(map(float, jitter)) if jittered else (0.0, 0.0)
        small = (SIZE[0] // scale, SIZE[1] // scale)
        layers = {}
        for place, size, step, j in (("lr", small, scale, jitter), ("hr", SIZE, 1, own)):
            shape = size[::-1]
            layers[place] = {
                "base_color": stripes(size, step, j),
                "normal": np.broadcast_to(np.float32([0, 0, 1]), (*shape, 3)),
                "depth": np.full((*shape, 1), 5, np.float32),
                "motion": np.zeros((*shape, 2), np.float32),
            }
        frames.append(
            Frame.of(
                layers["lr"]["base_color"],
                jitter=tuple(map(float, jitter)),
                hr_jitter=own,
                reset=t == 0,
                lr=layers["lr"],
                hr=layers["hr"],
            )
        )
    return frames


@pytest.mark.parametrize("scale", [2, 4])
def test_at_rest_jittered_buffers_remove_aliasing(scale):
    def ripple(jittered):
        *_, last = stream(METHODS["guided-taau"], wall(scale, jittered))
        return float(np.std(np.asarray(to_display(last.image))[4:-4, 4:-4]))

    assert ripple(False) > 0.05  # samples at the same places for ever
    assert ripple(True) < 0.4 * ripple(False)


def test_a_still_scene_stays_where_it_is():
    """Over the last frames the image moves by less than 0.05 pixels, while both jitters move by up to one."""
    jitters = np.asarray(jitter_sequence(16, 16))
    frames = []
    for t in range(16):
        jitter = tuple(map(float, jitters[t]))
        frame, _ = analytic.frame(0, (96, 54), 2, jitter, hr_jitter_px=jitter)
        frames.append(
            frame._replace(
                hr=frame.hr._replace(motion_px=np.zeros_like(frame.hr.motion_px)),
                lr=frame.lr._replace(motion_px=np.zeros_like(frame.lr.motion_px)),
                reset=np.asarray(t == 0),
            )
        )
    images = [np.asarray(to_display(made.image)).mean(-1) for made in stream(METHODS["guided-taau"], frames)]
    slopes = np.stack(np.gradient(images[-1]), -1)[2:-2, 2:-2].reshape(-1, 2)
    change = (images[-1] - images[-2])[2:-2, 2:-2].reshape(-1)
    shift, *_ = np.linalg.lstsq(slopes, change, rcond=None)
    assert np.abs(shift).max() < 0.05


def test_buffers_with_the_projection_of_the_lr_frame():
    """An engine jitters HR buffers by the scale times J, which may exceed a pixel."""
    jitter = (0.4, -0.3)
    large = analytic.frame(0, SIZE, 4, jitter, hr_jitter_px=(1.6, -1.2))[0]
    small = analytic.frame(0, SIZE, 4, jitter, hr_jitter_px=(0.0, 0.0))[0]
    images = [next(iter(stream(METHODS["guided-taau"], [f]))).image for f in (large, small)]
    a, b = (np.asarray(to_display(image))[4:-4, 4:-4] for image in images)
    assert np.sqrt(np.mean((a - b) ** 2)) < 0.06  # other samples of the same picture, and not another place
    shifted = np.asarray(to_display(images[0]))[4:-4, 3:-5]
    assert np.mean((shifted - b) ** 2) > np.mean((a - b) ** 2)


@pytest.mark.parametrize("name", ["guided", "fusion-sr"])
def test_other_methods_refuse_jittered_buffers(name):
    from jaxsr.runtime.load import LoadedMethod
    from jaxsr.runtime.upscaler import Upscaler

    frame = frame_at((0.3, 0.1))
    up = Upscaler(LoadedMethod(METHODS[name]), 2)
    with pytest.raises(JaxsrError, match="does not account for jittered HR buffers"):
        up.init(frame)
    if name == "guided":
        up.init(frame_at())


def test_taau_takes_jittered_depth_and_motion():
    from jaxsr.runtime.load import LoadedMethod
    from jaxsr.runtime.upscaler import Upscaler

    up = Upscaler(LoadedMethod(METHODS["taau"]), 2)
    image, _ = up(frame_at((0.3, 0.1)), up.init(frame_at((0.3, 0.1))))
    assert np.isfinite(image).all()
