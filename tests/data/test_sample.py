"""The rendered sample that ships: whole, readable, small enough, and what the data card says it is."""

import numpy as np
import pytest

from jaxsr.data import sample
from jaxsr.errors import JaxsrError
from jaxsr.io.archive import read_manifest, verify
from jaxsr.io.sequence import Sequence

SCENES = ["bunker", "docks", "forest"]


def test_three_scenes_in_at_most_25_megabytes():
    assert sample.sample_scenes() == SCENES
    files = [sample.sample_folder() / f"{scene}.jsrz" for scene in SCENES]
    assert sum(f.stat().st_size for f in files) < 25e6
    assert max(f.stat().st_size for f in files) < 10e6


@pytest.mark.parametrize("scene", SCENES)
def test_archives_are_whole_and_hold_test_and_training_frames(scene):
    archive = sample.sample_folder() / f"{scene}.jsrz"
    verify(archive)
    heads = {name.split("/")[-1]: head for name, head in read_manifest(archive)["sequences"].items()}
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
