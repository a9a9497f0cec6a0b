"""jaxsr.io.exr: what is written comes back, and every way a file can be wrong is one clear line."""

import contextlib
import os
import struct
import sys
import threading
import time
import tracemalloc

import numpy as np
import OpenEXR
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.io import exr_header
from jaxsr.io.exr import read_exr, read_exr_header, write_exr


def example(h=20, w=30):
    rng = np.random.default_rng(0)
    depth = rng.normal(size=(h, w)).astype(np.float32)
    depth[0, 0], depth[0, 1] = np.inf, np.nan
    return {
        "color.R": rng.normal(size=(h, w)).astype(np.float16),
        "depth.Z": depth,
        "object_id.V": rng.integers(0, 2**32, (h, w), dtype=np.uint32),
    }


@pytest.mark.parametrize("compression", ["zip", "zips", "piz", "none"])
def test_types_values_and_metadata_survive(tmp_path, compression):
    channels = example()
    keep = dict(channels)
    write_exr(tmp_path / "a.exr", channels, {"note": "hello", "seed": 3, "gain": 1.5}, compression)
    assert all(channels[k] is keep[k] for k in keep), "the caller's dictionary was changed"
    back, metadata = read_exr(tmp_path / "a.exr")
    assert set(back) == set(channels)
    for name, pixels in channels.items():
        assert back[name].dtype == pixels.dtype
        np.testing.assert_array_equal(back[name], pixels)
    assert metadata == {"note": "hello", "seed": 3, "gain": 1.5}
    write_exr(tmp_path / "b.exr", back, metadata)
    assert read_exr(tmp_path / "b.exr")[1] == metadata
    assert read_exr_header(tmp_path / "a.exr") == (sorted(channels), metadata)


@pytest.mark.parametrize(("h", "w"), [(1, 1), (1, 7), (17, 1), (33, 5)])
def test_small_and_odd_sizes(tmp_path, h, w):
    channels = example(max(h, 2), max(w, 2))
    channels = {k: v[:h, :w] for k, v in channels.items()}  # not contiguous
    write_exr(tmp_path / "a.exr", channels)
    for name, pixels in read_exr(tmp_path / "a.exr")[0].items():
        np.testing.assert_array_equal(pixels, channels[name])


def test_parts_are_merged_and_clashes_named(tmp_path):
    a, b = np.zeros((4, 6), np.float32), np.ones((4, 6), np.float32)
    parts = [OpenEXR.Part({}, {"Z": a}, "front"), OpenEXR.Part({}, {"Z": b, "N.X": b}, "back")]
    OpenEXR.File(parts).write(str(tmp_path / "m.exr"))
    back, _ = read_exr(tmp_path / "m.exr")
    assert set(back) == {"front.Z", "back.Z", "N.X"} == set(read_exr_header(tmp_path / "m.exr")[0])
    np.testing.assert_array_equal(back["back.Z"], b)


def windowed(path, data, display):
    (x0, y0, x1, y1), (u0, v0, u1, v1) = data, display
    pixels = np.arange((y1 - y0 + 1) * (x1 - x0 + 1), dtype=np.float32).reshape(y1 - y0 + 1, -1)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)),
        "displayWindow": (np.array([u0, v0], np.int32), np.array([u1, v1], np.int32)),
    }
    OpenEXR.File(header, {"Z": pixels.copy()}).write(str(path))
    return pixels


def test_overscan_is_cropped(tmp_path):
    pixels = windowed(tmp_path / "o.exr", (-2, -1, 9, 6), (0, 0, 7, 5))
    for pad in (True, False):
        np.testing.assert_array_equal(read_exr(tmp_path / "o.exr", pad=pad)[0]["Z"], pixels[1:7, 2:10])


def test_a_render_region_is_padded_or_refused(tmp_path):
    pixels = windowed(tmp_path / "r.exr", (2, 1, 5, 3), (0, 0, 7, 5))
    expected = np.zeros((6, 8), np.float32)
    expected[1:4, 2:6] = pixels
    np.testing.assert_array_equal(read_exr(tmp_path / "r.exr")[0]["Z"], expected)
    with pytest.raises(JaxsrError, match=r"r\.exr, channel 'Z'.*data window.*\(0, 0\)\.\.\(7, 5\)"):
        read_exr(tmp_path / "r.exr", pad=False)


def test_truncated_at_every_length_says_so(tmp_path, capfd):
    write_exr(tmp_path / "a.exr", example())
    whole = (tmp_path / "a.exr").read_bytes()
    cut = tmp_path / "cut.exr"
    for n in [*range(8, 600, 7), len(whole) // 2, len(whole) - 1]:
        cut.write_bytes(whole[:n])
        with pytest.raises(JaxsrError, match=rf"cut\.exr: the file is truncated.*found {n} bytes"):
            read_exr(cut)
        with pytest.raises(JaxsrError, match="truncated"):
            read_exr_header(cut)
    assert capfd.readouterr().err == "", "the library's own complaints leak to the user"


def test_multipart_truncated(tmp_path):
    z = np.random.default_rng(0).normal(size=(40, 6)).astype(np.float32)
    OpenEXR.File([OpenEXR.Part({}, {"Z": z}, "a"), OpenEXR.Part({}, {"N": z}, "b")]).write(
        str(tmp_path / "m.exr")
    )
    whole = (tmp_path / "m.exr").read_bytes()
    read_exr(tmp_path / "m.exr")
    (tmp_path / "m.exr").write_bytes(whole[:-5])
    with pytest.raises(JaxsrError, match="truncated"):
        read_exr(tmp_path / "m.exr")


def test_a_tiled_file_is_read(tmp_path):
    z = np.random.default_rng(0).normal(size=(70, 50)).astype(np.float32)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 32
    header = {"type": OpenEXR.tiledimage, "tiles": tiles, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"Z": z}).write(str(tmp_path / "t.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "t.exr")[0]["Z"], z)


def test_an_unfinished_file_is_truncated(tmp_path):
    write_exr(tmp_path / "a.exr", example())
    whole = bytearray((tmp_path / "a.exr").read_bytes())
    chunks = 2  # 20 lines, 16 a chunk
    end_of_header = len(whole) - _chunks_length(whole)
    whole[end_of_header : end_of_header + 8 * chunks] = b"\0" * (8 * chunks)
    (tmp_path / "a.exr").write_bytes(whole)
    with pytest.raises(JaxsrError, match="truncated; expected a finished file"):
        read_exr(tmp_path / "a.exr")


def _chunks_length(data: bytes) -> int:
    """Bytes from the chunk table to the end: the first offset points just behind the table of 2."""
    for at in range(8, len(data) - 8):
        if int.from_bytes(data[at : at + 8], "little") == at + 16:
            return len(data) - at
    raise AssertionError("no chunk table")


def damaged(path):
    write_exr(path, {"Z": np.arange(6000, dtype=np.float32).reshape(60, 100)})
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2 : len(whole) // 2 + 200] = b"\x55" * 200
    path.write_bytes(whole)
    return path


def test_damaged_pixels_are_one_error_and_nothing_is_printed(tmp_path, capsys):
    path, stdout = damaged(tmp_path / "a.exr"), sys.stdout
    with pytest.raises(JaxsrError, match=r"a\.exr: the pixel data is damaged"):
        read_exr(path)
    assert capsys.readouterr().out == ""
    assert sys.stdout is stdout


def test_other_threads_print_while_damaged_pixels_are_read(tmp_path, capsys):
    path, done, stdout = damaged(tmp_path / "a.exr"), threading.Event(), sys.stdout

    def work():
        for _ in range(30):
            with contextlib.suppress(JaxsrError):
                read_exr(path)
        done.set()

    threads = [threading.Thread(target=work) for _ in range(2)]
    for t in threads:
        t.start()
    lines = 0
    while lines < 50 or not done.is_set():
        print("mine")
        lines += 1
    for t in threads:
        t.join()
    assert capsys.readouterr().out == "mine\n" * lines
    assert sys.stdout is stdout


def test_what_is_no_exr(tmp_path):
    with pytest.raises(JaxsrError, match=r"gone\.exr: no such file"):
        read_exr(tmp_path / "gone.exr")
    with pytest.raises(JaxsrError, match="is a folder"):
        read_exr(tmp_path)
    (tmp_path / "e.exr").write_bytes(b"")
    with pytest.raises(JaxsrError, match="empty"):
        read_exr(tmp_path / "e.exr")
    (tmp_path / "p.exr").write_bytes(b"\x89PNG\r\n\x1a\n" * 9)
    with pytest.raises(JaxsrError, match=r"not an OpenEXR file.*found 89 50 4e 47"):
        read_exr(tmp_path / "p.exr")


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"a": np.zeros((2, 3), np.float32), "b": np.zeros((3, 2), np.float32)}, "channel 'b'.*wrong shape"),
        ({"a": np.zeros((2, 3, 1), np.float32)}, "channel 'a'.*wrong shape"),
        ({"a": np.zeros((2, 3))}, "channel 'a'.*float64"),
        ({}, "no channels"),
    ],
)
def test_writing_refuses(tmp_path, channels, message):
    with pytest.raises(JaxsrError, match=message):
        write_exr(tmp_path / "a.exr", channels)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    write_exr(tmp_path / "a.exr", example())
    before = (tmp_path / "a.exr").read_bytes()
    with pytest.raises(JaxsrError, match=r"a\.exr: cannot be written"):
        write_exr(tmp_path / "a.exr", example(), {"bad": object()})
    with pytest.raises(JaxsrError, match="compression 'dwaa'"):
        write_exr(tmp_path / "a.exr", example(), compression="dwaa")
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    assert (tmp_path / "a.exr").read_bytes() == before
    (tmp_path / "file").write_text("")
    with pytest.raises(JaxsrError, match="cannot write"):
        write_exr(tmp_path / "file" / "a.exr", example())


def patched(path, attribute: bytes, value: bytes):
    """Replace the value of an attribute in the header."""
    data = bytearray(path.read_bytes())
    at = data.index(attribute + b"\0") + len(attribute) + 1
    at = data.index(b"\0", at) + 5
    data[at : at + len(value)] = value
    path.write_bytes(data)
    return path


def refused(call, message):
    """The call raises one line that matches, in little time and memory."""
    tracemalloc.start()
    start = time.monotonic()
    try:
        with pytest.raises(JaxsrError, match=message) as caught:
            call()
        seconds, (_, peak) = time.monotonic() - start, tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert seconds < 2
    assert peak < 50e6
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        ((0, 0, 2**31 - 1, 2**31 - 1), r"a\.exr: the .* is too large; .* found 2147483648x2147483648"),
        ((-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), "too large; .* found 4294967296x4294967296"),
        ((0, 0, 2**31 - 1, 0), "too large"),
        ((5, 5, 0, 0), "is empty; .*found -4x-4"),
    ],
)
@pytest.mark.parametrize("name", [b"dataWindow", b"displayWindow"])
def test_headers_of_impossible_sizes(tmp_path, window, message, name):
    write_exr(tmp_path / "a.exr", example(4, 6), compression="zips")
    patched(tmp_path / "a.exr", name, struct.pack("<4i", *window))
    refused(lambda: read_exr(tmp_path / "a.exr"), message)


def test_a_huge_image_is_refused_by_its_header(tmp_path):
    """Zeros compress a thousandfold: a file of one megabyte decodes to gigabytes."""
    write_exr(tmp_path / "a.exr", {c: np.zeros((1200, 1200), np.float16) for c in "RGB"})
    refused(
        lambda: read_exr(tmp_path / "a.exr", size=(24, 32), because="scale 2"),
        r"wrong size; expected 32x24 \(scale 2\); found 1200x1200",
    )
    assert read_exr(tmp_path / "a.exr", size=(1200, 1200))[0]["R"].shape == (1200, 1200)
    windowed(tmp_path / "o.exr", (-99, -99, 100, 100), (0, 0, 7, 5))  # overscan of many times the image
    with pytest.raises(JaxsrError, match="data window is too large; expected 1 to 432 pixels; found 200x200"):
        read_exr(tmp_path / "o.exr", size=(6, 8))
    assert read_exr(tmp_path / "o.exr")[0]["Z"].shape == (6, 8)


def test_the_limits_without_an_expected_size(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", {c: np.zeros((60, 50), np.float16) for c in "RGB"})
    monkeypatch.setattr(exr_header, "MAX_PIXELS", 2999)
    with pytest.raises(JaxsrError, match="too large; expected 1 to 2999 pixels; found 50x60"):
        read_exr(tmp_path / "a.exr")
    monkeypatch.setattr(exr_header, "MAX_PIXELS", 3000)
    monkeypatch.setattr(exr_header, "MAX_BYTES", 3000 * 6 - 1)
    with pytest.raises(JaxsrError, match=r"decoded image is too large; expected at most 17999.*found 18000"):
        read_exr(tmp_path / "a.exr")
    monkeypatch.setattr(exr_header, "MAX_BYTES", 3000 * 6)
    assert set(read_exr(tmp_path / "a.exr")[0]) == set("RGB")


def test_headers_of_rubbish(tmp_path):
    magic, rng = bytes.fromhex("762f310102000000"), np.random.default_rng(0)
    for k, tail in enumerate(
        [
            b"",
            b"\0",
            b"a\0b\0" + struct.pack("<i", -5),
            b"a\0b\0" + struct.pack("<i", 2**31 - 1),
            b"a\0b",
            b"dataWindow\0box2i\0" + struct.pack("<i", 3) + b"abc\0" + b"x" * 100,
            b"compression\0compression\0" + struct.pack("<i", 0) + b"\0" + b"x" * 100,
            b"".join(b"%d\0int\0" % i + struct.pack("<ii", 4, 0) for i in range(20_000)),
            *(rng.bytes(400) for _ in range(20)),
        ]
    ):
        (tmp_path / f"{k}.exr").write_bytes(magic + tail)
        for read in (read_exr, read_exr_header):
            refused(lambda read=read, k=k: read(tmp_path / f"{k}.exr"), rf"{k}\.exr: ")


def test_a_header_of_one_byte_changed_is_read_or_refused(tmp_path):
    write_exr(tmp_path / "a.exr", example(6, 8))
    whole = (tmp_path / "a.exr").read_bytes()
    rng = np.random.default_rng(1)
    for at in rng.choice(len(whole) - 8, 200, replace=False) + 8:
        data = bytearray(whole)
        data[at] = rng.integers(256)
        (tmp_path / "b.exr").write_bytes(data)
        with contextlib.suppress(JaxsrError):
            read_exr(tmp_path / "b.exr", size=(6, 8))


def test_a_pipe_is_refused_and_never_waited_for(tmp_path):
    os.mkfifo(tmp_path / "0001.exr")
    for read in (read_exr, read_exr_header):
        with pytest.raises(JaxsrError, match=r"0001\.exr: is not a regular file; .*found a named pipe"):
            read(tmp_path / "0001.exr")


def test_reading_from_threads(tmp_path):
    for k in range(4):
        write_exr(tmp_path / f"{k}.exr", {"Z": np.full((40, 40), k, np.float32)})
    wrong = []

    def work(k):
        for _ in range(10):
            if not (read_exr(tmp_path / f"{k}.exr")[0]["Z"] == k).all():
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not wrong
