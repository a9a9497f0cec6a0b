"""Training: the same to the bit however often it is killed, on two devices as on one, and clear errors."""

import dataclasses
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from jaxsr.data.loader import Loader, Stream
from jaxsr.data.windows import WindowSource
from jaxsr.errors import JaxsrError
from jaxsr.io.images import read_png
from jaxsr.methods import Network, fusion_sr, variant
from jaxsr.methods.image_loss import ImageLoss
from jaxsr.progress import Bar
from jaxsr.training import TrainConfig, checkpoints, command
from jaxsr.training import train as train_method
from jaxsr.training.checkpoints import Checkpoints
from jaxsr.training.data import open_data
from jaxsr.training.evaluate import Evaluator, evaluation_windows
from jaxsr.training.process import only_one
from jaxsr.training.record import Log, plot_curve
from jaxsr.training.state import begin, optimizer, schedule
from jaxsr.training.step import averaged, make_step, shardings
from jaxsr.weights.file import load_weights
from tests import tiny_method
from tests.builders import make_sequence
from tests.networks import SMALL
from tests.test_cli import error_line, run

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one sequence of five frames."""
    folder = tmp_path_factory.mktemp("train") / "data"
    make_sequence(folder / "clip", frames=5, scales=(2, 4))
    return folder


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A training that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "out"
    tiny_method.train(data, out)
    return out


def digest(out: Path, step: int = 12) -> str:
    """The hash of all arrays of a checkpoint: weights, optimiser, statistics, averages, random keys, step."""
    head = json.loads((out / "checkpoints" / str(step) / "_CHECKPOINT_METADATA").read_text())
    return head["custom_metadata"]["sha256"]


def rows(out: Path) -> list[dict[str, str]]:
    """The log, without the times."""
    lines = [line.split(",") for line in (out / "log.csv").read_text().splitlines()]
    return [{k: v for k, v in zip(lines[0], line, strict=True) if k != "seconds"} for line in lines[1:]]


def assert_same(a: Path, b: Path) -> None:
    """Both trainings made the same, to the bit."""
    assert digest(a) == digest(b)
    assert rows(a) == rows(b)
    for name in ("weights", "best"):
        x, y = (load_weights(out / f"{name}.safetensors")[0] for out in (a, b))
        assert x.keys() == y.keys()
        for key in x:
            np.testing.assert_array_equal(x[key], y[key])


def test_what_is_written(whole):
    assert rows(whole)[-1]["step"] == "12"
    steps = [int(row["step"]) for row in rows(whole) if row["eval/psnr"]]
    assert steps == [0, 4, 8, 12]
    for step in steps:
        assert read_png(whole / "pictures" / f"step-{step:06d}.png").shape == (40, 3 * 64, 3)
    assert (whole / "loss.png").stat().st_size > 1000
    assert list((whole / "tensorboard").iterdir())
    assert sorted(int(p.name) for p in (whole / "checkpoints").iterdir()) == [6, 9, 12]  # the last three
    arrays, header = load_weights(whole / "weights.safetensors")
    assert header["method"] == "tiny"
    assert header["training"]["steps"] == 12
    assert header["training"]["sequences"][0].startswith("clip ")
    assert not any("rngs" in name for name in arrays)
    config = json.loads((whole / "config.json").read_text())
    assert config["config"]["learning_rate"] == 1e-3
    assert config["made"]["jax"] == jax.__version__


def test_the_loss_falls(data, tmp_path):
    tiny_method.train(
        data, tmp_path / "out", steps=60, eval_every=60, save_every=60, learning_rate=3e-3, ema=0
    )
    losses = [float(row["loss"]) for row in rows(tmp_path / "out") if row["loss"]]
    assert losses[-1] < 0.7 * losses[0]


def test_run_again_is_the_same(whole, data, tmp_path):
    """And a finished training that is run again changes nothing."""
    tiny_method.train(data, tmp_path / "out")
    assert_same(tmp_path / "out", whole)
    before = (tmp_path / "out" / "weights.safetensors").read_bytes()
    tiny_method.train(data, tmp_path / "out")
    assert (tmp_path / "out" / "weights.safetensors").read_bytes() == before


def test_interrupt_saves_and_goes_on(whole, data, tmp_path, monkeypatch, capfd):
    """The step ends, a checkpoint is written, and the rest is as if nothing had happened."""
    update = Bar.update

    def interrupting(self, step, note):
        if step == 5:
            os.kill(os.getpid(), signal.SIGINT)
        update(self, step, note)

    out, before = tmp_path / "out", signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(Bar, "update", interrupting)
    with pytest.raises(KeyboardInterrupt):
        tiny_method.train(data, out)
    monkeypatch.undo()
    assert "once more stops at once" in capfd.readouterr().err
    stopped = max(int(p.name) for p in (out / "checkpoints").iterdir())
    assert stopped in (5, 6, 7)
    assert signal.getsignal(signal.SIGINT) == before
    tiny_method.train(data, out)
    assert digest(out) == digest(whole)


def child(data: Path, out: Path, *moment: str) -> int:
    environment = os.environ | {"XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "tests.tiny_method", str(data), str(out), *moment]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


@pytest.mark.slow
def test_killed_at_any_moment(data, tmp_path):
    """Five processes, of which four are killed, make what one makes."""
    one, many = tmp_path / "one", tmp_path / "many"
    assert child(data, one) == 0
    assert child(data, many, "--step", "2") == -signal.SIGKILL  # before the first checkpoint
    assert child(data, many, "--save", "6") == -signal.SIGKILL
    half = [p.name for p in (many / "checkpoints").iterdir() if "tmp" in p.name]
    assert len(half) == 1  # it was inside
    assert child(data, many, "--picture", "8") == -signal.SIGKILL  # released, but not yet saved
    assert not [p for p in (many / "checkpoints").iterdir() if "tmp" in p.name]
    assert child(data, many, "--step", "11") == -signal.SIGKILL
    assert child(data, many) == 0
    assert_same(one, many)


FUSION_SR = fusion_sr.method(loss=ImageLoss(perceptual_weight=0.0))


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(tiny_method.method(), id="tiny"),
        pytest.param(FUSION_SR, id="fusion-sr", marks=pytest.mark.slow),
        *(
            pytest.param(variant(name, SMALL[name] | {"scale": 2}), id=name, marks=pytest.mark.slow)
            for name in SMALL
        ),
    ],
)
def test_two_devices_train_as_one(data, method):
    """The same loss, gradient and statistics: those of the whole batch; dropout draws alike.

    Each step begins with the same weights on one and on two: Adam's first steps divide gradients by their own
    size, so that rounding decides where weights go whose gradient is nearly 0.
    """
    config = TrainConfig(batch=4, scale=2, crop=16, ema=0.9, clip_norm=1.0)
    windows = method.network.windows
    source = WindowSource([data / "clip"], method.needs, windows, scale=2, cache=data.parent / "cache")
    loader = Loader(source, Stream(batch=4, crop=16))
    batches = [next(loader) for _ in range(3)]
    loader.close()
    graphdef, start = begin(method, config)
    placed = [shardings(4, jax.local_devices()[:n]) for n in (1, 2)]
    updates = [make_step(method, graphdef, config, whole) for whole, _ in placed]
    for batch in batches:
        found = []
        for (whole, parts), update in zip(placed, updates, strict=True):
            state = jax.device_put(jax.tree.map(jnp.copy, start), whole)  # which the step gives away
            found.append(update(state, jax.device_put(batch, parts)))
        (one, loss_one), (two, loss_two) = found
        assert all(len(x.sharding.device_set) == 2 for x in jax.tree.leaves(two))
        np.testing.assert_allclose(float(loss_one["loss"]), float(loss_two["loss"]), atol=1e-6)
        moments = [optax.tree.get(s.optimizer, "mu") for s in (one, two)]
        norm = float(optax.tree.norm(moments[0]))
        assert norm > 0
        for got in zip(*map(jax.tree.leaves, moments), strict=True):
            np.testing.assert_allclose(*got, atol=1e-4 * norm)
        statistics = [nnx.filter_state(s.rest, nnx.Not(nnx.RngState)) for s in (one, two)]
        for got in zip(*map(jax.tree.leaves, statistics), strict=True):
            np.testing.assert_allclose(*got, rtol=1e-4, atol=1e-6)
        start = one


def test_batch_must_be_shared_out():
    with pytest.raises(JaxsrError, match="multiple of the 2 devices; found 3"):
        shardings(3)


def rate(t, **options):
    return float(schedule(TrainConfig(steps=200, **options))(t))


def test_schedules():
    assert rate(0) == pytest.approx(1e-3)
    assert rate(2) == pytest.approx(1e-3 * 0.98, rel=1e-5)  # an epoch is a hundredth
    assert rate(200) == pytest.approx(1e-3 * 0.98**100, rel=1e-4)
    assert rate(100, schedule="cosine") == pytest.approx(5e-4, rel=1e-4)
    assert rate(200, schedule="cosine") == pytest.approx(0, abs=1e-9)
    assert rate(150, schedule="constant") == pytest.approx(1e-3)


def test_schedules_that_hold():
    """Constant for the first steps; then as without a hold, over the steps that are left."""
    cosine = {"schedule": "cosine", "hold_steps": 50, "end_rate": 1e-6}
    found = [rate(t, **cosine) for t in (0, 49, 50, 51, 125, 199, 200)]
    assert found[:3] == [pytest.approx(1e-3)] * 3
    assert found[3] < found[2]
    assert found[4] == pytest.approx((1e-3 + 1e-6) / 2, rel=1e-4)
    assert found[5] == pytest.approx(1e-6, rel=0.15)
    assert found[6] == pytest.approx(1e-6, rel=1e-3)
    assert rate(49, hold_steps=50) == rate(50, hold_steps=50) == pytest.approx(1e-3)
    assert rate(200, hold_steps=50) == pytest.approx(1e-3 * 0.98**100, rel=1e-4)
    assert rate(199, hold_steps=199) == pytest.approx(1e-3)


def test_clipping():
    """A gradient longer than the bound counts as one of that length: Adam's first moment shows it."""
    gradient = {"w": jnp.array([30.0, 40.0])}
    tx = optimizer(TrainConfig(clip_norm=1.0))
    with jax.numpy_dtype_promotion("standard"):
        _, state = tx.update(gradient, tx.init(gradient), gradient)
    moment = jax.tree.leaves(state)[1]
    np.testing.assert_allclose(moment, [0.06, 0.08], rtol=1e-5)


def test_averages():
    old, new = {"w": jnp.array(1.0), "n": jnp.array(1)}, {"w": jnp.array(2.0), "n": jnp.array(2)}
    late = averaged(old, new, 0.9, jnp.array(10_000))
    assert float(late["w"]) == pytest.approx(1.1)
    assert int(late["n"]) == 2
    first = averaged(old, new, 0.9, jnp.array(0))
    assert float(first["w"]) == pytest.approx(1.9)  # (1 + 0) / (10 + 0) of the old


def test_averages_are_what_is_released(whole):
    arrays, _ = load_weights(whole / "weights.safetensors")
    _, like = begin(tiny_method.method(), TrainConfig(ema=0.9))
    with Checkpoints(whole / "checkpoints") as checkpoints:
        state, _ = checkpoints.restore(like)
    np.testing.assert_array_equal(arrays["conv1.kernel"], state.average["conv1"]["kernel"][...])
    np.testing.assert_array_equal(arrays["norm.var"], state.average["norm"]["var"][...])
    assert not np.array_equal(arrays["conv1.kernel"], state.params["conv1"]["kernel"][...])


def test_fine_tuning_starts_from_the_weights(whole, data, tmp_path):
    options = {"steps": 1, "init": (str(whole / "weights.safetensors"),), "ema": 0.0, "learning_rate": 1e-9}
    tiny_method.train(data, tmp_path / "out", **options)
    old, new = (load_weights(out / "weights.safetensors")[0] for out in (whole, tmp_path / "out"))
    np.testing.assert_allclose(new["conv1.kernel"], old["conv1.kernel"], atol=1e-7)


def test_fine_tuning_at_another_scale(whole, data, tmp_path):
    """Nothing in the weights depends on the scale."""
    options = {"steps": 1, "init": (str(whole / "weights.safetensors"),), "scale": 4, "learning_rate": 1e-9}
    tiny_method.train(data, tmp_path / "out", **options)
    arrays, header = load_weights(tmp_path / "out" / "weights.safetensors")
    assert header["scale"] == 4
    assert header["training"]["config"]["init"] == ["weights.safetensors"]
    assert header["training"]["best_by"] == "psnr"
    np.testing.assert_allclose(
        arrays["conv1.kernel"], load_weights(whole / "weights.safetensors")[0]["conv1.kernel"], atol=1e-7
    )


def test_weights_of_other_settings_are_noted(data, tmp_path, capsys):
    """Shapes can fit where the meaning does not."""
    old, new = (
        tiny_method.method()._replace(network=Network(tiny_method.Net, tiny_method.loss, settings=settings))
        for settings in (
            {"demodulated": False, "buffers": ["depth"]},
            {"demodulated": True, "buffers": ["depth"]},
        )
    )
    config = TrainConfig(data=(data,), out=tmp_path / "old", cache=data.parent / "cache", scale=2, crop=16)
    config = dataclasses.replace(config, steps=1, batch=2)
    file = train_method(old, config, quiet=True)
    train_method(new, dataclasses.replace(config, out=tmp_path / "new", init=(str(file),)))
    assert "weights.safetensors was made with other options: demodulated False -> True\n" in (
        capsys.readouterr().err
    )


@pytest.mark.slow
def test_the_sample_is_the_default(tmp_path):
    """Its training frames are unpacked into the cache, once."""
    out, cache = tmp_path / "out", tmp_path / "cache"
    config = TrainConfig(out=out, cache=cache, crop=16, batch=2, steps=1)
    train_method(tiny_method.method(), config, quiet=True)
    names = [text.split()[0] for text in json.loads((out / "config.json").read_text())["sequences"]]
    assert names == ["bunker-train-0", "docks-train-0", "forest-train-0"]
    (sample,) = cache.glob("sample-*")
    first = next(sample.glob("*/hr/*.exr")).stat().st_mtime_ns
    train_method(tiny_method.method(), config, quiet=True)
    assert next(sample.glob("*/hr/*.exr")).stat().st_mtime_ns == first


def test_the_last_frame_is_held_back(data):
    config = TrainConfig(data=(data,), cache=data.parent / "cache", scale=2, crop=16)
    loader, evaluate, _ = open_data(tiny_method.method(), config, quiet=True)
    loader.close()
    assert loader.windows == 4
    assert evaluate.frames == "clip 5, held back from training"


def evaluator(method, data, **options):
    windows = evaluation_windows(method.network.windows)
    source = WindowSource([data / "clip"], method.needs, windows, scale=2, cache=data.parent / "cache")
    return Evaluator(method, source, **options)


def test_any_window_is_measured_where_the_sequences_are_others(data):
    method = tiny_method.method(window=2)
    assert evaluator(method, data).frames == "clip 2, clip 3, clip 4, clip 5"  # the last of each of 4 windows


def test_a_window_is_history(data):
    """A method with a state sees the frames before the one that is measured, the first of them as a reset."""
    seen = []

    def upscale(net, state, frame):
        jax.debug.callback(lambda reset, n: seen.append((bool(reset), int(n))), frame.reset, state)
        return state + 1, jnp.ones_like(frame.hr.base_color)

    method = tiny_method.method(window=3)._replace(
        init=lambda frame: jnp.where(frame.reset, jnp.int32(0), jnp.int32(-1)), upscale=upscale
    )
    found = evaluator(method, data, last_only=True)(None)
    jax.effects_barrier()
    assert seen == [(True, 0), (False, 1), (False, 2)]
    assert found.picture.shape == (40, 3 * 64, 3)


def copied(whole: Path, tmp_path: Path) -> Path:
    out = tmp_path / "copy"
    shutil.copytree(whole, out)
    return out


class TestErrors:
    """One line that names the place and the remedy."""

    def test_another_configuration(self, whole, data, tmp_path):
        out = copied(whole, tmp_path)
        with pytest.raises(
            JaxsrError, match=r"steps: 12 -> 20, learning_rate: 0.001 -> 0.01; choose another"
        ):
            tiny_method.train(data, out, steps=20, learning_rate=1e-2)
        assert digest(out) == digest(whole)

    def test_another_truth(self, tmp_path):
        """The truth is in config.json and in the weights, and the same "best" may mean another one later."""
        make_sequence(tmp_path / "data" / "clip", frames=2, reference=True)
        out = tmp_path / "out"
        tiny_method.train(tmp_path / "data", out, steps=1)
        assert json.loads((out / "config.json").read_text())["config"]["truth"] == "reference"
        _, header = load_weights(out / "weights.safetensors")
        assert header["training"]["config"]["truth"] == "reference"
        tiny_method.train(tmp_path / "data", out, steps=1, truth="reference")
        with pytest.raises(JaxsrError, match=r"truth: reference -> color; choose another"):
            tiny_method.train(tmp_path / "data", out, steps=1, truth="color")

    def test_no_such_truth(self, data, tmp_path):
        with pytest.raises(JaxsrError, match=r"frame 1 has no truth.*layer reference"):
            tiny_method.train(data, tmp_path / "out", truth="reference")

    def test_an_old_training_had_the_color_as_its_truth(self, whole, data, tmp_path):
        out = copied(whole, tmp_path)
        record = json.loads((out / "config.json").read_text())
        assert record["config"].pop("truth") == "color"
        (out / "config.json").write_text(json.dumps(record))
        tiny_method.train(data, out)
        assert digest(out) == digest(whole)

    def test_what_may_change(self, whole, data, tmp_path):
        """Intervals, and where the data lie."""
        moved, out = tmp_path / "elsewhere", copied(whole, tmp_path)
        shutil.copytree(data, moved)
        shutil.rmtree(out / "checkpoints" / "12")  # as if it had been killed before the last one
        tiny_method.train(moved, out, eval_every=5, save_every=7)
        assert digest(out) == digest(whole)

    def test_weights_that_it_began_with(self, whole, data, tmp_path):
        """Their numbers count, until there is a checkpoint; then the file may go."""
        file, out = tmp_path / "first.safetensors", tmp_path / "out"
        shutil.copy(whole / "weights.safetensors", file)
        tiny_method.train(data, out, steps=2, init=(str(file),))
        moved = file.rename(tmp_path / "moved.safetensors")
        tiny_method.train(data, out, steps=2, init=(str(moved),))
        tiny_method.train(data, out, steps=2, init=(str(file),))
        with pytest.raises(JaxsrError, match=r"init: \w{12} -> null"):
            tiny_method.train(data, out, steps=2)
        shutil.copy(out / "weights.safetensors", file)
        with pytest.raises(JaxsrError, match=r"init: \w{12} -> \w{12}"):
            tiny_method.train(data, out, steps=2, init=(str(file),))
        with pytest.raises(JaxsrError, match=r"none.safetensors: no such file"):
            tiny_method.train(data, tmp_path / "new", steps=2, init=(str(tmp_path / "none.safetensors"),))

    def test_other_data(self, whole, tmp_path):
        make_sequence(tmp_path / "data" / "other", frames=4)
        with pytest.raises(JaxsrError, match=r"sequences: .*clip .* -> .*other"):
            tiny_method.train(tmp_path / "data", copied(whole, tmp_path))

    def test_folder_with_other_things(self, data, tmp_path):
        (tmp_path / "thesis.txt").write_text("precious")
        with pytest.raises(JaxsrError, match=r"holds no training; found thesis.txt"):
            tiny_method.train(data, tmp_path)

    def test_bad_config_json(self, whole, data, tmp_path):
        out = copied(whole, tmp_path)
        (out / "config.json").write_text("{}")
        with pytest.raises(JaxsrError, match=r"config.json: not the description"):
            tiny_method.train(data, out)

    def test_bad_log(self, whole, data, tmp_path):
        out = copied(whole, tmp_path)
        (out / "log.csv").write_text("a,b\nc,d\n")
        with pytest.raises(JaxsrError, match=r"log.csv: not the log"):
            tiny_method.train(data, out)

    def test_checkpoint_of_another_version(self, whole, data, tmp_path, monkeypatch):
        out = copied(whole, tmp_path)
        named = checkpoints._named
        monkeypatch.setattr(checkpoints, "_named", lambda state: [(f"new.{n}", x) for n, x in named(state)])
        words = r"checkpoints/12: the checkpoint is of another version of jaxsr.*with --init"
        with pytest.raises(JaxsrError, match=words):
            tiny_method.train(data, out)

    @pytest.mark.parametrize("damage", ["gone", "metadata", "truncated", "bits"])
    def test_damaged_checkpoint(self, whole, data, tmp_path, damage, capfd):
        out = copied(whole, tmp_path)
        last = out / "checkpoints" / "12"
        if damage == "gone":
            shutil.rmtree(last / "state")
        elif damage == "metadata":
            (last / "_CHECKPOINT_METADATA").write_text("{{{")
        else:
            for file in last.rglob("d/*"):
                content = bytearray(file.read_bytes())
                if damage == "truncated":
                    content = content[:50]
                else:
                    content[len(content) // 3 :: 97] = bytes(len(content[len(content) // 3 :: 97]))
                file.write_bytes(content)
        with pytest.raises(
            JaxsrError, match=r"checkpoints/12: the checkpoint is damaged.*delete that folder"
        ):
            tiny_method.train(data, out)
        assert "Traceback" not in capfd.readouterr().err
        if damage == "gone":
            shutil.rmtree(last)  # what the error says
            tiny_method.train(data, out)
            assert digest(out) == digest(whole)

    def test_half_deleted_old_checkpoint(self, whole, data, tmp_path):
        """Killed while an old one was removed: nothing is lost."""
        out = copied(whole, tmp_path)
        shutil.rmtree(out / "checkpoints" / "6" / "state")
        tiny_method.train(data, out)

    def test_diverged(self, data, tmp_path):
        def loss(net, window):
            total, parts = tiny_method.loss(net, window)
            return total * jnp.where(net.dropout.rngs.count[...] > 4, jnp.nan, 1.0), parts

        config = TrainConfig(
            data=(data,),
            out=tmp_path / "out",
            cache=data.parent / "cache",
            scale=2,
            crop=16,
            batch=2,
            save_every=2,
        )
        with pytest.raises(
            JaxsrError,
            match=r"step 5: the training diverged.*loss nan.*checkpoint of step 4 is kept.*--clip-norm",
        ):
            train_method(tiny_method.method(loss), config, quiet=True)
        assert (tmp_path / "out" / "checkpoints" / "4").is_dir()

    @pytest.mark.parametrize("bytes_", [100, 1000, 3000, 30_000])
    def test_no_room(self, whole, data, tmp_path, bytes_, capfd):
        """No file may grow larger: one line says which; with room again it goes on as if nothing had been."""
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_, hard))
            with pytest.raises(JaxsrError, match=r"out/.*cannot be written|out/.*cannot write") as error:
                tiny_method.train(data, tmp_path / "out")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "File too large" in str(error.value)
        assert "Traceback" not in capfd.readouterr().err
        tiny_method.train(data, tmp_path / "out")
        assert_same(tmp_path / "out", whole)

    def test_without_lpips(self, capsys, tmp_path, monkeypatch):
        """At once: nothing was unpacked or converted."""
        monkeypatch.setattr("jaxsr.nets.vgg.installed", lambda: False)
        line = error_line(
            capsys, "train", "fusion-sr", "--out", tmp_path / "out", "--cache", tmp_path / "cache"
        )
        assert "jaxsr[perceptual]" in line
        assert "--perceptual-weight 0" in line
        assert not list(tmp_path.iterdir())

    def test_two_at_once(self, whole, data, tmp_path):
        with only_one(whole), pytest.raises(JaxsrError, match="another process trains"):
            tiny_method.train(data, whole)

    def test_weights_of_another_method(self, whole, data, tmp_path):
        other = tiny_method.method()._replace(name="other")
        config = TrainConfig(data=(data,), out=tmp_path / "out", init=(str(whole / "weights.safetensors"),))
        with pytest.raises(JaxsrError, match="weights of another method; expected other; found tiny"):
            train_method(other, config, quiet=True)

    def test_trained_on_what_is_evaluated(self, data, tmp_path):
        with pytest.raises(JaxsrError, match="clip: is in --data and in --eval-data"):
            tiny_method.train(data, tmp_path / "out", eval_data=(data / "clip",))
        copy = shutil.copytree(data / "clip", tmp_path / "copy" / "clip")
        with pytest.raises(JaxsrError, match="clip: is in --data and in --eval-data"):
            tiny_method.train(data, tmp_path / "out", eval_data=(copy,))

    def test_too_short(self, tmp_path):
        make_sequence(tmp_path / "clip", frames=1)
        with pytest.raises(JaxsrError, match=r"too short to hold.*at least 2 frames; found 1.*--eval-data"):
            tiny_method.train(tmp_path / "clip", tmp_path / "out")

    def test_nothing_to_learn(self, tmp_path):
        method = tiny_method.method()._replace(network=None)
        with pytest.raises(JaxsrError, match="learns nothing"):
            train_method(method, TrainConfig(out=tmp_path), quiet=True)

    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            ([], "no method to train"),
            (["magic"], "no method 'magic' that learns; expected one of fusion-sr"),
            (["fusion-sr", "--data", "nowhere"], "nowhere: no such folder"),
            (["fusion-sr", "--steps", "0"], "--steps: bad steps; expected a whole number from 1; found 0"),
            (["fusion-sr", "--crop", "30"], "--crop: bad crop; expected a multiple of the scale 4"),
            (["fusion-sr", "--learning-rate", "-1"], "--learning-rate: bad learning_rate"),
            (["fusion-sr", "--learning-rate", "nan"], "--learning-rate: bad learning_rate"),
            (["fusion-sr", "--ema", "1"], "--ema: bad ema"),
            (["fusion-sr", "--clip-norm", "-1"], "--clip-norm"),
            (["fusion-sr", "--eval-every", "0"], "--eval-every"),
            (["fusion-sr", "--hold-steps", "500"], "--hold-steps: bad hold_steps; expected 0, or fewer than"),
            (
                ["fusion-sr", "--end-rate", "1e-6"],
                "--end-rate: bad end_rate; expected 0, unless --schedule cos",
            ),
            (
                ["fusion-sr", "--schedule", "cosine", "--end-rate", "1"],
                "--end-rate: bad end_rate; expected a number from 0 to the learning rate 0.001",
            ),
            (
                ["fusion-sr", "--best-by", "psnr_extrapolated"],
                "--best-by: the evaluation of 'fusion-sr' has no",
            ),
            (["fusion-sr", "--batch", "3"], "--batch: the batch cannot be shared out"),
            (["fusion-sr", "--init", "nothing.safetensors"], "nothing.safetensors"),
        ],
    )
    def test_arguments(self, capsys, tmp_path, arguments, expected):
        more = ["--out", tmp_path / "out"] if arguments[1:] else []
        assert expected in error_line(capsys, "train", *arguments, *more)
        assert not (tmp_path / "out").exists()


def test_old_names_of_options_still_work(capsys):
    old = [
        "--color",
        "lighting",
        "--start=nothing",
        "--no-follow-jitter",
        "--compute",
        "bfloat16",
        "--steps",
        "3",
    ]
    new = ["--demodulated", "--base", "none", "--no-unjitter", "--dtype", "bfloat16", "--steps", "3"]
    assert command._renamed(old) == new
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "jaxsr train: --color is now --demodulated; the old name will go"
    assert len(lines) == 4
    assert command._renamed(["--color=display"]) == ["--no-demodulated"]
    assert command._renamed(old, own=("color", "start", "no_follow_jitter", "compute")) == old
    with pytest.raises(JaxsrError, match="--color: bad color; expected display or lighting; found hdr"):
        command._renamed(["--color", "hdr"])


def test_a_killed_log_loses_no_row(tmp_path):
    """What lies past the checkpoint goes, and so does half a line; what lies before stays as it was."""
    log = Log(tmp_path, 0)
    log.add({"step": 10, "loss": 0.5})
    log.add({"step": 20, "loss": 0.25, "eval/psnr": 20.0})
    log.close()
    file = tmp_path / "log.csv"
    before = file.read_text()
    file.write_text(before + "30,0.125,\n4")
    log = Log(tmp_path, 20)
    log.close()
    assert file.read_text() == before == "step,loss,eval/psnr\n10,0.5,\n20,0.25,20.0\n"


@pytest.mark.parametrize("count", [0, 1, 100])
def test_curve(tmp_path, count):
    plot_curve(tmp_path / "loss.png", [{"step": k, "loss": 1.0 / (k + 1)} for k in range(count)])
    assert read_png(tmp_path / "loss.png").shape[-1] == 3


def test_checkpoint_holds_random_keys(tmp_path):
    _, state = begin(tiny_method.method(), TrainConfig(ema=0.5))
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        assert checkpoints.latest is None
        checkpoints.save(state, {"data": {"position": 7}, "best": None})
        _, other = begin(tiny_method.method(), TrainConfig(ema=0.5, seed=1))
        restored, run_ = checkpoints.restore(other)
    assert run_ == {"data": {"position": 7}, "best": None}
    for a, b in zip(jax.tree.leaves(restored), jax.tree.leaves(state), strict=True):
        assert a.dtype == b.dtype
        pair = [
            jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
            for x in (a, b)
        ]
        np.testing.assert_array_equal(*pair)


def test_help(capsys):
    status, out, _ = run(capsys, "train", "--help")
    assert status == 0
    assert "fusion-sr" in out
    status, out, _ = run(capsys, "train", "fusion-sr", "--help")
    assert status == 0
    assert "--learning-rate" in out
    assert "--fusion" in out


@pytest.mark.slow
def test_command_line(capsys, data, tmp_path):
    """`jaxsr train fusion-sr`, and the same command again."""
    options = ["--data", data, "--out", tmp_path / "out", "--cache", tmp_path, "--scale", 2, "--steps", 2]
    options += ["--crop", 16, "--batch", 2, "--perceptual-weight", 0, "--fusion", "add"]
    options += ["--compute", "bfloat16"]
    status, out, err = run(capsys, "train", "fusion-sr", *options)
    assert status == 0, err
    assert "jaxsr upscale SEQ --method" in out
    assert "step 1: loss" in err
    assert "compiled in" in err
    status, _, err = run(capsys, "train", "fusion-sr", *options)
    assert status == 0
    assert "resuming after step 2 of 2" in err
    line = error_line(capsys, "train", "fusion-sr", *options, "--fusion", "concat")
    assert "fusion: add -> concat" in line
