"""The experiments of the fusion paper: what is trained, the tables, and the page with their numbers."""

import dataclasses
import importlib.util
import json

import jax
import numpy as np
import pytest
from flax import nnx

from experiments.fusion_sr import flicker, rates, study, tables, timing
from jaxsr.errors import JaxsrError
from jaxsr.io.images import read_png
from jaxsr.methods import LEARNED
from jaxsr.runtime.cost import count_parameters
from jaxsr.runtime.load import find_method
from jaxsr.runtime.stream import stream
from jaxsr.training import TrainConfig, train
from tests.builders import make_sequence

LEARNING = [name for name, variant in study.VARIANTS.items() if variant.changes is not None]

WEIGHTS = {
    "rcan": 2_009_235,
    "nsrr": 547_767,
    "rrn": 501_936,
    "fusion": 418_619,
    "fusion-guided": 418_616,
    "fusion-zero": 418_619,
    "concat": 358_363,
    "add": 318_939,
    "unet": 506_907,
    "depth-only": 418_627,
    "no-base-color": 418_622,
    "no-normal": 418_622,
    "no-depth": 418_620,
    "no-roughness": 418_620,
    "no-metallic": 418_620,
}
"""Learned numbers, as the measured files have them too."""


def made(name, seed=0, psnr=20.0, **changes):
    """A file of `study.py`, all of whose frames have the same numbers."""
    metrics = {"psnr": [psnr] * 4, "ssim": [0.5] * 4, "tpsnr": [None, psnr, psnr, psnr]}
    scene = {"sequence": "s", "frames": [5, 6, 7, 8], "metrics": metrics, "regions": {"edges": metrics}}
    found = {
        "name": name,
        "scenes": dict.fromkeys(tables.SCENES, scene),
        "measured": {"display": "sRGB", "date": "2026-01-01", "commit": "abc"},
        "cost": {"parameters": 7, "multiply_adds_per_px": 8.0},
    }
    if study.VARIANTS[name].changes is not None:
        network = study.VARIANTS[name].build().network
        config = {"steps": 3, "batch": 1, "crop": 8, "scale": 4, "learning_rate": 1e-3}
        found |= {
            "seed": seed,
            "config": config | {"schedule": "cosine", "clip_norm": 1.0},
            "settings": json.loads(json.dumps(dict(network.settings))),
            "loss": json.loads(json.dumps(dict(network.loss_settings))),
            "sequences": ["clip hash"],
            "trained": {"commit": "abc", "device": "cpu", "seconds": 3600},
        }
    return found | changes


@pytest.mark.parametrize("file", sorted(study.RESULTS.glob("*-s[0-9].json")), ids=lambda file: file.stem)
def test_the_settings_in_the_committed_files_are_those_of_the_study(file):
    """Also where version 0.1 wrote them, under other names."""
    run = json.loads(file.read_text())
    network = study.VARIANTS[run["name"]].build().network
    assert study.settings_of(run) == {**network.settings, **network.loss_settings}


@pytest.mark.parametrize("name", LEARNING)
def test_a_variant_is_the_network_that_its_label_says(name):
    method = study.VARIANTS[name].build()
    state = nnx.eval_shape(lambda: nnx.state(method.network.new(nnx.Rngs(0))))
    count = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.filter_state(state, nnx.Param)))
    assert count == WEIGHTS[name]
    seen = {
        word for word in ("depth", "base-color", "normal", "roughness", "metallic") if f"no-{word}" == name
    }
    if seen:
        assert not {f"hr.{word.replace('-', '_')}" for word in seen} & method.needs.rendered
    loss = method.network.loss_settings
    assert (loss["ssim_weight"], loss["l1_weight"], loss["perceptual_weight"]) == (1, 1, 0)
    assert method.network.windows.length == 5
    assert loss.get("frames", 5) == 5


def test_names_are_checked_before_any_work(tmp_path):
    with pytest.raises(JaxsrError, match=r"no variant 'rcam'.*expected bicubic"):
        study.main(("rcam",), results=tmp_path)
    with pytest.raises(JaxsrError, match=r"no table 'table9'.*expected table1"):
        tables.main(("table9",))


def test_an_incomplete_training_set_is_an_error(tmp_path):
    with pytest.raises(JaxsrError, match=r"no training clip.*9 clips.*--clips 3"):
        study.main(("fusion",), data=tmp_path, runs=tmp_path / "runs", results=tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_what_has_numbers_is_not_made_again(tmp_path, capsys):
    study.results_file("taau", 0, tmp_path).write_text("{}")
    study.main(("taau",), results=tmp_path)
    assert "all is there" in capsys.readouterr().out
    assert study.results_file("taau", 0, tmp_path).read_text() == "{}"


def test_a_number_is_the_mean_over_frames_then_seeds():
    runs = [made("fusion", 0, 20.0), made("fusion", 1, 21.0)]
    assert tables.value(runs, "docks", "psnr") == (20.5, 0.5, 2)
    assert tables.value(runs, "docks", "tpsnr", "edges") == (20.5, 0.5, 2)
    assert tables.value(runs, "docks", "lpips") is None
    assert tables.shown(tables.value(runs, "docks", "psnr"), "psnr") == "20.50 ± 0.50"
    assert tables.shown(tables.value(runs[:1], "docks", "psnr"), "psnr") == "20.00"


def test_a_table_has_the_papers_numbers_beside_ours():
    runs = {name: [made(name, psnr=20.0 - (name == "nsrr"))] for name in tables.TABLES["table5"].variants}
    found = tables.document("table5", runs)
    lines = tables.markdown(found)
    assert "| docks | NSRR | 19.00 | 20.79 | -1.00 | 0.5000 | 0.7006 | 19.00 | 7 | 8 |" in lines
    assert (
        "| docks | fusion, residuals from 0 | 20.00 | 25.37 |  | 0.5000 | 0.8705 | 20.00 | 7 | 8 |" in lines
    )
    assert "3 steps of 1 crops of 8 px from 1 clips" in lines[-1]
    assert "commit abc" in lines[-1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": made("nsrr")["config"] | {"steps": 4}}, "options of nsrr"),
        ({"config": made("nsrr")["config"] | {"flips": False}}, "options of nsrr"),
        ({"sequences": ["clip other"]}, "training clips of nsrr"),
        ({"settings": made("nsrr")["settings"] | {"previous": 3}}, "nsrr was another network"),
        ({"loss": made("nsrr")["loss"] | {"l1_weight": 0.5}}, "nsrr was another network"),
        ({"measured": {"display": "linear", "date": "", "commit": None}}, "display of nsrr"),
        ({"seed": 1}, "no seed that all were trained with"),
    ],
)
def test_a_table_of_unequal_runs_is_an_error(changes, message):
    runs = {name: [made(name)] for name in tables.TABLES["table5"].variants}
    runs["nsrr"] = [made("nsrr", **changes)]
    with pytest.raises(JaxsrError, match=message):
        tables.document("table5", runs)


def test_a_table_has_the_seeds_that_all_have():
    runs = {name: [made(name, 0), made(name, 1, 30.0)] for name in tables.TABLES["table5"].variants}
    runs["nsrr"] = runs["nsrr"][:1]
    found = tables.document("table5", runs)
    assert found["seeds"] == {"depth-only": [0], "nsrr": [0], "fusion-zero": [0]}
    assert found["scenes"]["docks"]["fusion-zero"]["measured"]["psnr"]["mean"] == 20
    runs["nsrr"].append(made("nsrr", 1, 30.0))
    assert tables.document("table5", runs)["scenes"]["docks"]["fusion-zero"]["measured"]["psnr"]["mean"] == 25


def test_differences_are_seed_against_seed():
    ours = [made("concat", 0, 20.0), made("concat", 1, 23.0)]
    fusion = [made("fusion", 0, 21.0), made("fusion", 1, 22.0)]
    assert tables.difference(ours, fusion, "docks") == (0.0, 1.0, 2)
    assert tables.difference([made("taau", psnr=20.0)], fusion, "docks") == (-1.5, 0.5, 2)
    assert tables.difference(fusion, fusion, "docks") is None


def test_learning_rates_are_those_that_were_best():
    """Of each architecture; others have that of theirs."""
    files = {file.stem: json.loads(file.read_text()) for file in (study.RESULTS / "rates").glob("*.json")}
    assert {file["name"] for file in files.values()} == set(rates.ARCHITECTURES)
    for name in rates.ARCHITECTURES:
        ssim = {
            f["config"]["learning_rate"]: f["curve"][-1]["eval/ssim"]
            for f in files.values()
            if f["name"] == name
        }
        assert len(ssim) > 1
        assert study.VARIANTS[name].learning_rate == max(ssim, key=ssim.get), name


def test_a_table_without_a_run_names_the_command():
    with pytest.raises(JaxsrError, match=r"no numbers of depth-only, nsrr.*study.py depth-only nsrr"):
        tables.document("table5", {"fusion-zero": [made("fusion-zero")]})


def test_the_page_keeps_what_is_around_a_table():
    page = "before\n<!-- t -->\nold\n<!-- end of t -->\nafter"
    new = tables.on_page(page, "t", ["new"])
    assert new == "before\n<!-- t -->\nnew\n<!-- end of t -->\nafter"
    with pytest.raises(JaxsrError, match=r"no place for u.*<!-- u -->"):
        tables.on_page(page, "u", [])


def block(name):
    """What the page has between the marks of a table."""
    page = tables.PAGE.read_text(encoding="utf-8")
    return page.partition(f"<!-- {name} -->\n")[2].partition(f"<!-- end of {name} -->")[0].splitlines()


@pytest.mark.parametrize("name", tables.TABLES)
def test_the_page_has_the_numbers_of_the_files(name):
    if not (tables.RESULTS / f"{name}.json").is_file():
        assert block(name) == ["Not measured yet."]
        return
    found = tables.document(name, tables.load())
    assert json.loads((tables.RESULTS / f"{name}.json").read_text()) == json.loads(json.dumps(found))
    lines = tables.markdown(found)
    assert block(name)[: len(lines)] == lines


@pytest.mark.parametrize("name", ["figure9", "runtime", "table2"])
def test_the_page_has_the_numbers_of_flicker_and_timing(name):
    files = {"figure9": "flicker", "runtime": "runtime", "table2": "render"}
    file = tables.RESULTS / f"{files[name]}.json"
    if not file.is_file():
        assert block(name) == ["Not measured yet."]
        return
    found = json.loads(file.read_text())
    if name == "figure9":
        lines = flicker.table(found["shares"], found["tiles"])
    elif name == "runtime":
        lines = timing.runtime_table(found["methods"], found["about"])
    else:
        runtime = json.loads((tables.RESULTS / "runtime.json").read_text())
        lines = timing.render_table(found["seconds"], found["about"], runtime)
    assert block(name)[: len(lines)] == lines


def test_old_colour_is_told_from_an_average_and_blur_is_neither():
    tile, grey, nowhere = flicker.TILE, np.full((48, 48, 3), 0.5), np.zeros((48, 48), bool)

    def lit(*color):
        image = grey.copy()
        image[:tile, : 2 * tile] = color  # a lamp on two tiles
        return image

    red, blue, mean = lit(0.8, 0.5, 0.5), lit(0.4, 0.5, 0.9), lit(0.6, 0.6, 0.6)
    lamp = flicker.lamp(red, blue, nowhere)
    assert lamp.lit.sum() == 2
    assert lamp.lit[0, :2].all()

    def shares(image, lamp=lamp):
        return flicker.shares([image], [lamp], flicker.tile_means(mean))

    assert shares(red) == (0, 0)
    assert shares(blue) == pytest.approx((1, 0), abs=1e-4)
    assert shares(mean) == pytest.approx((0, 1), abs=1e-4)
    assert shares(0.7 * red + 0.2 * blue + 0.1 * mean) == pytest.approx((0.2, 0.1), abs=1e-4)
    assert shares(red + 0.1 * np.resize([1, -1], (48, 1))) == pytest.approx((0, 0), abs=1e-4)
    hidden = nowhere.copy()
    hidden[: tile // 2] = True
    assert shares(blue, flicker.lamp(red, blue, hidden)) is None


def test_a_clip_without_a_lamp_is_an_error(tmp_path):
    still = make_sequence(tmp_path / "clip", frames=2, scales=(4,), size=(64, 48), still=True, frozen=True)
    with pytest.raises(JaxsrError, match="no lamp"):
        flicker.lamps(still)


def test_frames_that_are_not_there_name_the_command(tmp_path):
    with pytest.raises(JaxsrError, match=r"no frames of nsrr.*expected 8 frames.*study.py nsrr"):
        flicker.frames_of("nsrr", tmp_path, "bunker-test-0", 8)


@pytest.fixture
def example():
    """The worked example; what it adds is taken away again."""
    file = study.ROOT / "experiments" / "examples" / "add_a_method.py"
    assert len(file.read_text().splitlines()) < 60
    before = dict(LEARNED)
    spec = importlib.util.spec_from_file_location("add_a_method", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    LEARNED.clear()
    LEARNED.update(before)


def test_the_worked_example_trains_and_runs(example, tmp_path):
    sequence = make_sequence(tmp_path / "clip", frames=3, scales=(4,), size=(64, 48))
    config = {"steps": 2, "batch": 2, "crop": 32, "out": tmp_path / "out", "cache": tmp_path / "cache"}
    weights = train(example.MINE, TrainConfig(data=(tmp_path / "clip",), **config), quiet=True)
    ready = find_method(str(weights), 4)
    assert count_parameters(ready.net) == 9 * 9 * 16 + 16 + 9 * 16 * 3 + 3
    images = [out.image for out in stream(ready.method, (sequence.frame(i, 4) for i in range(3)), ready.net)]
    assert all(image.shape == (48, 64, 3) and np.isfinite(image).all() for image in images)


@pytest.mark.slow
def test_from_clips_to_a_table(tmp_path, monkeypatch):
    """Train, measure, tabulate: two networks for two steps on tiny clips; all again makes nothing anew."""
    clips = [tmp_path / f"{scene}-test-0" for scene in tables.SCENES]
    for clip in clips:
        make_sequence(clip, frames=6, scales=(4,), size=(64, 48))
    monkeypatch.setattr(study, "training_clips", lambda data: tuple(clips))
    budget = {"steps": 2, "batch": 2, "crop": 32, "eval_every": 2, "cache": tmp_path / "cache"}
    monkeypatch.setattr(study, "BUDGET", dataclasses.replace(study.BUDGET, **budget))

    def sample(out, split, scenes=(), scale=None):
        return [clip for clip in clips if not scenes or clip.name.split("-")[0] in scenes]

    for module in (study, tables):
        monkeypatch.setattr(module, "unpack_sample", sample)
    results, runs, page, images = (tmp_path / name for name in ("results", "runs", "page.md", "images"))
    monkeypatch.setattr(tables, "RESULTS", results)
    monkeypatch.setattr(tables, "PAGE", page)
    monkeypatch.setattr(tables, "IMAGES", images)
    table = tables.Table("Test", ("taau", "add", "fusion"), {}, ("docks",))
    monkeypatch.setitem(tables.TABLES, "test", table)
    page.write_text("<!-- test -->\n<!-- end of test -->\n")

    study.main(("taau", "add", "fusion"), seeds=(0,), runs=runs, results=results)
    files = {file.name: file.read_bytes() for file in results.iterdir()}
    assert sorted(files) == ["add-s0.json", "fusion-s0.json", "taau.json"]
    study.main(("taau", "add", "fusion"), seeds=(0,), runs=runs, results=results)
    assert {file.name: file.read_bytes() for file in results.iterdir()} == files
    one = json.loads(files["add-s0.json"])
    assert one["seed"] == one["config"]["seed"] == 0
    assert one["curve"][-1]["step"] == 2
    assert one["scenes"]["docks"]["frames"] == [5, 6]
    assert "out" not in one["config"]

    tables.main(("test",), runs=runs)
    assert len([line for line in page.read_text().splitlines() if line.startswith("| docks")]) == 3
    assert (results / "test.md").read_text().startswith("# Test")
    assert read_png(images / "fusion_test.png").shape[2] == 3
    assert read_png(images / "fusion_test_docks.png").shape[2] == 3
