"""NSRR: its network against loops, its history against windows of frames, its step, its training.

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
from jaxsr.frames import Window
from jaxsr.methods import METHODS, build, nsrr, variant
from jaxsr.methods.base import step
from jaxsr.methods.image_loss import ImageLoss
from jaxsr.methods.nsrr import Options
from jaxsr.nets import NSRR
from jaxsr.nets.nsrr import CHANNELS
from jaxsr.ops import backward_warp, compose_motion, to_display, warp_zero_upsampled, world_position
from jaxsr.ops.encoding import normalized_depth
from jaxsr.runtime.load import find_method
from tests.builders import make_sequence
from tests.networks import drawn
from tests.reference import nsrr as reference
from tests.reference import resampling, warping
from tests.test_cli import error_line, run

SIZE = (24, 16)

VARIANTS = {"default": {}, "two": {"previous": 2}, "half": {"previous": 1, "dtype": "bfloat16"}}


# The network.


@functools.cache
def network(previous=4, seed=0, dtype=jnp.float32):
    return drawn(functools.partial(NSRR, previous=previous, dtype=dtype), seed)


@functools.cache
def compiled(previous=4, seed=0, dtype=jnp.float32):
    """`reconstruct`, compiled, and the state of the network."""
    graph, state = nnx.split(network(previous, seed, dtype))
    return jax.jit(lambda state, *maps: nnx.merge(graph, state).reconstruct(*maps)), state


def maps(seed=0, size=(8, 8), previous=4, batch=1):
    rng = np.random.default_rng(seed)
    frames = rng.random((batch, 1 + previous, *size, CHANNELS), np.float32)
    return jnp.asarray(frames[:, 0]), jnp.asarray(frames[:, 1:])


def test_parameter_counts():
    def count(previous):
        net = nnx.eval_shape(lambda: NSRR(previous=previous, rngs=nnx.Rngs(0)))
        return sum(p.size for p in jax.tree.leaves(nnx.state(net, nnx.Param)))

    # Features, twice: 9 (4 32 + 32 32 + 32 8) + 32 + 32 + 8 = 12,744.
    # Reweighting: 9 (20 32 + 32 32 + 32 4) + 32 + 32 + 4 = 16,196.
    # Reconstruction: 9 (60 64 + 64 32 + 32 64 + 64 64 + 64 128 + 128 128 + 192 64 + 64 64 + 96 32 + 32 3)
    #     + 64 + 32 + 64 + 64 + 128 + 128 + 64 + 64 + 32 + 3 = 506,083.
    assert count(4) == 2 * 12_744 + 16_196 + 506_083 == 547_767
    # A frame less: 4 inputs and one output of the reweighting, 12 inputs of the reconstruction.
    assert count(3) == 547_767 - 9 * 4 * 32 - (9 * 32 + 1) - 9 * 12 * 64


def test_the_network_is_the_loops():
    """RGB-D of three frames, motion and jitter, to the colour of the last; a size that is padded."""
    rng, scale, (h, w) = np.random.default_rng(1), 2, (3, 2)
    rgbd = rng.random((3, h, w, 4), np.float32)  # the newest first
    offsets = [(0, 1), (1, 1), (1, 0)]
    motion = (rng.integers(-12, 13, (2, h * scale, w * scale, 2)) / 8).astype(np.float32)
    net = network(2, 1)
    weights = {
        ".".join(map(str, path)): np.asarray(v.get_value(), np.float64)
        for path, v in nnx.to_flat_state(nnx.state(net))
    }
    paths = [motion[0], warping.compose_motion(motion[0], motion[1])]
    current = resampling.zero_upsample(reference.features(rgbd[0], weights, "features"), scale, offsets[0])
    previous = [
        warping.warp_zero_upsampled(
            reference.features(rgbd[k], weights, "previous_features"), paths[k - 1], scale, offsets[k]
        )
        for k in (1, 2)
    ]
    expected = reference.reconstruct(current, previous, weights)

    @jax.jit
    def made(rgbd, motion):
        before = compose_motion(motion[0], nsrr.with_own_path(motion[1]))
        places = jnp.array(offsets, jnp.int32)
        steps = jnp.moveaxis(before.reshape(*before.shape[:2], 2, 2), 2, 0)
        from_before = warp_zero_upsampled(net.previous_features(rgbd[1:]), steps, scale, places[1:])
        return net.reconstruct(
            nsrr.zero_upsample(net.features(rgbd[:1]), scale, places[:1]), from_before[None]
        )[0]

    found = made(rgbd, motion)
    assert found.shape == (h * scale, w * scale, 3)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert expected.std() > 0.05


@pytest.mark.parametrize("size", [(1, 1), (6, 10), (9, 3), (12, 20), (5, 8)])
def test_any_size(size):
    graph, state = nnx.split(network())
    call = lambda state, *maps: nnx.merge(graph, state).reconstruct(*maps)  # noqa: E731
    out = jax.eval_shape(call, state, *maps(size=size, batch=2))
    assert out.shape == (2, *size, 3)
    assert out.dtype == jnp.float32


def test_padding_is_no_samples():
    run, state = compiled()
    current, previous = maps(2, (6, 9))
    room = ((0, 0), (0, 2), (0, 3), (0, 0))
    padded = run(state, jnp.pad(current, room), jnp.pad(previous, ((0, 0), *room)))
    np.testing.assert_allclose(run(state, current, previous), padded[:, :6, :9], atol=1e-5)


@pytest.mark.slow
def test_jit_is_eager_and_batches_are_images():
    run, state = compiled(1)
    current, previous = maps(3, (6, 5), 1, batch=2)
    batch = run(state, current, previous)
    with jax.disable_jit():
        single = network(1).reconstruct(current[:1], previous[:1])
    np.testing.assert_allclose(batch[:1], single, atol=1e-5)
    assert np.asarray(batch).std() > 1e-2


def test_weights_of_previous_frames_go_from_nothing_to_ten():
    run, state = compiled()
    current, previous = maps(4)

    def made(bias, previous):
        flat = dict(nnx.to_flat_state(state))
        for part, value in (("kernel", 0.0), ("bias", bias)):
            old = flat["weights", part]
            flat["weights", part] = old.replace(jnp.full_like(old.get_value(), value))
        return np.asarray(run(nnx.from_flat_state(flat), current, previous))

    np.testing.assert_allclose(made(50.0, previous), made(0.0, 2 * previous), atol=1e-4)  # 10 is twice 5
    np.testing.assert_allclose(made(-50.0, previous), made(0.0, 0 * previous), atol=1e-4)
    assert np.abs(made(50.0, previous) - made(-50.0, previous)).max() > 0.1


def test_each_previous_frame_has_weights_of_its_own():
    run, state = compiled()
    current, previous = maps(5)
    swapped = previous.at[:, 0].set(previous[:, 1]).at[:, 1].set(previous[:, 0])
    assert np.abs(run(state, current, previous) - run(state, current, swapped)).max() > 1e-2


def test_gradients_reach_everything():
    graph, params = nnx.split(network(2))
    rgbd = jnp.asarray(np.random.default_rng(6).random((3, 4, 4, 4), np.float32))

    @jax.jit
    def gradient(params, rgbd):
        def loss(params, rgbd):
            net = nnx.merge(graph, params)
            return jnp.mean(
                jnp.square(net.reconstruct(net.features(rgbd[:1]), net.previous_features(rgbd[1:])[None]))
            )

        return jax.grad(loss, (0, 1))(params, rgbd)

    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient(params, rgbd.at[1].set(0))):
        assert np.all(np.isfinite(leaf)), path
        assert np.any(leaf != 0), path


def test_bfloat16_computes_close_by():
    current, previous = maps(7)
    (run, state), (run_half, half) = compiled(), compiled(dtype=jnp.bfloat16)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(half))
    exact, close = run(state, current, previous), run_half(half, current, previous)
    assert close.dtype == jnp.float32
    assert 0 < np.abs(np.asarray(close - exact)).max() / np.abs(exact).max() < 0.03


def test_maps_that_do_not_fit_are_named():
    net = network()
    current, previous = maps()
    for bad in ((current, previous[:, 1:]), (current[..., 1:], previous[..., 1:])):
        with pytest.raises(JaxsrError, match=r"previous: maps of the frames do not fit together; expected"):
            net.reconstruct(*bad)
    with pytest.raises(JaxsrError, match="previous: bad previous"):
        NSRR(previous=0, rngs=nnx.Rngs(0))


# The history.


@functools.cache
def method_of(name):
    return variant("nsrr", VARIANTS[name])


@functools.cache
def state_of(name, seed=0):
    return nnx.state(drawn(lambda rngs: method_of(name).network.new(rngs), seed))


@functools.cache
def step_of(name):
    return jax.jit(step(method_of(name)))


def model_of(name):
    graph = nnx.graphdef(nnx.eval_shape(lambda: method_of(name).network.new(nnx.Rngs(0))))
    return nnx.merge(graph, state_of(name))


@functools.cache
def frame_at(t, size=SIZE, scale=2, rendered=True):
    jitter = tuple(float((a * (t + 1)) % 1 - 0.5) for a in (0.37, 0.71))
    frame, truth = analytic.frame(t, size, scale, jitter, rendered=rendered)
    first, exposure = jnp.asarray(t == 0), jnp.asarray(1 + 0.1 * t, jnp.float32)
    return jax.tree.map(jnp.asarray, frame)._replace(reset=first, exposure=exposure), jnp.asarray(truth)


def clip(count=5, unrendered=(), **options):
    return [frame_at(t, rendered=t not in unrendered, **options)[0] for t in range(count)]


def stream(name, frames):
    """States and images of the compiled step, one after the other."""
    state, made = method_of(name).init(frames[0]), []
    for frame in frames:
        state, image = step_of(name)(state_of(name), state, frame)
        made.append((state, np.asarray(image)))
    return made


@functools.cache
def streamed():
    return stream("default", clip())


def batched(*frames):
    return jax.tree.map(lambda *xs: jnp.stack(xs), *frames)


def test_a_window_is_what_streaming_has_seen():
    """Jitter, motion and exposure change from frame to frame; the last frame is the same to 1e-5."""
    frames = clip()
    now = jax.tree.map(lambda x: x[None], frames[-1])
    graph, net = nnx.split(model_of("default"))

    @jax.jit
    def seen(net, window, now):
        model = nnx.merge(graph, net)
        history = nsrr.previous_of(model, window)
        return history, nsrr.displayed(model, now, history)

    history, shown = seen(net, jax.tree.map(lambda x: x[None], batched(*frames)), now)
    before = streamed()[3][0].previous
    np.testing.assert_allclose(history.features[0], before.features, atol=1e-5)
    np.testing.assert_array_equal(history.offset[0], before.offset)
    paths = compose_motion(frames[-1].hr.motion_px, before.motion_px)
    np.testing.assert_allclose(history.motion_px[0], paths, atol=1e-5)
    image = to_display(streamed()[4][1], frames[-1].exposure)
    np.testing.assert_allclose(jnp.clip(shown[0], 0, 1), image, atol=1e-5)
    assert np.asarray(image).std() > 0.05
    assert len({tuple(o) for o in np.asarray(history.offset[0])}) > 1
    assert np.abs(paths).max() > 1


def test_the_history_lies_where_the_scene_does():
    """Samples of what does not move, found four frames later where they belong, at jittered places."""
    size, scale, frames = (96, 64), 4, []
    for t in range(5):
        # Jitter that puts samples on HR pixels exactly.
        frames.append(analytic.frame(t, size, scale, ((t % 4 - 1.5) / 4, (1.5 - 3 * t % 4) / 4))[0])
        frames[-1] = jax.tree.map(jnp.asarray, frames[-1])
    path = jnp.zeros((64, 96, 0))
    for frame in frames[1:]:
        path = compose_motion(frame.hr.motion_px, nsrr.with_own_path(path))
    ids, now = np.asarray(frames[4].hr.object_id), frames[4].hr
    pixel, positions = 2 * 0.62 / size[0], world_position(now.depth_linear, frames[4].camera)
    for k in range(1, 5):
        past = frames[4 - k]
        ones = jnp.ones_like(past.lr.depth_linear)
        points = world_position(past.lr.depth_linear, past.camera, past.jitter_px)
        samples = jnp.concatenate([points, past.lr.object_id, ones], -1)
        offset = nsrr.sample_offset(past.jitter_px, scale)
        found = warp_zero_upsampled(samples, path[..., 2 * k - 2 : 2 * k], scale, offset)
        weight = np.asarray(found[..., -1:])
        there = np.asarray(found / jnp.maximum(found[..., -1:], 1e-6))
        # A sample that counts at least half is within a pixel; the floor is seen at a slant.
        same = (weight > 0.5) & (ids == np.round(there[..., 3:4])) & np.isin(ids, (2, 4))
        assert same.sum() > 30
        off = np.linalg.norm(there[..., :3] - positions, axis=-1, keepdims=True)
        assert np.quantile((off / now.depth_linear)[same], 0.9) < 1.5 * pixel
        # As many samples as there were, but for the border: one in 16 pixels.
        assert 0.7 < weight.sum() * 16 / weight.size < 1.2


def test_frames_that_were_not_rendered_are_passed_through():
    """Without frames 1 and 2, whose motion is added to that of frame 3, the history is the same."""
    frames = clip(5, unrendered=(1, 2))
    with_them = stream("default", frames)
    motion = [frame.hr.motion_px for frame in frames]
    added = compose_motion(motion[3], compose_motion(motion[2], motion[1]))
    frames[3] = frames[3]._replace(hr=frames[3].hr._replace(motion_px=added))
    without = stream("default", [frames[0], *frames[3:]])
    for k in (1, 2):
        (state, image), (expected_state, expected) = with_them[2 + k], without[k]
        np.testing.assert_allclose(image, expected, atol=1e-5)
        kept = slice(2 + 2 * k)  # beyond, paths lead to frames that are not there
        for a, b in zip(state.previous[:2], expected_state.previous[:2], strict=True):
            np.testing.assert_array_equal(a, b)
        paths, expected_paths = (s.previous.motion_px[..., kept] for s in (state, expected_state))
        np.testing.assert_allclose(paths, expected_paths, atol=1e-5)
    assert np.abs(with_them[3][1] - streamed()[3][1]).max() > 1e-2


def test_it_extrapolates_by_warping_its_last_output():
    frames = clip(3, unrendered=(1, 2))
    made = stream("default", frames)
    for t in (1, 2):
        expected = backward_warp(made[t - 1][1], frames[t].hr.motion_px)
        np.testing.assert_allclose(made[t][1], expected, atol=1e-5)


def test_an_extrapolated_frame_never_sees_its_colour():
    frames = clip(3, unrendered=(1,))
    hidden = frames[1]._replace(color_linear=jnp.full_like(frames[1].color_linear, jnp.nan))
    pairs = zip(stream("default", frames), stream("default", [frames[0], hidden, frames[2]]), strict=True)
    for (_, image), (_, expected) in pairs:
        np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("name", VARIANTS)
def test_the_state_keeps_its_size(name):
    state = method_of(name).init(frame_at(0)[0])
    shapes = jax.tree.map(lambda x: (x.shape, x.dtype), state)
    n = method_of(name).network.windows.length - 1
    assert state.previous.features.shape == (n, 8, 12, CHANNELS)
    for rendered in (True, False):
        frame, _ = frame_at(1, rendered=rendered)
        after, _ = jax.eval_shape(step(method_of(name)), state_of(name), state, frame)
        assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == shapes


def test_after_a_reset_nothing_is_remembered():
    frames = clip()
    broken = frames[0]._replace(color_linear=jnp.full_like(frames[0].color_linear, jnp.nan))
    again = [frame._replace(reset=jnp.asarray(t == 0)) for t, frame in enumerate(frames[2:])]
    alone, after = stream("default", again), stream("default", [broken, frames[1], *again])[2:]
    for (state, image), (other, expected) in zip(after, alone, strict=True):
        np.testing.assert_array_equal(image, expected)
        jax.tree.map(np.testing.assert_array_equal, state, other)
    assert not np.any(alone[0][0].previous.features[1:])
    assert np.abs(alone[0][1] - streamed()[2][1]).max() > 1e-2


def test_a_broken_pixel_is_forgotten():
    """A NaN sample is in the history for four frames, and not for ever."""
    frames = clip(6)
    frames[0] = frames[0]._replace(color_linear=frames[0].color_linear.at[4, 6].set(jnp.nan))
    made = [image for _, image in stream("default", frames)]
    assert np.isnan(made[0]).any()
    assert np.isfinite(made[5]).all()


# The step.


def test_the_input():
    frame, _ = frame_at(1)
    found = nsrr.rgbd_input(frame)
    np.testing.assert_array_equal(found[..., :3], to_display(frame.color_linear, frame.exposure))
    np.testing.assert_array_equal(found[..., 3:], normalized_depth(frame.lr.depth_linear))


def test_streaming_equals_scan():
    frames = clip(4, unrendered=(2,))
    run = jax.jit(lambda net, s, fs: jax.lax.scan(functools.partial(step(method_of("default")), net), s, fs))
    _, images = run(state_of("default"), method_of("default").init(frames[0]), batched(*frames))
    made = np.stack([image for _, image in stream("default", frames)])
    np.testing.assert_allclose(made, images, rtol=2e-4, atol=2e-4)


@pytest.mark.slow
def test_jit_equals_eager():
    frames = clip(2)
    with jax.disable_jit():
        _, image = step(method_of("default"))(state_of("default"), streamed()[0][0], frames[1])
    np.testing.assert_allclose(image, streamed()[1][1], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("size", "scale"), [((2, 2), 2), ((9, 3), 3), ((28, 20), 4), ((8, 24), 8)])
def test_any_size_and_scale(size, scale):
    frame, _ = frame_at(0, size, scale)
    method = method_of("default")
    _, image = jax.eval_shape(step(method), state_of("default"), method.init(frame), frame)
    assert image.shape == (*size[::-1], 3)
    assert image.dtype == jnp.float32


@pytest.mark.parametrize(("size", "scale"), [((2, 2), 2), ((15, 9), 3)])
def test_odd_frames_run(size, scale):
    compiled_step = jax.jit(step(method_of("two")))
    state = method_of("two").init(frame_at(0, size, scale)[0])
    for t in range(2):
        state, image = compiled_step(state_of("two"), state, frame_at(t, size, scale)[0])
        assert np.isfinite(image).all()
        assert (np.asarray(image) >= 0).all()


def test_half_precision_runs():
    for _, image in stream("half", clip(2)):
        assert np.isfinite(image).all()
        assert image.std() > 0


def test_full_size_frames_pass_unchanged():
    method = method_of("default")
    frames = [frame_at(t, scale=1, rendered=t == 0)[0] for t in range(2)]
    state = method.init(frames[0])
    assert state.previous.features.size == state.previous.motion_px.size == 0
    compiled_step = jax.jit(step(method))
    state, image = compiled_step(state_of("default"), state, frames[0])
    np.testing.assert_array_equal(image, frames[0].color_linear)
    _, image = compiled_step(state_of("default"), state, frames[1])
    np.testing.assert_allclose(
        image, backward_warp(frames[0].color_linear, frames[1].hr.motion_px), atol=1e-5
    )


@pytest.mark.parametrize("name", VARIANTS)
def test_it_sees_only_what_it_needs(name):
    method, frame = method_of(name), frame_at(0)[0]
    assert method.needs.of(True) == {"lr.color", "lr.depth", "hr.motion"}
    names = ("normal", "base_color", "roughness", "metallic", "object_id")
    bare = {place: getattr(frame, place)._replace(**dict.fromkeys(names)) for place in ("lr", "hr")}
    frame = frame._replace(**bare)
    _, image = jax.eval_shape(step(method), state_of(name), method.init(frame), frame)
    assert image.shape == (*SIZE[::-1], 3)


@pytest.mark.parametrize("name", VARIANTS)
def test_settings_in_json_build_the_same_method(name):
    method = method_of(name)
    again = build("nsrr", json.loads(json.dumps(dict(method.network.settings))))
    assert again.network.settings == method.network.settings
    assert (
        again.network.windows.length
        == method.network.windows.length
        == Options(**VARIANTS[name]).previous + 1
    )


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"previous": 0}, "previous: bad previous; expected a whole number from 1; found 0"),
        ({"previous": 1.5}, "previous: bad previous; expected a whole number from 0 to 4096; found 1.5"),
        ({"dtype": "float16"}, "dtype"),
        ({"depth_octaves": 0.0}, "depth_octaves: bad depth_octaves; expected a number above 0"),
        ({"perceptual_weight": -1.0}, "perceptual_weight"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    options, loss = Options(), ImageLoss()
    for name, value in arguments.items():  # not through the constructors: tests alone check types there
        object.__setattr__(options if hasattr(options, name) else loss, name, value)
    with pytest.raises(JaxsrError, match=match):
        nsrr.method(options, loss)


def test_it_is_among_the_methods(tmp_path, monkeypatch):
    assert METHODS["nsrr"].network.windows.length == 5
    monkeypatch.setattr("jaxsr.runtime.load.weights_folder", lambda: tmp_path)
    with pytest.raises(JaxsrError, match=r"no weights of 'nsrr' for scale 4; found no weights of it"):
        find_method("nsrr", 4)


# Training.


def window(frames, truths):
    return jax.tree.map(lambda x: x[None], Window(batched(*frames), jnp.stack(truths)))


@functools.cache
def training():
    """Parameters, and one compiled update; with two previous frames."""
    loss = ImageLoss(perceptual_weight=0.0, l1_weight=1.0)
    method = nsrr.method(Options(**VARIANTS["two"]), loss)
    graph, params = nnx.split(drawn(lambda rngs: method.network.new(rngs)))
    optimizer = optax.adam(2e-3)

    @jax.jit
    def update(params, opt, window):
        def loss(params):
            return method.network.loss(nnx.merge(graph, params, copy=True), window)

        (total, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(gradient, opt)
        return optax.apply_updates(params, updates), opt, (total, parts, gradient)

    return params, optimizer.init(params), update


@pytest.mark.slow
def test_the_loss_falls_on_one_window():
    params, opt, update = training()
    frames, truths = zip(*(frame_at(t) for t in (1, 2, 3)), strict=True)
    seen, totals = window(frames, truths), []
    for _ in range(80):
        params, opt, (total, parts, _) = update(params, opt, seen)
        totals.append(float(total))
    assert float(total) == pytest.approx(float(parts["ssim"] + parts["l1"]), rel=1e-5)
    assert min(totals[-5:]) < 0.4 * totals[0]


def test_the_loss_is_of_the_last_frame():
    params, opt, update = training()
    frames, truths = zip(*(frame_at(t) for t in (1, 2, 3)), strict=True)
    _, _, (total, _, _) = update(params, opt, window(frames, truths))
    wrong = [0 * truths[0], 0 * truths[1], truths[2]]
    np.testing.assert_array_equal(update(params, opt, window(frames, wrong))[2][0], total)
    assert update(params, opt, window(frames, truths[::-1]))[2][0] != total


def hard_windows():
    frames, truths = zip(*(frame_at(t) for t in (1, 2, 3)), strict=True)

    def moving(motion):
        shape = frames[0].hr.motion_px.shape
        return [
            f._replace(hr=f.hr._replace(motion_px=jnp.broadcast_to(jnp.asarray(motion, jnp.float32), shape)))
            for f in frames
        ], truths

    def sky(gbuffer):
        return gbuffer._replace(depth_linear=jnp.full_like(gbuffer.depth_linear, jnp.inf))

    flat = frames[0]._replace(color_linear=jnp.full_like(frames[0].color_linear, 0.5))
    return {
        "still and identical": ([frames[0]] * 3, [truths[0]] * 3),
        "flat": ([flat] * 3, [jnp.full_like(truths[0], 0.5)] * 3),
        "still": moving([0.0, 0.0]),
        "unknown": moving([jnp.nan, jnp.nan]),
        "infinite": moving([jnp.inf, -jnp.inf]),
        "out of view": moving([1000.0, 0.0]),
        "sky": ([f._replace(lr=sky(f.lr), hr=sky(f.hr)) for f in frames], truths),
        "black": ([f._replace(color_linear=0 * f.color_linear) for f in frames], [0 * t for t in truths]),
        "bright": ([f._replace(color_linear=1e6 * f.color_linear) for f in frames], truths),
    }


@pytest.mark.parametrize("kind", list(hard_windows()))
def test_loss_and_gradients_are_finite(kind):
    params, opt, update = training()
    _, _, (total, _, gradient) = update(params, opt, window(*hard_windows()[kind]))
    assert np.isfinite(total)
    leaves = jax.tree_util.tree_leaves_with_path(gradient)
    for path, leaf in leaves:
        assert np.isfinite(leaf).all(), path
    lost = kind in ("infinite", "out of view")
    seen = {str(path[0].key): bool(np.any(leaf)) for path, leaf in leaves}
    assert seen["features"]
    assert seen["previous_features"] != lost


@pytest.mark.slow
def test_train_upscale_evaluate(capsys, tmp_path):
    """The whole way, by the command line."""
    make_sequence(tmp_path / "data" / "clip", frames=6)
    weights = tmp_path / "out" / "weights.safetensors"
    options = ["--data", tmp_path / "data", "--out", tmp_path / "out", "--cache", tmp_path / "cache"]
    options += ["--scale", 2, "--steps", 2, "--crop", 16, "--batch", 2, "--perceptual-weight", 0]
    status, out, err = run(capsys, "train", "nsrr", *options)
    assert status == 0, err
    assert f"jaxsr upscale SEQ --method {weights}" in out
    clip = tmp_path / "data" / "clip"
    chosen = ["--scale", 2, "--every", 2]
    status, _, err = run(capsys, "upscale", clip, "--method", weights, *chosen, "--out", tmp_path / "made")
    assert status == 0, err
    assert len(list((tmp_path / "made" / "png").iterdir())) == 6
    methods = ["--methods", f"bilinear,{weights}"]
    status, _, err = run(capsys, "evaluate", clip, *methods, *chosen, "--out", tmp_path / "page")
    assert status == 0, err
    line = error_line(capsys, "train", "nsrr", *options, "--previous", 3)
    assert "previous: 4 -> 3" in line
    line = error_line(capsys, "train", "nsrr", *options[:2], "--out", tmp_path / "b", "--previous", 7)
    assert "expected at least 9 frames; found 6" in line
