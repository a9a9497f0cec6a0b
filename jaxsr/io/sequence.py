"""Reading a sequence: frames as the pytrees of `jaxsr.frames`, of NumPy float32 arrays.

The format is described in docs/data.md; `SequenceWriter` and `FrameInfo` (from `jaxsr.io.writing`) make one.
Opening reads `sequence.json` and checks that the files it lists are there, and no others; pixels are read,
and checked, frame by frame, and only those of the layers that are needed. Nothing but the description is kept
in memory. Reading is safe from threads.
"""

import queue
import threading
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from jaxsr.errors import JaxsrError
from jaxsr.files import read_json
from jaxsr.frames import Frame, GBuffer, Scale
from jaxsr.io.description import check_head, check_order, check_pixels, frame_info, has_hr
from jaxsr.io.exr import read_exr, read_exr_header
from jaxsr.io.writing import FrameInfo, SequenceWriter, frame_file
from jaxsr.layers import DERIVED, FIELDS, LAYERS, channels, needed
from jaxsr.ops.motion import hr_from_lr_on_host
from jaxsr.ops.pinhole import world_from_depth

__all__ = ["NEEDS", "FrameInfo", "Sequence", "SequenceWriter", "prefetch"]

T = TypeVar("T")

NEEDS = frozenset(f"{place}.{layer}" for place in ("lr", "hr") for layer in FIELDS) | {"lr.color"}
"""All that a method can need: "lr.color", "hr.depth", ... The truth, "hr.color", is not among it."""


class Sequence:
    """A sequence on disk. Open one with `Sequence.open(path)`.

    Attributes:
        path, name, size (HR `(W, H)`), scales, hr (whether there are HR images), fps, exposure (of frames
        that have none of their own), license, generator, infos (one FrameInfo per frame), check (whether
        what breaks a convention is refused).
    """

    def __init__(self, path: Path, head: dict[str, Any], infos: list[FrameInfo], check: bool):
        self.path, self.infos, self.check = path, infos, check
        self.name: str = head.get("name", path.name)
        self.size: tuple[int, int] = (head["size"][0], head["size"][1])
        self.scales: tuple[int, ...] = tuple(head["scales"])
        self.hr: bool = has_hr(head)
        self.fps: float = float(head.get("fps", 24.0))
        self.exposure: float = float(head.get("exposure", 1.0))
        self.license: str = head.get("license", "")
        self.generator: dict[str, Any] = head.get("generator", {})

    @classmethod
    def open(cls, path: str | Path, *, check: bool = True) -> "Sequence":
        """Read the description and see that its files are there.

        Args:
            path: the folder, or its `sequence.json`.
            check: refuse what breaks a convention: NaN, Inf and depth not above 0 in the pixels that are
                read, jitter of more than half a pixel, cameras that are not rigid. `jaxsr inspect` opens
                sequences without it.

        Raises:
            JaxsrError: not a sequence, bad JSON, another version, values that are refused, or files that do
                not match the list.
        """
        path = Path(path)
        path = path.parent if path.name == "sequence.json" else path
        head = _read_head(path)
        file = path / "sequence.json"
        infos = [frame_info(entry, k, file, check) for k, entry in enumerate(head["frames"])]
        check_order(infos, file)
        seq = cls(path, head, infos, check)
        for resolution in seq.resolutions:
            _check_files(path / resolution, [i.index for i in infos])
        return seq

    def __len__(self) -> int:
        return len(self.infos)

    @property
    def resolutions(self) -> tuple[str, ...]:
        """Folders of frames: "hr", "x2", ..."""
        return (*(["hr"] if self.hr else []), *(f"x{s}" for s in self.scales if s > 1))

    def layers(self, resolution: str, i: int = 0) -> tuple[str, ...]:
        """The layers that frame number `i` of the list has in "hr", "x2", ... (from the header alone)."""
        path = frame_file(self.path, self._resolution(resolution), self._info(i).index)
        names = set(read_exr_header(path)[0])
        return tuple(layer for layer in LAYERS if names.issuperset(channels(layer)))

    def exposure_at(self, i: int) -> float:
        """The exposure of the frame at position `i`: its own, or that of the sequence."""
        own = self._info(i).exposure
        return self.exposure if own is None else own

    def frame(self, i: int, scale: int, rendered: bool = True, needs: frozenset[str] | None = None) -> Frame:
        """The frame at position `i` of the list, as NumPy arrays.

        HR depth and motion that are needed, and that the files do not have, are derived from LR depth and
        motion (`jaxsr.ops.hr_from_lr`).

        Args:
            i: 0 .. len - 1.
            scale: one of `scales`; or 1: the HR images are then also the LR ones, and the jitter is 0.
            rendered: False gives a frame without colour (zeros), whose colour is never read.
            needs: some of `NEEDS`. Only these are read, checked, and in the frame; files that hold none of
                them are not opened. None: all layers that the files have, and LR colour must be there.

        Raises:
            JaxsrError: no such frame or scale; a file that is missing or damaged; a layer that is needed and
                is missing, not finite, or not above 0 (depth).
        """
        unknown = sorted((needs or frozenset()) - NEEDS)
        if unknown:
            raise JaxsrError(f"unknown buffer {unknown[0]!r}", expected=f"some of {sorted(NEEDS)}")
        info, place = self._info(i), self._place(scale)
        demanded = {"lr": frozenset({"color"}), "hr": frozenset[str]()}
        wanted = {"lr": demanded["lr"] | frozenset(FIELDS), "hr": frozenset(FIELDS)}
        if needs is not None:
            wanted = demanded = {where: needed(needs, where) for where in ("lr", "hr")}
        if not rendered:
            demanded, wanted = ({**of, "lr": of["lr"] - {"color"}} for of in (demanded, wanted))
        if scale == 1:
            images = self._read(i, "hr", wanted["lr"] | wanted["hr"], demanded["lr"] | demanded["hr"])
            lr, hr = ({n: x for n, x in images.items() if n in wanted[where]} for where in ("lr", "hr"))
        else:
            lr, hr = self._pair(i, scale, wanted, demanded)
        width, height = self.size
        black = np.zeros((height // scale, width // scale, 3), np.float32)
        return Frame(
            color_linear=lr.get("color", black),  # type: ignore[arg-type]
            lr=_gbuffer(lr),
            hr=_gbuffer(hr),
            jitter_px=np.asarray((0.0, 0.0) if place == "hr" else info.jitter_px, np.float32),  # type: ignore[arg-type]
            hr_jitter_px=np.asarray(info.hr_jitter_px, np.float32),  # type: ignore[arg-type]
            camera=info.camera,
            reset=np.asarray(info.reset),  # type: ignore[arg-type]
            rendered=np.asarray(rendered),  # type: ignore[arg-type]
            exposure=np.asarray(self.exposure_at(i), np.float32),  # type: ignore[arg-type]
            factor=Scale(scale),
        )

    def truth(self, i: int, layer: str = "color") -> Float[np.ndarray, "H W 3"]:
        """An HR colour, scene-linear and not jittered. Nothing else is read.

        Args:
            layer: "color", sampled at the centres of pixels, or "reference", anti-aliased.

        Raises:
            JaxsrError: the sequence, or this frame, has none.
        """
        only = frozenset({layer})
        return self._read(i, self._resolution("hr"), only, only)[layer]

    def lr_color(self, i: int, scale: int) -> Float[np.ndarray, "h w 3"]:
        """The LR colour, scene-linear and jittered; at scale 1 the HR colour. Nothing else is read.

        Raises:
            JaxsrError: the sequence, or this frame, has none.
        """
        color = frozenset({"color"})
        return self._read(i, self._place(scale), color, color)["color"]

    def stored(self, i: int, resolution: str) -> dict[str, np.ndarray]:
        """The layers of frame number `i` in "hr", "x2", ..., but for position, in the types of the file.

        Their values are not checked.
        """
        wanted = frozenset(LAYERS) - {"position"}
        return self._read(i, self._resolution(resolution), wanted, as_stored=True)

    def position(self, i: int, scale: int | str) -> Float[np.ndarray, "h w 3"]:
        """World position of every pixel of an LR scale or of "hr" (what the jittered pixel sees); 0 for sky.

        Taken from the file, or rebuilt from depth and camera where the file has none.

        Raises:
            JaxsrError: neither position nor depth and camera are there.
        """
        resolution = self._place(1 if scale == "hr" else int(scale))
        if "position" in self.layers(resolution, i):
            return self._read(i, resolution, frozenset({"position"}))["position"]
        info, depth = self._info(i), frozenset({"depth"})
        if not info.has_camera:
            raise JaxsrError(
                f"frame {info.index} has no camera: positions cannot be rebuilt",
                where=self.path / "sequence.json",
                fix="export the camera, or the layer position (docs/data.md)",
            )
        jitter = info.hr_jitter_px if resolution == "hr" else info.jitter_px
        layers = self._read(i, resolution, depth, depth)
        return world_from_depth(layers["depth"], info, jitter, np).astype(np.float32)

    @cached_property
    def _hr_layers(self) -> frozenset[str]:
        """The layers of which the first frame has at least a channel in HR: all frames must have them."""
        if not self.hr:
            return frozenset()
        names = set(read_exr_header(frame_file(self.path, "hr", self.infos[0].index))[0])
        return frozenset(layer for layer in LAYERS if not names.isdisjoint(channels(layer)))

    def _pair(
        self, i: int, scale: int, wanted: dict[str, frozenset[str]], demanded: dict[str, frozenset[str]]
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """LR and HR layers, with what must be derived."""
        derived = frozenset[str]()
        if wanted["hr"]:
            derived = (wanted["hr"] & DERIVED) - self._hr_layers
            lacking = demanded["hr"] - derived if not self.hr else frozenset()
            if lacking:
                raise JaxsrError(
                    "missing HR buffers " + ", ".join(f"hr.{layer}" for layer in sorted(lacking)),
                    where=self.path,
                    found="no HR images; only HR depth and motion can be derived from LR",
                    fix="export them, or choose a method that does without (jaxsr inspect lists them)",
                )
        source = DERIVED if derived else frozenset[str]()
        must = source if derived & demanded["hr"] else frozenset[str]()
        read = self._read(i, f"x{scale}", wanted["lr"] | source, demanded["lr"] | must)
        lr = {name: x for name, x in read.items() if name in wanted["lr"]}
        rest = wanted["hr"] - derived
        hr = self._read(i, "hr", rest, demanded["hr"] - derived) if rest and self.hr else {}
        if derived and read.keys() >= source:
            depth, motion = hr_from_lr_on_host(read["depth"], read["motion"], self._info(i).jitter_px, scale)
            hr |= {name: x for name, x in (("depth", depth), ("motion", motion)) if name in derived}
        return lr, hr

    def _info(self, i: int) -> FrameInfo:
        if not 0 <= i < len(self.infos):
            raise JaxsrError("no such frame", where=self.path, expected=f"0 to {len(self) - 1}", found=i)
        return self.infos[i]

    def _place(self, scale: int) -> str:
        return self._resolution("hr" if scale == 1 else f"x{scale}")

    def _resolution(self, resolution: str) -> str:
        if resolution == "hr" and not self.hr:
            raise JaxsrError(
                "the sequence has no HR images",
                where=self.path,
                expected=f"one of the scales {[s for s in self.scales if s > 1]}",
                found='"hr": false in sequence.json',
                fix="upscale from one of these; training and measuring need HR colour, which is the truth",
            )
        if resolution not in self.resolutions:
            raise JaxsrError(
                f"scale {1 if resolution == 'hr' else resolution.lstrip('x')} is not available",
                where=self.path,
                expected=f"one of {[*([1] if self.hr else []), *(s for s in self.scales if s > 1)]}",
                fix="render the sequence at that scale, or choose one of these",
            )
        return resolution

    def _read(
        self,
        i: int,
        resolution: str,
        wanted: frozenset[str],
        demanded: frozenset[str] = frozenset(),
        as_stored: bool = False,
    ) -> dict[str, np.ndarray]:
        """The layers of one file that are wanted; opens nothing if none are."""
        if not wanted:
            return {}
        index = self._info(i).index
        path = frame_file(self.path, resolution, index)
        scale = 1 if resolution == "hr" else int(resolution[1:])
        width, height = self.size
        found, _ = read_exr(
            path,
            pad=False,
            size=(height // scale, width // scale),
            because=f"sequence.json: HR {width}x{height}, scale {scale}",
        )
        layers = {}
        for layer in (n for n in LAYERS if n in wanted):
            names = channels(layer)
            absent = [n for n in names if n not in found]
            if len(absent) == len(names) and layer not in demanded:
                continue
            if absent:
                raise _missing(layer, absent, index, path, found)
            planes = [found[n] for n in names]
            x = np.empty(
                (*planes[0].shape, len(planes)), np.result_type(*planes) if as_stored else np.float32
            )
            for k, plane in enumerate(planes):
                x[..., k] = plane
            if self.check and not as_stored:
                fix = "render it again, or open the sequence with check=False"
                check_pixels(layer, x, path, f"frame {index}: ", fix)
            layers[layer] = x
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
    return GBuffer(**{field: layers.get(layer) for layer, field in FIELDS.items()})  # type: ignore[arg-type]


def _missing(layer: str, absent: list[str], index: int, path: Path, found: Iterable[str]) -> JaxsrError:
    names = channels(layer)
    if len(absent) < len(names):
        return JaxsrError(
            f"frame {index}: layer {layer!r} lacks channel {absent[0]!r}",
            where=path,
            expected=", ".join(names),
            found=", ".join(sorted(found)),
        )
    there = dict.fromkeys(n.rpartition(".")[0] or n for n in found)
    return JaxsrError(
        f"frame {index}: missing layer {layer!r}",
        where=path,
        expected="channels " + ", ".join(names),
        found="layers " + (", ".join(there) or "none"),
        fix="export it (docs/data.md)",
    )


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
    head: dict[str, Any] = read_json(file, dict)
    check_head(head, file)
    return head


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
