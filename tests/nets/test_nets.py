"""The networks: sizes, parity with the published ones, types, modes, gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.nets import NSRR, RCAN, RRN, FusionSR, UNetSR
from jaxsr.nets.blocks import (
    XAVIER,
    LoopConv,
    ShallowFeatures,
    UpConcat,
    UpConv,
    conv,
    conv_beside,
    stacked,
    through,
)
from tests.networks import drawn

NETS = {"fusion": FusionSR, "unet": UNetSR}


@functools.cache
def _abstract(make):
    return nnx.eval_shape(lambda: make(rngs=nnx.Rngs(0)))


def _count(make):
    return sum(p.size for p in jax.tree.leaves(nnx.state(_abstract(make), nnx.Param)))


def _inputs(seed=0, batch=1, size=(3, 2), scale=4, channels=9):
    rng = np.random.default_rng(seed)
    color = rng.random((batch, *size, 3), np.float32)
    gbuffer = rng.random((batch, size[0] * scale, size[1] * scale, channels), np.float32)
    return jnp.asarray(color), jnp.asarray(gbuffer)


def _pure(net):
    """The compiled network in inference mode, and its state."""
    net.eval()
    graph, state = nnx.split(net)
    return jax.jit(lambda state, *inputs: nnx.merge(graph, state)(*inputs)), state


@pytest.mark.parametrize(
    ("make", "count"),
    [
        (FusionSR, 418_619),
        (UNetSR, 506_907),
        # Without the modules: 3 (2 n^2 + 9 n^2 + 4 n) + 2 n^2 / 16 fewer, n = 16, 32, 64.
        (functools.partial(FusionSR, fusion="concat"), 418_619 - 59_136 - 448 - 672),
        # Half the inputs of both transposed convolutions' level, and of both concatenations.
        (
            functools.partial(FusionSR, fusion="add"),
            418_619 - 59_136 - 448 - 672 - 64 * 64 * 4 - 32 * 64 * 9 - 16 * 32 * 9,
        ),
        (functools.partial(FusionSR, down_kernel=2), 418_619 - 2 * 5 * (16 * 32 + 32 * 64)),
        # 8 fewer inputs, 8 more outputs: both beside 32 channels.
        (functools.partial(FusionSR, buffers=("depth",)), 418_619 + 8),
        (functools.partial(UNetSR, buffers=("depth", "normal"), down_kernel=2), 506_907 + 5 - 5 * 10_240),
    ],
)
def test_parameter_counts(make, count):
    assert _count(make) == count


def test_the_paper_s_widths():
    net = _abstract(FusionSR)
    shapes = {".".join(map(str, k)): v.shape for k, v in nnx.to_flat_state(nnx.state(net, nnx.Param))}
    assert shapes["color_shallow.conv3.kernel"] == (3, 3, 32, 15)
    assert shapes["gbuffer_shallow.conv3.kernel"] == (3, 3, 32, 9)
    assert [shapes[f"color_encoder.{i}.conv2.kernel"][-1] for i in range(3)] == [16, 32, 64]
    assert shapes["fusions.0.se.squeeze.kernel"] == (16, 1)
    assert shapes["decoder2.up.kernel"] == (2, 2, 128, 64)
    assert shapes["decoder1.convs.conv1.kernel"] == (3, 3, 64, 32)


def test_kernels_are_xavier_uniform_and_biases_zero():
    net = UpConcat(128, 64, 64, 64, dtype=jnp.float32, rngs=nnx.Rngs(0))
    kernel = np.asarray(net.convs.conv1.kernel[...])
    bound = np.sqrt(6 / (9 * (128 + 64)))
    assert 0.98 * bound < np.abs(kernel).max() <= bound
    assert abs(kernel.std() - bound / np.sqrt(3)) < 0.01 * bound
    assert not np.any(net.up.bias[...])


@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize(("size", "scale"), [((3, 5), 4), ((3, 5), 2), ((1, 1), 2), ((2, 3), 3)])
def test_any_size_and_scale(name, size, scale):
    graph, state = nnx.split(_abstract(NETS[name]))
    inputs = *_inputs(size=size, scale=scale), jnp.zeros((1, 2), jnp.int32)
    out = jax.eval_shape(lambda state, *inputs: nnx.merge(graph, state)(*inputs), state, *inputs)
    assert out.shape == (1, size[0] * scale, size[1] * scale, 3)
    assert out.dtype == jnp.float32


@pytest.mark.parametrize(
    "make", [functools.partial(UNetSR, scale=2), functools.partial(FusionSR, scale=2, fusion="add")]
)
def test_padding_repeats_the_border(make):
    run, state = _pure(drawn(make))
    color, gbuffer = _inputs(size=(3, 4), scale=2)
    padded = [
        jnp.pad(x, ((0, 0), (0, n), (0, 0), (0, 0)), mode="edge") for x, n in ((color, 1), (gbuffer, 2))
    ]
    np.testing.assert_allclose(run(state, color, gbuffer), run(state, *padded)[:, :6], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETS)
def test_jit_is_eager_and_batches_are_images(name):
    net = drawn(functools.partial(NETS[name], down_kernel=2, buffers=("normal", "depth")), 1)
    run, state = _pure(net)
    color, gbuffer = _inputs(1, batch=2, size=(2, 3), scale=2, channels=4)
    batch = run(state, color, gbuffer)
    assert np.asarray(batch).std() > 1e-3
    with jax.disable_jit():
        single = net(color[:1], gbuffer[:1])
    np.testing.assert_allclose(batch[:1], single, atol=1e-5)


@pytest.mark.parametrize("name", NETS)
def test_offset_places_the_samples(name):
    run, state = _pure(drawn(NETS[name], 2))
    color, gbuffer = _inputs(2, batch=2)
    topleft = run(state, color, gbuffer)
    np.testing.assert_array_equal(topleft, run(state, color, gbuffer, jnp.zeros((2, 2), jnp.int32)))
    moved = run(state, color, gbuffer, jnp.array([[0, 0], [2, 1]]))
    np.testing.assert_allclose(moved[0], topleft[0], atol=1e-5)
    assert np.abs(moved[1] - topleft[1]).max() > 1e-3


def test_offset_shifts_the_output():
    # Away from the borders a shift of samples and G-buffer together is a shift of the picture. Without
    # squeeze-and-excitation, which sees the borders too, and by whole cells of the coarsest level.
    run, state = _pure(drawn(functools.partial(FusionSR, fusion="concat", scale=8), 3))
    color, gbuffer = _inputs(3, size=(8, 8), scale=8)
    color, gbuffer = color.at[:, :3].set(0.5).at[:, -3:].set(0.5), jnp.full_like(gbuffer, 0.3)
    topleft, moved = run(state, color, gbuffer), run(state, color, gbuffer, jnp.array([[0, 4]]))
    # The shallow features' own padding is at LR and does not move: compare the middle.
    np.testing.assert_allclose(moved[:, 28:44, 24:40], topleft[:, 24:40, 24:40], atol=1e-5)


def test_batch_norm_trains_by_batch_and_infers_by_its_running_mean():
    net = drawn(FusionSR)
    norm = net.fusions[0].norm1
    assert (norm.momentum, norm.epsilon) == (0.9, 1e-5)
    color, gbuffer = _inputs(4, batch=2)
    graph, state = nnx.split(net)

    @jax.jit
    def train(state):
        net = nnx.merge(graph, state)
        net.train()
        return net(color, gbuffer), nnx.state(net)

    first, after = train(state)
    mean, var = (np.asarray(after["fusions"][0]["norm1"][k][...]) for k in ("mean", "var"))
    assert np.abs(mean).max() > 0  # a tenth of the batch's on zero
    assert np.all(var > 0.9)
    assert np.all(var < 0.9 + 0.1 * 10)
    for leaf in ("scale", "bias"):
        np.testing.assert_array_equal(
            after["fusions"][0]["norm1"][leaf][...], state["fusions"][0]["norm1"][leaf][...]
        )
    run, _ = _pure(nnx.merge(graph, state))
    inferred = run(state, color, gbuffer)
    assert np.abs(inferred - first).max() > 1e-3
    np.testing.assert_array_equal(inferred, run(state, color, gbuffer))  # and nothing has moved
    # Inference does not depend on the rest of the batch.
    np.testing.assert_allclose(run(state, color[:1], gbuffer[:1])[0], inferred[0], atol=1e-5)
    # After many steps on one batch the running statistics are that batch's.
    for _ in range(200):
        last, after = train(after)
    np.testing.assert_allclose(run(after, color, gbuffer), last, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("make", [FusionSR, functools.partial(UNetSR, down_kernel=2)])
def test_gradients_are_finite_and_reach_everything(make):
    graph, params, rest = nnx.split(drawn(make, 5), nnx.Param, ...)
    color, gbuffer = _inputs(5, batch=2, size=(3, 3))
    color = color.at[0].set(0)  # a black frame

    @jax.jit
    def gradient(params, color, gbuffer):
        def loss(params, color, gbuffer):
            return jnp.mean(jnp.square(nnx.merge(graph, params, rest, copy=True)(color, gbuffer) - 0.5))

        return jax.grad(loss, argnums=(0, 1, 2))(params, color, gbuffer)

    grads = gradient(params, color, gbuffer)
    for path, leaf in jax.tree_util.tree_leaves_with_path(grads):
        assert np.all(np.isfinite(leaf)), path
        assert np.any(leaf != 0), path


@pytest.mark.parametrize("name", NETS)
def test_bfloat16_computes_close_by(name):
    color, gbuffer = _inputs(6)
    run, state = _pure(drawn(NETS[name], 6))
    run_half, half = _pure(drawn(functools.partial(NETS[name], dtype=jnp.bfloat16), 6))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(half))
    exact, close = run(state, color, gbuffer), run_half(half, color, gbuffer)
    assert close.dtype == jnp.float32
    difference = np.abs(np.asarray(close - exact)).max() / np.abs(exact).max()
    assert 0 < difference < 0.03


@pytest.mark.slow
def test_bfloat16_trains():
    net = drawn(functools.partial(FusionSR, dtype=jnp.bfloat16), 6)
    graph, params, rest = nnx.split(net, nnx.Param, ...)
    color, gbuffer = _inputs(6)
    grads = jax.jit(jax.grad(lambda p: jnp.mean(nnx.merge(graph, p, rest, copy=True)(color, gbuffer))))(
        params
    )
    assert all(x.dtype == jnp.float32 and np.all(np.isfinite(x)) for x in jax.tree.leaves(grads))


@pytest.mark.slow
@pytest.mark.parametrize("make", [FusionSR, UNetSR])
def test_it_learns_one_image(make):
    y, x = jnp.mgrid[:8, :8].astype(jnp.float32) / 8
    truth = jnp.stack([x, y, (x > 0.5).astype(jnp.float32)], -1)[None]
    gbuffer = jnp.concatenate([truth, jnp.zeros((1, 8, 8, 1))], -1)
    color = truth[:, ::4, ::4]
    net = drawn(functools.partial(make, buffers=("base_color", "depth")))
    graph, params, rest = nnx.split(net, nnx.Param, ...)
    optimizer = optax.adam(3e-3)

    @jax.jit
    def step(params, rest, opt):
        def loss(params):
            net = nnx.merge(graph, params, rest, copy=True)
            error = jnp.mean(jnp.abs(net(color, gbuffer) - truth))
            return error, nnx.state(net, nnx.Not(nnx.Param))

        (error, rest), grads = jax.value_and_grad(loss, has_aux=True)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers with floats
            updates, opt = optimizer.update(grads, opt)
        return optax.apply_updates(params, updates), rest, opt, error

    opt = optimizer.init(params)
    errors = []
    for _ in range(150):
        params, rest, opt, error = step(params, rest, opt)
        errors.append(float(error))
    assert errors[-1] < 0.03 < 0.15 < errors[0]


def test_convolution_of_parts_is_that_of_the_whole():
    layer = conv(5, 4, stride=2, dtype=jnp.float32, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(4.0)
    x = jax.random.normal(jax.random.key(0), (2, 6, 4, 5))
    np.testing.assert_allclose(conv_beside(layer, x[..., :2], x[..., 2:]), layer(x), atol=1e-5)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_a_convolution_for_loops_is_flax_s_with_its_gradient(dtype):
    layer = LoopConv(3, 5, init=XAVIER, dtype=dtype, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(5.0)
    x, cotangent = (jax.random.normal(jax.random.key(k), (2, 5, 4, c)) for k, c in enumerate((3, 5)))
    found = []
    for call in (LoopConv.__call__, nnx.Conv.__call__):
        graph, params = nnx.split(layer)

        def loss(params, x, call=call, graph=graph):
            made = call(nnx.merge(graph, params), x).astype(jnp.float32)
            return jnp.sum(made * cotangent), made

        found.append(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(params, x))
    for ours, expected in zip(*map(jax.tree.leaves, found), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(ours, expected, atol=scale * (1e-6 if dtype == jnp.float32 else 2e-2))


def test_stacked_modules_are_run_one_after_the_other():
    many = stacked(3, lambda rngs: LoopConv(4, 4, init=XAVIER, dtype=jnp.float32, rngs=rngs), nnx.Rngs(0))
    assert many.kernel.shape == (3, 3, 3, 4, 4)
    x = y = jax.random.normal(jax.random.key(0), (1, 4, 3, 4))
    for k in range(3):
        one = LoopConv(4, 4, init=XAVIER, dtype=jnp.float32, rngs=nnx.Rngs(1))
        one.kernel[...] = many.kernel[k]
        y = one(y)
    assert np.abs(many.kernel[0] - many.kernel[1]).max() > 0.01  # each was drawn for itself
    np.testing.assert_allclose(through(x, many), y, atol=1e-5)


def test_upsampling_is_flax_s_transposed_convolution():
    layer = UpConv(3, 5, dtype=jnp.float32, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(5.0)
    x = jax.random.normal(jax.random.key(0), (2, 4, 3, 3))
    np.testing.assert_allclose(layer(x), nnx.ConvTranspose.__call__(layer, x), atol=1e-5)


def test_shallow_features_keep_the_input():
    layer = ShallowFeatures(4, 6, dtype=jnp.float32, rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(0), (1, 3, 2, 4))
    assert layer(x).shape == (1, 3, 2, 10)
    np.testing.assert_array_equal(layer(x)[..., :4], x)


def test_size_of_the_export_may_be_open():
    run, state = _pure(drawn(functools.partial(UNetSR, scale=4)))
    h, w = jax.export.symbolic_shape("h, w")
    shapes = [jax.ShapeDtypeStruct((1, *size), jnp.float32) for size in ((h, w, 3), (4 * h, 4 * w, 9))]
    exported = jax.export.export(jax.jit(lambda c, g: run(state, c, g)))(*shapes)
    inputs = _inputs(7)
    np.testing.assert_allclose(exported.call(*inputs), run(state, *inputs), atol=1e-5)


def nsrr_steps(net, rgbd):
    return net.reconstruct(net.features(rgbd), net.previous_features(rgbd)[:, None])


COLOR, WIDE = (1, 4, 4, 3), (1, 8, 8, 3)
EVERY_NET = {
    "fusion": (FusionSR, [COLOR, (1, 8, 8, 9)]),
    "unet": (UNetSR, [COLOR, (1, 8, 8, 9)]),
    "rcan": (functools.partial(RCAN, scale=2, groups=1, blocks=1, features=4, reduction=2), [COLOR]),
    "rrn": (functools.partial(RRN, scale=2, blocks=1, features=4), [COLOR, COLOR, (1, 4, 4, 4), WIDE]),
    "nsrr": (functools.partial(NSRR, previous=1), [(1, 8, 8, 4)], nsrr_steps),
}


@pytest.mark.parametrize("name", EVERY_NET)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("images", ["float32", "float64"])
def test_where_doubles_are_allowed_networks_stay_float32(name, dtype, images):
    """Whatever the type of the images: parameters, their gradients, and the output."""
    make, shapes, *other = EVERY_NET[name]
    call = other[0] if other else lambda net, *inputs: net(*inputs)

    with jax.enable_x64(True):
        net = nnx.eval_shape(lambda: make(dtype=dtype, rngs=nnx.Rngs(0)))
        graph, params, rest = nnx.split(net, nnx.Param, ...)

        def total(params, rest, *inputs):
            out = call(nnx.merge(graph, params, rest, copy=True), *inputs)
            return sum(jnp.sum(x) for x in jax.tree.leaves(out)), out

        inputs = [jax.ShapeDtypeStruct(shape, images) for shape in shapes]
        found = jax.eval_shape(jax.grad(total, has_aux=True), params, rest, *inputs)
    assert {x.dtype for x in jax.tree.leaves(found)} == {jnp.dtype("float32")}


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"fusion": "product"}, "fusion: unknown fusion; expected se-residual"),
        ({"down_kernel": 4}, "down_kernel"),
        ({"scale": 0}, "scale"),
        ({"buffers": ()}, "buffers"),
        ({"buffers": ("depth", "depth")}, "buffers"),
        ({"buffers": ("velocity",)}, "velocity"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    with pytest.raises(JaxsrError, match=match):
        FusionSR(**arguments, rngs=nnx.Rngs(0))


@pytest.mark.parametrize("name", NETS)
def test_inputs_that_do_not_fit_are_named(name):
    net = _abstract(functools.partial(NETS[name], scale=2))
    color, gbuffer = _inputs(scale=4)
    with pytest.raises(JaxsrError, match="expected 4 x 6, 2 times 2 x 3; found 8 x 12"):
        net(color, gbuffer)
    with pytest.raises(JaxsrError, match="gbuffer: wrong number of channels; expected 9; found 8"):
        net(color, gbuffer[..., :8])
