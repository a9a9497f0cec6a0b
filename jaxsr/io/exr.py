"""OpenEXR files as dictionaries of channels: names to `[H, W]` arrays of float16, float32 or uint32.

Types are kept as stored. Rows run down, row 0 is the top of the display window: a data window that is
larger is cropped, a smaller one is padded with zeros (or refused, `pad=False`). All parts of a multi-part
file are merged; where two parts share a channel name the names become `part.channel`. Deep images are not
read. Writing is single-part, scan lines, lossless, and atomic.
"""

import contextlib
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path
from jaxsr.io.exr_header import check_file

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


def read_exr(
    path: str | Path, *, pad: bool = True, size: tuple[int, int] | None = None, because: str = ""
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read every channel of every part.

    Args:
        path: the file.
        pad: fill what the data window leaves out of the display window with zeros; False makes it an error.
        size: the height and width that the image must have. They are compared with the header, before any
            pixel is decoded: a small file can hold a huge image.
        because: for the error: what says that size, such as "HR 32x24, scale 2".

    Returns:
        Channel name -> `[H, W]` array as stored, and the header's attributes that are not about layout
        (those of the first part win).

    Raises:
        JaxsrError: missing, not an OpenEXR file, truncated, damaged, deep, of another size, above the limits
            of `jaxsr.io.exr_header`, or not covering its window.
    """
    path = Path(path)
    check_file(path, size, because)
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
                    expected="one value per pixel",
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
    check_file(path)
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
        compression: "zip" (blocks of 16 lines), "zips" (of 1 line), "piz" or "none". All lossless: the lossy
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
    """The latest one, which is used again. `print` in another thread holds no reference to sys.stdout: if
    this object were freed, that thread would crash."""

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
