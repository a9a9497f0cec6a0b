"""Writing a sequence: a folder with `sequence.json` and one OpenEXR file a frame and resolution.

The format is described in docs/data.md. Every file is written atomically, `sequence.json` after each frame,
so that a writer that was killed resumes where it stopped. One writer a sequence. Needs NumPy only: it also
runs in the Python of a renderer that has no JAX.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, remove_leftovers
from jaxsr.io.exr import write_exr

if TYPE_CHECKING:
    from jaxsr.frames import Camera

FORMAT, VERSION = "jaxsr-sequence", 1

LAYERS: dict[str, str] = {
    "color": "RGB", "depth": "Z", "motion": "XY", "normal": "XYZ", "base_color": "RGB",
    "roughness": "V", "metallic": "V", "object_id": "V", "position": "XYZ",
}  # fmt: skip
"""Layer -> the letters of its channels: `color.R`, `color.G`, `color.B`, `depth.Z`, ..."""

PRECISION: dict[str, str] = {
    "color": "half", "depth": "float", "motion": "float", "normal": "half", "base_color": "half",
    "roughness": "half", "metallic": "half", "object_id": "half", "position": "float",
}  # fmt: skip
"""How each layer is stored unless told otherwise; object ids above 2048 become uint32 by themselves."""

HALF_MAX = 65504.0


@dataclass(frozen=True, eq=False)
class FrameInfo:
    """What `sequence.json` knows of one frame. See `jaxsr.frames` for the conventions."""

    index: int
    """Number of the frame, and name of its files; consecutive unless `reset`."""
    jitter_px: Any
    """(x, y): J in LR pixels, the same numbers for every scale."""
    reset: bool
    """True where the frame does not continue the one before it."""
    world_from_view: Any
    """`[4, 4]`, view space x right, y down, z forward."""
    tan_half_fov: Any
    """(x, y), as in `frames.Camera`."""
    lens_shift: Any = (0.0, 0.0)
    """(x, y), as in `frames.Camera`."""

    @property
    def camera(self) -> "Camera":
        """The camera as float32 arrays."""
        from jaxsr.frames import Camera  # late: it needs JAX, which a renderer's Python lacks

        fields = (self.world_from_view, self.tan_half_fov, self.lens_shift)
        return Camera(*(np.asarray(x, np.float32) for x in fields))  # type: ignore[arg-type]

    def to_json(self) -> dict[str, Any]:
        """The entry of `frames` in sequence.json."""
        camera = {
            "world_from_view": np.asarray(self.world_from_view, float).tolist(),
            "tan_half_fov": np.asarray(self.tan_half_fov, float).tolist(),
            "lens_shift": np.asarray(self.lens_shift, float).tolist(),
        }
        jitter = [float(x) for x in self.jitter_px]
        return {"index": int(self.index), "jitter_px": jitter, "cut": bool(self.reset), "camera": camera}


def frame_file(folder: Path, resolution: str, index: int) -> Path:
    """`SEQ/hr/0001.exr`, `SEQ/x2/0001.exr`."""
    return folder / resolution / f"{index:04d}.exr"


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
        fps: frames a second.
        exposure: factor on linear colour before the display tone map.
        license: licence of the pictures.
        generator: free-form, JSON: tool, versions, seed, samples. Must be the same when a writer resumes.
        resume: continue what is there; False refuses a folder that already holds a sequence.
        precision: layer -> "half", "float" or "uint", over `PRECISION`.
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
        fps: float = 24.0,
        exposure: float = 1.0,
        license: str = "",
        generator: Mapping[str, Any] | None = None,
        resume: bool = True,
        precision: Mapping[str, str] | None = None,
        round_bits: Mapping[str, int] | None = None,
    ):
        self.path = Path(path)
        self.size, self.scales = (int(size[0]), int(size[1])), tuple(int(s) for s in scales)
        self.precision, self.round_bits = PRECISION | dict(precision or {}), dict(round_bits or {})
        for layer, kind in [*self.precision.items(), *self.round_bits.items()]:
            if layer not in LAYERS or kind not in ("half", "float", "uint", *range(1, 24)):
                raise JaxsrError(f"bad precision of {layer!r}", expected="half, float or uint", found=kind)
        for key, value in (("fps", fps), ("exposure", exposure)):
            if not (math.isfinite(value) and value > 0):
                raise JaxsrError(f"bad {key}", where=self.path, expected="a number above 0", found=value)
        for s in self.scales:
            if s < 1 or self.size[0] % s or self.size[1] % s:
                raise JaxsrError(
                    f"scale {s} does not divide the HR size", where=self.path, found=f"{size[0]}x{size[1]}"
                )
        head = {
            "format": FORMAT, "version": VERSION, "name": name, "size": self.size, "scales": self.scales,
            "fps": fps, "exposure": exposure, "license": license, "generator": dict(generator or {}),
        }  # fmt: skip
        try:
            self._head = json.loads(json.dumps(head))
        except TypeError as e:
            raise JaxsrError("the generator's notes are not JSON", where=self.path, found=e) from e
        self._frames: dict[int, dict[str, Any]] = {}
        if (self.path / "sequence.json").exists():
            self._take_up(resume)
        for resolution in self.resolutions:
            remove_leftovers(self.path / resolution)
        remove_leftovers(self.path)

    @property
    def resolutions(self) -> tuple[str, ...]:
        """Folders: "hr", "x2", ..."""
        return ("hr", *(f"x{s}" for s in self.scales if s > 1))

    def has(self, index: int) -> bool:
        """Whether the frame is complete: listed, and all its files there."""
        return index in self._frames and all(
            frame_file(self.path, r, index).exists() for r in self.resolutions
        )

    def is_reset(self, index: int) -> bool:
        """Whether the frame is listed as one that does not continue the one before it."""
        return bool(self._frames.get(index, {}).get("cut"))

    def write_frame(
        self,
        info: FrameInfo,
        hr: Mapping[str, np.ndarray | None],
        lr: Mapping[int, Mapping[str, np.ndarray | None]],
    ) -> None:
        """Write one frame, replacing it if it is there.

        Args:
            info: index, jitter, reset and camera.
            hr: layer -> `[H, W, C]` (or `[H, W]`), unjittered; None is left out.
            lr: scale -> layer -> `[h, w, C]`, jittered; one for each scale above 1.

        Raises:
            JaxsrError: missing or unknown layers or scales, wrong sizes, values that a reader would refuse.
        """
        where = f"{self.path}, frame {info.index}"
        if set(lr) != {s for s in self.scales if s > 1}:
            raise JaxsrError("wrong LR scales", where=where, expected=list(self.scales), found=sorted(lr))
        for resolution, layers, scale in [("hr", hr, 1), *((f"x{s}", lr[s], s) for s in lr)]:
            shape = (self.size[1] // scale, self.size[0] // scale)
            needed = ("depth", "motion") if resolution == "hr" else ("color", "depth", "motion")
            channels = self._channels(layers, needed, shape, f"{where}, {resolution}")
            write_exr(frame_file(self.path, resolution, info.index), channels)
        self._frames[int(info.index)] = info.to_json()
        self._write_json()

    def close(self) -> None:
        """Write sequence.json."""
        self._write_json()

    def __enter__(self) -> "SequenceWriter":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _take_up(self, resume: bool) -> None:
        path = self.path / "sequence.json"
        if not resume:
            raise JaxsrError("already holds a sequence", where=self.path, fix="choose another folder")
        try:
            old = json.loads(path.read_text())
            frames = {int(f["index"]): f for f in old.pop("frames")}
        except (ValueError, KeyError, TypeError, AttributeError) as e:
            raise JaxsrError("not the description of a sequence", where=path, found=e, fix="delete it") from e
        for key in self._head:
            if old.get(key) != self._head[key]:
                raise JaxsrError(
                    f"holds another sequence: {key!r} differs",
                    where=path,
                    expected=self._head[key],
                    found=old.get(key),
                    fix="choose another folder, or delete this one",
                )
        self._frames = frames

    def _write_json(self) -> None:
        frames = [self._frames[i] for i in sorted(self._frames)]
        with atomic_path(self.path / "sequence.json") as temporary:
            head = json.dumps(self._head, indent=1, ensure_ascii=False)[:-2]
            rows = ",\n  ".join(json.dumps(f) for f in frames)
            temporary.write_text(f'{head},\n "frames": [\n  {rows}\n ]\n}}\n', encoding="utf-8")

    def _channels(
        self,
        layers: Mapping[str, np.ndarray | None],
        needed: tuple[str, ...],
        shape: tuple[int, int],
        where: str,
    ) -> dict[str, np.ndarray]:
        for layer in needed:
            if layers.get(layer) is None:
                raise JaxsrError(f"missing layer {layer!r}", where=where, found=sorted(layers))
        out: dict[str, np.ndarray] = {}
        for layer, values in layers.items():
            if values is None:
                continue
            if layer not in LAYERS:
                raise JaxsrError(f"unknown layer {layer!r}", where=where, expected=f"one of {list(LAYERS)}")
            letters, x = LAYERS[layer], np.asarray(values)
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
        return out

    def _store(self, layer: str, x: np.ndarray, where: str) -> np.ndarray:
        kind = self.precision[layer]
        finite = ~np.isnan(x) if layer == "depth" else np.isfinite(x)
        if not finite.all():
            raise JaxsrError(
                f"layer {layer!r} holds NaN or Inf", where=where, found=f"{(~finite).sum()} values"
            )
        if layer == "object_id" and (kind == "uint" or (kind == "half" and x.max() > 2048)):
            return np.rint(x).astype(np.uint32)
        x = x.astype(np.float32)
        if layer in self.round_bits:
            x = round_mantissa(x, self.round_bits[layer])
        if kind != "half":
            return x
        if layer == "color":
            x = x.clip(-HALF_MAX, HALF_MAX)  # a lamp seen directly: brighter than any tone map shows
        elif np.abs(x[np.isfinite(x)]).max(initial=0) > HALF_MAX:
            raise JaxsrError(f"layer {layer!r} does not fit half precision", where=where, fix="use float")
        return x.astype(np.float16)
