"""Windows are the frames of the sequence, read as late as can be."""

import json

import jax
import numpy as np
import pytest

from jaxsr.data.windows import NEEDS, WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import GBuffer
from jaxsr.methods import Needs, Windows
from tests.builders import edit_frames, make_sequence

SMALL = {"size": (16, 8), "scales": (2, 4)}
COLOR = frozenset({"lr.color"})


def source_of(*sequences, needs=COLOR, windows=Windows(), scale=2, **options):  # noqa: B008 (a constant)
    """Windows of sequences of the same folder, in which the cache lies."""
    paths = [seq.path for seq in sequences]
    needs = needs if isinstance(needs, Needs) else Needs(frozenset(needs))
    cache = paths[0].parent / "cache" if paths else None
    return WindowSource(paths, needs, windows, scale=scale, cache=cache, **options)


def reset_at(seq, *indices):
    """Mark frames as resets in the description."""
    file = seq.path / "sequence.json"
    head = json.loads(file.read_text())
    for frame in head["frames"]:
        frame["reset"] = frame["index"] in indices
    file.write_text(json.dumps(head))


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_a_window_is_the_frames_of_the_sequence(tmp_path, scale):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=4, exposure=1.5)
    source = source_of(seq, needs=NEEDS, windows=Windows(2, made=None), scale=scale)
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


def test_the_truth_of_a_window_is_the_layer_that_is_asked_for(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=2, reference=True)
    for truth in ("color", "reference"):
        source = source_of(seq, truth=truth)
        np.testing.assert_array_equal(source[1].truth_linear[0], seq.truth(1, truth))
    bare = make_sequence(tmp_path / "bare", **SMALL, frames=2)
    with pytest.raises(JaxsrError, match="reference"):
        source_of(bare, truth="reference")


def test_windows_carry_the_jitter_of_hr_buffers(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=2)
    edit_frames(seq.path, lambda frame: frame.update(hr_jitter_px=[0.25 * frame["index"], -0.5]))
    source = source_of(seq, windows=Windows(2, made=None))
    np.testing.assert_array_equal(source[0].frames.hr_jitter_px, [[0.25, -0.5], [0.5, -0.5]])


def test_windows_do_not_cross_cuts(tmp_path):
    a = make_sequence(tmp_path / "a", **SMALL, frames=6)
    reset_at(a, 1, 4)
    b = make_sequence(tmp_path / "b", **SMALL, frames=3)
    reset_at(b)  # not even the first: it has a past that was left out
    source = source_of(a, b, windows=Windows(2))
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
        return source_of(seq, windows=Windows(2), held_back=held_back)

    windows = source(2)
    assert [windows.place(i) for i in range(len(windows))] == [(0, 0), (0, 1)]
    np.testing.assert_array_equal(windows[1].frames.jitter_px[-1], seq.infos[2].jitter_px)
    for held_back in (4, 9):
        with pytest.raises(JaxsrError, match=rf"2 consecutive .* before the last {held_back}"):
            source(held_back)
    with pytest.raises(JaxsrError, match="bad number of held-back frames"):
        source(-1)


def test_what_is_not_needed_is_none(tmp_path):
    """LR colour alone is always there: without need, a view of a single zero."""
    seq = make_sequence(tmp_path / "s", **SMALL)
    window = source_of(seq, needs={"hr.normal", "lr.depth"}, scale=4)[0]
    given = {
        p: [n for n in GBuffer._fields if getattr(getattr(window.frames, p), n) is not None]
        for p in ("lr", "hr")
    }
    assert given == {"lr": ["depth_linear"], "hr": ["normal"]}
    assert not window.frames.color_linear.any()
    assert set(window.frames.color_linear.strides) == {0}
    assert window.frames.lr.depth_linear.all()
    assert window.lr_truth_linear is None
    batch = stack([window, window])
    assert batch.frames.color_linear.shape == (2, 1, 2, 4, 3)
    assert batch.frames.hr.motion_px is None


CADENCE = Windows(3, (True, False, True), made=(1,), lr_truth=True)


def test_the_cadence_hides_colour_and_chooses_the_truth(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=4)
    needs = Needs(COLOR | {"lr.depth"}, frozenset({"hr.motion"}))
    source = source_of(seq, needs=needs, windows=CADENCE)
    assert len(source) == 2
    batch = stack([source[1]])
    frames = [seq.frame(1 + t, 2) for t in range(3)]
    assert batch.frames.rendered.tolist() == [[True, False, True]]
    for t in (0, 2):
        np.testing.assert_array_equal(batch.frames.color_linear[0, t], frames[t].color_linear)
    assert not batch.frames.color_linear[0, 1].any()
    for t in range(3):  # what any frame of the window needs
        np.testing.assert_array_equal(batch.frames.lr.depth_linear[0, t], frames[t].lr.depth_linear)
        np.testing.assert_array_equal(batch.frames.hr.motion_px[0, t], frames[t].hr.motion_px)
    assert batch.truth_linear.shape == (1, 1, 8, 16, 3)
    np.testing.assert_array_equal(batch.truth_linear[0, 0], seq.truth(2))
    np.testing.assert_array_equal(batch.lr_truth_linear[0, 0], frames[1].color_linear)


@pytest.mark.parametrize(("lr_truth", "read"), [(False, [0, 2]), (True, [0, 1, 2])])
def test_hidden_colour_is_not_read(tmp_path, lr_truth, read):
    """A colour that turns NaN after it was converted shows where it is read."""
    seq = make_sequence(tmp_path / "s", **SMALL)
    source = source_of(seq, windows=CADENCE._replace(lr_truth=lr_truth))
    (file,) = (tmp_path / "cache").glob("*/x2-*/color.npy")
    color = np.load(file, mmap_mode="r+")
    for t in range(3):
        color[t] = t + 1 if t in read else np.nan
    color.flush()
    batch = stack([source[0]])
    assert batch.frames.color_linear[0, :, 0, 0, 0].tolist() == [1, 0, 3]
    if lr_truth:
        assert (batch.lr_truth_linear == 2).all()
    else:
        assert batch.lr_truth_linear is None


@pytest.mark.parametrize(
    ("made", "expected"), [(None, [0, 1, 2, 3]), ((-1, 0), [0, 3]), ((0, 1, 3), [0, 1, 3])]
)
def test_truth_is_that_of_the_frames_to_be_made(tmp_path, made, expected):
    seq = make_sequence(tmp_path / "s", **SMALL, frames=4)
    batch = stack([source_of(seq, windows=Windows(4, made=made))[0]])
    np.testing.assert_array_equal(batch.truth_linear[0], [seq.truth(i) for i in expected])


def test_needs_of_extrapolation_count_only_where_frames_are_extrapolated(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    needs = Needs(COLOR, frozenset({"hr.motion"}))
    assert source_of(seq, needs=needs, windows=Windows(3))[0].frames.hr.motion_px is None
    assert source_of(seq, needs=needs, windows=CADENCE)[0].frames.hr.motion_px is not None


def test_nothing_is_read_before_the_batch(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    window = source_of(seq, needs=NEEDS, windows=Windows(lr_truth=True))[1]
    images = (
        window.truth_linear,
        window.lr_truth_linear,
        *jax.tree.leaves((window.frames.hr, window.frames.lr)),
    )
    for image in images:
        base = image
        while isinstance(base.base, np.ndarray):
            base = base.base
        assert isinstance(base, np.memmap)


@pytest.mark.parametrize(
    ("windows", "message"),
    [
        (Windows(0), "no frames in a window"),
        (Windows(2, (True,)), "cadence of a window has another length; expected 2 flags; found 1"),
        (Windows(2, (False, True)), "first frame of a window must be rendered"),
        (Windows(2, made=(2,)), "bad frames to be made; expected positions from -2 to 1"),
        (Windows(2, made=()), "bad frames to be made"),
        (Windows(2, made=(1, -1)), "each once"),
        (Windows(2, warmup=2), "bad warm-up; expected 0 to 1 frames; found 2"),
        (Windows(2, multiple=0), "bad multiple"),
    ],
)
def test_windows_that_contradict_themselves(windows, message):
    with pytest.raises(JaxsrError, match=message):
        source_of(windows=windows)


def test_errors_name_the_sequence(tmp_path):
    good = make_sequence(tmp_path / "good", **SMALL)

    def lacking(resolution, index, layers):
        del layers["normal"]
        if index == 3:
            del layers["roughness"]

    bad = make_sequence(tmp_path / "bad", **SMALL, spoil=lacking)
    other = make_sequence(tmp_path / "other", size=(16, 8), scales=(2,))

    def source(*sequences, **arguments):
        return source_of(*sequences, **({"scale": 4} | arguments))

    with pytest.raises(JaxsrError, match=r"bad/hr: missing layer 'normal'; expected what hr.normal needs"):
        source(good, bad, needs=("hr.normal",))
    with pytest.raises(JaxsrError, match=r"bad/x4: missing layer 'roughness' in frame 3; .*lr.roughness"):
        source(good, bad, needs=("lr.roughness",))
    with pytest.raises(JaxsrError, match=r"other: scale 4 is not available; expected one of \[1, 2\]"):
        source(good, other)
    with pytest.raises(JaxsrError, match=r"good: fewer frames .* expected 4 consecutive .* found 3"):
        source(good, windows=Windows(4))
    with pytest.raises(JaxsrError, match=r"unknown buffer 'hr.position'"):
        source(good, needs=("hr.position",))
    with pytest.raises(JaxsrError, match=r"bad scale"):
        source(good, scale=0)
    with pytest.raises(JaxsrError, match=r"no sequences"):
        source()


def test_a_sequence_without_truth_is_refused(tmp_path):
    def blind(resolution, index, layers):
        if resolution == "hr":
            del layers["color"]

    seq = make_sequence(tmp_path / "s", **SMALL, spoil=blind)
    with pytest.raises(JaxsrError, match=r"s/hr: missing layer 'color'"):
        source_of(seq)
