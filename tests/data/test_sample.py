"""The rendered sample that ships: whole, readable, small enough, and what the data card says it is."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxsr.data import sample
from jaxsr.errors import JaxsrError
from jaxsr.io.archive import pack, read_manifest, verify
from jaxsr.io.sequence import Sequence
from jaxsr.metrics import psnr
from jaxsr.ops import to_display
from tests.builders import make_sequence

SCENES = ["bunker", "docks", "forest"]


def test_three_scenes_in_at_most_40_megabytes():
    assert sample.sample_scenes() == SCENES
    files = [sample.sample_folder() / f"{scene}-{split}.jsrz" for scene in SCENES for split in sample.SPLITS]
    assert sum(f.stat().st_size for f in files) < 40e6
    assert max(f.stat().st_size for f in files) < 10e6


@pytest.mark.parametrize("scene", SCENES)
def test_archives_are_whole_and_hold_test_and_training_frames(scene):
    heads = {}
    for split in sample.SPLITS:
        archive = sample.sample_folder() / f"{scene}-{split}.jsrz"
        verify(archive)
        heads |= {name.split("/")[-1]: head for name, head in read_manifest(archive)["sequences"].items()}
    assert sorted(heads) == [f"{scene}-test-0", f"{scene}-train-0"]
    test, train = heads[f"{scene}-test-0"], heads[f"{scene}-train-0"]
    assert len(test["frames"]) == 8
    assert len(train["frames"]) == 3
    assert test["size"] == train["size"] == [384, 216]
    assert test["scales"] == [2, 4]
    assert test["license"] == "CC0-1.0"
    assert test["generator"]["arguments"]["split"] == "test"
    first, last = (f["camera"]["world_from_view"] for f in (test["frames"][0], test["frames"][-1]))
    assert not np.allclose(first, last)  # the camera travels


def test_a_sequence_of_the_sample_reads_as_any_other(tmp_path):
    (folder,) = sample.unpack_sample(tmp_path, "train", ("docks",))
    sequence = Sequence.open(folder)
    frame = sequence.frame(1, 4)
    assert frame.color_linear.shape == (54, 96, 3)
    assert frame.hr.normal is not None
    length = np.linalg.norm(np.asarray(frame.hr.normal), axis=-1)
    surface = np.isfinite(np.asarray(frame.hr.depth_linear))[..., 0]
    np.testing.assert_allclose(length[surface], 1.0, atol=2e-3)
    truth = sequence.truth(1)
    assert np.isfinite(truth).all()
    assert truth.mean() > 0.05
    smooth = sequence.truth(1, "reference")
    assert np.isfinite(smooth).all()
    shown, pixels = (np.asarray(to_display(x, sequence.exposure)) for x in (smooth, truth))
    assert 18 < psnr(pixels, shown) < 30  # the same picture, without its aliasing
    assert np.abs(np.diff(shown, axis=1)).mean() < np.abs(np.diff(pixels, axis=1)).mean()
    files = sorted(p.stat().st_mtime_ns for p in folder.rglob("*.exr"))
    assert sample.unpack_sample(tmp_path, "train", ("docks",)) == [folder]  # kept, not written again
    assert sorted(p.stat().st_mtime_ns for p in folder.rglob("*.exr")) == files


def test_errors(tmp_path):
    with pytest.raises(JaxsrError, match="no scene 'moon' in the sample; expected bunker, docks, forest"):
        sample.unpack_sample(tmp_path, "test", ("moon",))
    with pytest.raises(JaxsrError, match="no such part of the sample"):
        sample.unpack_sample(tmp_path, "validation")
    with pytest.raises(JaxsrError, match="scale 3 is not available"):
        sample.unpack_sample(tmp_path, "test", scale=3)
    assert not list(tmp_path.iterdir())


TOGETHER = """
import os, sys, traceback
from pathlib import Path
from jaxsr.data import sample
from jaxsr.io.sequence import Sequence

sample.sample_folder = lambda: Path(sys.argv[1])
gate, opener = os.pipe()
children = []
for _ in range(8):
    children.append(os.fork())
    if children[-1] == 0:
        os.close(opener)
        os.read(gate, 1)  # until the parent closes it: all begin at once
        try:
            (folder,) = sample.unpack_sample(Path(sys.argv[2]), "train")
            sequence = Sequence.open(folder)
            assert len(sequence) == 4 and sequence.truth(3).shape == (12, 16, 3)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
os.close(opener)
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The folder of a sample of one tiny scene, which is used in place of the real one."""
    sequence = make_sequence(tmp_path / "tiny-train-0", size=(16, 12), frames=4, scales=(2,))
    pack({"train/tiny-train-0": sequence.path}, tmp_path / "archives" / "tiny-train.jsrz")
    monkeypatch.setattr(sample, "sample_folder", lambda: tmp_path / "archives")
    return tmp_path / "archives"


def test_eight_processes_unpack_at_once(tiny, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", TOGETHER, tiny, tmp_path / "out"],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.strip() == str([0] * 8), done.stderr
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["tiny-train-0"]


def test_leftovers_of_dead_processes_go_and_those_of_living_ones_stay(tiny, tmp_path):
    dead, alive = (tmp_path / "out" / f".tiny-train-0.{pid}-1.tmp" for pid in (9999999, os.getpid()))
    for folder in (dead, alive):
        (folder / "hr").mkdir(parents=True)
    (folder,) = sample.unpack_sample(tmp_path / "out", "train")
    assert sorted((tmp_path / "out").iterdir()) == [alive, folder]


def test_a_part_that_an_earlier_version_left_is_completed(tiny, tmp_path):
    (folder,) = sample.unpack_sample(tmp_path / "out", "train")
    whole = {p.name: p.read_bytes() for p in (folder / "hr").iterdir()}
    (folder / "hr" / "0003.exr").unlink()
    assert sample.unpack_sample(tmp_path / "out", "train") == [folder]
    assert {p.name: p.read_bytes() for p in (folder / "hr").iterdir()} == whole


def test_a_full_disk_leaves_nothing_behind(tiny, tmp_path, monkeypatch):
    def full(archive, manifest, name, folder):
        (folder / "hr").mkdir(parents=True)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sample, "unpack_sequence", full)
    with pytest.raises(JaxsrError, match="tiny-train-0: cannot write; found No space left on device"):
        sample.unpack_sample(tmp_path / "out", "train")
    assert not list((tmp_path / "out").iterdir())
