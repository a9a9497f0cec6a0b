"""Sequences as memory-mapped arrays, because training needs crops and decoding whole OpenEXR files is slow.

Each resolution of a sequence ("hr", "x2", ...) is converted once, when it is first asked for, to one file
`[N, H, W, C]` per layer in the type of the OpenEXR channels, under

    <cache>/<name of the folder>-<hash of its path>/<resolution>-<key>/   color.npy depth.npy ... arrays.json

The key is a hash of the bytes of `sequence.json` and of the sizes and times of the frames' files: a changed
sequence is converted again, and the arrays of its earlier state are deleted. A conversion is written under a
temporary name and renamed when it is complete; processes that convert the same one at the same time do
not disturb each other. Pixels are checked as in `Sequence`, but a bad layer is an error only for methods that
need it: `arrays.json` records the fault. Positions are not converted, because no frame has them.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_folder, read_json, remove_leftovers
from jaxsr.io.description import check_pixels
from jaxsr.io.sequence import Sequence
from jaxsr.io.writing import frame_file
from jaxsr.layers import LAYERS
from jaxsr.progress import Progress, silent

_VERSION = 2
_WORKERS = 4


class Arrays(NamedTuple):
    """A sequence, and the memory maps of one of its resolutions."""

    sequence: Sequence
    resolution: str
    layers: dict[str, np.ndarray]
    """Layer -> `[N, H, W, C]`, read-only, of float16, float32 or uint32; read from disk as it is touched."""
    absent: dict[str, int]
    """Layer that some frames have and others lack -> the number of the first frame that lacks it."""
    broken: dict[str, dict[str, str]]
    """Layer with invalid values -> the fault, as arguments of `JaxsrError`."""


def default_cache() -> Path:
    """`$XDG_CACHE_HOME/jaxsr/arrays`, by default `~/.cache/jaxsr/arrays`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsr" / "arrays"


def open_arrays(
    path: str | Path,
    resolutions: Iterable[str],
    *,
    cache: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Arrays]:
    """Memory maps of a sequence; it is converted first if there is no conversion yet.

    Args:
        path: the folder of the sequence.
        resolutions: some of "hr", "x2", ...
        cache: folder of the arrays; `default_cache()` by default.
        progress: called for each converted frame.

    Returns:
        Resolution -> its arrays.

    Raises:
        JaxsrError: not a sequence, no such resolution, damaged or wrong pixels (the file is named), a
            sequence that changes while it is read, a cache that cannot be written.
    """
    seq = Sequence.open(path)
    home = (default_cache() if cache is None else Path(cache)) / _name(seq.path)
    found = {}
    for resolution in resolutions:
        seq.layers(resolution)  # the error for an unknown resolution lists the known ones
        found[resolution] = _open(seq, resolution, home, progress)
    return found


def source_key(seq: Sequence, resolution: str, times: bool = True) -> str:
    """A hash that changes with `sequence.json` and with the files of a resolution.

    Args:
        times: include the times of modification, which change when files are copied.
    """
    digest = hashlib.sha256(f"{_VERSION} {resolution}\n".encode())
    try:
        digest.update((seq.path / "sequence.json").read_bytes())
        for info in seq.infos:
            stat = frame_file(seq.path, resolution, info.index).stat()
            digest.update(f"{info.index} {stat.st_size} {stat.st_mtime_ns if times else 0}\n".encode())
    except OSError as e:
        raise JaxsrError("cannot be read", where=e.filename or seq.path, found=e.strerror or e) from e
    return digest.hexdigest()


def _name(path: Path) -> str:
    path = path.resolve()
    return f"{path.name}-{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"


def _open(seq: Sequence, resolution: str, home: Path, progress: Progress) -> Arrays:
    key = source_key(seq, resolution)
    folder = home / f"{resolution}-{key[:16]}"
    if not folder.is_dir():
        _convert(seq, resolution, key, folder, progress)
        _remove_stale(home, resolution, folder)
    try:
        head = read_json(folder / "arrays.json", dict)
        layers = {n: _map(folder / f"{n}.npy") for n in head["layers"]}
        return Arrays(seq, resolution, layers, head["absent"], head["broken"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        fix = "delete that folder: it is made again"
        raise JaxsrError("the arrays of a sequence cannot be read", where=folder, found=e, fix=fix) from e


def _map(path: Path) -> np.ndarray:
    # A plain view: slices of the subclass cost several times as much.
    return np.load(path, mmap_mode="r").view(np.ndarray)


def _convert(seq: Sequence, resolution: str, key: str, folder: Path, progress: Progress) -> None:
    advance = progress(f"convert {seq.path.name}", len(seq))
    fix = "make room, or choose another folder for the cache"
    with atomic_folder(folder, fix) as temporary, contextlib.ExitStack() as stack:
        files = {n: stack.enter_context(_LayerFile(temporary / f"{n}.npy", len(seq))) for n in LAYERS}
        broken: dict[str, dict[str, str]] = {}
        for i, layers in enumerate(_frames(seq, resolution)):
            for name, pixels in layers.items():
                files[name].append(i, pixels)
                if name not in broken and (wrong := _wrong(seq, resolution, i, name, pixels)):
                    broken[name] = wrong
            advance()
        for file in files.values():
            file.close()
        if source_key(seq, resolution) != key:
            raise JaxsrError(
                "the sequence changed while it was read", where=seq.path, fix="let its writer finish first"
            )
        whole = [n for n, file in files.items() if file.count == len(seq)]
        for name in set(files) - set(whole):
            (temporary / f"{name}.npy").unlink(missing_ok=True)
        head = {
            "version": _VERSION,
            "key": key,
            "source": str(seq.path.resolve()),
            "layers": whole,
            "absent": {n: seq.infos[f.count].index for n, f in files.items() if f.seen and n not in whole},
            "broken": broken,
            "sequence": read_json(seq.path / "sequence.json"),
        }
        (temporary / "arrays.json").write_text(json.dumps(head, indent=1), encoding="utf-8")


def _wrong(seq: Sequence, resolution: str, i: int, layer: str, pixels: np.ndarray) -> dict[str, str]:
    """What is wrong with the pixels of a layer, as arguments of `JaxsrError`; empty if nothing is."""
    index = seq.infos[i].index
    try:
        check_pixels(layer, pixels, frame_file(seq.path, resolution, index), f"frame {index}: ")
    except JaxsrError as error:
        parts = {"what": error.what, "where": error.where, "expected": error.expected, "found": error.found}
        return {name: str(value) for name, value in parts.items()}
    return {}


def _frames(seq: Sequence, resolution: str) -> Iterator[dict[str, np.ndarray]]:
    """Decoded in threads, a few frames ahead."""
    with ThreadPoolExecutor(_WORKERS) as pool:
        for start in range(0, len(seq), _WORKERS):
            block = range(start, min(start + _WORKERS, len(seq)))
            yield from pool.map(lambda i: seq.stored(i, resolution), block)


class _LayerFile:
    """A `.npy` file that grows frame by frame; a writable memory map would crash on a full disk."""

    def __init__(self, path: Path, frames: int):
        self.path, self.frames = path, frames
        self.seen, self.count = (
            False,
            0,
        )  # whether any frame has the layer; how many frames from the first on have it
        self.shape: tuple[int, ...] = ()
        self.dtype: np.dtype = np.dtype(np.float16)
        self.file: BinaryIO | None = None

    def __enter__(self) -> "_LayerFile":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def append(self, i: int, pixels: np.ndarray) -> None:
        self.seen = True
        if self.count < i:
            return  # an earlier frame lacks the layer, so no method can use it
        if self.file is None:
            self.shape, self.dtype = pixels.shape, _storable(pixels.dtype)
            self._begin()
        elif pixels.dtype != self.dtype:
            self._widen()
        assert self.file is not None
        self.file.write(np.ascontiguousarray(pixels, self.dtype).data)
        self.count += 1

    def close(self) -> None:
        if self.file is not None:
            self.file.close()

    def _begin(self) -> None:
        self.file = self.path.open("wb")
        header = {"descr": self.dtype.str, "fortran_order": False, "shape": (self.frames, *self.shape)}
        np.lib.format.write_array_header_1_0(self.file, header)

    def _widen(self) -> None:
        """The type changes on the way (large object ids, say): float32 for all, as `Sequence` reads them."""
        if self.dtype == np.float32:
            return
        self.close()
        narrow, pixels = self.path.with_suffix(".narrow"), int(np.prod(self.shape))
        self.path.rename(narrow)
        with narrow.open("rb") as old:
            np.lib.format.read_magic(old)
            np.lib.format.read_array_header_1_0(old)
            dtype, self.dtype = self.dtype, np.dtype(np.float32)
            self._begin()
            assert self.file is not None
            for _ in range(self.count):
                self.file.write(np.fromfile(old, dtype, pixels).astype(np.float32).data)
        narrow.unlink()


def _storable(dtype: np.dtype) -> np.dtype:
    return dtype if dtype in (np.float16, np.float32, np.uint32) else np.dtype(np.float32)


def _remove_stale(home: Path, resolution: str, keep: Path) -> None:
    """Delete the arrays of earlier states of the sequence and the leftovers of killed conversions."""
    for old in home.glob(f"{resolution}-*"):
        if old != keep:
            shutil.rmtree(old, ignore_errors=True)
    remove_leftovers(home)
