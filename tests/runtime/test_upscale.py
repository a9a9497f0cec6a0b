"""`upscale` into folders: runs do not mix, nothing of others is touched; frames are in memory when timed."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.io.images import read_color, read_png
from jaxsr.io.sequence import Sequence
from jaxsr.methods import METHODS
from jaxsr.ops import to_display
from jaxsr.runtime.load import find_method
from jaxsr.runtime.record import SUFFIXES, claim_folder, describe_run, read_run
from jaxsr.runtime.upscale import TOGETHER, frames_in_memory, upscale
from tests.builders import make_sequence, random_weights


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return make_sequence(tmp_path_factory.mktemp("data") / "seq", frames=3, size=(32, 24))


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_run_says_what_it_is_and_goes_on(sequence, tmp_path):
    upscale(sequence, find_method("nearest", 2), tmp_path / "out", scale=2)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (record["method"], record["weights"], record["scale"], record["every"]) == ("nearest", None, 2, 1)
    assert record["frames"] == [1, 2, 3]
    assert record["sequence"]["name"] == "seq"
    assert record["made"]["packages"]["flax"]
    before = contents(tmp_path / "out")
    (tmp_path / "out" / "exr" / "0002.exr").unlink()  # as if it had been interrupted
    upscale(sequence, find_method("nearest", 2), tmp_path / "out", scale=2)
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize("every", [1, 2])
def test_a_camera_that_only_some_frames_have_is_not_used(sequence, tmp_path, every):
    images = []
    for known in ((), (0, 2)):
        folder = tmp_path / f"{len(known)}"
        shutil.copytree(sequence.path, folder)
        head = json.loads((folder / "sequence.json").read_text())
        for k, frame in enumerate(head["frames"]):
            if k not in known:
                del frame["camera"]
        (folder / "sequence.json").write_text(json.dumps(head))
        out = tmp_path / f"out{len(known)}"
        upscale(Sequence.open(folder), find_method("taau", 2), out, scale=2, every=every)
        images.append([(out / "exr" / f"{n:04d}.exr").read_bytes() for n in (1, 2, 3)])
    assert images[0] == images[1]


@pytest.mark.parametrize(("value", "pixels", "share"), [(np.nan, 1, "0.13%"), (np.inf, 768, "100.00%")])
def test_pixels_that_are_not_finite_are_not_written(sequence, tmp_path, value, pixels, share):
    nearest = find_method("nearest", 2)

    def bad(net, state, frame):
        state, image = nearest.method.upscale(net, state, frame)
        hit = (jnp.arange(768) < pixels).reshape(24, 32, 1) & (frame.jitter_px[0] == second)
        return state, jnp.where(hit, value, image)

    second = float(sequence.infos[1].jitter_px[0])
    loaded = nearest._replace(method=nearest.method._replace(upscale=bad))
    words = f"frame 2: the method made NaN or Inf.*found {share} of the pixels.*jaxsr inspect"
    with pytest.raises(JaxsrError, match=words) as error:
        upscale(sequence, loaded, tmp_path / "out", scale=2)
    assert "\n" not in str(error.value)
    for kind in ("exr", "png"):
        assert [p.stem for p in (tmp_path / "out" / kind).iterdir()] == ["0001"]


def test_runs_do_not_mix(sequence, tmp_path):
    out = tmp_path / "out"
    upscale(sequence, find_method("nearest", 2), out, scale=2)
    before = contents(out)
    other = make_sequence(tmp_path / "other", frames=3, size=(32, 24), scales=(2, 4))
    weights = [random_weights(tmp_path / f"{k}.safetensors", scale=2, seed=k) for k in (0, 1)]
    for run, name, options, words in (
        (sequence, "bilinear", {"scale": 2}, "expected method bilinear; found method nearest"),
        (sequence, "nearest", {"scale": 2, "every": 2}, "expected every 2; found every 1"),
        (other, "nearest", {"scale": 2}, r"expected sequence other \(.*\); found sequence seq \("),
        (other, "nearest", {"scale": 4}, "expected scale 4, sequence other.*found scale 2, sequence seq"),
    ):
        with pytest.raises(JaxsrError, match=f"frames of another run; {words}.*another folder") as error:
            upscale(run, find_method(name, options["scale"]), out, **options)
        assert "\n" not in str(error.value)
    assert contents(out) == before
    runs = [describe_run(sequence, 2, 1, "net", file) for file in weights]
    claim_folder(tmp_path / "net", runs[0])
    with pytest.raises(JaxsrError, match=r"expected weights [0-9a-f]+; found weights [0-9a-f]+"):
        claim_folder(tmp_path / "net", runs[1])


@pytest.mark.parametrize("kind", ["exr", "png"])
@pytest.mark.parametrize("name", ["0001", "0099", "beauty"])
def test_frames_of_others_are_not_touched(sequence, tmp_path, kind, name):
    file = tmp_path / kind / f"{name}{SUFFIXES[kind]}"
    file.parent.mkdir()
    file.write_text("a render")
    with pytest.raises(JaxsrError, match=rf"holds {file.name}, which no run.json of jaxsr names"):
        upscale(sequence, find_method("nearest", 2), tmp_path, scale=2)
    assert contents(tmp_path) == {file.relative_to(tmp_path): b"a render"}


@pytest.mark.parametrize(
    "record",
    [
        "{",
        "[]",
        '{"mine": 1}',
        '{"format": "jaxsr-run", "version": 2, "frames": [1], "kinds": ["exr"]}',
        '{"format": "jaxsr-run", "version": 1, "frames": ["../x"], "kinds": ["exr"]}',
        '{"format": "jaxsr-run", "version": 1, "frames": [1], "kinds": [".."]}',
        '{"format": "jaxsr-run", "version": 1, "frames": [1], "kinds": [["exr"]]}',
        '{"format": "jaxsr-run", "version": 1, "frames": 3, "kinds": ["exr"]}',
    ],
)
def test_a_record_of_others_is_refused(sequence, tmp_path, record):
    (tmp_path / "run.json").write_text(record)
    with pytest.raises(JaxsrError, match="not a record of a run"):
        upscale(sequence, find_method("nearest", 2), tmp_path, scale=2)
    assert contents(tmp_path) == {p: record.encode() for p in contents(tmp_path)}


def test_a_run_that_replaces_deletes_what_the_record_names(sequence, tmp_path):
    upscale(sequence, find_method("nearest", 2), tmp_path, scale=2)
    (tmp_path / "mine.txt").write_text("mine")
    run = describe_run(sequence, 2, 1, "bilinear") | {"frames": [2]}
    claim_folder(tmp_path, run, ["png"], replace=True)
    assert sorted(p.name for p in contents(tmp_path)) == ["mine.txt", "run.json"]
    assert read_run(tmp_path)["kinds"] == ["png"]


def test_no_thread_decodes_while_a_frame_is_used(monkeypatch, tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=TOGETHER + 2, size=(32, 24))
    reading, read = [], sequence.frame

    def frame(*arguments, **options):
        reading.append(1)
        made = read(*arguments, **options)
        reading.pop()
        return made

    monkeypatch.setattr(sequence, "frame", frame)
    busy = [len(reading) for _ in frames_in_memory(sequence, METHODS["guided"], 2)]
    assert busy == [0] * (TOGETHER + 2)


def test_frames_before_one_that_cannot_be_read_stay(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=3, size=(32, 24))
    shutil.copy(sequence.path / "sequence.json", sequence.path / "x2" / "0003.exr")
    with pytest.raises(JaxsrError, match=r"0003.exr"):
        upscale(sequence, find_method("nearest", 2), tmp_path / "out", scale=2)
    assert sorted(p.name for p in (tmp_path / "out" / "exr").iterdir()) == ["0001.exr", "0002.exr"]


def test_pictures_have_the_exposure_of_their_frame(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=2, size=(32, 24))
    sequence.infos[1] = dataclasses.replace(sequence.infos[1], exposure=0.25)
    upscale(sequence, find_method("nearest", 2), tmp_path / "out", scale=2)
    for index, exposure in ((1, sequence.exposure), (2, 0.25)):
        linear = read_color(tmp_path / "out" / "exr" / f"{index:04d}.exr")
        shown = read_png(tmp_path / "out" / "png" / f"{index:04d}.png")
        assert abs(np.asarray(to_display(linear, exposure)) - shown).max() < 1 / 255
