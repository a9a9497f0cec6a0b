"""Reading a sequence: frames as the pytrees of `jaxsr.frames`, of NumPy float32 arrays.

The format is described in docs/data.md; `SequenceWriter` and `FrameInfo` (from `jaxsr.io.writing`) make one.
Opening reads `sequence.json` and checks that the files it lists are there, and no others; pixels are read,
and checked, frame by frame. Nothing but the description is kept in memory. Reading is safe from threads.
"""

import itertools
import json
import math
import queue
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer, Scale
from jaxsr.io.exr import read_exr, read_exr_header
from jaxsr.io.geometry import world_position
from jaxsr.io.writing import FORMAT, LAYERS, VERSION, FrameInfo, SequenceWriter, frame_file

__all__ = ["FrameInfo", "Sequence", "SequenceWriter", "prefetch"]

T = TypeVar("T")


class Sequence:
    """A sequence on disk. Open one with `Sequence.open(path)`.

    Attributes:
        path, name, size (HR `(W, H)`), scales, fps, exposure, license, generator, infos (one FrameInfo a
        frame), check (whether pixels are searched for NaN and Inf).
    """

    def __init__(self, path: Path, head: dict[str, Any], infos: list[FrameInfo], check: bool):
        self.path, self.infos, self.check = path, infos, check
        self.name: str = head.get("name", path.name)
        self.size: tuple[int, int] = (head["size"][0], head["size"][1])
        self.scales: tuple[int, ...] = tuple(head["scales"])
        self.fps: float = float(head.get("fps", 24.0))
        self.exposure: float = float(head.get("exposure", 1.0))
        self.license: str = head.get("license", "")
        self.generator: dict[str, Any] = head.get("generator", {})

    @classmethod
    def open(cls, path: str | Path, *, check: bool = True) -> "Sequence":
        """Read the description and see that its files are there.

        Args:
            path: the folder, or its `sequence.json`.
            check: search the pixels that are read for NaN and Inf (depth may be +inf).

        Raises:
            JaxsrError: not a sequence, bad JSON, another version, or files that do not match the list.
        """
        path = Path(path)
        path = path.parent if path.name == "sequence.json" else path
        head = _read_head(path)
        infos = [frame_info(entry, k, path / "sequence.json") for k, entry in enumerate(head["frames"])]
        for a, b in itertools.pairwise(infos):
            if b.index <= a.index or (b.index != a.index + 1 and not b.reset):
                raise JaxsrError(
                    f"frame {b.index} follows frame {a.index}",
                    where=path / "sequence.json",
                    expected='consecutive frames, or "cut": true where the sequence is interrupted',
                )
        seq = cls(path, head, infos, check)
        for resolution in seq.resolutions:
            _check_files(path / resolution, [i.index for i in infos])
        return seq

    def __len__(self) -> int:
        return len(self.infos)

    @property
    def resolutions(self) -> tuple[str, ...]:
        """Folders of frames: "hr", "x2", ..."""
        return ("hr", *(f"x{s}" for s in self.scales if s > 1))

    def layers(self, resolution: str, i: int = 0) -> tuple[str, ...]:
        """The layers that frame number `i` of the list has in "hr", "x2", ... (from the header alone)."""
        path = frame_file(self.path, self._resolution(resolution), self._info(i).index)
        names = set(read_exr_header(path)[0])
        return tuple(n for n, cs in LAYERS.items() if all(f"{n}.{c}" in names for c in cs))

    def frame(self, i: int, scale: int, rendered: bool = True) -> Frame:
        """The frame at position `i` of the list, as NumPy arrays.

        Args:
            i: 0 .. len - 1.
            scale: one of `scales`; or 1: the HR images are then also the LR ones, and the jitter is 0.
            rendered: False gives a frame without colour (zeros), whose colour was not looked at.

        Raises:
            JaxsrError: no such frame or scale, or a file that is missing, damaged or lacks a layer.
        """
        info = self._info(i)
        resolution = self._resolution("hr" if scale == 1 else f"x{scale}")
        skip = () if rendered else ("color",)
        lr = self._read(i, resolution, skip=("position", *skip), need=("depth", "motion"))
        hr = lr if scale == 1 else self._read(i, "hr", skip=("position", "color"), need=("depth", "motion"))
        h, w = lr["depth"].shape[:2]
        if rendered and "color" not in lr:
            raise self._missing(i, resolution, "color", lr)
        color = lr["color"] if rendered else np.zeros((h, w, 3), np.float32)
        jitter = (0.0, 0.0) if scale == 1 else info.jitter_px
        return Frame(
            color_linear=color,  # type: ignore[arg-type]
            lr=_gbuffer(lr),
            hr=_gbuffer(hr),
            jitter_px=np.asarray(jitter, np.float32),  # type: ignore[arg-type]
            camera=info.camera,
            reset=np.asarray(info.reset),  # type: ignore[arg-type]
            rendered=np.asarray(rendered),  # type: ignore[arg-type]
            exposure=np.asarray(self.exposure, np.float32),  # type: ignore[arg-type]
            factor=Scale(scale),
        )

    def truth(self, i: int) -> Float[np.ndarray, "H W 3"]:
        """The HR colour, scene-linear."""
        return self._read(i, "hr", only=("color",), need=("color",))["color"]

    def stored(self, i: int, resolution: str) -> dict[str, np.ndarray]:
        """The layers of frame number `i` in "hr", "x2", ..., but for position, in the types of the file."""
        return self._read(i, self._resolution(resolution), skip=("position",), stored=True)

    def position(self, i: int, scale: int | str) -> Float[np.ndarray, "h w 3"]:
        """World position of every pixel of an LR scale or of "hr" (what the jittered pixel sees); 0 for sky.

        Taken from the file, or rebuilt from depth and camera where the file has none.
        """
        resolution = self._resolution("hr" if scale in ("hr", 1) else f"x{scale}")
        layers = self._read(i, resolution, only=("position", "depth"), need=("depth",))
        if "position" in layers:
            return layers["position"]
        info = self._info(i)
        jitter = (0.0, 0.0) if resolution == "hr" else info.jitter_px
        return world_position(layers["depth"], info, jitter)

    def _info(self, i: int) -> FrameInfo:
        if not 0 <= i < len(self.infos):
            raise JaxsrError("no such frame", where=self.path, expected=f"0 to {len(self) - 1}", found=i)
        return self.infos[i]

    def _resolution(self, resolution: str) -> str:
        if resolution not in self.resolutions:
            raise JaxsrError(
                f"scale {resolution.lstrip('x')} is not available",
                where=self.path,
                expected=f"one of {[1, *(s for s in self.scales if s > 1)]}",
                fix="render the sequence at that scale, or choose one of these",
            )
        return resolution

    def _missing(self, i: int, resolution: str, layer: str, found: Iterable[str]) -> JaxsrError:
        index = self.infos[i].index
        return JaxsrError(
            f"frame {index}: missing layer {layer!r}",
            where=frame_file(self.path, resolution, index),
            expected="channels " + ", ".join(f"{layer}.{c}" for c in LAYERS[layer]),
            found="layers " + (", ".join(found) or "none"),
            fix="export it (docs/data.md)",
        )

    def _read(
        self,
        i: int,
        resolution: str,
        *,
        only: tuple[str, ...] = tuple(LAYERS),
        skip: tuple[str, ...] = (),
        need: tuple[str, ...] = (),
        stored: bool = False,
    ) -> dict[str, np.ndarray]:
        index = self._info(i).index
        path = frame_file(self.path, resolution, index)
        scale = 1 if resolution == "hr" else int(resolution[1:])
        width, height = self.size
        channels, _ = read_exr(
            path,
            pad=False,
            size=(height // scale, width // scale),
            because=f"sequence.json: HR {width}x{height}, scale {scale}",
        )
        layers = {}
        for layer, letters in LAYERS.items():
            names = [f"{layer}.{c}" for c in letters]
            absent = [n for n in names if n not in channels]
            if layer not in only or layer in skip or len(absent) == len(names):
                continue
            if absent:
                raise JaxsrError(
                    f"frame {index}: layer {layer!r} lacks channel {absent[0]!r}",
                    where=path,
                    expected=", ".join(names),
                    found=", ".join(sorted(channels)),
                )
            x = np.stack([channels[n] for n in names], -1)
            layers[layer] = x if stored else x.astype(np.float32)
        for layer in need:
            if layer not in layers:
                raise self._missing(
                    i, resolution, layer, dict.fromkeys(n.rpartition(".")[0] or n for n in channels)
                )
        for layer, x in layers.items():
            if self.check:
                _check_finite(layer, x, index, path)
        return layers


def prefetch(items: Iterable[T], depth: int = 2) -> Iterator[T]:
    """Run an iterator in a thread, `depth` items ahead: files are decoded while the last item is used.

    `for frame in prefetch(seq.frame(i, 2) for i in range(len(seq))): ...`. Errors arrive where the item would
    have been. Leaving the loop early stops the thread.
    """
    ready: queue.Queue[tuple[bool, Any]] = queue.Queue(maxsize=depth)
    stop = threading.Event()

    def put(item: tuple[bool, Any]) -> None:
        while not stop.is_set():
            try:
                return ready.put(item, timeout=0.1)
            except queue.Full:
                continue

    def work() -> None:
        try:
            for item in items:
                put((True, item))
                if stop.is_set():
                    return
            put((False, None))
        except BaseException as e:  # handed to the consumer, who raises it
            put((False, e))

    thread = threading.Thread(target=work, name="prefetch", daemon=True)
    thread.start()
    try:
        while True:
            more, item = ready.get()
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        stop.set()
        thread.join()


def _gbuffer(layers: dict[str, np.ndarray]) -> GBuffer:
    names = {"depth_linear": "depth", "motion_px": "motion"}
    return GBuffer(**{f: layers.get(names.get(f, f)) for f in GBuffer._fields})  # type: ignore[arg-type]


def _read_head(path: Path) -> dict[str, Any]:
    file = path / "sequence.json"
    if not path.is_dir():
        raise JaxsrError("no such folder", where=path, expected="a sequence")
    if not file.is_file():
        inside = sorted(file.parent.name for file in path.glob("*/sequence.json"))
        if inside:
            raise JaxsrError(
                "a folder of sequences, where one is wanted", where=path, fix=f"name one: {', '.join(inside)}"
            )
        strays = next(iter(sorted(path.rglob("*.exr"))), None)
        raise JaxsrError(
            "not a sequence",
            where=path,
            expected="a file sequence.json",
            found="none" if strays is None else f"another layout ({strays.relative_to(path)})",
            fix="docs/data.md says how to make one",
        )
    try:
        head = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as e:
        raise JaxsrError(
            "bad JSON", where=file, found=e, fix="correct it, or write the sequence again"
        ) from e
    check_head(head, file)
    return head


def check_head(head: Any, file: str | Path) -> None:
    """See that a description, as read from JSON, is one: all but its frames (`frame_info`).

    Raises:
        JaxsrError: it is not, with `file` as the place.
    """
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        found = head.get("format") if isinstance(head, dict) else type(head).__name__
        raise JaxsrError("not a sequence", where=file, expected=f'"format": "{FORMAT}"', found=found)
    if head.get("version") != VERSION:
        raise JaxsrError(
            "unsupported version of the format",
            where=file,
            expected=VERSION,
            found=head.get("version"),
            fix="update jaxsr, or write the sequence again",
        )
    size, scales = head.get("size"), head.get("scales")
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size)):
        raise JaxsrError("bad size", where=file, expected="two whole numbers, [W, H]", found=size)
    if not (isinstance(scales, list) and all(isinstance(s, int) and s > 0 for s in scales)):
        raise JaxsrError("bad scales", where=file, expected="a list of whole numbers", found=scales)
    for s in scales:
        if size[0] % s or size[1] % s:
            raise JaxsrError(f"scale {s} does not divide the size", where=file, found=f"{size[0]}x{size[1]}")
    for key in ("fps", "exposure"):
        value = head.get(key, 1.0)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and 0 < value < math.inf):
            raise JaxsrError(f"bad {key}", where=file, expected="a number above 0", found=json.dumps(value))
    for key, kind, words in (
        ("name", str, "a text"),
        ("license", str, "a text"),
        ("generator", dict, "{...}"),
    ):
        if not isinstance(head.get(key, kind()), kind):
            raise JaxsrError(f"bad {key}", where=file, expected=words, found=json.dumps(head[key]))
    if not isinstance(head.get("frames"), list) or not head["frames"]:
        raise JaxsrError("no frames", where=file, expected='"frames": a list of at least one frame')


def frame_info(entry: Any, k: int, where: str | Path) -> FrameInfo:
    """Entry number `k` of "frames".

    Raises:
        JaxsrError: something is missing, not a number, or cannot be a camera; with `where` as the place.
    """
    try:
        camera, index = entry["camera"], entry["index"]
        if not isinstance(index, int) or isinstance(index, bool) or index < 0:
            raise ValueError(f"index {json.dumps(index)}")
        info = FrameInfo(
            index=index,
            jitter_px=tuple(np.asarray(entry["jitter_px"], float).reshape(2).tolist()),
            reset=bool(entry["cut"]),
            world_from_view=np.asarray(camera["world_from_view"], float).reshape(4, 4),
            tan_half_fov=tuple(np.asarray(camera["tan_half_fov"], float).reshape(2).tolist()),
            lens_shift=tuple(np.asarray(camera.get("lens_shift", [0, 0]), float).reshape(2).tolist()),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as e:
        raise JaxsrError(
            f"entry {k} of frames is not right",
            where=where,
            expected="index, jitter_px, cut, camera (world_from_view, tan_half_fov, lens_shift)",
            found=f"missing {e}" if isinstance(e, KeyError) else e,
        ) from e
    matrix = info.world_from_view
    numbers = [np.ravel(x) for x in (info.jitter_px, matrix, info.tan_half_fov, info.lens_shift)]
    if not np.isfinite(np.concatenate(numbers)).all():
        raise JaxsrError(f"frame {info.index}: camera or jitter is not finite", where=where)
    if min(info.tan_half_fov) <= 0:
        found = list(info.tan_half_fov)
        raise JaxsrError(
            f"frame {info.index}: bad tan_half_fov", where=where, expected="numbers above 0", found=found
        )
    if np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise JaxsrError(
            f"frame {info.index}: world_from_view is singular",
            where=where,
            expected="a rotation and a translation",
            found=matrix[:3, :3].tolist(),
        )
    return info


def _check_files(folder: Path, indices: list[int]) -> None:
    listed = {frame_file(folder.parent, folder.name, i).name for i in indices}
    there = {p.name for p in folder.glob("*.exr") if not p.name.startswith(".")} if folder.is_dir() else set()
    if listed == there:
        return
    absent, extra = sorted(listed - there), sorted(there - listed)
    raise JaxsrError(
        f"file {absent[0]} is missing" if absent else f"file {extra[0]} is not in sequence.json",
        where=folder,
        expected=f"{len(listed)} frames as sequence.json lists them",
        found=f"{len(there)} files" if folder.is_dir() else "no such folder",
        fix="let the writer finish (it resumes), or correct sequence.json",
    )


def _check_finite(layer: str, x: np.ndarray, index: int, path: Path) -> None:
    bad = np.isnan(x) | np.isneginf(x) if layer == "depth" else ~np.isfinite(x)
    if not bad.any():
        return
    y, px, c = (int(n) for n in np.argwhere(bad)[0])
    raise JaxsrError(
        f"frame {index}: layer {layer!r} holds NaN or Inf",
        where=path,
        expected="finite numbers, or +inf for sky" if layer == "depth" else "finite numbers",
        found=f"{int(bad.any(-1).sum())} pixels, the first x={px} y={y} ({layer}.{LAYERS[layer][c]})",
        fix="render it again, or open the sequence with check=False",
    )
