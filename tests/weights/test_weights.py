"""Files of weights, ours and published ones: exact, and nothing in them runs."""

import functools
import json
import pickle
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.methods import build
from jaxsr.nets import RCAN, RRN, FusionSR, UNetSR
from jaxsr.nets.fusion_sr import Fusion
from jaxsr.nets.rcan import MEAN
from jaxsr.runtime.load import find_method
from jaxsr.weights.convert import convert_published
from jaxsr.weights.file import flatten, into, load_weights, save_weights
from jaxsr.weights.names import PUBLISHED
from jaxsr.weights.torch import read_published
from tests.networks import drawn
from tests.reference import golden_color_nets, golden_fusion_sr
from tests.test_cli import error_line, run

GOLDENS = Path(__file__).parents[3] / "shared" / "goldens"
HEADER = {"method": "fusion-sr", "settings": {"fusion": "add"}, "scale": 4, "trained": [1, "ä"]}


def block(*, rngs):
    """A part of a network that has every kind of array."""
    return Fusion(16, dtype=jnp.float32, rngs=rngs)


@pytest.fixture
def state():
    return nnx.state(drawn(block))


@pytest.fixture
def arrays(state):
    return flatten(state)


def test_roundtrip_is_exact(tmp_path, state):
    path = tmp_path / "weights.safetensors"
    save_weights(path, state, HEADER)
    arrays, header = load_weights(path)
    assert header == HEADER
    abstract = nnx.state(nnx.eval_shape(lambda: block(rngs=nnx.Rngs(0))))
    again = into(abstract, arrays, path)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    jax.tree.map(np.testing.assert_array_equal, again, state)
    first = path.read_bytes()
    save_weights(path, again, dict(reversed(HEADER.items())))
    assert path.read_bytes() == first
    assert list(tmp_path.iterdir()) == [path]


def test_names_are_places_in_the_network(arrays):
    assert "se.squeeze.kernel" in arrays
    assert {k for k in arrays if k.startswith("norm1.")} == {
        f"norm1.{k}" for k in ("scale", "bias", "mean", "var")
    }


def test_half_is_half_the_size_and_rounded(tmp_path, arrays):
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    save_weights(whole, arrays, HEADER)
    save_weights(half, arrays, HEADER, half=True)
    saved = whole.stat().st_size - half.stat().st_size
    assert abs(saved - 2 * sum(a.size for a in arrays.values())) < 100
    loaded, _ = load_weights(half)
    for name, array in arrays.items():
        assert loaded[name].dtype == np.float32
        np.testing.assert_array_equal(loaded[name], array.astype(np.float16).astype(np.float32))


@pytest.mark.parametrize(
    ("value", "half", "words"),
    [
        (np.nan, False, "conv1.kernel is not finite.*the training diverged"),
        (np.inf, True, "conv1.kernel is not finite.*the training diverged"),
        (1e5, True, "expected values within float16; found 100000.*store float32"),
    ],
)
def test_weights_that_are_not_finite_are_not_written(tmp_path, arrays, value, half, words):
    arrays["conv1.kernel"] = np.full((1, 1, 32, 16), value, np.float32)
    with pytest.raises(JaxsrError, match=words):
        save_weights(tmp_path / "weights.safetensors", arrays, HEADER, half=half)
    assert not list(tmp_path.iterdir())


def test_a_header_must_be_json(tmp_path, arrays):
    for value in (np.float32(1), float("nan"), {1, 2}):
        with pytest.raises(JaxsrError, match="the header is no JSON"):
            save_weights(tmp_path / "weights.safetensors", arrays, HEADER | {"value": value})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("keep", [0, 4, 8, 100, -1])
def test_a_truncated_file_is_named(tmp_path, arrays, keep):
    path = tmp_path / "weights.safetensors"
    save_weights(path, arrays, HEADER)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(JaxsrError, match=r"weights.safetensors: .*expected a whole safetensors file"):
        load_weights(path)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: None, "no such file of weights"),
        (lambda p: p.mkdir(), "a folder, not a file"),
        (lambda p: p.write_bytes(b"PNG" * 100), "expected a whole safetensors file"),
        (lambda p: save_file({"a": np.zeros(2, np.float32)}, p), "found no metadata; .*convert-weights"),
        (lambda p: save_file({}, p, {"format": "pt"}), "which method its weights are for; .*found format"),
        (lambda p: save_file({}, p, {"jaxsr": "{"}), "the header of the weights is damaged"),
        (lambda p: save_file({}, p, {"jaxsr": "[1]"}), "which method"),
        (lambda p: save_file({}, p, {"jaxsr": '{"scale": 4}'}), "which method"),
    ],
    ids=["missing", "folder", "other", "foreign", "no entry", "damaged", "list", "no method"],
)
def test_files_that_are_not_ours_are_named(tmp_path, write, words):
    path = tmp_path / "weights.safetensors"
    write(path)
    with pytest.raises(JaxsrError, match=f"weights.safetensors: .*{words}"):
        load_weights(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("norm2.var"), r"expected its 12 arrays; found a file of 11 that lacks norm2.var;"),
        (lambda a: a.update(x=np.zeros(1)), "found a file of 13 that has x;"),
        (
            lambda a: [a.pop(k) for k in list(a) if k.startswith("norm")] and a.update(x=np.zeros(1)),
            "that lacks norm1.bias, .* and 5 more and has x;",
        ),
        (
            lambda a: a.update({"conv1.kernel": a["conv1.kernel"][..., :5]}),
            r"conv1.kernel has another shape .*expected \[1, 1, 32, 16\]; found \[1, 1, 32, 5\]",
        ),
    ],
    ids=["missing", "extra", "both", "shape"],
)
def test_weights_of_another_network_are_named(state, arrays, change, words):
    change(arrays)
    with pytest.raises(JaxsrError, match=f"file.st: .*{words}"):
        into(state, arrays, "file.st")


# Published weights.


def published(method, net, seed=0):
    """Random weights for `net` under published names, in PyTorch's layouts."""
    layers = {".".join(map(str, path)): module for path, module in nnx.iter_modules(net)}
    leaves = {"kernel": "weight", "scale": "weight", "mean": "running_mean", "var": "running_var"}
    rng, result = np.random.default_rng(seed), {}

    def put(array, ours, theirs, leaf):
        if not isinstance(theirs, str):  # one of ours is many of theirs
            for part, name in zip(array, theirs, strict=True):
                put(part, ours, name, leaf)
            return
        if array.ndim == 2 and method == "rcan":  # 1x1 convolutions
            array = array[None, None]
        if array.ndim == 4:
            is_up = isinstance(layers[ours], nnx.ConvTranspose)
            array = array.transpose(2, 3, 0, 1) if is_up else array.transpose(3, 2, 0, 1)
        result[f"{theirs}.{leaves.get(leaf, leaf)}"] = np.ascontiguousarray(
            array.T if array.ndim == 2 else array
        )

    for ours, theirs in PUBLISHED[method].layers(net):
        for (leaf,), variable in nnx.to_flat_state(nnx.state(layers[ours])):
            put(rng.random(variable.get_value().shape, np.float32), ours, theirs, leaf)
        if ".norm" in ours:
            result[f"{theirs}.num_batches_tracked"] = np.array(7.0, np.float32)
    return result | (mean_shifts(1) if method == "rcan" else {})


def mean_shifts(span):
    """RCAN's, for colours of this range."""
    mean, eye = np.array(MEAN, np.float32) * span, np.eye(3, dtype=np.float32)[..., None, None]
    return {"sub_mean.weight": eye, "sub_mean.bias": -mean, "add_mean.weight": eye, "add_mean.bias": mean}


@functools.cache
def abstract(make, **arguments):
    return nnx.eval_shape(lambda: make(**arguments, rngs=nnx.Rngs(0)))


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (FusionSR, {}),
        (FusionSR, {"fusion": "concat", "down_kernel": 2}),
        (FusionSR, {"fusion": "add"}),
        (FusionSR, {"buffers": ("normal", "depth")}),
        (UNetSR, {}),
        (UNetSR, {"buffers": ("base_color",), "down_kernel": 2}),
    ],
)
def test_the_header_of_published_weights_builds_their_network(tmp_path, make, arguments):
    source, out = tmp_path / "a.npz", tmp_path / "a.safetensors"
    np.savez(source, **published("fusion-sr", abstract(make, **arguments)))
    told = convert_published(source, out, buffers=arguments.get("buffers"), scale=2)
    arrays, header = load_weights(out)
    assert header == json.loads(json.dumps(told))
    assert (header["method"], header["scale"], header["jaxsr"]) == ("fusion-sr", 2, jaxsr.__version__)
    assert header["source"]["file"] == "a.npz"
    assert {k: header["settings"][k] for k in ("demodulated", "base", "unjitter")} == {
        "demodulated": False,
        "base": "none",
        "unjitter": False,
    }
    method = build(header["method"], header["settings"])
    net = nnx.eval_shape(lambda: method.network.new(nnx.Rngs(0)))
    assert isinstance(net, make)
    into(nnx.state(net), arrays, out)
    for key, value in arguments.items():
        assert method.network.settings[key] == (list(value) if isinstance(value, tuple) else value)


@pytest.mark.parametrize(
    ("make", "method", "arguments"),
    [
        (RCAN, "rcan", {"scale": 4, "groups": 2, "blocks": 3, "features": 8, "reduction": 2}),
        (RCAN, "rcan", {"scale": 3, "groups": 1, "blocks": 1, "features": 6, "reduction": 6}),
        (RCAN, "rcan", {"scale": 2, "groups": 11, "blocks": 1, "features": 4, "reduction": 4}),
        (RRN, "rrn", {"scale": 4, "blocks": 2, "features": 8}),
        (RRN, "rrn", {"scale": 2, "blocks": 12, "features": 4}),
    ],
)
def test_names_and_shapes_of_published_weights_tell_all(tmp_path, capsys, make, method, arguments):
    source, out = tmp_path / "a.npz", tmp_path / "a.safetensors"
    np.savez(source, **published(method, abstract(make, **arguments)))
    status, told, _ = run(capsys, "convert-weights", source, out)
    assert status == 0
    assert f"{method}, scale {arguments['scale']}" in told
    arrays, header = load_weights(out)
    assert (header["method"], header["format"], header["scale"]) == (method, 2, arguments["scale"])
    assert header["settings"] == arguments | {"unjitter": True, "dtype": "float32"}
    into(nnx.state(abstract(make, **arguments)), arrays, out)
    assert (
        find_method(str(out), arguments["scale"]).method.network.settings["features"] == arguments["features"]
    )
    line = error_line(capsys, "convert-weights", source, out, "--scale", 7)
    assert f"a.npz: the weights are of another scale; expected 7; found {arguments['scale']}" in line
    line = error_line(capsys, "convert-weights", source, out, "--buffers", "depth")
    assert "the network sees no G-buffer" in line
    line = error_line(capsys, "convert-weights", source, out, "--method", "fusion-sr")
    assert "not weights of a published fusion-sr network" in line


def test_the_range_of_colours_of_a_published_rcan_does_not_matter(tmp_path):
    """The official weights are for colours up to 255: the same network in other units."""
    sizes = {"scale": 2, "groups": 1, "blocks": 2, "features": 4, "reduction": 2}
    arrays = published("rcan", abstract(RCAN, **sizes))
    other = arrays | mean_shifts(255) | {"head.0.weight": arrays["head.0.weight"] / 255}
    other |= {name: arrays[name] * 255 for name in ("tail.1.weight", "tail.1.bias")}
    converted = []
    for name, content in (("unit", arrays), ("bytes", other)):
        np.savez(tmp_path / f"{name}.npz", **content)
        convert_published(tmp_path / f"{name}.npz", tmp_path / f"{name}.safetensors")
        converted.append(load_weights(tmp_path / f"{name}.safetensors")[0])
    for name, array in converted[0].items():
        np.testing.assert_allclose(converted[1][name], array, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("sub_mean.bias"), r"a.npz: sub_mean is not RCAN's; .* found no such array"),
        (lambda a: a.update({"add_mean.bias": np.array([0.5, 0.5, 0.5])}), r"add_mean is .*found \[0.5, 0.5"),
        (lambda a: a.update({"add_mean.bias": np.zeros(7)}), "add_mean is not RCAN's"),
        (lambda a: a.update({"sub_mean.weight": np.zeros((3, 3, 1, 1))}), "sub_mean is not RCAN's"),
        (lambda a: a.pop("tail.1.bias"), "tail.1.bias is missing"),
        (lambda a: a.pop("tail.0.0.weight"), r"bad scale; expected 2 \| 3 \| 4 \| 8; found 1"),
        (lambda a: a.pop("body.0.body.1.body.2.bias"), "body.0.body.1.body.2.bias is missing"),
        (
            lambda a: a.update({"body.0.body.0.body.3.conv_du.2.weight": np.zeros((4, 2, 3, 3))}),
            "arrays of several shapes for groups.blocks.attention.excite.kernel",
        ),
        (lambda a: a.update({"head.0.weight": np.zeros(4)}), "not weights of a published rcan network"),
    ],
)
def test_published_rcans_that_do_not_fit_are_named(tmp_path, capsys, change, words):
    sizes = {"scale": 2, "groups": 1, "blocks": 2, "features": 4, "reduction": 2}
    arrays = published("rcan", abstract(RCAN, **sizes))
    change(arrays)
    np.savez(tmp_path / "a.npz", **arrays)
    line = error_line(capsys, "convert-weights", tmp_path / "a.npz", tmp_path / "out.safetensors")
    with pytest.raises(JaxsrError, match=words):
        raise JaxsrError(line)


def converted(source, out):
    """Our network with published weights, by way of `jaxsr convert-weights`: compiled, and its state."""
    convert_published(source, out)
    arrays, header = load_weights(out)
    new_net = build(header["method"], header["settings"]).network.new
    graph, state = nnx.split(nnx.eval_shape(lambda: new_net(nnx.Rngs(0))))
    net = nnx.merge(graph, into(state, arrays, out))
    net.eval()
    graph, state = nnx.split(net)
    return jax.jit(lambda state, *inputs: nnx.merge(graph, state)(*inputs)), state


def converted_output(source, out, *inputs):
    run, state = converted(source, out)
    return run(state, *inputs)


def golden_of(name):
    if not (source := GOLDENS / f"{name}.npz").is_file():
        pytest.skip("the goldens of the published networks are not here")
    return source, np.load(source)


@pytest.mark.parametrize(
    ("name", "inputs"),
    [
        ("fusion_sr", ("color", "gbuffer")),
        ("unet_sr", ("color", "gbuffer")),
        ("rcan_g2b2c32", ("x",)),
    ],
)
def test_converted_weights_give_the_published_output(tmp_path, name, inputs):
    source, golden = golden_of(name)
    images = (np.moveaxis(golden[f"in/{k}"], 1, -1) for k in inputs)
    made = converted_output(source, tmp_path / "converted.safetensors", *images)
    expected = np.moveaxis(golden["out/y"], 1, -1)
    np.testing.assert_allclose(made, expected, atol=1e-4 * np.abs(expected).max())


def test_a_converted_rrn_gives_the_published_outputs(tmp_path):
    """Three steps; of four frames the first only precedes the second."""
    source, golden = golden_of("rrn_c32b2")
    frames = np.moveaxis(golden["in/sequence"], (2, 1), (0, -1))
    expected, last = np.moveaxis(golden["out/y"], (1, 2), (0, -1)), np.moveaxis(golden["out/h"], 1, -1)
    run, state = converted(source, tmp_path / "converted.safetensors")
    hidden, made = jnp.zeros(last.shape, jnp.float32), jnp.zeros(expected[0].shape, jnp.float32)
    for t in range(3):
        made, hidden = run(state, frames[t], frames[t + 1], hidden, made)
        np.testing.assert_allclose(made, expected[t], atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(hidden, last, atol=1e-4 * np.abs(last).max())


def test_converted_weights_give_the_output_of_pytorch(tmp_path):
    """The golden in the repository: the same network in PyTorch, smaller images."""
    golden = dict(np.load(Path(golden_fusion_sr.__file__).with_suffix(".npz")))
    expected = golden.pop("output")
    np.savez(source := tmp_path / "published.npz", **golden_fusion_sr.weights(golden))
    made = converted_output(source, tmp_path / "converted.safetensors", *golden_fusion_sr.inputs())
    np.testing.assert_allclose(made, expected, atol=1e-4 * np.abs(expected).max())


def color_golden(name, shapes, tmp_path):
    """Outputs of a network in PyTorch, and ours with the same weights."""
    arrays = golden_fusion_sr.weights(shapes)
    arrays |= golden_color_nets.shifts() if name == "rcan" else {}
    np.savez(source := tmp_path / "published.npz", **arrays)
    golden = np.load(Path(golden_color_nets.__file__).with_suffix(".npz"))
    return golden, *converted(source, tmp_path / "converted.safetensors")


def test_a_converted_rcan_gives_the_output_of_pytorch(tmp_path):
    golden, run, state = color_golden("rcan", golden_color_nets.rcan_shapes(), tmp_path)
    made = run(state, golden_color_nets.frames()[0])
    np.testing.assert_allclose(made, golden["rcan"], atol=1e-4 * np.abs(golden["rcan"]).max())


def test_a_converted_rrn_gives_the_outputs_of_pytorch(tmp_path):
    golden, run, state = color_golden("rrn", golden_color_nets.rrn_shapes(), tmp_path)
    frames, expected = golden_color_nets.frames(), golden["rrn"]
    hidden, made = jnp.zeros(golden["hidden"].shape), jnp.zeros(expected[0].shape)
    for t in range(golden_color_nets.STEPS):
        made, hidden = run(state, frames[t], frames[t + 1], hidden, made)
        np.testing.assert_allclose(made, expected[t], atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(hidden, golden["hidden"], atol=1e-4 * np.abs(golden["hidden"]).max())


# A .pth file by hand: a ZIP archive of a pickle, whose opcodes are written here, and of raw storages.


def plain(value):
    return pickle.dumps(value, 2)[2:-1]


def tensor(key, size, stride, offset=0, storage="FloatStorage", length=1):
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n((" + plain("storage") + f"ctorch\n{storage}\n".encode()
        + plain(key) + plain("cpu") + plain(length) + b"tQ" + plain(offset) + plain(size) + plain(stride)
        + plain(False) + b"ccollections\nOrderedDict\n)RtR"
    )  # fmt: skip


def ordered(items):
    return b"ccollections\nOrderedDict\n)R(" + b"".join(plain(k) + v for k, v in items.items()) + b"u"


def state_dict(arrays):
    return ordered(
        {
            name: tensor(str(i), a.shape, tuple(s // a.itemsize for s in a.strides), length=a.size)
            for i, (name, a) in enumerate(arrays.items())
        }
    )


def write_pth(path, body, storages, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("archive/data.pkl", b"\x80\x02" + body + b".")
        file.writestr("archive/byteorder", b"little")
        for key, content in storages.items():
            file.writestr(f"archive/data/{key}", content)


def dense(arrays):
    return {str(i): a.tobytes() for i, a in enumerate(arrays.values())}


@pytest.mark.parametrize("kind", [".pth", "wrapped.pth", ".npz", "sd.npz", ".safetensors", "parallel.pt"])
def test_every_kind_of_file_is_read(tmp_path, capsys, kind):
    arrays = published("fusion-sr", abstract(FusionSR))
    source = tmp_path / f"weights{kind}"
    if kind.endswith("npz"):
        prefix = "sd/" if kind == "sd.npz" else ""
        more = {"in/color": np.zeros(3)} if prefix else {}
        np.savez(source, **{prefix + k: a for k, a in arrays.items()}, **more)
    elif kind == ".safetensors":
        save_file(arrays, source)
    else:
        named = {f"module.{k}" if kind == "parallel.pt" else k: a for k, a in arrays.items()}
        body = state_dict(named)
        if kind == "wrapped.pth":
            body = b"}(" + plain("epoch") + plain(3) + plain("state_dict") + body + b"u"
        write_pth(source, body, dense(named))
    out = tmp_path / "out.safetensors"
    status, told, _ = run(capsys, "convert-weights", source, out, "--method", "fusion-sr")
    assert status == 0
    assert "architecture fusion" in told
    found, _ = load_weights(out)
    convolution = arrays["fusion_reconstruct.rgb_conv2.conv.0.weight"]
    np.testing.assert_array_equal(found["color_encoder.1.conv1.kernel"], convolution.transpose(2, 3, 1, 0))
    np.testing.assert_array_equal(
        found["fusions.0.norm2.var"], arrays["fusion_reconstruct.fuse1.residual.4.running_var"]
    )


def test_tensors_may_share_a_storage_and_be_of_other_types(tmp_path):
    path, values = tmp_path / "a.pth", np.arange(12, dtype=np.float32)
    items = {
        "view": tensor("0", (2, 3), (1, 4), offset=1),
        "whole": tensor("0", (12,), (1,)),
        "scalar": tensor("0", (), (), offset=5),
        "none": tensor("0", (0, 3), (3, 1)),
        "count": tensor("1", (1,), (1,), storage="LongStorage"),
        "brain": tensor("2", (2,), (1,), storage="BFloat16Storage"),
    }
    brain = np.array([0x3F80, 0xC000], np.uint16).tobytes()  # 1 and -2
    write_pth(path, ordered(items), {"0": values.tobytes(), "1": np.array([7]).tobytes(), "2": brain})
    found = read_published(path)
    np.testing.assert_array_equal(found["view"], [[1, 5, 9], [2, 6, 10]])
    np.testing.assert_array_equal(found["whole"], values)
    assert found["scalar"] == 5
    assert found["none"].shape == (0, 3)
    np.testing.assert_array_equal(found["count"], [7])
    np.testing.assert_array_equal(found["brain"], [1, -2])
    assert all(a.dtype == np.float32 for a in found.values())


def test_brain_floats_in_safetensors_are_read(tmp_path):
    path = tmp_path / "a.safetensors"
    head = json.dumps({"a": {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}}).encode()
    path.write_bytes(len(head).to_bytes(8, "little") + head + b"\x00\xc0")
    np.testing.assert_array_equal(read_published(path)["a"], [-2])


class Evil:
    """Touches a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def evil_pickle(tmp_path):
    class Command:
        def __reduce__(self):
            return eval, (f"open({str(tmp_path / 'ran')!r}, 'w')",)

    return pickle.dumps(Command(), 2)[2:-1]


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (evil_pickle, "eval"),
        (lambda p: ordered({"a": b"cos\nsystem\n(" + plain(f"touch {p}/ran") + b"tR"}), "os.system"),
        (lambda p: ordered({"a": b"ctorch\nload\n(" + plain("x") + b"tR"}), "torch.load"),
        (lambda p: b"cnumpy\nload\n(" + plain("x") + b"tR", "numpy.load"),
        # With protocol 4 a name may have dots.
        (lambda p: b"\x80\x04\x8c\x05torch\x8c\x16FloatStorage.__class__\x93.", "torch.FloatStorage.__class"),
    ],
    ids=["eval", "system", "torch", "numpy", "dots"],
)
def test_a_malicious_pickle_is_refused_in_one_line(tmp_path, capsys, body, named):
    source, out = tmp_path / "evil.pth", tmp_path / "out.safetensors"
    write_pth(source, body(tmp_path), {})
    line = error_line(capsys, "convert-weights", source, out)
    assert "evil.pth: the pickle names " in line
    assert named in line
    assert "could run code" in line
    assert not (tmp_path / "ran").exists()
    assert not out.exists()


def test_a_pickle_cannot_change_the_reader(tmp_path):
    path = tmp_path / "a.pth"
    change = b"ctorch._utils\n_rebuild_tensor_v2\nN}(" + plain("size") + plain((9,)) + b"u\x86b0"
    items = {"a": tensor("0", (2,), (1,))}
    write_pth(path, change + ordered(items), {"0": np.ones(2, np.float32).tobytes()})
    np.testing.assert_array_equal(read_published(path)["a"], [1, 1])


def objects(path):
    np.savez(path, a=np.array([Evil(path.parent / "ran")], object), allow_pickle=True)


FOUR = {"0": np.ones(4, np.float32).tobytes()}


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("a.pth", lambda p: p.write_bytes(pickle.dumps({"a": 1})), "expected a whole .pth file"),
        ("a.pth", lambda p: write_pth(p, plain([1, 2]), {}), "no state dictionary in the file.*found list"),
        ("a.pth", lambda p: write_pth(p, plain({"epoch": 1}), {}), "no state dictionary.*found epoch"),
        ("a.pth", lambda p: write_pth(p, b"garbage", {}), "cannot read the weights"),
        ("a.pth", lambda p: write_pth(p, ordered({"a": tensor("1", (2,), (1,))}), FOUR), "cannot read"),
        (
            "a.pth",
            lambda p: write_pth(p, ordered({"a": tensor("0", (5,), (1,))}), FOUR),
            "larger than its storage",
        ),
        (
            "a.pth",
            lambda p: write_pth(p, ordered({"a": tensor("0", (10**6, 10**6), (0, 0))}), FOUR),
            "larger than its storage",
        ),
        (
            "a.pth",
            lambda p: write_pth(p, ordered({"a": tensor("0", (2,), (1,), offset=-1)}), FOUR),
            "impossible layout",
        ),
        (
            "a.pth",
            lambda p: write_pth(p, ordered({"a": tensor("0", (2,), (1,))}), FOUR, zipfile.ZIP_DEFLATED),
            "is compressed",
        ),
        ("a.npz", objects, "expected a whole .npz file of plain arrays"),
        ("a.npz", lambda p: p.write_bytes(b"PK"), "expected a whole .npz file"),
        ("a.safetensors", lambda p: p.write_bytes(b"x"), "expected a whole safetensors file"),
        ("a.safetensors", lambda p: save_weights(p, {}, HEADER), "weights of jaxsr already"),
        ("a.onnx", lambda p: p.write_bytes(b"x"), "unknown kind of weights; expected .pth, .pt, .npz"),
        ("a.npz", lambda p: np.savez(p, a=np.zeros(2)), "not weights of a published network that is known"),
        ("a.npz", lambda p: np.savez(p), "no weights in the file"),
        ("a.pth", lambda p: None, "no such file"),
    ],
)
def test_damaged_published_files_are_named_in_one_line(tmp_path, capsys, name, write, words):
    source, out = tmp_path / name, tmp_path / "out.safetensors"
    write(source)
    line = error_line(capsys, "convert-weights", source, out)
    with pytest.raises(JaxsrError, match=f"{name}: .*{words}"):
        raise JaxsrError(line.removeprefix("jaxsr: "))
    assert not out.exists()
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (lambda a: a.pop("cur_rgb_extract.f_e_net.0.bias"), (), "rgb_extract.f_e_net.0.bias is missing"),
        (lambda a: a.update(more=np.zeros(1)), (), "does not have; .*found 1 more: more"),
        (
            lambda a: a.update({"cur_rgb_extract.f_e_net.0.bias": np.zeros(5)}),
            (),
            r"color_shallow.conv1.bias has another shape .*expected \[32\]; found \[5\]",
        ),
        (lambda a: None, ("--buffers", "depth"), "expected 9; found 1"),
        (lambda a: None, ("--buffers", "colour"), "bad parts of the G-buffer"),
        (lambda a: None, ("--method", "taau"), "no published weights of 'taau'.*expected one of fusion-sr"),
    ],
)
def test_published_weights_that_do_not_fit_are_named(tmp_path, capsys, change, options, words):
    arrays = published("fusion-sr", abstract(FusionSR))
    change(arrays)
    source, out = tmp_path / "a.npz", tmp_path / "out.safetensors"
    np.savez(source, **arrays)
    line = error_line(capsys, "convert-weights", source, out, *options)
    with pytest.raises(JaxsrError, match=words):
        raise JaxsrError(line)
    assert not out.exists()


def test_the_buffers_of_a_smaller_network_must_be_said(tmp_path, capsys):
    source = tmp_path / "a.npz"
    np.savez(source, **published("fusion-sr", abstract(FusionSR, buffers=("depth", "normal"))))
    line = error_line(capsys, "convert-weights", source, tmp_path / "out.safetensors")
    assert "G-buffer of 4 channels" in line
    assert "--buffers" in line
    line = error_line(capsys, "convert-weights", source, tmp_path / "out.pth")
    assert "end in .safetensors" in line
    out = tmp_path / "out.safetensors"
    status, told, _ = run(capsys, "convert-weights", source, out, "--buffers", "depth", "normal", "--half")
    assert status == 0
    assert load_weights(out)[1]["settings"]["buffers"] == ["depth", "normal"]
    assert "normal" in told
