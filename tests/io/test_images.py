"""jaxsr.io.images: PNG round trips, the sRGB curve, and which layer of an OpenEXR file is the colour."""

import os
import struct
import time
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

from jaxsr.errors import JaxsrError
from jaxsr.io.exr import write_exr
from jaxsr.io.images import read_color, read_png, write_png
from jaxsr.srgb import linear_from_srgb


def test_png_round_trip(tmp_path):
    levels = (np.arange(256) / 255).astype(np.float32).reshape(16, 16, 1)
    image = np.concatenate([levels, levels[::-1], levels[:, ::-1]], -1)
    write_png(tmp_path / "sub" / "a.png", image)
    np.testing.assert_array_equal(read_png(tmp_path / "sub" / "a.png"), image)
    write_png(tmp_path / "b.png", (image * 255).round().astype(np.uint8))
    np.testing.assert_array_equal(read_png(tmp_path / "b.png"), image)


def test_png_clips_rounds_and_repeats_grey(tmp_path):
    write_png(tmp_path / "a.png", np.array([[-1.0, 0.4999 / 255, 0.5001 / 255, 7.0, np.inf]]))
    expected = np.repeat(np.array([0, 0, 1, 255, 255], np.float32)[None, :, None] / 255, 3, -1)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), expected)
    write_png(tmp_path / "b.png", np.full((2, 2, 4), 0.5, np.float32))
    assert read_png(tmp_path / "b.png").shape == (2, 2, 3)


def test_16_bit_grey_is_not_clipped(tmp_path):
    Image.fromarray(np.array([[0, 32768, 65535]], np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_png(tmp_path / "a.png")[0, :, 0], [0, 32768 / 65535, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.full((2, 2, 3), np.nan), "holds NaN"),
        (np.zeros((2, 2, 2)), "not a picture"),
        (np.zeros((0, 2, 3)), "not a picture"),
        (np.zeros((2, 2, 3), np.int64), "wrong type"),
    ],
)
def test_png_refuses(tmp_path, image, message):
    with pytest.raises(JaxsrError, match=message):
        write_png(tmp_path / "a.png", image)
    assert not list(tmp_path.iterdir())


def test_read_color(tmp_path):
    rgb = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32) * 3
    for number, prefix in enumerate(["", "color.", "ViewLayer.Combined.", "beauty."]):
        channels = {f"{prefix}{c}": rgb[..., k] for k, c in enumerate("RGB")}
        write_exr(tmp_path / f"{number}.exr", channels | {"depth.Z": rgb[..., 0]})
        np.testing.assert_array_equal(read_color(tmp_path / f"{number}.exr"), rgb)
    write_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(
        read_color(tmp_path / "a.png"), linear_from_srgb(read_png(tmp_path / "a.png"))
    )


def test_color_is_chosen_before_other_layers(tmp_path):
    ones = np.ones((2, 2), np.float32)
    channels = {f"base_color.{c}": 0 * ones for c in "RGB"} | {f"color.{c}": ones for c in "RGB"}
    write_exr(tmp_path / "a.exr", channels)
    assert read_color(tmp_path / "a.exr").min() == 1


def test_read_color_errors(tmp_path):
    z = np.zeros((2, 2), np.float32)
    write_exr(tmp_path / "none.exr", {"depth.Z": z})
    with pytest.raises(JaxsrError, match=r"no colour layer.*found depth\.Z"):
        read_color(tmp_path / "none.exr")
    write_exr(tmp_path / "two.exr", {f"{layer}.{c}": z for layer in "ab" for c in "RGB"})
    with pytest.raises(JaxsrError, match="several layers"):
        read_color(tmp_path / "two.exr")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(JaxsrError, match=r"unknown kind.*found \.txt"):
        read_color(tmp_path / "a.txt")
    (tmp_path / "a.png").write_text("x")
    with pytest.raises(JaxsrError, match=r"a\.png: cannot be read"):
        read_color(tmp_path / "a.png")
    with pytest.raises(JaxsrError, match="no such file"):
        read_color(tmp_path / "gone.png")
    write_png(tmp_path / "huge.png", np.zeros((2, 2, 3)))
    data = bytearray((tmp_path / "huge.png").read_bytes())
    data[16:24] = struct.pack(">II", 60000, 60000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (tmp_path / "huge.png").write_bytes(data)
    with pytest.raises(JaxsrError, match=r"huge\.png: the picture is too large; .* found 60000x60000"):
        read_color(tmp_path / "huge.png")
    write_png(tmp_path / "whole.png", np.random.default_rng(0).random((64, 64, 3)))
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:3000])
    with pytest.raises(JaxsrError, match=r"cut\.png: cannot be read"):
        read_color(tmp_path / "cut.png")


def png_of(path, width, height, rows):
    """A grey PNG whose header says one size and whose pixels are `rows` lines of zeros."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(rows * (width + 1))))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + body + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("side", [13_000, 14_000, 2**31 - 1])
def test_a_huge_picture_is_refused_by_its_header(tmp_path, side):
    path = png_of(tmp_path / "a.png", side, side, 1 if side > 20_000 else 100)
    start = time.monotonic()
    tracemalloc.start()
    with pytest.raises(JaxsrError, match=rf"a\.png: the picture is too large; .* found {side}x{side}"):
        read_png(path)
    with pytest.raises(JaxsrError, match=rf"a\.png: wrong size; expected 3x2; found {side}x{side}"):
        read_color(path, size=(2, 3))
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert time.monotonic() - start < 1


def test_the_expected_size(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((2, 3, 3)))
    assert read_png(tmp_path / "a.png", (2, 3)).shape == (2, 3, 3)
    with pytest.raises(JaxsrError, match="wrong size; expected 2x3; found 3x2"):
        read_png(tmp_path / "a.png", (3, 2))
    write_exr(tmp_path / "a.exr", {c: np.zeros((2, 3), np.float32) for c in "RGB"})
    assert read_color(tmp_path / "a.exr", (2, 3)).shape == (2, 3, 3)
    with pytest.raises(JaxsrError, match="wrong size; expected 2x3; found 3x2"):
        read_color(tmp_path / "a.exr", (3, 2))


def test_other_formats_under_the_name_of_a_picture(tmp_path):
    gif, tiff = Image.new("RGB", (2, 2)), Image.new("RGB", (2, 2))
    gif.save(tmp_path / "gif.png", format="GIF")
    tiff.save(tmp_path / "tiff.png", format="TIFF")
    (tmp_path / "ps.png").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "short.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "short.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    (tmp_path / "rubbish.jpg").write_bytes(b"\xff\xd8\xff" + np.random.default_rng(0).bytes(500))
    for name, message in [
        ("ps.png", "expected PNG or JPEG; found the bytes 25 21 50 53"),
        ("gif.png", "expected PNG or JPEG; found the bytes 47 49 46 38"),
        ("tiff.png", "expected PNG or JPEG"),
        ("empty.png", "expected PNG or JPEG; found an empty file"),
        ("short.png", ""),
        ("short.jpg", ""),
        ("rubbish.jpg", ""),
    ]:
        with pytest.raises(JaxsrError, match=f"{name}: cannot be read as a picture; {message}") as caught:
            read_color(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_pipe_is_refused_and_never_waited_for(tmp_path):
    for name in ("a.png", "a.exr"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(JaxsrError, match=f"{name}: is not a regular file; .*found a named pipe"):
            read_color(tmp_path / name)


def test_jpeg_and_pictures_cut_anywhere(tmp_path):
    image = np.arange(24 * 32 * 3, dtype=np.float32).reshape(24, 32, 3)
    image = (image / 9).astype(np.uint8)
    for kind in ("png", "jpg"):
        whole, cut = tmp_path / f"a.{kind}", tmp_path / f"cut.{kind}"
        Image.fromarray(image).save(whole, quality=95)
        np.testing.assert_allclose(read_png(whole), image / 255, atol=0 if kind == "png" else 0.03, rtol=1e-6)
        data = whole.read_bytes()
        for n in range(0, len(data) // 2, len(data) // 40):
            cut.write_bytes(data[:n])
            with pytest.raises(JaxsrError, match=rf"cut\.{kind}: cannot be read"):
                read_png(cut)
