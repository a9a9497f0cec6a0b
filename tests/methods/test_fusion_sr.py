"""The method fusion-sr: normalisation, placement of samples, its step, its loss.

Networks are drawn by NumPy and frames are tiny, but programs compile in seconds: what is compiled is shared.
"""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.frames import FIELDS, Window
from jaxsr.methods import METHODS, accumulation, build, fusion_sr, guided, guided_taau, variant
from jaxsr.methods.base import step
from jaxsr.methods.fusion_sr import Options, displayed
from jaxsr.methods.image_loss import ImageLoss, middle
from jaxsr.methods.options import from_json
from jaxsr.nets import blocks as layers
from jaxsr.ops import backward_warp, to_display, upsample, zero_upsample
from jaxsr.ops.encoding import normalized_depth, sample_offset
from tests.networks import drawn

PAPER = {"demodulated": False, "base": "none", "unjitter": False}
SIZE = (24, 16)

VARIANTS = {
    "default": {},
    "paper": PAPER,
    "unet": {"architecture": "unet", "down_kernel": 2} | PAPER,
    "unet guided": {"architecture": "unet", "buffers": ("depth", "base_color")},
    "concat display": {"fusion": "concat", "demodulated": False, "dtype": "bfloat16"},
    "add depth": {"fusion": "add", "buffers": ("depth",), "base": "none"},
    "display depth": {"buffers": ("roughness", "depth"), "base": "none", "demodulated": False},
}


@functools.cache
def method_of(name):
    return variant("fusion-sr", VARIANTS[name])


@functools.cache
def state_of(name, seed=0):
    return nnx.state(drawn(lambda rngs: method_of(name).network.new(rngs), seed))


@functools.cache
def step_of(name):
    return jax.jit(step(method_of(name)))


def model_of(name):
    graph = nnx.graphdef(nnx.eval_shape(lambda: method_of(name).network.new(nnx.Rngs(0))))
    model = nnx.merge(graph, state_of(name))
    model.eval()
    return model


@functools.cache
def frame_at(t, size=SIZE, scale=2, rendered=True, jitter=None):
    jitter = (0.3 - 0.2 * t, 0.1 * t - 0.4) if jitter is None else jitter
    frame, truth = analytic.frame(t, size, scale, jitter, rendered=rendered)
    first = jnp.asarray(t == 0)
    return jax.tree.map(jnp.asarray, frame)._replace(reset=first), jnp.asarray(truth)


def clip():
    return [frame_at(t, rendered=t != 1)[0] for t in range(3)]


def stream(name, frames):
    """Images of the compiled step, one after the other."""
    state, images = method_of(name).init(frames[0]), []
    for frame in frames:
        state, image = step_of(name)(state_of(name), state, frame)
        images.append(np.asarray(image))
    return images


@functools.cache
def streamed():
    return stream("default", clip())


def batched(*frames):
    return jax.tree.map(lambda *xs: jnp.stack(xs), *frames)


# Inputs and outputs of the network.


@pytest.mark.parametrize("demodulated", [False, True])
@pytest.mark.parametrize("exposure", [0.25, 3.0])
def test_a_network_that_passes_colour_on_gives_the_colour(demodulated, exposure):
    """What the network sees is turned back into scene-linear colour by the inverse of the same map."""
    options = Options(demodulated=demodulated, base="none")
    frame, _ = frame_at(0)
    enlarged = functools.partial(upsample, scale=2, mode="nearest")
    flat = [jnp.asarray(np.random.default_rng(s).random((8, 12, 3), np.float32)) for s in (0, 1)]
    linear = (2.0 / exposure) * flat[0]
    base, depth = flat[1].at[:2].set(0), jnp.ones((8, 12, 1)).at[:2].set(jnp.inf)  # sky, with black below it
    base = base.at[2].set(0)
    frame = frame._replace(
        color_linear=linear,
        exposure=jnp.asarray(exposure),
        lr=frame.lr._replace(base_color=base, depth_linear=depth),
        hr=frame.hr._replace(base_color=enlarged(base), depth_linear=enlarged(depth)),
    )
    shown, made = displayed(lambda c, g, o: enlarged(c), batched(frame), options)
    np.testing.assert_allclose(made[0], enlarged(linear), rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(shown[0], to_display(enlarged(linear), exposure), atol=2e-4)


@pytest.mark.parametrize("options", [Options(), Options(**PAPER)])
def test_the_inputs_are_those_of_exposed_colour(options):
    frame, _ = frame_at(0)
    unit = 1e4  # of radiance, as in candela a square metre
    other = frame._replace(color_linear=frame.color_linear * unit, exposure=frame.exposure / unit)
    for function in (fusion_sr.color_input, fusion_sr.base_image)[: 1 + (options.base == "guided")]:
        first, second = (function(f, options) for f in (frame, other))
        np.testing.assert_allclose(first, second, atol=1e-4)
        assert (np.asarray(first) >= 0).all()
        assert (np.asarray(first) <= 1).all()


def test_channels_are_in_order():
    gbuffer = frame_at(0)[0].hr
    found = fusion_sr.gbuffer_input(gbuffer, ("metallic", "normal", "depth"))
    np.testing.assert_array_equal(found[..., :1], gbuffer.metallic)
    np.testing.assert_array_equal(found[..., 1:4], gbuffer.normal)
    np.testing.assert_array_equal(found[..., 4:], normalized_depth(gbuffer.depth_linear))
    everything = fusion_sr.gbuffer_input(gbuffer, fusion_sr.BUFFERS)
    assert np.isfinite(everything).all()
    assert everything.min() >= -1
    assert everything.max() <= 1


def test_a_prediction_that_is_too_bright_can_come_down():
    """Beyond white the picture does not change any more, but the slope of what the loss sees is positive."""
    options = Options(base="none")
    frame = jax.tree.map(lambda x: x[None], frame_at(0)[0])

    def shown(output):
        made, linear = displayed(lambda *_: output, frame, options)
        return made, to_display(linear * frame.exposure[..., None, None, None])

    output = jnp.broadcast_to(jnp.linspace(0, 1.2, SIZE[0])[None, None, :, None], (1, *SIZE[::-1], 3))
    made, expected = shown(output)
    np.testing.assert_allclose(made, expected, atol=1e-5)  # values are those of the picture
    slope = np.asarray(jax.grad(lambda x: jnp.sum(shown(x)[0]))(output))
    white = np.asarray(expected) > 0.9999
    assert white.mean() > 0.1
    np.testing.assert_allclose(slope[white & (np.asarray(output) > 1)], 0.1, rtol=1e-4)
    assert (slope[white] >= 0).all()
    dark = jax.tree.map(lambda x: jnp.full_like(x, 0.2), expected)
    pull = jax.grad(lambda x: jnp.mean(jnp.abs(shown(x)[0] - dark)))(jnp.full_like(output, 1.1))
    assert (np.asarray(pull) > 0).all()  # a step against it makes the prediction darker


# Where LR samples go.


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_offsets_are_the_nearest_pixel_of_the_block(scale):
    jitters = np.linspace(-0.5, 0.5, 47)
    found = np.asarray(sample_offset(jnp.asarray(np.stack([jitters, -jitters], -1), jnp.float32), scale))
    for jitter, (x, y) in zip(jitters, found, strict=True):
        for j, k in ((jitter, x), (-jitter, y)):
            place = scale * (j + 0.5) - 0.5  # of LR pixel 0 among the HR pixels
            distances = [abs(place - pixel) for pixel in range(scale)]
            assert distances[k] <= min(distances) + 1e-5


@pytest.mark.parametrize("scale", [2, 4])
def test_samples_lie_on_the_pixels_that_show_the_same(scale):
    """Where jitter puts samples on HR pixels exactly, their buffers are those of the HR image."""
    steps = (np.arange(scale) - (scale - 1) / 2) / scale
    for jx, jy in zip(steps, np.roll(steps, 1), strict=True):
        frame, _ = frame_at(0, scale=scale, jitter=(float(jx), float(jy)))
        offset = sample_offset(frame.jitter_px, scale)
        placed = zero_upsample(frame.lr.base_color, scale, offset)
        there = np.asarray(zero_upsample(jnp.ones_like(frame.lr.depth_linear), scale, offset)) == 1
        np.testing.assert_allclose(
            np.where(there, placed, 0), np.where(there, frame.hr.base_color, 0), atol=1e-4
        )


def test_following_the_jitter_is_nearer_than_the_top_left():
    errors = {True: [], False: []}
    for t in range(8):
        frame, _ = frame_at(0, scale=4, jitter=tuple((np.array([0.37, 0.71]) * (t + 1)) % 1 - 0.5))
        for follows in errors:
            offset = sample_offset(frame.jitter_px, 4) if follows else None
            placed = zero_upsample(frame.lr.depth_linear, 4, offset)
            there = np.isfinite(placed) & (np.asarray(placed) > 0) & np.isfinite(frame.hr.depth_linear)
            off = np.abs(np.log(np.asarray(placed)[there] / np.asarray(frame.hr.depth_linear)[there]))
            errors[follows].append(off.mean())
    assert np.mean(errors[True]) < 0.5 * np.mean(errors[False])


def test_the_network_is_told_the_offset():
    seen = []

    def net(color, gbuffer, offset):
        seen.append(offset)
        return jnp.zeros((*gbuffer.shape[:-1], 3))

    frames = batched(*(frame_at(t, scale=4)[0] for t in range(2)))
    displayed(net, frames, Options(base="none"))
    displayed(net, frames, Options(base="none", unjitter=False))
    np.testing.assert_array_equal(seen[0], [[3, 0], [2, 0]])
    assert seen[1] is None


# The step.


@pytest.mark.slow
def test_streaming_equals_scan():
    frames = clip()
    run = jax.jit(lambda net, s, fs: jax.lax.scan(functools.partial(step(method_of("default")), net), s, fs))
    _, images = run(state_of("default"), method_of("default").init(frames[0]), batched(*frames))
    np.testing.assert_allclose(np.stack(streamed()), images, rtol=2e-4, atol=2e-4)


@pytest.mark.slow
def test_jit_equals_eager():
    frame = clip()[0]
    with jax.disable_jit():
        _, image = step(method_of("default"))(state_of("default"), method_of("default").init(frame), frame)
    np.testing.assert_allclose(image, streamed()[0], rtol=1e-3, atol=1e-4)


def test_an_extrapolated_frame_never_sees_its_colour():
    frames = clip()
    frames[1] = frames[1]._replace(color_linear=jnp.full_like(frames[1].color_linear, jnp.nan))
    for image, expected in zip(stream("default", frames), streamed(), strict=True):
        np.testing.assert_array_equal(image, expected)


def test_it_extrapolates_by_guided_reprojection_of_its_output():
    frames = clip()
    last = guided.keep(jnp.asarray(streamed()[0]), frames[0])
    state = accumulation.State(last, jnp.ones((*SIZE[::-1], 1)))
    _, expected = guided.extrapolate(guided.Options(), state, frames[1])
    np.testing.assert_allclose(streamed()[1], expected, rtol=1e-4, atol=1e-5)


def test_it_extrapolates_by_plain_warping_without_guides():
    frames = clip()[:2]
    first, second = stream("add depth", frames)
    np.testing.assert_allclose(second, backward_warp(first, frames[1].hr.motion_px), rtol=1e-4, atol=1e-5)


def test_a_reset_drops_the_history():
    frames = clip()
    broken = frames[0]._replace(color_linear=jnp.full_like(frames[0].color_linear, jnp.nan))
    after = frames[2]._replace(reset=jnp.asarray(True))
    np.testing.assert_array_equal(stream("default", [broken, frames[1], after])[2], streamed()[2])


def test_rendered_frames_need_no_history():
    np.testing.assert_array_equal(stream("default", clip()[2:])[0], streamed()[2])


def test_full_size_frames_pass_unchanged():
    frame, truth = frame_at(0, scale=1, jitter=(0.0, 0.0))
    method = method_of("default")
    _, image = jax.jit(step(method))(state_of("default"), method.init(frame), frame)
    np.testing.assert_array_equal(image, frame.color_linear)
    np.testing.assert_allclose(image, truth, rtol=1e-6)


def test_the_smallest_frame():
    frame, _ = frame_at(0, (2, 2))
    _, image = step_of("default")(state_of("default"), method_of("default").init(frame), frame)
    assert image.shape == (2, 2, 3)
    assert np.isfinite(image).all()


@pytest.mark.parametrize(("size", "scale"), [((6, 2), 2), ((9, 3), 3), ((28, 20), 4), ((8, 24), 8)])
def test_any_size_and_scale(size, scale):
    frame, _ = frame_at(0, size, scale)
    method = method_of("default")
    _, image = jax.eval_shape(step(method), state_of("default"), method.init(frame), frame)
    assert image.shape == (*size[::-1], 3)


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_see_only_what_they_need(name):
    """Buffers that are not asked for are not there."""
    method, frame = method_of(name), frame_at(0)[0]
    for place in ("lr", "hr"):
        gbuffer = getattr(frame, place)
        absent = {field: None for k, field in FIELDS.items() if f"{place}.{k}" not in method.needs.of(True)}
        frame = frame._replace(**{place: gbuffer._replace(**absent)})
    _, image = jax.eval_shape(step(method), state_of(name), method.init(frame), frame)
    assert image.shape == (*SIZE[::-1], 3)
    assert image.dtype == jnp.float32
    assert {"lr.color", "hr.motion"} <= method.needs.of(True)


@pytest.mark.parametrize("name", ["unet", "concat display"])
def test_variants_run(name):
    image = stream(name, clip()[:1])[0]
    assert np.isfinite(image).all()
    assert (image >= 0).all()
    assert image.std() > 0


@pytest.mark.parametrize("name", VARIANTS)
def test_settings_in_json_build_the_same_method(name):
    method = method_of(name)
    again = build("fusion-sr", json.loads(json.dumps(dict(method.network.settings))))
    assert again.network.settings == method.network.settings
    assert again.needs.of(True) == method.needs.of(True)
    assert from_json(Options, again.network.settings) == Options(**VARIANTS[name])
    shapes = [
        jax.tree.map(jnp.shape, nnx.state(nnx.eval_shape(lambda m=m: m.network.new(nnx.Rngs(0)))))
        for m in (method, again)
    ]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize(("architecture", "count"), [("fusion", 418_619), ("unet", 506_907)])
def test_the_paper_s_form_has_the_paper_s_size(architecture, count):
    method = variant("fusion-sr", PAPER | {"architecture": architecture})
    net = nnx.eval_shape(lambda: method.network.new(nnx.Rngs(0)))
    assert sum(p.size for p in jax.tree.leaves(nnx.state(net, nnx.Param))) == count
    assert method.needs.of(True) == {"lr.color", "hr.motion"} | {f"hr.{k}" for k in fusion_sr.BUFFERS}


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"buffers": ["depth", "estimate"]}, "unknown buffer 'estimate'"),
        ({"buffers": []}, "buffers"),
        ({"buffers": ["depth", "depth"]}, "buffers"),
        (
            {"base": "hdr"},
            r"base: bad base; expected none \| guided; found hdr",
        ),
        ({"demodulated": "lighting"}, "demodulated: bad demodulated; expected true or false; found lighting"),
        ({"depth_octaves": 0.0}, "depth_octaves: bad depth_octaves; expected a number above 0"),
        ({"eps": 0.0}, "eps: bad eps; expected a number above 0; found 0"),
        ({"fusion": "product"}, "fusion"),
        ({"architecture": "gan"}, "architecture"),
        ({"down_kernel": 4}, "down_kernel"),
        ({"dtype": "float16"}, "dtype"),
        ({"buffers": 5}, "buffers: bad buffers; expected a list of names; found 5"),
        ({"buffers": [1, 2]}, "buffers"),
        ({"unjitter": "no"}, "unjitter: bad unjitter; expected true or false; found no"),
        ({"perceptual_crop": "x"}, "perceptual_crop"),
        ({"perceptual_crop": 15}, "perceptual_crop: bad perceptual_crop; expected at least 16, which LPIPS"),
        ({"l1_weight": None}, "l1_weight"),
        ({"perceptual_weight": -1.0}, "perceptual_weight"),
        ({"perceptual_weight": float("nan")}, "perceptual_weight"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    options, loss = Options(), ImageLoss()
    for name, value in arguments.items():  # not through the constructors: tests alone check types there
        value = tuple(value) if isinstance(value, list) else value
        object.__setattr__(options if hasattr(options, name) else loss, name, value)
    with pytest.raises(JaxsrError, match=match):
        fusion_sr.method(options, loss)


def test_settings_of_another_version_are_named():
    settings = dict(METHODS["fusion-sr"].network.settings)
    with pytest.raises(JaxsrError, match=r"a\.b: no setting 'colour' is known; expected architecture"):
        build("fusion-sr", settings | {"colour": "display"}, "a.b")
    del settings["eps"]
    with pytest.raises(JaxsrError, match=r"a\.b: the setting 'eps' is missing; expected architecture"):
        build("fusion-sr", settings, "a.b")
    settings = settings | {"eps": 0.02, "estimate": {"sigma_guide": 0.3}}
    with pytest.raises(JaxsrError, match=r"a\.b: the setting 'kernel_sigma' is missing"):
        build("fusion-sr", settings, "a.b")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radius": 4096}, "36864 and 268500996"),
        ({"strides": [4096]}, "4096 and 9"),
        ({"eps": 0.0}, "found 0"),
    ],
)
def test_settings_that_make_no_sense_name_the_file(change, words):
    settings = json.loads(json.dumps(dict(METHODS["fusion-sr"].network.settings)))
    settings["reprojection"] |= change
    with pytest.raises(JaxsrError, match=rf"^a\.b: .*{words}"):
        build("fusion-sr", settings, "a.b")


def test_it_is_among_the_methods():
    assert METHODS["fusion-sr"].network.settings == method_of("default").network.settings
    assert METHODS["fusion-sr"].network.windows.length == 1


def test_untrained_it_is_the_guided_upsampling(monkeypatch):
    draw = np.random.default_rng(0)

    def numpy_init(key, shape, dtype=jnp.float32, **_):
        return jnp.asarray(draw.normal(0, 0.1, shape), dtype)

    monkeypatch.setattr(layers, "XAVIER", numpy_init)  # JAX's own compiles for every shape
    net = nnx.state(method_of("default").network.new(nnx.Rngs(0)))
    for t in range(2):
        frame = frame_at(t)[0]._replace(exposure=jnp.asarray(1.5))
        _, image = step_of("default")(net, method_of("default").init(frame), frame)
        color = guided_taau.estimate(frame, guided_taau.Upsampling()).color
        estimate = accumulation.from_working(color, frame.exposure)
        expected = guided.color_of(estimate, frame.hr, 0.02)
        np.testing.assert_allclose(image, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["default", "concat display"])
def test_training_and_inference_make_the_same_picture(name):
    """One batch of frames as training sees them, and each by itself as the step does."""
    frames = [clip()[0], clip()[2]._replace(exposure=jnp.asarray(0.4))]
    options = Options(**VARIANTS[name])
    run = jax.jit(lambda net, frames: displayed(nnx.merge(graph, net), frames, options))
    graph, net = nnx.split(model_of(name))
    shown, linear = run(net, batched(*frames))
    for i, frame in enumerate(frames):
        _, image = step_of(name)(state_of(name), method_of(name).init(frame), frame)
        tolerance = 0.02 if options.dtype == "bfloat16" else 1e-4
        np.testing.assert_allclose(linear[i], image, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(
            jnp.clip(shown[i], 0, 1), to_display(image, frame.exposure), atol=max(tolerance, 2e-4)
        )


# The loss.


def window(*frames_and_truths):
    frames, truths = zip(*frames_and_truths, strict=True)
    return Window(jax.tree.map(lambda x: x[:, None], batched(*frames)), jnp.stack(truths)[:, None])


@functools.cache
def training(name):
    """Parameters, the rest, and one compiled update."""
    options = Options(**VARIANTS[name])
    method = fusion_sr.method(options, ImageLoss(perceptual_weight=0.0, l1_weight=1.0))
    net = drawn(lambda rngs: method.network.new(rngs))
    last = net.decoder1.convs.conv2
    if options.base == "guided":
        last.kernel[...], last.bias[...] = 0.1 * last.kernel[...], jnp.full_like(last.bias[...], 0.5)
    graph, params, rest = nnx.split(net, nnx.Param, ...)
    optimizer = optax.adam(2e-3)

    @jax.jit
    def update(params, rest, opt, window):
        def loss(params):
            net = nnx.merge(graph, params, rest, copy=True)
            total, parts = method.network.loss(net, window)
            return total, (parts, nnx.state(net, nnx.Param, ...)[1])

        (total, (parts, new)), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(gradient, opt)
        return optax.apply_updates(params, updates), new, opt, (total, parts, gradient)

    return params, rest, optimizer.init(params), update


@pytest.mark.slow
def test_residuals_may_begin_at_zero():
    def scales(**options):
        net = fusion_sr.method(fusion_sr.Options(**options)).network.new(nnx.Rngs(0))
        return [float(jnp.max(jnp.abs(fusion.norm2.scale[...]))) for fusion in net.fusions]

    assert scales() == [1, 1, 1]
    assert scales(residual="zero") == [0, 0, 0]
    fusion_sr.method(fusion_sr.Options(residual="zero", fusion="concat")).network.new(nnx.Rngs(0))  # has none


@pytest.mark.slow
def test_the_loss_falls_on_one_window():
    params, rest, opt, update = training("default")
    seen = window(frame_at(0), frame_at(2))
    totals = []
    for _ in range(30):
        params, rest, opt, (total, parts, _) = update(params, rest, opt, seen)
        totals.append(float(total))
    assert float(total) == pytest.approx(float(parts["ssim"] + parts["l1"]), rel=1e-5)
    assert min(totals[-5:]) < 0.85 * totals[0]


def hard_frames():
    """Pictures that are all sky, black, or far too bright."""
    frame, truth = frame_at(0)

    def sky(gbuffer):
        nothing = {k: jnp.zeros_like(getattr(gbuffer, k)) for k in ("normal", "base_color", "roughness")}
        return gbuffer._replace(depth_linear=jnp.full_like(gbuffer.depth_linear, jnp.inf), **nothing)

    return {
        "sky": (frame._replace(lr=sky(frame.lr), hr=sky(frame.hr)), truth),
        "black": (frame._replace(color_linear=0 * frame.color_linear), 0 * truth),
        "bright": (frame._replace(color_linear=1e6 * frame.color_linear), 1e6 * truth),
        "negative": (frame._replace(color_linear=frame.color_linear - 1), truth),
    }


@pytest.mark.parametrize("kind", ["sky", "black", "bright", "negative"])
def test_loss_and_gradients_are_finite(kind):
    params, rest, opt, update = training("default")
    _, new, _, (total, _, gradient) = update(params, rest, opt, window(frame_at(1), hard_frames()[kind]))
    assert np.isfinite(total)
    for path, leaf in jax.tree_util.tree_leaves_with_path((gradient, new)):
        assert np.isfinite(leaf).all(), path
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("kind", ["sky", "black", "bright"])
def test_hard_frames_give_finite_pictures(kind):
    frame, _ = hard_frames()[kind]
    _, image = step_of("default")(state_of("default"), method_of("default").init(frame), frame)
    assert np.isfinite(image).all()
    assert (np.asarray(image) >= 0).all()


def test_the_loss_is_its_parts_on_displayed_colour(monkeypatch):
    """The last frame of the window, exposed; LPIPS of the middle alone, with its weight."""
    seen = []

    def fake(pred, target):
        seen.append((pred, target))
        return jnp.mean(jnp.abs(pred - target))

    monkeypatch.setattr("jaxsr.methods.image_loss.lpips", fake)
    method = fusion_sr.method(
        Options(base="none", demodulated=False), ImageLoss(perceptual_crop=16, l1_weight=0.5)
    )
    (frame, truth), (other, wrong) = frame_at(0), frame_at(1)
    frame = frame._replace(exposure=jnp.asarray(0.5))
    frames = jax.tree.map(lambda a, b: jnp.stack([a, b])[None], other, frame)

    class Nearest(nnx.Module):
        def __call__(self, color, gbuffer, offset):
            return upsample(color, 2, "nearest")

    net = Nearest()
    total, parts = method.network.loss(net, Window(frames, jnp.stack([wrong, truth])[None]))
    target = to_display(truth, 0.5)
    np.testing.assert_allclose(seen[0][1][0], target[:, 4:20], atol=1e-6)
    assert seen[0][0].shape == (1, 16, 16, 3)
    made = upsample(to_display(frame.color_linear, 0.5), 2, "nearest")
    assert float(parts["l1"]) == pytest.approx(float(jnp.mean(jnp.abs(made - target))), rel=1e-4)
    expected = parts["ssim"] + 0.5 * parts["l1"] + 0.2 * parts["lpips"]
    assert float(total) == pytest.approx(float(expected), rel=1e-6)


def test_the_middle():
    image = jnp.arange(2 * 5 * 8 * 1.0).reshape(2, 5, 8, 1)
    np.testing.assert_array_equal(middle(image, 4), image[:, 0:4, 2:6])
    np.testing.assert_array_equal(middle(image, 6), image[:, :, 1:7])
    np.testing.assert_array_equal(middle(image, 99), image)
