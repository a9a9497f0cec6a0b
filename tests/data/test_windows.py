"""Windows are the frames of the sequence, read as late as can be."""

import json

import jax
import numpy as np
import pytest

from jaxsr.data.windows import NEEDS, WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import GBuffer
from tests.builders import make_sequence

SMALL = {"size": (16, 8), "scales": (2, 4)}


def cut_at(seq, *indices):
    """Mark frames as cuts in the description."""
    file = seq.path / "sequence.json"
    head = json.loads(file.read_text())
    for frame in head["frames"]:
        frame["reset"] = frame["index"] in indices
    file.write_text(json.dumps(head))


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_a_window_is_the_frames_of_the_sequence(tmp_path, scale):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=4, exposure=1.5)
    source = WindowSource([seq.path], scale=scale, needs=NEEDS, length=2, cache=tmp_path / "cache")
    assert len(source) == 3
    for i in range(3):
        batch = stack([source[i]])
        for t in range(2):
            frame = seq.frame(i + t, scale)
            expected = jax.tree.map(np.asarray, frame)
            # Half in the files, and half here: equal to the bit.
            jax.tree.map(lambda a, b, t=t: np.testing.assert_array_equal(a[0, t], b), batch.frames, expected)
            assert jax.tree.map(np.dtype, jax.tree.map(lambda a: a.dtype, batch.frames)) == jax.tree.map(
                lambda a: a.dtype, expected
            )
            np.testing.assert_array_equal(batch.truth_linear[0, t], seq.truth(i + t))
        assert batch.frames.scale == scale


def test_windows_do_not_cross_cuts(tmp_path):
    a = make_sequence(tmp_path / "a", **SMALL, frames=6)
    cut_at(a, 1, 4)
    b = make_sequence(tmp_path / "b", **SMALL, frames=3)
    cut_at(b)  # not even the first: it has a past that was left out
    source = WindowSource(
        [a.path, b.path], scale=2, needs=frozenset({"lr.color"}), length=2, cache=tmp_path / "c"
    )
    jitters = [np.float32(w.frames.jitter_px).tolist() for w in map(source.__getitem__, range(len(source)))]
    expected = [(a, 0), (a, 1), (a, 3), (a, 4), (b, 0), (b, 1)]
    assert jitters == [[seq.frame(i + t, 2).jitter_px.tolist() for t in range(2)] for seq, i in expected]
    assert [w.frames.reset.tolist() for w in map(source.__getitem__, (0, 1, 2, 4))] == [
        [True, False],
        [False, False],
        [True, False],
        [False, False],
    ]
    with pytest.raises(IndexError):
        source[len(source)]


def test_frames_that_are_held_back_are_in_no_window(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=5)

    def source(held_back):
        arguments = {"scale": 2, "needs": frozenset({"lr.color"}), "length": 2, "cache": tmp_path / "cache"}
        return WindowSource([seq.path], held_back=held_back, **arguments)

    windows = source(2)
    assert [windows.place(i) for i in range(len(windows))] == [(0, 0), (0, 1)]
    np.testing.assert_array_equal(windows[1].frames.jitter_px[-1], seq.infos[2].jitter_px)
    for held_back in (4, 9):
        with pytest.raises(JaxsrError, match=rf"2 consecutive .* before the last {held_back}"):
            source(held_back)
    with pytest.raises(JaxsrError, match="bad number of held-back frames"):
        source(-1)


def test_what_is_not_needed_is_none_or_costs_nothing(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    needs = frozenset({"hr.normal", "lr.depth"})
    window = WindowSource([seq.path], scale=4, needs=needs, cache=tmp_path / "cache")[0]
    given = {
        p: [n for n in GBuffer._fields if getattr(getattr(window.frames, p), n) is not None]
        for p in ("lr", "hr")
    }
    assert given == {"lr": ["depth_linear", "motion_px"], "hr": ["depth_linear", "motion_px", "normal"]}
    for zeros in (window.frames.color_linear, window.frames.hr.depth_linear, window.frames.lr.motion_px):
        assert not zeros.any()
        assert set(zeros.strides) == {0}
    assert window.frames.lr.depth_linear.all()
    batch = stack([window, window])
    assert batch.frames.color_linear.shape == (2, 1, 2, 4, 3)
    assert batch.frames.hr.motion_px.shape == (2, 1, 8, 16, 2)


def test_nothing_is_read_before_the_batch(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    window = WindowSource([seq.path], scale=2, needs=NEEDS, cache=tmp_path / "cache")[1]
    for image in (window.truth_linear, *jax.tree.leaves((window.frames.hr, window.frames.lr))):
        base = image
        while isinstance(base.base, np.ndarray):
            base = base.base
        assert isinstance(base, np.memmap)


def test_errors_name_the_sequence(tmp_path):
    good = make_sequence(tmp_path / "good", **SMALL)

    def lacking(resolution, index, layers):
        del layers["normal"]
        if index == 3:
            del layers["roughness"]

    bad = make_sequence(tmp_path / "bad", **SMALL, spoil=lacking)
    other = make_sequence(tmp_path / "other", size=(16, 8), scales=(2,))

    def source(*paths, needs=("lr.color",), **arguments):
        arguments = {"scale": 4, "cache": tmp_path / "cache"} | arguments
        return WindowSource([p.path for p in paths], needs=frozenset(needs), **arguments)

    with pytest.raises(JaxsrError, match=r"bad/hr: missing layer 'normal'; expected what hr.normal needs"):
        source(good, bad, needs=("hr.normal",))
    with pytest.raises(JaxsrError, match=r"bad/x4: missing layer 'roughness' in frame 3; .*lr.roughness"):
        source(good, bad, needs=("lr.roughness",))
    with pytest.raises(JaxsrError, match=r"other: scale 4 is not available; expected one of \[1, 2\]"):
        source(good, other)
    with pytest.raises(JaxsrError, match=r"good: fewer frames .* expected 4 consecutive .* found 3"):
        source(good, length=4)
    with pytest.raises(JaxsrError, match=r"unknown buffer 'hr.position'"):
        source(good, needs=("hr.position",))
    with pytest.raises(JaxsrError, match=r"no frames in a window"):
        source(good, length=0)
    with pytest.raises(JaxsrError, match=r"no sequences"):
        source()


def test_a_sequence_without_truth_is_refused(tmp_path):
    def blind(resolution, index, layers):
        if resolution == "hr":
            del layers["color"]

    seq = make_sequence(tmp_path / "s", **SMALL, spoil=blind)
    with pytest.raises(JaxsrError, match=r"s/hr: missing layer 'color'"):
        WindowSource([seq.path], scale=2, needs=frozenset({"lr.color"}), cache=tmp_path / "cache")
