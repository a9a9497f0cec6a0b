"""`jaxsr.load`: a method on frames of one's own, and what it says of frames that do not fit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsr
from jaxsr.data import analytic
from jaxsr.methods.base import step
from jaxsr.ops import hr_from_lr, jitter_sequence
from jaxsr.runtime.load import find_method
from jaxsr.runtime.stream import stream

SIZE = (48, 32)
NAMES = ("bilinear", "taau", "guided", "guided-taau", "fusion-sr")


@functools.cache
def clip(count=5, every=2):
    """Frames of the analytic scene; every second one is not rendered."""
    jitters = np.asarray(jitter_sequence(count)).tolist()
    return [analytic.frame(t, SIZE, 2, tuple(jitters[t]), rendered=t % every == 0)[0] for t in range(count)]


@functools.cache
def loaded(name):
    return jaxsr.load(name, scale=2)


@pytest.mark.parametrize("name", NAMES)
def test_it_makes_what_the_stream_makes(name):
    up, frames = loaded(name), clip()
    state = up.init(frames[0])
    images = []
    for frame in frames:
        image, state = up(frame, state)
        images.append(image)  # kept: the donated state must not take the image with it
    method = find_method(name, 2)
    for image, output in zip(images, stream(method.method, frames, method.net), strict=True):
        np.testing.assert_allclose(np.asarray(image), output.image, rtol=2e-5, atol=2e-6)


def test_each_kind_of_frame_is_compiled_once():
    up, frames = jaxsr.load("taau", scale=2), clip()
    state = up.init(frames[0])
    for frame in (*frames, *frames[1:]):
        _, state = up(frame, state)
    assert [compiled._cache_size() for compiled in up._steps.values()] == [1, 1]


def test_a_reset_begins_anew():
    up, frames = loaded("taau"), clip(every=1)
    state = up.init(frames[0])
    for frame in frames[:3]:
        _, state = up(frame, state)
    again, _ = up(frames[3]._replace(reset=np.asarray(True)), state)
    alone, _ = up(frames[3], up.init(frames[3]))
    np.testing.assert_array_equal(again, alone)


def test_the_steps_can_be_scanned():
    up, frames = loaded("guided-taau"), clip()
    stacked = jax.tree.map(lambda *xs: jnp.stack([jnp.asarray(x) for x in xs]), *frames)
    state = up.init(frames[0])
    _, images = jax.jit(lambda s, fs: jax.lax.scan(functools.partial(step(up.method), up.net), s, fs))(
        jax.tree.map(jnp.copy, state), stacked
    )
    for frame, image in zip(frames, images, strict=True):
        single, state = up(frame, state)
        np.testing.assert_allclose(single, image, rtol=2e-4, atol=2e-4)


def test_buffers_that_it_does_not_need_may_be_anything():
    up, (frame, *_) = loaded("bicubic"), clip()
    nan = jax.tree.map(lambda x: np.full_like(x, np.nan), frame.hr)
    expected, _ = up(frame, up.init(frame))
    for other in (frame._replace(hr=nan, lr=jaxsr.GBuffer()), frame._replace(camera=None)):
        image, _ = up(other, up.init(other))
        np.testing.assert_array_equal(image, expected)


def test_hr_depth_and_motion_come_from_lr_where_they_are_missing():
    up, frames = loaded("taau"), clip(every=1)
    bare = [f._replace(hr=jaxsr.GBuffer(), factor=type(f.factor)(0)) for f in frames]
    derived = []
    for f in frames:
        depth, motion = hr_from_lr(
            jnp.asarray(f.lr.depth_linear), jnp.asarray(f.lr.motion_px), f.jitter_px, 2
        )
        derived.append(f._replace(hr=jaxsr.GBuffer(depth, motion)))
    states = up.init(bare[0]), up.init(derived[0])
    for lr_only, full in zip(bare, derived, strict=True):
        (image, first), (expected, second) = up(lr_only, states[0]), up(full, states[1])
        np.testing.assert_array_equal(image, expected)
        states = first, second


def test_at_scale_1_the_buffers_of_both_places_are_the_same():
    up, frames = jaxsr.load("taau", scale=1), clip()
    images = []
    for place in ("lr", "hr"):
        frame, other = (
            jaxsr.Frame.of(
                color=f.lr.base_color if f.rendered else None,
                rendered=bool(f.rendered),
                scale=1,
                **{place: {"depth": f.lr.depth_linear, "motion": f.lr.motion_px}},
            )
            for f in frames[:2]
        )
        _, state = up(frame, up.init(frame))
        images.append(up(other, state)[0])
    np.testing.assert_array_equal(*images)


class TestErrors:
    def line(self, match, call, *arguments, **options):
        with pytest.raises(jaxsr.JaxsrError, match=match) as caught:
            call(*arguments, **options)
        assert "\n" not in str(caught.value)

    def test_of_jittered_hr_buffers(self):
        """Only those methods take them that account for them."""
        frame = analytic.frame(0, SIZE, 2, (0.1, 0.2), hr_jitter_px=(0.25, -0.5))[0]
        up = loaded("guided")
        self.line(r"guided: the method does not account for jittered HR buffers", up, frame, None)
        up = loaded("guided-taau")
        image, _ = up(frame, up.init(frame))
        assert np.isfinite(np.asarray(image)).all()

    def test_of_load(self):
        self.line("unknown method 'nope'; expected one of nearest", jaxsr.load, "nope", scale=2)
        self.line("no weights of 'fusion-sr' for scale 3", jaxsr.load, "fusion-sr", scale=3)
        for scale in (0, True):
            self.line("bad scale", jaxsr.load, "taau", scale=scale)

    def test_of_a_frame(self):
        up, frames = loaded("guided-taau"), clip()
        first, second, *_ = frames
        state = up.init(first)
        self.line("guided-taau: the first frame is not rendered", up.init, second)
        fresh = second._replace(reset=np.asarray(True))
        self.line("a frame that begins anew is not rendered", up, fresh, state)
        for place, name in (("lr", "base_color"), ("hr", "normal")):
            bare = first._replace(**{place: getattr(first, place)._replace(**{name: None})})
            self.line(f"the frame lacks {place}.{name}; expected hr.base_color, ", up, bare, state)
        self.line("lacks hr.base_color", up, second._replace(hr=second.hr._replace(base_color=None)), state)
        self.line(
            "the frame has another scale; expected 2; found 4",
            up,
            analytic.frame(0, SIZE, 4, (0, 0))[0],
            state,
        )
        small = analytic.frame(0, (24, 16), 2, (0.0, 0.0))[0]._replace(reset=np.asarray(False))
        self.line("the state does not fit the frame; expected a state for 24x16", up, small, state)

    def test_of_a_state_that_was_used(self):
        up, frames = loaded("taau"), clip(every=1)
        state = up.init(frames[0])
        _, after = up(frames[0], state)
        jax.tree.map(lambda x: x.delete(), state)  # where a device does not do it by itself
        self.line("taau: the state was used already; use the state that the last", up, frames[1], state)
        up(frames[1], after)

    def test_an_extrapolation_without_the_history_that_it_wants(self):
        up, (first, second, *_) = loaded("guided"), clip()
        first = first._replace(hr=first.hr._replace(base_color=None, normal=None))
        image, state = up(first, up.init(first))  # enough to upscale
        assert np.isfinite(image).all()
        self.line("the state does not fit the frame", up, second, state)
