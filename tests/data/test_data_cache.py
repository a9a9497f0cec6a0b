"""The memory-mapped arrays are the files, to the bit, and nothing half made is ever taken for whole."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from jaxsr.data.cache import default_cache, open_arrays
from jaxsr.data.windows import WindowSource
from jaxsr.errors import JaxsrError
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.layers import LAYERS
from jaxsr.needs import Needs, Windows
from tests.builders import make_sequence

SMALL = {"size": (16, 8), "scales": (2,)}


class Count:
    """A progress callback that counts the frames that were converted."""

    def __init__(self):
        self.frames = 0

    def __call__(self, title, total):
        return self.step

    def step(self):
        self.frames += 1


def leftovers(cache):
    return [p for p in cache.rglob("*") if p.name.endswith(".tmp")]


def test_arrays_are_the_layers_of_the_files(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL, precision={"motion": "half", "object_id": "uint"})
    found = open_arrays(seq.path, ("hr", "x2"), cache=tmp_path / "cache")
    for resolution, arrays in found.items():
        assert set(arrays.layers) == set(LAYERS) - {"position", "reference"}
        for layer, pixels in arrays.layers.items():
            expected = np.stack([seq.stored(i, resolution)[layer] for i in range(3)])
            assert pixels.dtype == expected.dtype
            np.testing.assert_array_equal(pixels, expected)
            with pytest.raises(ValueError, match=r"read-only"):
                pixels[0] = 0
    types = {layer: str(pixels.dtype) for layer, pixels in found["hr"].layers.items()}
    assert types["depth"] == "float32"
    assert types["object_id"] == "uint32"
    assert {types[n] for n in types if n not in ("depth", "object_id")} == {"float16"}


def test_only_what_is_asked_for_is_converted_and_only_once(tmp_path):
    seq, count = make_sequence(tmp_path / "s", **SMALL), Count()
    for _ in range(2):
        open_arrays(seq.path, ("x2",), cache=tmp_path / "cache", progress=count)
    assert count.frames == 3
    (home,) = (tmp_path / "cache").iterdir()
    (folder,) = home.iterdir()
    assert folder.name.startswith("x2-")
    head = json.loads((folder / "arrays.json").read_text())
    assert head["sequence"] == json.loads((seq.path / "sequence.json").read_text())
    open_arrays(seq.path / "sequence.json", ("hr", "x2"), cache=tmp_path / "cache", progress=count)
    assert count.frames == 6


@pytest.mark.parametrize("large", [0, 1, 2])
def test_a_type_that_changes_on_the_way_becomes_float32(tmp_path, large):
    def spoil(resolution, index, layers):
        layers["object_id"][0, 0] = 3001 if index == large + 1 else 7

    seq = make_sequence(tmp_path / "s", **SMALL, spoil=spoil)
    ids = open_arrays(seq.path, ("hr",), cache=tmp_path / "cache")["hr"].layers["object_id"]
    assert ids.dtype == np.float32
    assert ids[:, 0, 0, 0].tolist() == [3001 if k == large else 7 for k in range(3)]
    np.testing.assert_array_equal(ids[1], seq.frame(1, 2).hr.object_id)


def test_a_layer_that_some_frames_lack_is_left_out_and_named(tmp_path):
    def spoil(resolution, index, layers):
        if index == 2:
            del layers["normal"]
        if index == 1:
            del layers["roughness"]

    seq = make_sequence(tmp_path / "s", **SMALL, spoil=spoil)
    arrays = open_arrays(seq.path, ("hr",), cache=tmp_path / "cache")["hr"]
    assert not {"normal", "roughness"} & set(arrays.layers)
    assert arrays.absent == {"normal": 2, "roughness": 1}
    assert sorted(p.stem for p in (tmp_path / "cache").rglob("*.npy")) == sorted(arrays.layers)


@pytest.mark.parametrize("change", ["pixels", "description", "time"])
def test_a_sequence_that_changed_is_converted_again(tmp_path, change):
    seq, count = make_sequence(tmp_path / "s", **SMALL), Count()
    before = open_arrays(seq.path, ("hr", "x2"), cache=tmp_path / "cache")["hr"]
    file = seq.path / "hr/0002.exr"
    if change == "pixels":
        channels, _ = read_exr(file)
        channels["color.R"][:] = 9
        write_exr(file, channels)
    elif change == "description":
        text = (seq.path / "sequence.json").read_text()
        (seq.path / "sequence.json").write_text(text.replace('"fps": 24.0', '"fps": 25.0'))
    else:
        os.utime(file, (1, 1))
    after = open_arrays(seq.path, ("hr", "x2"), cache=tmp_path / "cache", progress=count)["hr"]
    assert count.frames == (6 if change == "description" else 3)  # x2 has its own key
    assert (after.layers["color"][1, ..., 0] == 9).all() == (change == "pixels")
    assert before.layers["color"].shape == after.layers["color"].shape  # still mapped, though deleted
    assert len(list((tmp_path / "cache").glob("*/hr-*"))) == 1


KILLED = """
import os, signal, sys
from jaxsr.data.cache import open_arrays

def progress(title, total):
    steps = iter(range(total))
    return lambda: os.kill(os.getpid(), signal.SIGKILL) if next(steps) == 1 else None

open_arrays(sys.argv[1], ("hr",), cache=sys.argv[2], progress=progress)
"""


def test_a_killed_conversion_is_not_taken_for_whole(tmp_path):
    seq, cache = make_sequence(tmp_path / "s", **SMALL), tmp_path / "cache"
    process = subprocess.run(
        [sys.executable, "-c", KILLED, str(seq.path), str(cache)],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[2],
        timeout=120,
    )
    assert process.returncode == -signal.SIGKILL
    assert len(leftovers(cache)) == 1
    arrays = open_arrays(seq.path, ("hr",), cache=cache)["hr"]
    np.testing.assert_array_equal(arrays.layers["color"][2], seq.truth(2).astype(np.float16))
    assert not leftovers(cache)  # its process is dead


def test_two_at_the_same_time_do_not_disturb_each_other(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    meet = threading.Barrier(2)

    def progress(title, total):
        meet.wait(30)  # both have seen that nothing is there
        return lambda: None

    found = []

    def work():
        found.append(open_arrays(seq.path, ("hr",), cache=tmp_path / "cache", progress=progress)["hr"])

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for layer, pixels in found[0].layers.items():
        np.testing.assert_array_equal(pixels, found[1].layers[layer])
    assert len(list((tmp_path / "cache").glob("*/*"))) == 1


@pytest.mark.parametrize(("layer", "value"), [("color", np.nan), ("depth", -np.inf), ("normal", np.inf)])
def test_bad_pixels_stop_only_those_who_need_them(tmp_path, layer, value):
    seq = make_sequence(tmp_path / "s", **SMALL)
    file = seq.path / "hr/0003.exr"
    channels, _ = read_exr(file)
    channels[f"{layer}.{LAYERS[layer].letters[0]}"][1, 2] = value
    write_exr(file, channels)
    arrays = open_arrays(seq.path, ("hr",), cache=tmp_path / "cache")["hr"]
    assert list(arrays.broken) == [layer]

    def windows(*needs):
        return WindowSource([seq.path], Needs(frozenset(needs)), Windows(), scale=1, cache=tmp_path / "cache")

    with pytest.raises(JaxsrError, match=rf"0003.exr: frame 3: layer '{layer}' .* x=2 y=1"):
        windows(f"lr.{layer}")
    if layer != "color":  # it is the truth, which is always needed
        assert len(windows("lr.color", "hr.roughness")) == 3


def test_sky_is_no_bad_pixel(tmp_path):
    def spoil(resolution, index, layers):
        layers["depth"][:2] = np.inf

    seq = make_sequence(tmp_path / "s", **SMALL, spoil=spoil)
    assert np.isinf(open_arrays(seq.path, ("hr",), cache=tmp_path / "c")["hr"].layers["depth"][:, :2]).all()


def test_a_sequence_that_is_being_written_is_refused(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)

    def progress(title, total):
        return lambda: os.utime(seq.path / "hr/0001.exr", (1, 1))

    with pytest.raises(JaxsrError, match=r"changed while it was read; let its writer finish"):
        open_arrays(seq.path, ("hr",), cache=tmp_path / "cache", progress=progress)
    assert not list((tmp_path / "cache").glob("*/*"))


def test_errors_name_the_place(tmp_path):
    seq, cache = make_sequence(tmp_path / "s", **SMALL), tmp_path / "cache"
    with pytest.raises(JaxsrError, match=r"scale 4 is not available; expected one of \[1, 2\]"):
        open_arrays(seq.path, ("x4",), cache=cache)
    (tmp_path / "file").write_text("")
    with pytest.raises(JaxsrError, match=r"file.*cannot write.*choose another folder"):
        open_arrays(seq.path, ("hr",), cache=tmp_path / "file")
    open_arrays(seq.path, ("hr",), cache=cache)
    for damaged in ("color.npy", "arrays.json"):
        file = next(cache.rglob(damaged))
        whole = file.read_bytes()
        file.write_bytes(whole[:100])
        with pytest.raises(JaxsrError, match=r"hr-.* cannot be read.*delete that folder"):
            open_arrays(seq.path, ("hr",), cache=cache)
        file.write_bytes(whole)


def test_a_disk_that_is_full_is_an_error(tmp_path):
    seq = make_sequence(tmp_path / "s", **SMALL)
    script = (
        "import resource, signal, sys; from jaxsr.data.cache import open_arrays\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))\n"
        "open_arrays(sys.argv[1], ('hr',), cache=sys.argv[2])"
    )
    process = subprocess.run(
        [sys.executable, "-c", script, str(seq.path), str(tmp_path / "cache")],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "cannot write; found File too large; make room" in process.stderr
    assert not leftovers(tmp_path)


def test_the_default_place_follows_xdg(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    seq = make_sequence(tmp_path / "s", **SMALL)
    start = time.time()
    open_arrays(seq.path, ("x2",))
    assert default_cache() == tmp_path / "home/jaxsr/arrays"
    (home,) = default_cache().iterdir()
    assert home.name.startswith("s-")
    assert home.stat().st_mtime >= start - 2
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache() == Path.home() / ".cache/jaxsr/arrays"
