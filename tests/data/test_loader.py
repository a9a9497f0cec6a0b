"""The stream of batches: the same for the same seed, new in each epoch, and resumed to the bit."""

import functools
import json

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsr.data.loader import Loader, Stream, check_crop
from jaxsr.data.windows import WindowSource
from jaxsr.errors import JaxsrError
from jaxsr.io.find import find_sequences
from jaxsr.methods import Needs, Windows
from tests.builders import make_sequence

NEEDS = frozenset({"lr.color", "hr.depth", "hr.normal"})


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    """A loader of two small sequences: 9 frames, 7 windows of two."""
    root = tmp_path_factory.mktemp("loader")
    for name, frames in (("a", 5), ("b", 4)):
        make_sequence(root / "set" / name, size=(24, 16), scales=(2, 4), frames=frames)

    def call(paths=(root / "set",), **arguments):
        windows = arguments.pop("windows", Windows(2, made=None))
        needs = Needs(arguments.pop("needs", NEEDS))
        places = {"scale": arguments.pop("scale", 2), "held_back": arguments.pop("held_back", 0)}
        source = WindowSource(find_sequences(paths), needs, windows, cache=root / "cache", **places)
        return Loader(source, Stream(**({"batch": 3, "crop": 8} | arguments)))

    return call


def take(loader, count):
    return [next(loader) for _ in range(count)]


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def differs(a, b):
    return any(not np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def frames_of(batches):
    """Which windows these are, by where their cameras stand (the two sequences: by frame and by jitter)."""
    return [
        tuple(np.round(np.abs(m[:, :3, 3]), 4).ravel())
        for batch in batches
        for m in batch.frames.camera.world_from_view
    ]


def test_a_batch_has_windows_of_float32(load):
    batch = next(load())
    assert {str(x.dtype) for x in jax.tree.leaves(batch)} == {"float32", "bool"}
    assert batch.truth_linear.shape == (3, 2, 8, 8, 3)
    assert batch.frames.color_linear.shape == (3, 2, 4, 4, 3)
    assert batch.frames.camera.world_from_view.shape == (3, 2, 4, 4)
    assert batch.frames.lr.normal is None
    assert batch.frames.hr.base_color is None
    assert batch.frames.rendered.all()
    assert batch.frames.scale == 2


@pytest.mark.parametrize("vertical", [False, True])
def test_the_seed_makes_the_stream(load, vertical):
    one, same, other = (load(seed=s, vertical_flips=vertical) for s in (4, 4, 5))
    a, b, c = (take(loader, 6) for loader in (one, same, other))
    equal(a, b)
    assert differs(a, c)


@settings(max_examples=6)
@given(k=st.integers(0, 12), ahead=st.integers(0, 6))
def test_a_resumed_stream_is_the_one_that_never_stopped(load, k, ahead):
    """7 windows and batches of 3: `k` is before, at and after the ends of epochs."""
    reference = _reference(load)
    loader = load(seed=7)
    take(loader, k)
    state = json.loads(json.dumps(loader.get_state()))
    fresh = load(seed=7)
    take(fresh, ahead)  # it has read, and read ahead, something else
    fresh.set_state(state)
    equal(take(fresh, 4), reference[k : k + 4])
    assert fresh.get_state() != state
    loader.set_state(state)
    equal(take(loader, 2), reference[k : k + 2])
    loader.close()
    fresh.close()


@functools.cache
def _reference(load):
    return take(load(seed=7), 16)


def test_every_epoch_shows_every_window_once_in_another_order_and_crop(load):
    loader = load(batch=1, flips=False)
    assert loader.windows == 7
    first, second, third = (take(loader, 7) for _ in range(3))
    orders = [frames_of(epoch) for epoch in (first, second, third)]
    # Frames 1 to 5 and 1 to 4 of the same path: 4 different windows, 3 of them twice.
    assert all(sorted(order) == sorted(orders[0]) for order in orders)
    assert len(set(orders[0])) == 4
    assert orders[0] != orders[1] or orders[1] != orders[2]
    shifts = [{tuple(b.frames.camera.lens_shift[0, 0]) for b in epoch} for epoch in (first, second, third)]
    assert shifts[0] != shifts[1] != shifts[2]


def test_a_small_data_set_fills_a_batch(load, tmp_path):
    seq = make_sequence(tmp_path / "one", size=(24, 16), scales=(2,), frames=1)
    loader = load([seq.path], windows=Windows(), batch=8)
    batch = next(loader)
    assert batch.truth_linear.shape == (8, 1, 8, 8, 3)
    assert len(np.unique(batch.frames.camera.lens_shift, axis=0)) > 3
    equal(batch, next(load([seq.path], windows=Windows(), batch=8)))


def test_processes_share_one_stream(load):
    alone = load(batch=6)
    parts = [load(batch=3, process_index=k, process_count=2) for k in range(2)]
    for _ in range(5):
        whole, shares = next(alone), [next(part) for part in parts]
        for k, share in enumerate(shares):
            equal(share, jax.tree.map(lambda x, k=k: x[k::2], whole))


def test_flips_come_up_half_of_the_time_and_leave_the_crops_alone(load):
    plain, flipped = (take(load(flips=f, crop=4, batch=8), 6) for f in (False, True))
    mirrored = np.concatenate(
        [
            a.frames.camera.world_from_view[:, 0, 0, 3] != b.frames.camera.world_from_view[:, 0, 0, 3]
            for a, b in zip(plain, flipped, strict=True)
        ]
    )
    assert 0.25 < mirrored.mean() < 0.75
    for a, b in zip(plain, flipped, strict=True):
        for x, y in zip(a.truth_linear, b.truth_linear, strict=True):
            np.testing.assert_array_equal(np.sort(x, None), np.sort(y, None))


def test_a_position_of_another_stream_is_refused(load, tmp_path):
    state = load().get_state()
    for other in ({"seed": 1}, {"batch": 2}, {"crop": 4}, {"scale": 4}, {"flips": False}, {"held_back": 1}):
        with pytest.raises(JaxsrError, match=r"position .* belongs to other data or other options"):
            load(**other).set_state(state)
    for windows in (Windows(2), Windows(2, (True, False), made=None), Windows(2, made=None, lr_truth=True)):
        with pytest.raises(JaxsrError, match="belongs to other data"):
            load(windows=windows).set_state(state)
    seq = make_sequence(tmp_path / "other", size=(24, 16), scales=(2,))
    with pytest.raises(JaxsrError, match="belongs to other data"):
        load([seq.path]).set_state(state)
    load(needs=NEEDS | {"hr.roughness"}).set_state(state)  # more buffers of the same stream


def test_a_copy_of_the_data_goes_on(load, tmp_path):
    args = {"size": (24, 16), "scales": (2,), "frames": 3, "name": "s"}
    first, copy = (make_sequence(tmp_path / place / "s", **args) for place in ("here", "there"))
    one, other = load([first.path]), load([copy.path])
    take(one, 2)
    other.set_state(one.get_state())
    equal(next(one), next(other))


def test_crops_of_windows_with_a_cadence(load):
    """Hidden colour stays hidden, and LR truth is cropped and mirrored with the rest."""
    windows = Windows(3, (True, False, True), made=(1,), lr_truth=True)
    shown, hidden = (next(load(windows=windows._replace(rendered=r))) for r in (None, windows.rendered))
    assert hidden.truth_linear.shape == (3, 1, 8, 8, 3)
    assert not hidden.frames.color_linear[:, 1].any()
    np.testing.assert_array_equal(hidden.frames.color_linear[:, ::2], shown.frames.color_linear[:, ::2])
    np.testing.assert_array_equal(hidden.lr_truth_linear[:, 0], shown.frames.color_linear[:, 1])


def test_crops_are_multiples_of_what_the_network_takes(load):
    windows = Windows(2, multiple=3)
    batch = next(load(windows=windows, crop=12))
    assert batch.frames.color_linear.shape[2:4] == (6, 6)
    with pytest.raises(JaxsrError, match=r"multiple of 6: .* multiples of 3, at scale 2; .*choose 6 or 12"):
        load(windows=windows, crop=8)
    with pytest.raises(JaxsrError, match=r"--crop: bad crop; .*; choose 32"):
        check_crop(30, 4, 8, "--crop")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"batch": 0}, "bad batch; expected 1 or more; found 0"),
        ({"crop": 0}, "bad crop"),
        ({"crop": 9}, "bad crop; expected a multiple of the scale 2; found 9"),
        ({"crop": 18}, r"set/a: the crop is larger than the frames; expected at most 16; found 18"),
        ({"seed": -1}, "bad seed"),
        ({"seed": 2**32}, "bad seed"),
        ({"scale": 0}, "bad scale"),
        ({"scale": 8}, r"set/a: scale 8 is not available; expected one of \[1, 2, 4\]"),
        ({"windows": Windows(5)}, r"set/b: fewer frames than a window has"),
        ({"windows": Windows(0)}, "no frames in a window"),
        ({"needs": frozenset({"hr.colour"})}, r"unknown buffer 'hr\.colour'"),
        ({"process_index": 2, "process_count": 2}, "bad process; expected 0 to 1; found 2"),
        ({"paths": []}, "no sequences"),
    ],
)
def test_bad_arguments_are_named(load, arguments, message):
    with pytest.raises(JaxsrError, match=message):
        load(**arguments)
