"""The networks that ship: their files, cards and committed numbers agree, and they win as README says."""

import atexit
import functools
import inspect
import json
import re
import shutil
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.fusion_sr import release, train_released
from experiments.fusion_sr.train_released import LOSS, OPTIONS, RUNS
from experiments.guided_unet import release as guided_unet_release
from jaxsr.data import analytic
from jaxsr.data.sample import sample_folder
from jaxsr.errors import JaxsrError
from jaxsr.io.archive import read_manifest, unpack_sequence
from jaxsr.io.sequence import Sequence
from jaxsr.methods import fusion_sr, guided, guided_taau, taau, to_json
from jaxsr.methods.legacy import upgrade
from jaxsr.metrics import psnr
from jaxsr.ops.demodulation import demodulation_divisor
from jaxsr.ops.encoding import normalized_depth
from jaxsr.runtime.load import find_method
from jaxsr.runtime.upscale import display
from jaxsr.weights.file import load_weights, save_weights

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = ROOT / "jaxsr" / "weights" / "released"


def numbers(name):
    """`{clip: {method: {metric: mean}}}` of the committed results."""
    document = json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())
    return {
        section["title"].split(",")[0]: {
            track["name"]: {key: value["mean"] for key, value in track["summary"]["all"].items()}
            for track in section["tracks"]
        }
        for section in document["sections"]
    }


def test_every_run_ships_and_nothing_else():
    assert {file.stem for file in WEIGHTS.glob("*.safetensors")} == {*RUNS, *guided_unet_release.RUNS}


@pytest.mark.parametrize("name", RUNS)
def test_a_network_is_small_and_is_that_of_its_run(name):
    file, run = WEIGHTS / f"{name}.safetensors", RUNS[name]
    assert file.stat().st_size <= release.MAX_MEGABYTES * 1e6
    _, head = load_weights(file)
    trained = head["training"]
    for option in (
        "steps",
        "batch",
        "crop",
        "scale",
        "learning_rate",
        "schedule",
        "clip_norm",
        "ema",
        "seed",
    ):
        assert trained["config"][option] == getattr(run.config, option), option
    assert trained["steps"] == run.config.steps
    assert head["format"] == 2
    assert head["settings"] == to_json(OPTIONS)
    assert trained["loss"] == to_json(LOSS)
    assert {clip.split("-")[0] for clip in trained["sequences"]} == set(run.scenes)
    assert all("-train-" in clip for clip in trained["sequences"])


@pytest.mark.parametrize("name", RUNS)
def test_a_network_beats_its_rivals_on_every_scene_of_its_own(name):
    for clip, methods in numbers(name).items():
        *rivals, network = methods
        assert rivals == list(release.RIVALS)
        for metric, sign in (("psnr", 1), ("ssim", 1), ("lpips", -1)):
            best = max(sign * methods[rival][metric] for rival in rivals)
            assert sign * methods[network][metric] > best, f"{clip}: {metric}"


@pytest.mark.parametrize("name", RUNS)
def test_the_card_has_the_numbers_of_the_results(name):
    card = (ROOT / "docs" / "models" / f"{name}.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in card.splitlines() if "` | " in line]
    found = {
        (clip, method.strip("`")): [float(c.split(" ")[0]) for c in cells] for clip, method, *cells in rows
    }
    expected = numbers(name)
    assert len(found) == sum(map(len, expected.values()))
    for clip, methods in expected.items():
        for method, values in methods.items():
            assert found[clip, method] == pytest.approx(list(values.values()), abs=6e-3)


@pytest.mark.parametrize("script", [train_released, release])
def test_an_unknown_run_is_an_error(script, tmp_path):
    with pytest.raises(JaxsrError, match=r"no run 'fusion-sr-x3'.*expected fusion-sr-x4"):
        script.main(("fusion-sr-x3",), runs=tmp_path)


def test_an_incomplete_training_set_is_an_error(tmp_path):
    with pytest.raises(JaxsrError, match=r"no training clip.*15 clips"):
        train_released.main(("fusion-sr-x4",), data=tmp_path, runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_run_that_has_not_ended_is_not_released(tmp_path, monkeypatch):
    """Weights are written at each evaluation; these are of the last one of a shorter run."""
    monkeypatch.setattr(release, "WEIGHTS", tmp_path / "shipped")
    run = tmp_path / "runs" / "fusion-sr-x4"
    run.mkdir(parents=True)
    shutil.copy(WEIGHTS / "fusion-sr-bunker-x4.safetensors", run / "weights.safetensors")
    with pytest.raises(JaxsrError, match=r"has not ended.*expected 2500 steps.*found 500"):
        release.main(runs=tmp_path / "runs")
    assert not (tmp_path / "shipped").exists()


def test_a_run_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(JaxsrError, match=r"weights\.safetensors"):
        release.main(("fusion-sr-x4",), runs=tmp_path)


# What the files make of frames.


@functools.cache
def clip(scene):
    """The first two frames of a scene's test clip, as a sequence; unpacked once."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    archive = sample_folder() / f"{scene}-test.jsrz"
    manifest, name = read_manifest(archive), f"sample/{scene}-test-0"
    head = manifest["sequences"][name]
    manifest["sequences"][name] = head | {"frames": head["frames"][:2]}
    return Sequence.open(unpack_sequence(archive, manifest, name, Path(folder.name) / f"{scene}-test-0"))


@functools.cache
def compiled(scale, settings):
    """The step for rendered frames; networks of equal settings share it."""
    name = next(n for n in RUNS if (RUNS[n].config.scale, settings_text(n)) == (scale, settings))
    method = find_method(name, scale).method
    return jax.jit(method.init), jax.jit(method.upscale)


def settings_text(name):
    return json.dumps(load_weights(WEIGHTS / f"{name}.safetensors")[1]["settings"], sort_keys=True)


@pytest.mark.parametrize("name", RUNS)
def test_the_file_makes_frames_as_good_as_committed(name):
    scale, scene = RUNS[name].config.scale, RUNS[name].scenes[0]
    document = json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())
    section = next(s for s in document["sections"] if s["meta"]["sequence"] == f"{scene}-test-0")
    expected = section["tracks"][-1]["metrics"]["psnr"]
    loaded, sequence = find_method(name, scale), clip(scene)
    init, upscale = compiled(scale, settings_text(name))
    for i in range(2):
        frame = jax.tree.map(jnp.asarray, sequence.frame(i, scale, needs=loaded.method.needs.of(True)))
        _, image = upscale(loaded.net, init(frame), frame)
        shown, truth = (display(np.asarray(x), sequence.exposure) for x in (image, sequence.truth(i)))
        assert section["frames"][i] == sequence.infos[i].index
        assert psnr(shown, truth) == pytest.approx(expected[i], abs=0.05)


def program(method, net):
    """The steps of a method as text, traced anew."""
    jax.clear_caches()
    frame = jax.tree.map(jnp.asarray, analytic.frame(0, (16, 8), 2, (0.3, -0.2))[0])
    state = jax.eval_shape(method.init, frame)
    steps = (method.upscale, method.extrapolate)
    return [re.sub(r"0x[0-9a-f]+", "", str(jax.make_jaxpr(f)(net, state, frame))) for f in steps]


def changed(monkeypatch, function, **values):
    """Give arguments of a function other defaults."""
    function = inspect.unwrap(function)
    names = list(inspect.signature(function).parameters)
    assert values.keys() <= set(names)
    keyword = dict(function.__kwdefaults__ or {})
    plain = list(function.__defaults__ or ())
    positional = function.__code__.co_varnames[: function.__code__.co_argcount][-len(plain) or None :]
    for name, value in values.items():
        if name in keyword:
            keyword[name] = value
        else:
            plain[positional.index(name)] = value
    monkeypatch.setattr(function, "__defaults__", tuple(plain))
    monkeypatch.setattr(function, "__kwdefaults__", keyword or None)


def test_a_file_holds_all_that_its_output_depends_on(tmp_path, monkeypatch):
    """Other defaults elsewhere change neither step; another value in the header does."""
    file = WEIGHTS / "fusion-sr-x2.safetensors"
    loaded = find_method(str(file), 2)
    before = program(loaded.method, loaded.net)
    arrays, head = load_weights(file)
    estimate = head["settings"]["estimate"]
    for settings in (
        {"eps": 0.05},
        {"depth_octaves": 8.0},
        {"estimate": estimate | {"sigma_guide": 0.25}},
        {"estimate": estimate | {"kernel_sigma": 0.25}},
        {"reprojection": head["settings"]["reprojection"] | {"sigma_guide": 0.5}},
    ):
        other = tmp_path / "other.safetensors"
        save_weights(other, arrays, head | {"settings": head["settings"] | settings})
        assert program(find_method(str(other), 2).method, loaded.net) != before, settings
    changed(monkeypatch, guided_taau.Upsampling.__init__, sigma_guide=0.25, depth_tolerance=0.1, eps=0.05)
    changed(monkeypatch, taau.Options.__init__, kernel_sigma=0.2, floor=0.1, box=3.0)
    changed(monkeypatch, guided.Options.__init__, sigma_guide=0.5, sigma_space=9.0, strides=(1,), eps=0.05)
    changed(monkeypatch, fusion_sr.Options.__init__, eps=0.05, depth_octaves=8.0, base="none")
    changed(monkeypatch, demodulation_divisor, eps=0.1)
    changed(monkeypatch, normalized_depth, octaves=8.0)
    again = find_method(str(file), 2)
    assert program(again.method, again.net) == before


def test_a_header_of_version_0_1_gives_the_same_method(tmp_path):
    """With the names and the few settings that it had; the constants are those of that version."""
    file, old = WEIGHTS / "fusion-sr-x4.safetensors", tmp_path / "old.safetensors"
    arrays, head = load_weights(file)
    arguments = {
        "architecture": "fusion",
        "buffers": ["depth", "base_color", "normal", "roughness", "metallic"],
        "color": "lighting",
        "compute": "float32",
        "down_kernel": 3,
        "follow_jitter": True,
        "fusion": "se-residual",
        "l1_weight": 1.0,
        "perceptual_crop": 48,
        "perceptual_weight": 0.2,
        "start": "guided",
    }
    save_weights(old, arrays, {"method": "fusion-sr", "arguments": arguments, "scale": 4, "jaxsr": "0.1.0"})
    new, found = find_method(str(file), 4), find_method(str(old), 4)
    assert found.method.network.settings == new.method.network.settings == head["settings"]
    jax.tree.map(np.testing.assert_array_equal, found.net, new.net)
    paper = {**arguments, "color": "display", "start": "nothing", "follow_jitter": False}
    settings = upgrade("fusion-sr", paper)
    assert [settings[k] for k in ("demodulated", "base", "unjitter")] == [False, "none", False]
    save_weights(old, arrays, {"method": "fusion-sr", "arguments": paper | {"sharp": 1}, "scale": 4})
    with pytest.raises(JaxsrError, match="no setting 'sharp' is known"):
        find_method(str(old), 4)
