"""Two truths of a sequence: the layers, and which one is chosen; and the jitter of HR buffers."""

import json

import jax
import numpy as np
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.io.sequence import Sequence
from jaxsr.io.truth import choose_truth
from tests.builders import edit_frames, make_sequence

SMALL = {"size": (16, 8), "frames": 2}


def drop_reference(resolution, index, layers):
    """The second frame has no reference."""
    if resolution == "hr" and index == 2:
        del layers["reference"]


@pytest.fixture
def both(tmp_path):
    return make_sequence(tmp_path / "both", **SMALL, reference=True)


@pytest.fixture
def partial(tmp_path):
    return make_sequence(tmp_path / "partial", **SMALL, reference=True, spoil=drop_reference)


def test_both_truths_are_read_and_differ(both):
    color, reference = both.truth(1), both.truth(1, "reference")
    assert np.abs(color - reference).max() > 0.05
    np.testing.assert_allclose(reference, color[:, ::-1] * 0.5, rtol=2e-3, atol=1e-4)  # half floats
    assert "reference" in both.layers("hr", 0)


def test_no_frame_holds_the_reference(both):
    frame = both.frame(0, 2)
    reference = both.truth(0, "reference")
    images = [np.asarray(x) for x in jax.tree.leaves(frame)]
    assert len(images) > 6
    assert not any(x.shape == reference.shape and np.allclose(x, reference) for x in images)


def test_the_reference_is_the_default_where_all_frames_have_it(both, partial):
    assert choose_truth([both]) == "reference"
    assert choose_truth([both], "color") == "color"
    assert choose_truth([both, partial]) == "color"
    assert choose_truth([partial]) == "color"


def test_a_truth_that_is_not_there_is_refused(both, partial, tmp_path):
    with pytest.raises(JaxsrError, match=r"frame 2 has no truth.*layer reference.*--reference-samples"):
        choose_truth([both, partial], "reference")
    bare = make_sequence(
        tmp_path / "bare",
        **SMALL,
        spoil=lambda name, index, layers: layers.pop("color") if name == "hr" else None,
    )
    with pytest.raises(JaxsrError, match=r"frame 1 has no truth.*reference or color"):
        choose_truth([bare])


def test_jitter_of_hr_buffers_is_kept(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    np.testing.assert_array_equal(seq.frame(0, 2).hr_jitter_px, [0, 0])
    assert "hr_jitter_px" not in json.loads((seq.path / "sequence.json").read_text())["frames"][0]
    edit_frames(seq.path, lambda frame: frame.update(hr_jitter_px=[0.25, -0.5]))
    again = Sequence.open(seq.path, check=False)
    np.testing.assert_array_equal(again.frame(1, 2).hr_jitter_px, [0.25, -0.5])
    assert again.infos[1].to_json()["hr_jitter_px"] == [0.25, -0.5]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ([8.25, 0], r"frame 1: jitter of the HR buffers of more than 8\.0 pixels.*found \[8\.25"),
        ([0], r"found hr_jitter_px \[0\]"),
        ("0", "hr_jitter_px"),
        ([float("nan"), 0], "found NaN"),
        (None, "hr_jitter_px"),
    ],
)
def test_bad_jitter_of_hr_buffers_is_refused(tmp_path, wrong, words):
    seq = make_sequence(tmp_path / "s", **SMALL)
    edit_frames(seq.path, lambda frame: frame.update(hr_jitter_px=wrong))
    with pytest.raises(JaxsrError, match=words):
        Sequence.open(seq.path)
