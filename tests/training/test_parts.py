"""Networks of several parts: frozen ones stay as they are, and parts start from files of their own."""

import csv
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxsr.data.loader import Loader, Stream
from jaxsr.data.windows import WindowSource
from jaxsr.errors import JaxsrError
from jaxsr.methods import Windows
from jaxsr.training import TrainConfig, train
from jaxsr.training.checkpoints import Checkpoints
from jaxsr.training.evaluate import evaluation_windows, held_back_frames, score_names
from jaxsr.training.initial import Source, initial_weights, parse, same_hashes
from jaxsr.training.state import begin, inference_net
from jaxsr.training.step import make_step, shardings
from jaxsr.weights.file import flatten, load_weights, new_header, save_weights
from tests.builders import make_sequence
from tests.training import two_parts

FROZEN = nnx.PathContains("upscaler")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one sequence of six frames."""
    folder = tmp_path_factory.mktemp("parts") / "data"
    make_sequence(folder / "clip", frames=6, size=(32, 16))
    return folder


def config_of(data, out, **options):
    defaults = {"steps": 3, "batch": 2, "crop": 8, "scale": 2, "eval_every": 3, "save_every": 3, "ema": 0.9}
    return TrainConfig(data=(data,), out=out, cache=data.parent / "cache", **defaults | options)


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """Three steps of a network of which one part is frozen."""
    out = tmp_path_factory.mktemp("parts") / "out"
    train(two_parts.method(FROZEN), config_of(data, out), quiet=True)
    return out


def names(tree):
    return {".".join(map(str, path)) for path, _ in nnx.to_flat_state(tree)}


def test_frozen_parts_stay_to_the_bit(trained):
    """Parameters and statistics; the other part moves."""
    _, start = begin(two_parts.method(FROZEN), TrainConfig(ema=0.9, batch=2))
    arrays, _ = load_weights(trained / "weights.safetensors")
    for name, before in flatten(nnx.filter_state(inference_net(start), nnx.Not(nnx.RngState))).items():
        same = np.array_equal(arrays[name], before)
        assert same == name.startswith("upscaler"), name


@pytest.mark.parametrize("filter_", [FROZEN, nnx.All(nnx.Param, FROZEN)])
def test_frozen_parts_have_no_moments_and_no_averages(filter_):
    """Also where the filter names the parameters alone."""
    graph, state = begin(two_parts.method(filter_), TrainConfig(ema=0.9, clip_norm=1.0))
    net = nnx.merge(graph, state.params, state.frozen, state.rest)
    assert names(state.frozen) == {n for n in names(nnx.state(net)) if n.startswith("upscaler")}
    assert names(state.params) == {
        "filler.conv.kernel",
        "filler.conv.bias",
        "filler.norm.scale",
        "filler.norm.bias",
    }
    assert all(name.startswith("filler") for name in names(state.average) | names(state.rest))
    paths = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(state.optimizer)]
    assert any("filler" in path for path in paths)
    assert not any("upscaler" in path for path in paths)
    assert net.upscaler.norm.use_running_average
    assert net.upscaler.dropout.deterministic
    assert not net.filler.norm.use_running_average


def test_a_checkpoint_holds_frozen_parts_once(trained):
    _, like = begin(two_parts.method(FROZEN), TrainConfig(ema=0.9, seed=1))
    with Checkpoints(trained / "checkpoints") as checkpoints:
        state, run = checkpoints.restore(like)
    arrays, _ = load_weights(trained / "weights.safetensors")
    kernel = state.frozen["upscaler"]["conv"]["kernel"][...]
    np.testing.assert_array_equal(kernel, arrays["upscaler.conv.kernel"])
    assert run["best_step"] in (0, 3)
    (checkpoint,) = (trained / "checkpoints").glob("3/_CHECKPOINT_METADATA")
    assert "sha256" in checkpoint.read_text()


def test_frozen_parameters_make_no_difference_to_the_gradient_norm(data):
    """The norm that is logged, and clipped, is that of what is learned."""
    method = two_parts.method(FROZEN)
    config = TrainConfig(batch=2, scale=2, crop=8)
    source = WindowSource(
        [data / "clip"], method.needs, two_parts.WINDOWS, scale=2, cache=data.parent / "cache"
    )
    loader = Loader(source, Stream(batch=2, crop=8))
    window = next(loader)
    loader.close()
    graph, state = begin(method, config)
    whole, _ = shardings(2, jax.local_devices()[:1])

    def total(params):
        return two_parts.loss(nnx.merge(graph, params, state.frozen, state.rest, copy=True), window)[0]

    expected = jnp.sqrt(sum(jnp.sum(g * g) for g in jax.tree.leaves(jax.jit(jax.grad(total))(state.params))))
    _, measured = make_step(method, graph, config, whole)(jax.device_put(state, whole), window)
    np.testing.assert_allclose(measured["grad_norm"], expected, rtol=1e-5)


def test_weights_without_random_streams_run():
    """A file of weights has none, and a method's steps do not draw."""
    net = nnx.state(two_parts.Net(nnx.Rngs(0)))
    shown = jnp.linspace(0, 1, 24).reshape(1, 2, 4, 3)
    made = [
        two_parts.module(state).upscale(shown, 2)
        for state in (net, nnx.filter_state(net, nnx.Not(nnx.RngState)))
    ]
    np.testing.assert_array_equal(*made)


def test_all_frozen_is_refused():
    with pytest.raises(JaxsrError, match="all of the network of 'two' is frozen"):
        begin(two_parts.method(True), TrainConfig())


# Windows with a cadence, from the sequence to the weights.


def test_a_cadence_trains_and_is_evaluated_apart(trained):
    with (trained / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["0", "3"]
    last = {k.removeprefix("eval/"): float(v) for k, v in rows[-1].items() if k.startswith("eval/")}
    assert set(last) == {f"{n}{k}" for n in ("psnr", "ssim") for k in ("", "_rendered", "_extrapolated")}
    assert last["psnr_rendered"] != last["psnr_extrapolated"]
    assert last["psnr"] == pytest.approx((last["psnr_rendered"] + last["psnr_extrapolated"]) / 2)
    assert {"loss/hr", "loss/lr"} <= set(rows[-1])
    _, header = load_weights(trained / "weights.safetensors")
    assert header["training"]["metrics"].keys() == last.keys()
    config = json.loads((trained / "config.json").read_text())
    assert config["config"]["best_by"] == "psnr"


def test_the_best_is_chosen_by_the_number_that_was_named(data, tmp_path):
    config = config_of(data, tmp_path / "out", best_by="psnr_extrapolated", eval_every=1)
    train(two_parts.method(FROZEN), config, quiet=True)
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["step"] != "0"]
    _, header = load_weights(tmp_path / "out" / "best.safetensors")
    best = max(rows, key=lambda row: float(row["eval/psnr_extrapolated"]))
    assert header["training"]["steps"] == int(best["step"])
    assert header["training"]["best_by"] == "psnr_extrapolated"


def test_what_is_measured():
    """The last frame of each kind that is not in the warm-up; none of them is trained on."""
    assert evaluation_windows(two_parts.WINDOWS).targets == (1, 2)
    assert held_back_frames(two_parts.WINDOWS) == 2
    long = Windows(6, (True, True, False, True, False, True), made=None)
    assert evaluation_windows(long).targets == (4, 5)
    assert evaluation_windows(long._replace(warmup=5)).targets == (5,)
    assert score_names(long._replace(warmup=5)) == ("psnr", "ssim")
    assert evaluation_windows(Windows(4, made=None)).targets == (3,)
    assert held_back_frames(Windows(4, made=None)) == 1
    with pytest.raises(JaxsrError, match="no frame of a window is left"):
        evaluation_windows(Windows(2, warmup=2))


def test_measured_frames_are_held_back(data, tmp_path):
    """Windows of three frames, two of which are measured: four frames are too few."""
    make_sequence(tmp_path / "short", frames=4, size=(32, 16))
    with pytest.raises(JaxsrError, match=r"hold back 2 frames for .*at least 5 frames; found 4"):
        train(two_parts.method(), config_of(tmp_path / "short", tmp_path / "out"), quiet=True)


# Parts to start from.


@pytest.fixture
def part_file(tmp_path):
    """The upscaler as a file of its own, of a method that is called otherwise, with every number 0.25."""
    state = nnx.state(two_parts.Net(nnx.Rngs(5)).upscaler, nnx.Not(nnx.RngState))
    file = tmp_path / "upscaler.safetensors"
    arrays = {name: np.full_like(x, 0.25) for name, x in flatten(state).items()}
    save_weights(file, arrays, new_header("other", {}, 2))
    return file


def test_a_part_starts_from_its_file(part_file):
    method = two_parts.method()
    weights, notes = initial_weights(method, (f"upscaler={part_file}",))
    _, state = begin(method, TrainConfig(), weights)
    _, fresh = begin(method, TrainConfig())
    assert not notes
    arrays, others = (flatten(nnx.filter_state(s.params, nnx.Param)) for s in (state, fresh))
    for name in arrays:
        expected = 0.25 if name.startswith("upscaler") else others[name]
        np.testing.assert_array_equal(arrays[name], np.broadcast_to(expected, arrays[name].shape))


def test_parts_and_the_whole_in_order(trained, part_file):
    """Later files replace earlier ones; a part may come from a file of the whole network."""
    method, whole = two_parts.method(), str(trained / "weights.safetensors")
    both, _ = initial_weights(method, (whole, f"upscaler={part_file}"))
    assert (both["upscaler"]["conv"]["kernel"][...] == 0.25).all()
    arrays, _ = load_weights(trained / "weights.safetensors")
    np.testing.assert_array_equal(both["filler"]["conv"]["kernel"][...], arrays["filler.conv.kernel"])
    one, _ = initial_weights(method, (f"filler.conv={whole}",))
    assert names(one) == {"filler.conv.kernel", "filler.conv.bias"}
    np.testing.assert_array_equal(one["filler"]["conv"]["kernel"][...], arrays["filler.conv.kernel"])
    assert initial_weights(method, ()) == (None, [])


def test_bad_parts_are_named(trained, part_file):
    method = two_parts.method()
    for text, message in (
        (
            f"frnet={part_file}",
            r"--init: the network of 'two' has no part 'frnet'; expected one of filler, upsc",
        ),
        (f"upscaler.x={part_file}", r"no part 'upscaler.x'; expected one of upscaler.conv, upscaler.norm"),
        (f"filler={part_file}", r"upscaler.safetensors: conv.kernel has another shape"),
        ("filler=none.safetensors", r"none.safetensors: no such file"),
        (str(part_file), r"weights of another method; expected two; found other"),
    ):
        with pytest.raises(JaxsrError, match=message):
            initial_weights(method, (text,))


def test_a_part_of_another_scale_or_other_settings_is_refused(part_file):
    method = two_parts.method()
    settings = {"width": 8, "eps": 0.1}
    method = method._replace(network=method.network._replace(settings=settings))
    init = (f"upscaler={part_file}",)
    assert initial_weights(method, init, 2)[0] is not None
    with pytest.raises(JaxsrError, match=r"part 'upscaler' .*expected scale 4; found scale 2"):
        initial_weights(method, init, 4)
    arrays, _ = load_weights(part_file)
    save_weights(part_file, arrays, new_header("other", {"width": 16, "depth": 3, "eps": 0.1}, 2))
    with pytest.raises(JaxsrError, match=r"safetensors: .*expected width 8; found width 16"):
        initial_weights(method, init, 2)


def test_files_and_parts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lr=3.safetensors").touch()
    assert parse("frnet.encoder=a/b=c.safetensors") == Source("frnet.encoder", Path("a/b=c.safetensors"))
    assert parse("runs/lr=1/w.safetensors").part == ""
    assert parse("lr=3.safetensors").part == ""
    assert parse("lr=4.safetensors").part == "lr"


def test_hashes_of_parts():
    assert same_hashes("abc frnet=def", "abc frnet=missing")
    assert not same_hashes("abc frnet=def", "frnet=missing abc")
    assert not same_hashes("frnet=def", "other=missing")
    assert not same_hashes("abc", None)
    assert same_hashes(None, None)


def test_the_hash_of_a_part_is_in_the_configuration(data, part_file, tmp_path):
    config = config_of(data, tmp_path / "out", steps=1, init=(f"upscaler={part_file}",))
    train(two_parts.method(FROZEN), config, quiet=True)
    record = json.loads((tmp_path / "out" / "config.json").read_text())
    part, _, digest = record["init"].partition("=")
    assert (part, len(digest)) == ("upscaler", 12)
    arrays, header = load_weights(tmp_path / "out" / "weights.safetensors")
    assert (arrays["upscaler.conv.kernel"] == 0.25).all()
    assert header["training"]["config"]["init"] == ["upscaler=upscaler.safetensors"]
