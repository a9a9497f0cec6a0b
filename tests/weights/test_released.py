"""The networks that ship: their files, cards and committed numbers agree, and they win as README says."""

import json
import shutil
from pathlib import Path

import pytest

from experiments.fusion_sr import release, train_released
from experiments.fusion_sr.train_released import LOSS, OPTIONS, RUNS
from jaxsr.errors import JaxsrError
from jaxsr.methods import to_json
from jaxsr.weights.file import load_weights

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
    assert {file.stem for file in WEIGHTS.glob("*.safetensors")} == set(RUNS)


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
