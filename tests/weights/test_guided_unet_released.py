"""The networks of guided-unet that ship: files, cards and numbers agree, and they win as README says."""

import atexit
import json
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.guided_unet.release import LOSS, MAX_MEGABYTES, OPTIONS, RIVALS, RUNS, START, WARMUP
from jaxsr.data.sample import sample_folder
from jaxsr.io.archive import read_manifest, unpack_sequence
from jaxsr.io.sequence import Sequence
from jaxsr.methods import to_json
from jaxsr.metrics import psnr
from jaxsr.runtime.load import find_method
from jaxsr.runtime.upscale import display
from jaxsr.weights.file import load_weights

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = ROOT / "jaxsr" / "weights" / "released"


def document(name):
    return json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())


def means(section):
    return {
        track["name"]: {key: value["mean"] for key, value in track["summary"]["all"].items()}
        for track in section["tracks"]
    }


@pytest.mark.parametrize("name", RUNS)
def test_a_network_is_small_and_is_that_of_its_run(name):
    file = WEIGHTS / f"{name}.safetensors"
    assert file.stat().st_size <= MAX_MEGABYTES * 1e6
    _, head = load_weights(file)
    trained = head["training"]
    options = (
        "steps",
        "batch",
        "crop",
        "scale",
        "learning_rate",
        "schedule",
        "clip_norm",
        "ema",
        "seed",
        "truth",
    )
    for option in options:
        assert trained["config"][option] == getattr(RUNS[name], option), option
    assert head["settings"] == json.loads(json.dumps(to_json(OPTIONS)))
    assert trained["loss"] == to_json(LOSS)
    assert {clip.split("-")[0] for clip in trained["sequences"]} == {"bunker", "docks", "forest"}
    assert all("-train-" in clip for clip in trained["sequences"])
    assert bool(trained["config"]["init"]) == (name in START)


@pytest.mark.parametrize("name", RUNS)
def test_a_network_beats_what_it_corrects_on_every_scene(name):
    for section in document(name)["sections"]:
        assert section["meta"]["truth"] == "reference"
        found = means(section)
        *rivals, network = found
        assert rivals == list(RIVALS)
        assert found[network]["psnr"] > max(found[rival]["psnr"] for rival in rivals)
        assert found[network]["ssim"] > max(found[rival]["ssim"] for rival in rivals)


@pytest.mark.parametrize("name", RUNS)
def test_the_card_has_the_numbers_of_the_results(name):
    card = (ROOT / "docs" / "models" / f"{name}.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in card.splitlines() if "` | " in line]
    found = {
        (clip, method.strip("`")): [float(c.split(" ")[0]) for c in cells] for clip, method, *cells in rows
    }
    sections = document(name)["sections"]
    assert len(found) == len(sections) * (len(RIVALS) + 1)
    for section in sections:
        for method, values in means(section).items():
            clip = section["title"].split(",")[0]
            assert found[clip, method] == pytest.approx(list(values.values()), abs=6e-3)


@pytest.mark.parametrize("name", RUNS)
def test_the_file_makes_frames_as_good_as_committed(name):
    """The first measured frame of the bunker, after the warm-up."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    archive = sample_folder() / "bunker-test.jsrz"
    manifest, clip = read_manifest(archive), "sample/bunker-test-0"
    head = manifest["sequences"][clip]
    manifest["sequences"][clip] = head | {"frames": head["frames"][: WARMUP + 1]}
    sequence = Sequence.open(unpack_sequence(archive, manifest, clip, Path(folder.name) / "bunker-test-0"))
    scale = RUNS[name].scale
    loaded, state = find_method(name, scale), None
    upscale = jax.jit(loaded.method.upscale)
    for i in range(WARMUP + 1):
        frame = sequence.frame(i, scale, needs=loaded.method.needs.rendered)
        frame = jax.tree.map(jnp.asarray, frame)
        state, image = upscale(loaded.net, loaded.method.init(frame) if state is None else state, frame)
    exposure = sequence.exposure
    found = psnr(display(np.asarray(image), exposure), display(sequence.truth(WARMUP, "reference"), exposure))
    section = next(s for s in document(name)["sections"] if s["meta"]["sequence"] == "bunker-test-0")
    assert section["frames"][0] == sequence.infos[WARMUP].index
    assert found == pytest.approx(section["tracks"][-1]["metrics"]["psnr"][0], abs=0.05)
