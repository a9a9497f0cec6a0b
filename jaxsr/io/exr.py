"""OpenEXR files as dictionaries of channels: names to `[H, W]` arrays of float16, float32 or uint32.

Types are kept as stored. Rows run down, row 0 is the top of the display window: a data window that is
larger is cropped, a smaller one is padded with zeros (or refused, `pad=False`). All parts of a multi-part
file are merged; where two parts share a channel name the names become `part.channel`. Deep images are not
read. Writing is single-part, scan lines, lossless, and atomic.
"""

import contextlib
import mmap
import os
import struct
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path

_COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION,
    "zips": OpenEXR.ZIPS_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
}
# Attributes that describe how the pixels lie in the file; the writer makes its own.
_STRUCTURE = {
    "channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio", "type",
    "screenWindowCenter", "screenWindowWidth", "tiles", "chunkCount", "version", "name", "view",
}  # fmt: skip
_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
_MAGIC = 20000630


def read_exr(path: str | Path, *, pad: bool = True) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read every channel of every part.

    Args:
        path: the file.
        pad: fill what the data window leaves out of the display window with zeros; False makes it an error.

    Returns:
        Channel name -> `[H, W]` array as stored, and the header's attributes that are not about layout
        (those of the first part win).

    Raises:
        JaxsrError: missing, not an OpenEXR file, truncated, damaged, deep, or not covering its window.
    """
    path = Path(path)
    _check_complete(path)
    file = _open(path, header_only=False)
    channels: dict[str, np.ndarray] = {}
    metadata: dict[str, Any] = {}
    count = [name for part in file.parts for name in part.channels]
    for number, part in enumerate(file.parts):
        header = part.header
        metadata = {k: v for k, v in header.items() if k not in _STRUCTURE} | metadata
        part_name = header.get("name") or str(number)
        for name, channel in part.channels.items():
            if channel.pixels is None:
                raise JaxsrError(f"channel {name!r} of part {part_name!r} has no pixels", where=path)
            if (channel.xSampling, channel.ySampling) != (1, 1):
                raise JaxsrError(
                    f"channel {name!r} is subsampled",
                    where=path,
                    expected="one value a pixel",
                    found=f"sampling {channel.xSampling}x{channel.ySampling}",
                    fix="write it again without chroma subsampling",
                )
            key = name if count.count(name) == 1 else f"{part_name}.{name}"
            channels[key] = _to_display_window(channel.pixels, header, f"{path}, channel {name!r}", pad)
    if not channels:
        raise JaxsrError("no channels could be read", where=path, fix="the file is damaged: write it again")
    return channels, metadata


def read_exr_header(path: str | Path) -> tuple[list[str], dict[str, Any]]:
    """Channel names of all parts (as `read_exr` names them) and attributes, without decoding pixels."""
    path = Path(path)
    _check_complete(path)
    parts = _open(path, header_only=True).parts
    names = [[c.name for c in part.header["channels"]] for part in parts]
    flat = [name for part in names for name in part]
    keys: list[str] = []
    metadata: dict[str, Any] = {}
    for number, (part, part_names) in enumerate(zip(parts, names, strict=True)):
        part_name = part.header.get("name") or str(number)
        keys += [n if flat.count(n) == 1 else f"{part_name}.{n}" for n in part_names]
        metadata = {k: v for k, v in part.header.items() if k not in _STRUCTURE} | metadata
    return keys, metadata


def write_exr(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any] | None = None,
    compression: str = "zip",
) -> None:
    """Write one single-part file, atomically.

    Args:
        path: the file; its folder is made.
        channels: name -> `[H, W]` array, all of one size, of float16, float32 or uint32.
        metadata: attributes for the header: strings, numbers, or what `read_exr` returned.
        compression: "zip" (16 lines a block), "zips" (1 line), "piz" or "none". All lossless: the lossy
            ones spoil G-buffers.

    Raises:
        JaxsrError: wrong shape, type, name or attribute; a file that cannot be written.
    """
    path = Path(path)
    if compression not in _COMPRESSIONS:
        raise JaxsrError(
            f"unknown compression {compression!r}", where=path, expected=f"one of {sorted(_COMPRESSIONS)}"
        )
    if not channels:
        raise JaxsrError("no channels to write", where=path)
    shape = np.shape(next(iter(channels.values())))
    for name, pixels in channels.items():
        if np.ndim(pixels) != 2 or np.shape(pixels) != shape or 0 in shape:
            raise JaxsrError(
                f"channel {name!r} has the wrong shape", where=path, expected=shape, found=np.shape(pixels)
            )
        if pixels.dtype not in (np.float16, np.float32, np.uint32):
            raise JaxsrError(
                f"channel {name!r} has a type that OpenEXR does not store",
                where=path,
                expected="float16, float32 or uint32",
                found=pixels.dtype,
                fix="convert it first",
            )
    header = {k: v for k, v in (metadata or {}).items() if k not in _STRUCTURE}
    header |= {"compression": _COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    # OpenEXR puts Channel objects into the dictionary it is given: hand it a fresh one.
    pixels_by_name = {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, pixels_by_name).write(str(temporary))
        except (RuntimeError, ValueError, TypeError) as e:
            raise JaxsrError("cannot be written as OpenEXR", where=path, found=e) from e


class _Muted:
    """Python's stdout without what the reading threads print; all other threads write through it."""

    lock = threading.Lock()
    readers: set[int] = set()  # noqa: RUF012
    last: "_Muted | None" = None
    """Kept and used again: `print` holds no reference to sys.stdout, so one that is freed here crashes it."""

    def __init__(self, stream: Any):
        self.stream = stream

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() in self.readers else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def _muted() -> Iterator[None]:
    """The binding prints a warning about damaged pixels to stdout, where a program may expect JSON.

    The lines that the C library writes to stderr stay: other threads may be writing there, too.
    """
    with _Muted.lock:
        _Muted.readers.add(threading.get_ident())
        if sys.stdout is not None and not isinstance(sys.stdout, _Muted):
            if _Muted.last is None or _Muted.last.stream is not sys.stdout:
                _Muted.last = _Muted(sys.stdout)
            sys.stdout = _Muted.last
    try:
        yield
    finally:
        with _Muted.lock:
            _Muted.readers.discard(threading.get_ident())
            if not _Muted.readers and isinstance(sys.stdout, _Muted):
                sys.stdout = sys.stdout.stream


def _open(path: Path, header_only: bool) -> Any:
    try:
        with _muted():
            file = OpenEXR.File(str(path), separate_channels=True, header_only=header_only)
    except (RuntimeError, ValueError, TypeError) as e:
        raise JaxsrError("OpenEXR cannot read it", where=path, found=e, fix="write the file again") from e
    # A part whose pixels cannot be decoded is left out by the library, with a warning on stderr.
    if not file.parts or any(p.header.get("channels") is None for p in file.parts):
        raise JaxsrError("the pixel data is damaged", where=path, fix="write the file again")
    return file


def _to_display_window(pixels: np.ndarray, header: Mapping[str, Any], where: str, pad: bool) -> np.ndarray:
    (x0, y0), (x1, y1) = (np.asarray(corner, int) for corner in header["dataWindow"])
    (u0, v0), (u1, v1) = (np.asarray(corner, int) for corner in header["displayWindow"])
    if (x0, y0, x1, y1) == (u0, v0, u1, v1):
        return pixels
    covers = x0 <= u0 and y0 <= v0 and x1 >= u1 and y1 >= v1
    if not covers and not pad:
        raise JaxsrError(
            "the data window does not cover the display window",
            where=where,
            expected=f"at least ({u0}, {v0})..({u1}, {v1})",
            found=f"({x0}, {y0})..({x1}, {y1})",
            fix="render the whole frame, without a render region",
        )
    out = np.zeros((v1 - v0 + 1, u1 - u0 + 1), pixels.dtype)
    left, top, right, bottom = max(x0, u0), max(y0, v0), min(x1, u1), min(y1, v1)
    if left <= right and top <= bottom:
        out[top - v0 : bottom - v0 + 1, left - u0 : right - u0 + 1] = pixels[
            top - y0 : bottom - y0 + 1, left - x0 : right - x0 + 1
        ]
    return out


def _check_complete(path: Path) -> None:
    """Walk the header and the table of chunk offsets: the library reports a cut file only as damaged."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise JaxsrError("the file is empty", where=path, fix="write it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                if size < 8 or struct.unpack_from("<i", data)[0] != _MAGIC:
                    raise JaxsrError(
                        "not an OpenEXR file",
                        where=path,
                        expected="the bytes 76 2f 31 01 at the start",
                        found=data[:4].hex(" "),
                    )
                needed = _needed_bytes(data, path)
    except FileNotFoundError as e:
        raise JaxsrError("no such file", where=path) from e
    except IsADirectoryError as e:
        raise JaxsrError("is a folder", where=path, expected="an OpenEXR file") from e
    except OSError as e:
        raise JaxsrError("cannot be read", where=path, found=e.strerror or e) from e
    except struct.error as e:
        raise _truncated(path, size, "a whole header") from e
    if needed is None or needed > size:
        raise _truncated(path, size, "a finished file" if needed is None else f"{needed} bytes at least")


def _truncated(path: Path, size: int, expected: str) -> JaxsrError:
    return JaxsrError(
        "the file is truncated",
        where=path,
        expected=expected,
        found=f"{size} bytes",
        fix="the writer was stopped or the disk was full: write it again",
    )


def _needed_bytes(data: mmap.mmap, path: Path) -> int | None:
    """Where the last chunk ends; None when the chunk table was never filled in."""
    flags = struct.unpack_from("<i", data, 4)[0]
    tiled, deep, multipart = flags & 0x200, flags & 0x800, flags & 0x1000
    if deep:
        raise JaxsrError("holds deep pixels", where=path, expected="a flat image", fix="flatten it first")
    at, chunks, known = 8, 0, True
    while True:  # one header a part; a multi-part file ends them with an empty one
        attributes, at = _attributes(data, at)
        if multipart and not attributes:
            break
        if "chunkCount" in attributes:
            chunks += struct.unpack("<i", attributes["chunkCount"])[0]
        elif not tiled and "dataWindow" in attributes and "compression" in attributes:
            _, y0, _, y1 = struct.unpack("<4i", attributes["dataWindow"])
            lines = _LINES_PER_CHUNK.get(attributes["compression"][0])
            known, chunks = known and lines is not None, chunks + -(-(y1 - y0 + 1) // (lines or 1))
        else:
            known = False
        if not multipart:
            break
    if not known or not 0 < chunks < 1 << 28:
        return 0  # tiles without a chunk count: left to the library
    offsets = struct.unpack_from(f"<{chunks}Q", data, at)
    if min(offsets) == 0:
        return None
    # A chunk is [part number], coordinates, the length of its pixels, and the pixels.
    pixels = max(offsets) + (4 if multipart else 0) + (16 if tiled else 4) + 4
    if pixels > len(data):
        return pixels
    return pixels + struct.unpack_from("<i", data, pixels - 4)[0]


def _attributes(data: mmap.mmap, at: int) -> tuple[dict[str, bytes], int]:
    found: dict[str, bytes] = {}
    while True:
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
