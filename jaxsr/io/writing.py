"""Writing a sequence: a folder with `sequence.json` and one OpenEXR file per frame and resolution.

The format is described in docs/data.md. Every file is written atomically, `sequence.json` after each frame,
so that a writer that was killed resumes where it stopped. Each sequence has one writer at a time. Needs NumPy
and OpenEXR only: it also runs in the Python of a renderer that has no JAX.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, read_json, remove_leftovers
from jaxsr.io.description import (
    FORMAT,
    VERSION,
    FrameInfo,
    check_head,
    check_info,
    check_order,
    check_pixels,
    frame_file,
    frame_info,
)
from jaxsr.io.exr import write_exr
from jaxsr.layers import LAYERS

__all__ = ["HALF_MAX", "FrameInfo", "SequenceWriter", "frame_file", "round_mantissa"]

HALF_MAX = 65504.0
_LARGEST_HALF_ID = 2048


def round_mantissa(x: np.ndarray, bits: int) -> np.ndarray:
    """Round float32 values to `bits` explicit bits of mantissa (of 23), so that lossless compression pays.

    The relative error is at most `2 ** -(bits + 1)`. Infinities and NaNs stay.
    """
    if not 1 <= bits <= 23:
        raise JaxsrError("wrong number of mantissa bits", expected="1 to 23", found=bits)
    x = np.array(x, np.float32)
    if bits == 23:
        return x
    drop = np.uint32(23 - bits)
    raw = x.view(np.uint32)
    half = (np.uint32(1) << (drop - np.uint32(1))) - np.uint32(1) + ((raw >> drop) & np.uint32(1))
    rounded = ((raw + half) >> drop << drop).view(np.float32)
    return np.where(np.isfinite(x), rounded, x)


class SequenceWriter:
    """Writes frames one by one; usable as a context manager.

    Args:
        path: the folder; made if missing.
        name: name of the sequence.
        size: HR `(W, H)`, a multiple of every scale.
        scales: LR scales, at least one unless the sequence is only to be doubled in rate (`()`: HR only).
        hr: False for a sequence that has no HR images at all.
        fps: frames per second.
        exposure: factor on linear colour before the display tone map, of frames that have none of their own.
        license: licence of the pictures.
        generator: free-form, JSON: tool, versions, seed, samples. Must be the same when a writer resumes.
        resume: continue what is there; False refuses a folder that already holds a sequence.
        precision: layer -> "half", "float" or (object_id only) "uint", over the `stored` of `jaxsr.layers`.
        round_bits: layer -> bits of mantissa to keep (see `round_mantissa`).

    Raises:
        JaxsrError: bad arguments; another sequence in the folder.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        name: str,
        size: tuple[int, int],
        scales: Sequence[int],
        hr: bool = True,
        fps: float = 24.0,
        exposure: float = 1.0,
        license: str = "",
        generator: Mapping[str, Any] | None = None,
        resume: bool = True,
        precision: Mapping[str, str] | None = None,
        round_bits: Mapping[str, int] | None = None,
    ):
        self.path = Path(path)
        self.size, self.scales, self.hr = (int(size[0]), int(size[1])), tuple(int(s) for s in scales), hr
        self.precision: dict[str, str] = {name: layer.stored for name, layer in LAYERS.items()}
        self.precision |= dict(precision or {})
        self.round_bits = dict(round_bits or {})
        self._check_precision()
        head = {
            "format": FORMAT, "version": VERSION, "name": name, "size": self.size, "scales": self.scales,
            "hr": hr, "fps": fps, "exposure": exposure, "license": license,
            "generator": dict(generator or {}),
        }  # fmt: skip
        try:
            self._head = json.loads(json.dumps(head))
        except TypeError as e:
            raise JaxsrError("the generator's notes are not JSON", where=self.path, found=e) from e
        check_head(self._head | {"frames": [None]}, self.path)
        self._frames: dict[int, FrameInfo] = {}
        if (self.path / "sequence.json").exists():
            self._take_up(resume)
        for resolution in self.resolutions:
            remove_leftovers(self.path / resolution)
        remove_leftovers(self.path)

    @property
    def resolutions(self) -> tuple[str, ...]:
        """Folders: "hr", "x2", ..."""
        return (*(["hr"] if self.hr else []), *(f"x{s}" for s in self.scales if s > 1))

    def has(self, index: int) -> bool:
        """Whether the frame is complete: listed, and all its files there."""
        return index in self._frames and all(
            frame_file(self.path, r, index).exists() for r in self.resolutions
        )

    def is_reset(self, index: int) -> bool:
        """Whether the frame is listed as one that does not continue the one before it."""
        return index in self._frames and bool(self._frames[index].reset)

    def write_frame(
        self,
        info: FrameInfo,
        hr: Mapping[str, np.ndarray | None] | None,
        lr: Mapping[int, Mapping[str, np.ndarray | None]],
    ) -> None:
        """Write one frame, replacing it if it is there.

        Args:
            info: index, jitter, reset and camera.
            hr: layer -> `[H, W, C]` (or `[H, W]`), unjittered; what is None is left out. None for a sequence
                without HR images.
            lr: scale -> layer -> `[h, w, C]`, jittered; one for each scale above 1. Colour must be there.

        Raises:
            JaxsrError: missing or unknown layers or scales, wrong sizes, values that a reader would refuse.
        """
        check_info(info, self.path)
        where = f"{self.path}, frame {info.index}"
        if set(lr) != {s for s in self.scales if s > 1}:
            raise JaxsrError("wrong LR scales", where=where, expected=list(self.scales), found=sorted(lr))
        if (hr is not None) != self.hr:
            expected = "HR layers" if self.hr else "None: this writer was made with hr=False"
            raise JaxsrError("wrong HR images", where=where, expected=expected)
        images = {f"x{s}": (lr[s], s) for s in lr} | ({} if hr is None else {"hr": (hr, 1)})
        channels = {}  # all are made, and checked, before any is written
        for resolution, (layers, scale) in images.items():
            shape = (self.size[1] // scale, self.size[0] // scale)
            place = f"{where}, {resolution}"
            if resolution != "hr" and layers.get("color") is None:
                raise JaxsrError("missing layer 'color'", where=place, found=sorted(layers))
            channels[resolution] = self._channels(layers, shape, place)
        for resolution in self.resolutions:
            write_exr(frame_file(self.path, resolution, info.index), channels[resolution])
        self._frames[int(info.index)] = info
        self._write_json()

    def close(self) -> None:
        """Write sequence.json.

        Raises:
            JaxsrError: a frame is missing between others (they stay, and a writer can resume).
        """
        self._write_json()
        check_order([self._frames[i] for i in sorted(self._frames)], self.path / "sequence.json")

    def __enter__(self) -> "SequenceWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        if kind is None:
            self.close()
        else:
            self._write_json()

    def _check_precision(self) -> None:
        for layer, kind in [*self.precision.items(), *self.round_bits.items()]:
            kinds = ("half", "float", "uint") if layer == "object_id" else ("half", "float")
            if layer not in LAYERS or kind not in (*kinds, *range(1, 24)):
                raise JaxsrError(f"bad precision of {layer!r}", expected=" or ".join(kinds), found=kind)

    def _take_up(self, resume: bool) -> None:
        path = self.path / "sequence.json"
        if not resume:
            raise JaxsrError("already holds a sequence", where=self.path, fix="choose another folder")
        try:
            old = read_json(path, dict)
            entries = old.pop("frames")
            infos = [frame_info(entry, k, path, conventions=False) for k, entry in enumerate(entries)]
        except (ValueError, KeyError, TypeError) as e:
            raise JaxsrError("not the description of a sequence", where=path, found=e, fix="delete it") from e
        old = {"hr": True} | old | ({"version": VERSION} if old.get("version") == 1 else {})
        for key in self._head:
            if old.get(key) != self._head[key]:
                raise JaxsrError(
                    f"holds another sequence: {key!r} differs",
                    where=path,
                    expected=self._head[key],
                    found=old.get(key),
                    fix="choose another folder, or delete this one",
                )
        self._frames = {info.index: info for info in infos}

    def _write_json(self) -> None:
        with atomic_path(self.path / "sequence.json") as temporary:
            head = json.dumps(self._head, indent=1, ensure_ascii=False)[:-2]
            rows = ",\n  ".join(json.dumps(self._frames[i].to_json()) for i in sorted(self._frames))
            temporary.write_text(f'{head},\n "frames": [\n  {rows}\n ]\n}}\n', encoding="utf-8")

    def _channels(
        self, layers: Mapping[str, np.ndarray | None], shape: tuple[int, int], where: str
    ) -> dict[str, np.ndarray]:
        out: dict[str, np.ndarray] = {}
        for layer, values in layers.items():
            if layer not in LAYERS:
                raise JaxsrError(f"unknown layer {layer!r}", where=where, expected=f"one of {list(LAYERS)}")
            if values is None:
                continue
            letters, x = LAYERS[layer].letters, np.asarray(values)
            x = x[..., None] if x.ndim == 2 else x
            if x.shape != (*shape, len(letters)):
                raise JaxsrError(
                    f"layer {layer!r} has the wrong size",
                    where=where,
                    expected=(*shape, len(letters)),
                    found=x.shape,
                )
            x = self._store(layer, x, where)
            out |= {f"{layer}.{letter}": x[..., k] for k, letter in enumerate(letters)}
        if not out:
            raise JaxsrError("no layers", where=where, expected=f"some of {list(LAYERS)}")
        return out

    def _store(self, layer: str, x: np.ndarray, where: str) -> np.ndarray:
        """Pixels in the type of the file, such that a reader accepts them."""
        check_pixels(layer, x, where)
        kind = self.precision[layer]
        if layer == "object_id":
            if x.min() < 0 or x.max() > LAYERS[layer].high:
                found = f"{x.min():g} to {x.max():g}"
                raise JaxsrError(
                    "object_id is out of range", where=where, expected="0 to 2^32 - 1", found=found
                )
            if kind == "uint" or (kind == "half" and x.max() > _LARGEST_HALF_ID):
                return np.rint(x).astype(np.uint32)
        with np.errstate(over="ignore"):
            stored = x.astype(np.float32)
            if layer in self.round_bits:
                stored = round_mantissa(stored, self.round_bits[layer])
            if kind == "half":
                if layer in ("color", "reference"):  # a lamp seen directly: brighter than any tone map shows
                    stored = stored.clip(-HALF_MAX, HALF_MAX)
                stored = stored.astype(np.float16)
        fits = np.isinf(stored) == np.isinf(x)
        if layer == "depth":
            fits &= stored > 0
        if not fits.all():
            fix = "use float" if kind == "half" else "check its unit"
            raise JaxsrError(
                f"layer {layer!r} does not fit {kind} precision",
                where=where,
                found=f"{x[~fits][0]:g}",
                fix=fix,
            )
        return stored
