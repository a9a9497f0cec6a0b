"""What the header of an OpenEXR file says, checked before the library decodes any pixel.

The library reports a file that was cut only as damaged, and it decodes a file of one megabyte to gigabytes
where the header asks for that. Here the header and the table of chunk offsets are walked: sizes, bytes per
pixel, and where the last chunk ends. Format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import mmap
import os
import struct
from pathlib import Path

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import open_file

MAX_PIXELS = 1 << 26
"""Pixels of an image at most: 8192 x 8192."""
MAX_BYTES = 1 << 32
"""Bytes of all decoded channels at most: 4 GiB."""
_MAX_ATTRIBUTES = 10_000
_MAGIC = 20000630
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
_BYTES_PER_VALUE = {0: 4, 1: 2, 2: 4}  # uint, half, float

Attributes = dict[str, bytes]


def check_file(path: Path, size: tuple[int, int] | None = None, because: str = "") -> None:
    """See that a file is a whole, flat OpenEXR image within the limits.

    Args:
        path: the file.
        size: the height and width that the image must have; overscan of up to its size on each side is
            allowed.
        because: for the error: what says so, such as "HR 32x24, scale 2".

    Raises:
        JaxsrError: no regular file, not OpenEXR, truncated, deep, too large, or of another size.
    """
    with open_file(path) as file:
        length = os.fstat(file.fileno()).st_size
        if length == 0:
            raise JaxsrError("the file is empty", where=path, fix="write it again")
        try:
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                parts, end, flags = _headers(data, path)
                _check_size(parts, path, size, because)
                needed = _needed_bytes(data, end, parts, flags)
        except OSError as e:
            raise JaxsrError("cannot be read", where=path, found=e.strerror or e) from e
        except struct.error as e:
            raise _truncated(path, length, "a whole header") from e
    if needed is None or needed > length:
        raise _truncated(path, length, "a finished file" if needed is None else f"{needed} bytes at least")


def _truncated(path: Path, length: int, expected: str) -> JaxsrError:
    return JaxsrError(
        "the file is truncated",
        where=path,
        expected=expected,
        found=f"{length} bytes",
        fix="the writer was stopped or the disk was full: write it again",
    )


def _headers(data: mmap.mmap, path: Path) -> tuple[list[Attributes], int, int]:
    """The headers of all parts, where they end, and the flags of the file."""
    if len(data) < 8 or struct.unpack_from("<i", data)[0] != _MAGIC:
        raise JaxsrError(
            "not an OpenEXR file",
            where=path,
            expected="the bytes 76 2f 31 01 at the start",
            found=data[:4].hex(" "),
        )
    flags = struct.unpack_from("<i", data, 4)[0]
    if flags & _DEEP:
        raise JaxsrError("holds deep pixels", where=path, expected="a flat image", fix="flatten it first")
    parts, at = [], 8
    while True:  # one header per part; a multi-part file ends them with an empty one
        attributes, at = _attributes(data, at, path)
        if attributes or not flags & _MULTIPART:
            parts.append(attributes)
        if not attributes or not flags & _MULTIPART:
            return parts, at, flags


def _check_size(parts: list[Attributes], path: Path, size: tuple[int, int] | None, because: str) -> None:
    total = 0
    for part in parts:
        shown, stored = _window(part, "displayWindow"), _window(part, "dataWindow")
        if shown is None or stored is None:
            continue  # the library says what is missing
        if size is not None and shown != size:
            expected, found = (f"{w}x{h}" for h, w in (size, shown))
            raise JaxsrError(
                "wrong size",
                where=path,
                expected=f"{expected} ({because})" if because else expected,
                found=found,
                fix="render it again, or correct what names its size",
            )
        for (h, w), name in ((shown, "image"), (stored, "data window")):
            allowed = MAX_PIXELS if size is None else min(MAX_PIXELS, 9 * size[0] * size[1])
            if h < 1 or w < 1 or h * w > allowed:
                raise JaxsrError(
                    f"the {name} is empty" if h < 1 or w < 1 else f"the {name} is too large",
                    where=path,
                    expected=f"1 to {allowed} pixels",
                    found=f"{w}x{h}",
                )
        total += _bytes_per_pixel(part) * max(shown[0] * shown[1], stored[0] * stored[1])
    if total > MAX_BYTES:
        raise JaxsrError(
            "the decoded image is too large", where=path, expected=f"at most {MAX_BYTES} bytes", found=total
        )


def _window(part: Attributes, name: str) -> tuple[int, int] | None:
    """Height and width of a window."""
    if name not in part:
        return None
    x0, y0, x1, y1 = struct.unpack("<4i", part[name])
    return y1 - y0 + 1, x1 - x0 + 1


def _bytes_per_pixel(part: Attributes) -> int:
    """Of all channels: name, 0, type, 4 bytes, two samplings; an empty name ends the list."""
    table, at, total = part.get("channels", b"\0"), 0, 0
    while at < len(table) and table[at]:
        at = table.find(b"\0", at) + 1
        if at == 0:
            raise struct.error("no end of a channel's name")
        (kind,) = struct.unpack_from("<i", table, at)
        total += _BYTES_PER_VALUE.get(kind, 4)
        at += 16
    return total


def _needed_bytes(data: mmap.mmap, at: int, parts: list[Attributes], flags: int) -> int | None:
    """Where the last chunk ends; None where the chunk table was never filled in, 0 if that cannot be told."""
    tiled, multipart, chunks = flags & _TILED, flags & _MULTIPART, 0
    for part in parts:
        if "chunkCount" in part:
            count = struct.unpack("<i", part["chunkCount"])[0]
        elif not tiled and "dataWindow" in part and part.get("compression"):
            lines = _LINES_PER_CHUNK.get(part["compression"][0], 0)
            count = -(-(_window(part, "dataWindow") or (0, 0))[0] // lines) if lines else 0
        else:
            count = 0
        if count <= 0:  # tiles without a count, or a compression of the future: left to the library
            return 0
        chunks += count
    end = at + 8 * chunks
    if end > len(data):
        raise struct.error("the table of chunks is longer than the file")
    offsets = np.frombuffer(data[at:end], "<u8")
    if not len(offsets) or offsets.min() == 0:
        return None if len(offsets) else 0
    # A chunk is [part number], coordinates, the length of its pixels, and the pixels.
    pixels = int(offsets.max()) + (4 if multipart else 0) + (16 if tiled else 4) + 4
    if pixels > len(data):
        return pixels
    return pixels + struct.unpack_from("<i", data, pixels - 4)[0]


def _attributes(data: mmap.mmap, at: int, path: Path) -> tuple[Attributes, int]:
    """The attributes of one header that starts at `at`, and where it ends."""
    found: Attributes = {}
    for _ in range(_MAX_ATTRIBUTES):
        end = data.find(b"\0", at)
        if end < 0:
            raise struct.error("no end of the attribute's name")
        if end == at:
            return found, at + 1
        name, kind_end = data[at:end].decode("latin-1"), data.find(b"\0", end + 1)
        if kind_end < 0:
            raise struct.error("no end of the attribute's type")
        (length,) = struct.unpack_from("<i", data, kind_end + 1)
        at = kind_end + 5 + length
        if length < 0 or at > len(data):
            raise struct.error("the attribute is longer than the file")
        found[name] = data[kind_end + 5 : at]
    raise JaxsrError("too many attributes", where=path, expected=f"at most {_MAX_ATTRIBUTES}")
