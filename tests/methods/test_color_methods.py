"""The methods rcan and rrn: their steps, their losses, the jitter, and both from the command line."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.data.windows import WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import Window
from jaxsr.io.images import read_png
from jaxsr.methods import LEARNED, METHODS, build, rcan, rrn, variant
from jaxsr.methods.base import step
from jaxsr.methods.color_only import ColorOptions, without_jitter
from jaxsr.needs import Windows
from jaxsr.ops import backward_warp, from_display, sample_jittered, to_display, upsample
from jaxsr.runtime.load import find_method
from jaxsr.training import TrainConfig, train
from jaxsr.weights.file import load_weights
from tests.builders import make_sequence, random_weights
from tests.methods.test_fusion_sr import SIZE, batched, frame_at
from tests.networks import SMALL, drawn
from tests.test_cli import error_line, run

NAMES = sorted(SMALL)


@functools.cache
def method_of(name, **changes):
    return variant(name, SMALL[name] | {"scale": 2} | changes)


@functools.cache
def state_of(name, seed=0):
    return nnx.state(drawn(lambda rngs: method_of(name).network.new(rngs), seed))


@functools.cache
def step_of(name):
    return jax.jit(step(method_of(name)))


def clip():
    """Five frames, of which the fourth is not rendered."""
    return [frame_at(t, rendered=t != 3)[0] for t in range(5)]


def stream(name, frames):
    """Images of the compiled step, one after the other, and the last state."""
    state, images = method_of(name).init(frames[0]), []
    for frame in frames:
        state, image = step_of(name)(state_of(name), state, frame)
        images.append(np.asarray(image))
    return images, state


@functools.cache
def streamed(name):
    return stream(name, clip())[0]


def window(frames_and_truths, reset=False):
    """One window, as training sees it: the past of its first frame was left out."""
    frames, truths = zip(*frames_and_truths, strict=True)
    frames = batched(*frames)
    frames = frames._replace(reset=jnp.zeros_like(frames.reset).at[0].set(reset))
    return Window(*jax.tree.map(lambda x: x[None], (frames, jnp.stack(truths))))


# The jitter.


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_taking_the_jitter_out_is_sampling_at_its_place(scale):
    rng, reach = np.random.default_rng(scale), -(-scale // 2)
    image = jnp.asarray(rng.random((5, 7, 6, 3), np.float32))
    jitter = np.array([[0, 0], [0.5, -0.5], [-0.5, 0.5], [0.25, 0.1], [-0.31, 0.47]], np.float32) * scale

    def ours(image):
        return without_jitter(image, jnp.asarray(jitter), reach)

    def theirs(image):
        return sample_jittered(image, jnp.asarray(jitter), (7, 6), "bicubic")

    np.testing.assert_allclose(ours(image), theirs(image), atol=1e-5)
    np.testing.assert_allclose(jax.jit(ours)(image), ours(image), atol=1e-6)
    cotangent = jnp.asarray(rng.random((5, 7, 6, 3), np.float32))
    gradients = [jax.grad(lambda x, f=f: jnp.sum(f(x) * cotangent))(image) for f in (ours, theirs)]
    np.testing.assert_allclose(*gradients, atol=1e-5)


@pytest.mark.parametrize("scale", [2, 4])
def test_a_ramp_is_where_it_was_before_the_jitter(scale):
    """Bilinear upsampling is exact on it, and so is the shift: what is left is the sign of the jitter."""
    size, options = (24, 16), rcan.Options(scale=scale, **SMALL["rcan"])
    frame, _ = frame_at(0, (size[0] * scale, size[1] * scale), scale)

    def ramp(x, y):  # of display-referred colour, x and y in LR pixels
        return jnp.stack([0.2 + 0.02 * x, 0.8 - 0.03 * y, 0.3 + 0.01 * (x + y)], -1)

    y, x = jnp.mgrid[: size[1], : size[0]].astype(jnp.float32)
    jx, jy = frame.jitter_px
    frame = frame._replace(color_linear=from_display(ramp(x + jx, y + jy)))  # I_J(p) = I_N(p + J)
    net = functools.partial(upsample, scale=scale)
    made = rcan.displayed(lambda color: net(color), batched(frame), options)[0]
    y, x = (jnp.mgrid[: size[1] * scale, : size[0] * scale].astype(jnp.float32) + 0.5) / scale - 0.5
    inside = (slice(3 * scale, -3 * scale),) * 2
    np.testing.assert_allclose(made[inside], ramp(x, y)[inside], atol=1e-4)


def test_a_network_that_is_bilinear_gives_what_bilinear_gives():
    """RRN without weights, up to the second interpolation; not so if the jitter is left in."""
    frame = frame_at(0, (96, 64), jitter=(0.4, -0.3))[0]
    _, expected = step(METHODS["bilinear"])(None, METHODS["bilinear"].init(frame), frame)
    errors = []
    for unjitter in (True, False):
        method = method_of("rrn", unjitter=unjitter)
        zeros = jax.tree.map(jnp.zeros_like, state_of("rrn"))
        _, image = jax.jit(step(method))(zeros, method.init(frame), frame)
        errors.append(float(jnp.mean(jnp.abs(to_display(image) - to_display(expected)))))
    assert errors[0] < 0.02
    assert errors[0] < 0.5 * errors[1]


# The step.


def assert_same(found, expected):
    """Of two runs of one compiled program: equal to the bit, as docs/training.md says.

    This holds on one processor, with the same number of cores and one version of jaxlib, whatever else the
    machine does. Functions that are compiled apart (eager, `lax.scan`, other structures of inputs) are equal
    but for rounding only.
    """
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", NAMES)
def test_two_runs_are_equal_to_the_bit(name):
    for _ in range(3):
        assert_same(np.stack(stream(name, clip())[0]), np.stack(streamed(name)))


@pytest.mark.parametrize("name", NAMES)
def test_streaming_equals_scan(name):
    frames = clip()
    scan = jax.jit(lambda net, s, fs: jax.lax.scan(functools.partial(step(method_of(name)), net), s, fs))
    _, images = scan(state_of(name), method_of(name).init(frames[0]), batched(*frames))
    np.testing.assert_allclose(np.stack(streamed(name)), images, rtol=2e-4, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_jit_equals_eager(name):
    frames, state = clip(), method_of(name).init(clip()[0])
    with jax.disable_jit():
        for frame, expected in zip(frames[:2], streamed(name), strict=False):
            state, image = step(method_of(name))(state_of(name), state, frame)
            np.testing.assert_allclose(image, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_pictures(name):
    for image in streamed(name):
        assert image.shape == (*SIZE[::-1], 3)
        assert image.dtype == np.float32
        assert np.isfinite(image).all()
        assert (image >= 0).all()
        assert image.std() > 0


@pytest.mark.parametrize("name", NAMES)
def test_an_extrapolated_frame_is_the_last_picture_warped(name):
    frames = clip()
    frames[3] = frames[3]._replace(color_linear=jnp.full_like(frames[3].color_linear, jnp.nan))
    images, _ = stream(name, frames)
    assert_same(np.stack(images), np.stack(streamed(name)))  # the colour was not seen
    expected = backward_warp(images[2], frames[3].hr.motion_px)
    np.testing.assert_allclose(images[3], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_reset_drops_the_history(name):
    frames = clip()
    broken = frames[0]._replace(color_linear=jnp.full_like(frames[0].color_linear, jnp.nan))
    after = [frames[2]._replace(reset=jnp.asarray(True)), frames[3]]
    alone, _ = stream(name, after)
    assert_same(stream(name, [broken, frames[1], *after])[0][2:], alone)


@pytest.mark.parametrize("name", NAMES)
def test_the_state_does_not_grow(name):
    _, first = stream(name, clip()[:1])
    _, last = stream(name, clip())
    assert jax.tree.map(jnp.shape, first) == jax.tree.map(jnp.shape, last)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_the_unit_of_radiance_does_not_matter(name, unit):
    others = [f._replace(color_linear=f.color_linear * unit, exposure=f.exposure / unit) for f in clip()]
    for made, expected in zip(stream(name, others)[0], streamed(name), strict=True):
        np.testing.assert_allclose(made / unit, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_full_size_frames_pass_unchanged(name):
    frame, truth = frame_at(0, scale=1, jitter=(0.0, 0.0))
    _, image = jax.jit(step(method_of(name)))(state_of(name), method_of(name).init(frame), frame)
    np.testing.assert_array_equal(image, frame.color_linear)
    np.testing.assert_allclose(image, truth, rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(2, 2), (10, 14)])
def test_tiny_frames(name, size):
    frame, _ = frame_at(0, size)
    _, image = jax.jit(step(method_of(name)))(state_of(name), method_of(name).init(frame), frame)
    assert image.shape == (*size[::-1], 3)
    assert np.isfinite(image).all()


@pytest.mark.parametrize("name", NAMES)
def test_it_sees_colour_and_motion_alone(name):
    method, frame = method_of(name), frame_at(0)[0]
    assert method.needs.of(True) == {"lr.color", "hr.motion"}

    def bare(gbuffer):
        absent = dict.fromkeys(("normal", "base_color", "roughness", "metallic", "object_id"))
        return gbuffer._replace(depth_linear=jnp.zeros_like(gbuffer.depth_linear), **absent)

    _, image = step_of(name)(
        state_of(name), method.init(frame), frame._replace(lr=bare(frame.lr), hr=bare(frame.hr))
    )
    # Another structure of inputs is another program. Linear colour is steep where the display is near white.
    np.testing.assert_allclose(image, streamed(name)[0], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_frames_of_another_scale_are_named(name):
    frame, truth = frame_at(0, (24, 16), 4)
    message = "made for another scale; expected frames of scale 2; found scale 4; choose other weights"
    with pytest.raises(JaxsrError, match=message):
        step(method_of(name))(state_of(name), method_of(name).init(frame), frame)
    net = drawn(lambda rngs: method_of(name).network.new(rngs))
    with pytest.raises(JaxsrError, match=message):
        method_of(name).network.loss(net, window([(frame, truth)] * 3))


# What is RRN's alone.


def test_rrn_remembers():
    """The third frame depends on the first; in a still scene it is not the first picture again."""
    frames = clip()
    other = frames[0]._replace(color_linear=0.5 * frames[0].color_linear)
    first, second = stream("rrn", frames[:3])[0], stream("rrn", [other, *frames[1:3]])[0]
    assert np.abs(first[2] - second[2]).max() > 1e-4
    assert_same(*(stream("rcan", [f, *frames[1:3]])[0][2] for f in (frames[0], other)))


def test_rrn_feeds_back_what_it_made():
    """Two steps of the network itself: the first frame precedes itself, its output comes back as it was."""
    method, frames = method_of("rrn"), clip()[:2]
    graph = nnx.graphdef(nnx.eval_shape(lambda: method.network.new(nnx.Rngs(0))))
    net = nnx.merge(graph, state_of("rrn"))
    colors = [to_display(f.color_linear, f.exposure)[None] for f in frames]
    zero = jnp.zeros((1, *colors[0].shape[1:3], 8)), jnp.zeros((1, *SIZE[::-1], 3))
    made, hidden = net(colors[0], colors[0], *zero)
    again, last = net(colors[0], colors[1], hidden, made)
    _, state = stream("rrn", frames)
    for ours, expected in zip(state.past, (colors[1], last, again), strict=True):
        np.testing.assert_allclose(ours, expected[0], atol=1e-4)
    shown = sample_jittered(again, 2 * frames[1].jitter_px[None], SIZE[::-1], "bicubic")[0]
    image = streamed("rrn")[1]
    np.testing.assert_allclose(to_display(image), jnp.clip(shown, 0, 1), atol=1e-3)


def test_rrn_s_past_waits_while_nothing_is_rendered():
    frames = clip()
    _, before = stream("rrn", frames[:3])
    _, after = stream("rrn", frames[:4])
    jax.tree.map(assert_same, before.past, after.past)


def test_a_broken_pixel_is_forgotten():
    frames = clip()
    frames[1] = frames[1]._replace(color_linear=frames[1].color_linear.at[3, 4].set(jnp.nan))
    images, _ = stream("rrn", frames)
    assert np.isnan(images[1]).any()
    assert np.isfinite(images[2]).all()


# The loss.


@pytest.mark.parametrize("reset", [False, True])
def test_rrn_s_loss_is_over_every_frame_from_an_empty_past(reset):
    """As streaming makes them, whether or not the first frame of the window has a past that it leaves out."""
    net = drawn(lambda rngs: method_of("rrn").network.new(rngs))
    seen = [frame_at(t) for t in range(3)]
    total, parts = method_of("rrn").network.loss(net, window(seen, reset))
    pairs = zip(streamed("rrn"), seen, strict=False)
    errors = [np.abs(to_display(image) - to_display(truth)).mean() for image, (_, truth) in pairs]
    # Streaming clips to [0, 1], which the random network leaves.
    assert float(total) == float(parts["l1"])
    assert np.mean(errors) <= float(total) < 3 * np.mean(errors)
    made, past = [], rrn.first_past(batched(seen[0][0]), rrn.Options(scale=2, **SMALL["rrn"]))
    for frame, _ in seen:
        past, image = rrn.displayed(net, past, batched(frame), rrn.Options(scale=2, **SMALL["rrn"]))
        made.append(np.abs(image[0] - to_display(seen[len(made)][1])).mean())
    assert float(total) == pytest.approx(np.mean(made), rel=1e-4)


def test_rcan_s_loss_is_that_of_the_last_frame():
    net = drawn(lambda rngs: method_of("rcan").network.new(rngs))
    (_, wrong), (frame, truth) = frame_at(1), frame_at(2)
    frame = frame._replace(exposure=jnp.asarray(0.5))
    total, parts = method_of("rcan").network.loss(net, window([(frame_at(1)[0], wrong), (frame, truth)]))
    made = rcan.displayed(net, batched(frame), rcan.Options(scale=2, **SMALL["rcan"]))
    assert float(total) == pytest.approx(float(jnp.mean(jnp.abs(made[0] - to_display(truth, 0.5)))), rel=1e-5)
    assert set(parts) == {"l1", "ssim"}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_learns_one_window(name):
    """From where training begins, not where `drawn` does: RRN's tame weights take a hundred steps to wake."""
    method = variant(name, SMALL[name] | {"scale": 2, "features": 16})
    graph, params = nnx.split(method.network.new(nnx.Rngs(0)))
    optimizer, seen = optax.adam(1e-3), window([frame_at(t) for t in range(method.network.windows.length)])

    @jax.jit
    def step(params, opt):
        def loss(params):
            return method.network.loss(nnx.merge(graph, params, copy=True), seen)[0]

        error, grads = jax.value_and_grad(loss)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(grads, opt)
        return optax.apply_updates(params, updates), opt, error, grads

    opt, errors = optimizer.init(params), []
    for _ in range(400):
        params, opt, error, grads = step(params, opt)
        errors.append(float(error))
    assert errors[-1] < 0.5 * errors[0]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [0.0, 1e6])
def test_gradients_are_finite_in_the_dark_and_in_the_sun(name, factor):
    method = method_of(name)
    graph, params = nnx.split(drawn(lambda rngs: method.network.new(rngs)))
    pairs = [
        (f._replace(color_linear=factor * f.color_linear), factor * t) for f, t in map(frame_at, range(3))
    ]
    loss = lambda params: method.network.loss(nnx.merge(graph, params), window(pairs))[0]  # noqa: E731
    value, grads = jax.jit(jax.value_and_grad(loss))(params)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def test_windows_leave_out_the_past(tmp_path):
    """A window has a reset only where the sequence has one, and no window crosses one."""
    make_sequence(tmp_path / "clip", frames=5)
    needs, windows = method_of("rrn").needs, Windows(3, made=None)
    source = WindowSource([tmp_path / "clip"], needs, windows, scale=2, cache=tmp_path / "cache")
    resets = np.stack([stack([source[i]]).frames.reset[0] for i in range(len(source))])
    np.testing.assert_array_equal(resets, [[True, False, False], [False] * 3, [False] * 3])


# Options, files and the command line.


@pytest.mark.parametrize("name", NAMES)
def test_settings_in_json_build_the_same_method(name):
    method = method_of(name, dtype="bfloat16", unjitter=False)
    again = build(name, json.loads(json.dumps(dict(method.network.settings))))
    assert again.network.settings == method.network.settings
    assert (again.needs.of(True), again.network.windows.length) == (
        method.needs.of(True),
        method.network.windows.length,
    )


def test_they_are_among_the_methods():
    assert METHODS["rcan"].network.settings == variant("rcan", {}).network.settings
    assert (METHODS["rcan"].network.windows.length, METHODS["rrn"].network.windows.length) == (1, 4)
    assert rrn.method(loss=rrn.Loss(frames=3)).network.windows.length == 3
    for name in NAMES:
        options = LEARNED[name].options()
        assert isinstance(options, ColorOptions)
        loss = LEARNED[name].loss()
        assert (loss.ssim_weight, loss.l1_weight, loss.perceptual_weight) == (0, 1, 0)
        with pytest.raises(JaxsrError, match=f"no weights of '{name}' for scale 4; found no weights of it"):
            find_method(name, 4)


@pytest.mark.parametrize(
    ("name", "arguments", "match"),
    [
        ("rcan", {"scale": 5}, r"scale: bad scale; expected 2 \| 3 \| 4 \| 8; found 5"),
        ("rcan", {"groups": 0}, "groups: bad groups"),
        ("rcan", {"reduction": 65}, "reduction: bad reduction; expected at most 64"),
        ("rrn", {"scale": 1}, "scale: bad scale"),
        ("rrn", {"blocks": 0}, "blocks: bad blocks"),
        ("rrn", {"frames": 0}, "frames: bad frames; expected a whole number of at least 1; found 0"),
        ("rrn", {"frames": 10**9}, "frames: bad frames; expected a whole number from 0 to 4096"),
        ("rrn", {"blocks": 10**7}, "blocks: bad blocks; expected a whole number from 0 to 4096"),
        ("rrn", {"features": "many"}, "features: bad features; expected a whole number .*; found many"),
        ("rcan", {"l1_weight": 0.0}, "a loss of nothing"),
        ("rcan", {"dtype": "float16"}, "dtype"),
    ],
)
def test_bad_options_are_named(name, arguments, match):
    options, loss = LEARNED[name].options(), LEARNED[name].loss()
    for field, value in arguments.items():  # not through the constructors: tests alone check types there
        object.__setattr__(options if hasattr(options, field) else loss, field, value)
    with pytest.raises(JaxsrError, match=match):
        LEARNED[name].method(options, loss)


def test_a_training_of_another_scale_is_named(tmp_path):
    with pytest.raises(
        JaxsrError, match="--scale: the network of 'rcan' is made for another scale; expected 2"
    ):
        train(method_of("rcan"), TrainConfig(out=tmp_path / "out"), quiet=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_weights_of_another_scale_are_named(name, tmp_path, capsys):
    file = random_weights(tmp_path / "w.safetensors", scale=2, method=name)
    make_sequence(tmp_path / "seq", frames=1, scales=(4,))
    line = error_line(capsys, "upscale", tmp_path / "seq", "--method", file, "-o", tmp_path / "out")
    assert "w.safetensors: the weights are made for another scale; expected scale 4; found scale 2" in line


def test_help_has_one_scale(capsys):
    for name in NAMES:
        status, out, _ = run(capsys, "train", name, "--help")
        assert status == 0
        assert out.count("--scale ") == 1
        assert "--features" in out
        assert "Take the jitter out" in out


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_train_upscale_and_evaluate(name, tmp_path, capsys):
    make_sequence(tmp_path / "data" / "clip", frames=5)
    sizes = [word for key, value in SMALL[name].items() for word in (f"--{key}", value)]
    options = ["--data", tmp_path / "data", "--out", tmp_path / "run", "--cache", tmp_path / "cache"]
    options += ["--scale", 2, "--steps", 2, "--crop", 16, "--batch", 2, *sizes]
    status, _, err = run(capsys, "train", name, *options)
    assert status == 0, err
    assert "step 1: loss" in err
    weights = tmp_path / "run" / "weights.safetensors"
    header = load_weights(weights)[1]
    assert (header["method"], header["scale"], header["settings"]["scale"]) == (name, 2, 2)
    assert header["settings"].items() >= SMALL[name].items()
    clip = tmp_path / "data" / "clip"
    status, out, err = run(capsys, "upscale", clip, "--method", weights, "--every", 2, "-o", tmp_path / "up")
    assert status == 0, err
    assert "5 frames" in out
    assert read_png(tmp_path / "up" / "png" / "0005.png").shape == (40, 64, 3)
    methods = f"bilinear,{weights}"
    status, out, err = run(
        capsys, "evaluate", clip, "--methods", methods, "--scale", 2, "--no-lpips", "-o", tmp_path / "ev"
    )
    assert status == 0, err
    assert "run" in out
    metrics = json.loads((tmp_path / "ev" / "metrics.json").read_text())
    assert [track["name"] for track in metrics["sections"][0]["tracks"]] == ["bilinear", "run"]
