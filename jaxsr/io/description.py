"""What `sequence.json` says, and what reader and writer refuse, each with one clear line.

The format is described in docs/data.md. The writer checks with the same functions as the reader, so that it
refuses what the reader would. Needs NumPy only: it also runs in the Python of a renderer that has no JAX.
"""

import itertools
import json
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.layers import LAYERS, MAX_HR_JITTER, MAX_JITTER, is_rigid

if TYPE_CHECKING:
    from jaxsr.frames import Camera

FORMAT, VERSION = "jaxsr-sequence", 2
READABLE = (1, 2)
"""Versions that can be read. Version 1 has one exposure, "cut" for "reset", and always HR images."""
MAX_SIDE = 65536
"""Pixels of a side of the HR image at most."""
MAX_INDEX = 2**31 - 1
LEAST, MOST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
"""What float32, in which frames are computed, can hold of positive numbers."""


@dataclass(frozen=True, eq=False)
class FrameInfo:
    """What `sequence.json` knows of one frame. See `jaxsr.frames` for the conventions."""

    index: int
    """Number of the frame, and name of its files; consecutive unless `reset`."""
    jitter_px: Any = (0.0, 0.0)
    """(x, y): J in LR pixels, the same numbers for every scale."""
    reset: bool = False
    """True where the frame does not continue the one before it."""
    world_from_view: Any = None
    """`[4, 4]`, rigid, view space x right, y down, z forward; None where the camera is not known."""
    tan_half_fov: Any = None
    """(x, y), as in `frames.Camera`; None where the camera is not known."""
    lens_shift: Any = (0.0, 0.0)
    """(x, y), as in `frames.Camera`."""
    exposure: float | None = None
    """Factor on linear colour before the display tone map; None: that of the sequence."""
    hr_jitter_px: Any = (0.0, 0.0)
    """(x, y): J of the HR G-buffers in HR pixels; HR colour is never jittered."""

    @property
    def has_camera(self) -> bool:
        """Whether the camera is known."""
        return self.world_from_view is not None

    @property
    def camera(self) -> "Camera | None":
        """The camera as float32 arrays; None where it is not known."""
        from jaxsr.frames import Camera  # late: it needs JAX, which a renderer's Python lacks

        if not self.has_camera:
            return None
        fields = (self.world_from_view, self.tan_half_fov, self.lens_shift)
        return Camera(*(np.asarray(x, np.float32) for x in fields))  # type: ignore[arg-type]

    def to_json(self) -> dict[str, Any]:
        """The entry of `frames` in sequence.json."""
        entry: dict[str, Any] = {
            "index": int(self.index),
            "jitter_px": [float(x) for x in self.jitter_px],
            "reset": bool(self.reset),
        }
        if any(self.hr_jitter_px):
            entry["hr_jitter_px"] = [float(x) for x in self.hr_jitter_px]
        if self.exposure is not None:
            entry["exposure"] = float(self.exposure)
        if self.has_camera:
            entry["camera"] = {
                "world_from_view": np.asarray(self.world_from_view, float).tolist(),
                "tan_half_fov": np.asarray(self.tan_half_fov, float).tolist(),
                "lens_shift": np.asarray(self.lens_shift, float).tolist(),
            }
        return entry


def frame_file(folder: Path, resolution: str, index: int) -> Path:
    """`SEQ/hr/0001.exr`, `SEQ/x2/0001.exr`."""
    return folder / resolution / f"{index:04d}.exr"


# --- sequence.json ---------------------------------------------------------------------------------------


def check_head(head: Any, file: str | Path) -> None:
    """See that a description, as read from JSON, is one: all but its frames (`frame_info`).

    Raises:
        JaxsrError: it is not, with `file` as the place.
    """
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        found = _short(head.get("format")) if isinstance(head, dict) else type(head).__name__
        raise JaxsrError("not a sequence", where=file, expected=f'"format": "{FORMAT}"', found=found)
    if not (_is_whole(head.get("version")) and head["version"] in READABLE):
        raise JaxsrError(
            "unsupported version of the format",
            where=file,
            expected=" or ".join(map(str, READABLE)),
            found=_short(head.get("version")),
            fix="update jaxsr, or write the sequence again",
        )
    _check_sizes(head, file)
    for key in ("fps", "exposure"):
        if not _is_positive(head.get(key, 1.0)):
            raise JaxsrError(f"bad {key}", where=file, expected="a number above 0", found=_short(head[key]))
    for key, kind, words in (
        ("name", str, "a text"),
        ("license", str, "a text"),
        ("generator", dict, "{...}"),
        ("hr", bool, "true or false"),
    ):
        if not isinstance(head.get(key, kind()), kind):
            raise JaxsrError(f"bad {key}", where=file, expected=words, found=_short(head[key]))
    if not (has_hr(head) or any(s > 1 for s in head["scales"])):
        raise JaxsrError('"hr" is false, and there is no scale above 1: there are no images', where=file)
    if not isinstance(head.get("frames"), list) or not head["frames"]:
        raise JaxsrError("no frames", where=file, expected='"frames": a list of at least one frame')


def has_hr(head: dict[str, Any]) -> bool:
    """Whether the sequence that is described has HR images."""
    return head["version"] == 1 or head.get("hr", True)


def _check_sizes(head: dict[str, Any], file: str | Path) -> None:
    size, scales = head.get("size"), head.get("scales")
    if not (isinstance(size, list) and len(size) == 2 and all(map(_is_whole, size))):
        raise JaxsrError("bad size", where=file, expected="two whole numbers, [W, H]", found=_short(size))
    if not all(1 <= n <= MAX_SIDE for n in size):
        raise JaxsrError(
            "bad size", where=file, expected=f"1 to {MAX_SIDE} pixels on each side", found=_short(size)
        )
    if not (isinstance(scales, list) and all(_is_whole(s) and s > 0 for s in scales)):
        raise JaxsrError("bad scales", where=file, expected="a list of whole numbers", found=_short(scales))
    for s in scales:
        if size[0] % s or size[1] % s:
            raise JaxsrError(f"scale {s} does not divide the size", where=file, found=f"{size[0]}x{size[1]}")


def frame_info(entry: Any, k: int, where: str | Path, conventions: bool = True) -> FrameInfo:
    """Entry number `k` of "frames".

    Args:
        conventions: see `check_info`.

    Raises:
        JaxsrError: something is missing, not a number, or breaks a convention; with `where` as the place.
    """
    try:
        reset = entry["reset"] if "reset" in entry else entry.get("cut", False)
        _check_scalars(entry["index"], reset, entry.get("exposure"), where)
        if entry.get("cut", reset) != reset:
            raise ValueError('"reset" and "cut", its old name, which differ')
        camera = entry.get("camera")
        fields: dict[str, Any] = {}
        if camera is not None:
            fields = {
                "world_from_view": _numbers(camera["world_from_view"], "world_from_view", (4, 4)),
                "tan_half_fov": _pair(camera["tan_half_fov"], "tan_half_fov"),
                "lens_shift": _pair(camera.get("lens_shift", [0, 0]), "lens_shift"),
            }
        info = FrameInfo(
            index=entry["index"],
            jitter_px=_pair(entry.get("jitter_px", [0, 0]), "jitter_px"),
            hr_jitter_px=_pair(entry.get("hr_jitter_px", [0, 0]), "hr_jitter_px"),
            reset=reset,
            exposure=entry.get("exposure"),
            **fields,
        )
    except JaxsrError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as e:
        raise JaxsrError(
            f"entry {k} of frames is not right",
            where=where,
            expected="index; where there are: jitter_px, hr_jitter_px, reset, exposure, camera "
            "(world_from_view, tan_half_fov, lens_shift)",
            found=f"missing {e}" if isinstance(e, KeyError) else e,
        ) from e
    check_info(info, where, conventions)
    return info


def check_info(info: FrameInfo, where: object, conventions: bool = True) -> None:
    """See that all of it are finite numbers that obey the conventions of `jaxsr.frames`.

    Args:
        where: named by the error.
        conventions: False allows jitter of more than half a pixel and cameras that are not rigid, which
            `jaxsr inspect` explains.

    Raises:
        JaxsrError: one line that says which value, what is expected, and what to do.
    """
    _check_scalars(info.index, info.reset, info.exposure, where)
    name = f"frame {info.index}"
    jitter = _finite(info.jitter_px, (2,), f"{name}: bad jitter_px", where)
    if conventions and np.abs(jitter).max() > MAX_JITTER:
        raise JaxsrError(
            f"{name}: jitter of more than half a pixel",
            where=where,
            expected="x and y in LR pixels, each within [-0.5, 0.5]",
            found=jitter.tolist(),
            fix="convert it to LR pixels (docs/conventions.md; jaxsr inspect finds its unit)",
        )
    hr_jitter = _finite(info.hr_jitter_px, (2,), f"{name}: bad hr_jitter_px", where)
    if conventions and np.abs(hr_jitter).max() > MAX_HR_JITTER:
        raise JaxsrError(
            f"{name}: jitter of the HR buffers of more than {MAX_HR_JITTER} pixels",
            where=where,
            expected="x and y in HR pixels, each at most half an LR pixel",
            found=hr_jitter.tolist(),
            fix="convert it to HR pixels (docs/conventions.md)",
        )
    if not info.has_camera and info.tan_half_fov is None:
        return
    if not info.has_camera or info.tan_half_fov is None:
        raise JaxsrError(
            f"{name}: half a camera", where=where, expected="world_from_view and tan_half_fov, or neither"
        )
    _check_camera(info, name, where, conventions)


def _check_scalars(index: Any, reset: Any, exposure: Any, where: object) -> None:
    if not _is_whole(index) or not 0 <= index <= MAX_INDEX:
        raise JaxsrError("bad index", where=where, expected=f"0 to {MAX_INDEX}", found=_short(index))
    if not isinstance(reset, bool | np.bool_):
        raise JaxsrError(
            f"frame {index}: bad reset", where=where, expected="true or false", found=_short(reset)
        )
    if exposure is not None and not _is_positive(exposure):
        raise JaxsrError(
            f"frame {index}: bad exposure", where=where, expected="a number above 0", found=_short(exposure)
        )


def _check_camera(info: FrameInfo, name: str, where: object, conventions: bool) -> None:
    matrix = _finite(info.world_from_view, (4, 4), f"{name}: bad world_from_view", where)
    tangents = _finite(info.tan_half_fov, (2,), f"{name}: bad tan_half_fov", where)
    _finite(info.lens_shift, (2,), f"{name}: bad lens_shift", where)
    if tangents.min() <= 0:
        raise JaxsrError(
            f"{name}: bad tan_half_fov", where=where, expected="numbers above 0", found=tangents.tolist()
        )
    if not conventions:
        return
    if not is_rigid(matrix.tolist()):
        raise JaxsrError(
            f"{name}: world_from_view is not rigid",
            where=where,
            expected="a rotation and a translation, without scale or mirror image; last row 0 0 0 1",
            found=matrix.round(6).tolist(),
            fix="take the scale out of the camera's matrix (docs/conventions.md)",
        )


def check_order(infos: Iterable[FrameInfo], where: object) -> None:
    """See that frames are consecutive unless they are resets.

    Raises:
        JaxsrError: they are not.
    """
    for a, b in itertools.pairwise(infos):
        if b.index <= a.index or (b.index != a.index + 1 and not b.reset):
            raise JaxsrError(
                f"frame {b.index} follows frame {a.index}",
                where=where,
                expected='consecutive frames, or "reset": true where the sequence is interrupted',
            )


# --- pixels ----------------------------------------------------------------------------------------------


def check_pixels(layer: str, x: np.ndarray, where: object, frame: str = "", fix: str | None = None) -> None:
    """See that `[H, W, C]` pixels are finite, and depth above 0 (+inf for sky).

    Args:
        frame: what the message begins with, such as "frame 3: ".

    Raises:
        JaxsrError: they are not; names the first bad pixel and its value.
    """
    bad = ~(x > 0) if layer == "depth" else ~np.isfinite(x)
    if not bad.any():
        return
    y, px, c = (int(n) for n in np.argwhere(bad)[0])
    depth, finite = layer == "depth", bool(np.isfinite(x[bad]).all())
    raise JaxsrError(
        f"{frame}layer {layer!r} {'is not above 0' if finite else 'holds NaN or Inf'}",
        where=where,
        expected="numbers above 0; sky is +inf" if depth else "finite numbers",
        found=f"{int(bad.any(-1).sum())} pixels, the first x={px} y={y} "
        f"({layer}.{LAYERS[layer].letters[c]} = {x[y, px, c]:g})",
        fix=fix,
    )


# --- values ----------------------------------------------------------------------------------------------


def _is_whole(x: Any) -> bool:
    if isinstance(x, bool | np.bool_):
        return False
    try:
        operator.index(x)
    except TypeError:
        return False
    return True


def _is_positive(x: Any) -> bool:
    """Whether x is a number above 0 that float32 can hold."""
    number = isinstance(x, int | float | np.integer | np.floating) and not isinstance(x, bool)
    return number and bool(LEAST <= x <= MOST)


def _short(value: Any) -> str:
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = str(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _numbers(value: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of JSON as float64. Texts and booleans, which NumPy would convert, are none."""
    array = np.asarray(value, object)
    if array.size != math.prod(shape) or any(type(x) not in (int, float) for x in array.flat):
        raise ValueError(f"{name} {_short(value)}")
    return array.astype(float).reshape(shape)


def _pair(value: Any, name: str) -> tuple[float, float]:
    x, y = _numbers(value, name, (2,)).tolist()
    return x, y


def _finite(value: Any, shape: tuple[int, ...], what: str, where: object) -> np.ndarray:
    expected = f"{' x '.join(map(str, shape))} finite numbers"
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError) as e:
        raise JaxsrError(what, where=where, expected=expected, found=_short(value)) from e
    if array.shape != shape or not np.isfinite(array).all():
        raise JaxsrError(what, where=where, expected=expected, found=_short(array.tolist()))
    return array
