"""Windows of consecutive frames over many sequences, as a random-access source for Grain.

Making a window reads no pixels where that can be avoided: its images are views of memory maps
(`jaxsr.data.cache`) in the types of the files, and cropping and flipping (`jaxsr.data.augment`) give views
again. `stack`, which makes a batch, reads the pixels that are left, once, and turns them into float32. Only
the colour of windows with frames that are not rendered is copied, without reading what is hidden.
"""

import bisect
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsr.data.cache import Arrays, open_arrays
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, Frame, GBuffer, Scale, Window
from jaxsr.io.sequence import Sequence as Clip
from jaxsr.layers import FIELDS, channels, needed
from jaxsr.needs import Needs, Windows
from jaxsr.progress import Progress, silent

NEEDS = frozenset(f"{place}.{layer}" for place in ("lr", "hr") for layer in ("color", *FIELDS))
"""All that a method can need: "lr.color", "hr.depth", ... The truth is "hr.color", and is always there."""


class WindowSource:
    """Item i is a `Window` of consecutive frames; no window crosses a reset.

    Every window has what its cadence allows. The colour of frames that do not count as rendered is zero, and
    is not read from the files. The truth is that of the frames to be made, `windows.targets`, and so is the
    LR truth. Buffers that no frame of a window needs are None. LR colour, which a `Frame` always has, is then
    a view of a single zero.

    The first frame of a window is a `reset` only if the sequence has one there: otherwise it has a past that
    the window leaves out. At scale 1 the HR images are the LR ones, and the jitter is 0. The camera is None
    unless all sequences know it. Cameras, exposure and jitter are float64 until the batch is made.

    Args:
        sequences: folders of sequences.
        needs: of the method.
        windows: length and cadence of the windows, and which frames are to be made.
        scale: HR size divided by LR size, one that all sequences have.
        held_back: frames at the end of each sequence that are in no window.
        cache, progress: as in `open_arrays`.

    Raises:
        JaxsrError: no sequences; one that lacks the scale or a layer, or has too few frames without a reset;
            unknown needs; windows that contradict themselves; what `open_arrays` raises.
    """

    def __init__(
        self,
        sequences: Iterable[str | Path],
        needs: Needs,
        windows: Windows,
        *,
        scale: int,
        truth: str = "color",
        held_back: int = 0,
        cache: Path | None = None,
        progress: Progress = silent,
    ):
        check_windows(windows)
        read = buffers_of(needs, windows)
        unknown = sorted(read - NEEDS)
        if unknown:
            raise JaxsrError(f"unknown buffer {unknown[0]!r}", expected=f"some of {sorted(NEEDS)}")
        if scale < 1:
            raise JaxsrError("bad scale", expected="1 or more", found=scale)
        if held_back < 0:
            raise JaxsrError("bad number of held-back frames", expected="0 or more", found=held_back)
        self.scale, self.windows, self.truth, self.held_back = scale, windows, truth, held_back
        self._layers = {place: needed(read, place) for place in ("lr", "hr")}
        self.sequences: list[Clip] = []
        self._arrays: list[tuple[Arrays, Arrays]] = []
        self._starts: list[list[int]] = []
        paths = list(sequences)
        if not paths:
            raise JaxsrError("no sequences", fix="name at least one folder of a sequence")
        lr = "hr" if scale == 1 else f"x{scale}"
        self.resolutions = tuple(dict.fromkeys((lr, "hr")))
        for path in paths:  # before anything is converted, which takes long
            clip = Clip.open(path)
            clip.layers(lr)
            self.sequences.append(clip)
            self._starts.append(_starts(clip, windows.length, held_back))
        demanded = read | {f"hr.{truth}"} | ({"lr.color"} if windows.lr_truth else set())
        for path in paths:
            found = open_arrays(path, self.resolutions, cache=cache, progress=progress)
            self._arrays.append((found[lr], found["hr"]))
            for need in sorted(demanded):
                place, layer = need.split(".")
                _check_layer(found[lr if place == "lr" else "hr"], layer, need)
        self._has_cameras = all(info.has_camera for clip in self.sequences for info in clip.infos)
        self._ends = list(itertools.accumulate(len(s) for s in self._starts))

    def __len__(self) -> int:
        return self._ends[-1]

    def place(self, i: int) -> tuple[int, int]:
        """Which of `sequences` window i is of, and the position in it of its first frame."""
        if not 0 <= i < len(self):
            raise IndexError(i)
        k = bisect.bisect_right(self._ends, i)
        return k, self._starts[k][i - (self._ends[k - 1] if k else 0)]

    def __getitem__(self, i: int) -> Window:
        k, start = self.place(i)
        clip = self.sequences[k]
        lr, hr = self._arrays[k]
        frames = slice(start, start + self.windows.length)
        infos = clip.infos[frames]
        made = [start + t for t in self.windows.targets]
        values: dict[str, Any] = {
            "jitter_px": np.array([info.jitter_px for info in infos], float) * (self.scale > 1),
            "hr_jitter_px": np.array([info.hr_jitter_px for info in infos], float),
            "reset": np.array([info.reset for info in infos]),
            "rendered": np.array(self.windows.cadence),
            "exposure": np.array([clip.exposure_at(start + t) for t in range(len(infos))], float),
        }
        camera: Any = None
        if self._has_cameras:
            camera = Camera(*(np.array([getattr(info, n) for info in infos], float) for n in Camera._fields))  # type: ignore[arg-type]
        return Window(
            Frame(
                color_linear=self._color(lr, frames),  # type: ignore[arg-type]
                lr=self._gbuffer(lr, "lr", frames),
                hr=self._gbuffer(hr, "hr", frames),
                camera=camera,
                factor=Scale(self.scale),
                **values,
            ),
            _pick(hr.layers[self.truth], made),
            _pick(lr.layers["color"], made) if self.windows.lr_truth else None,
        )

    def _color(self, lr: Arrays, frames: slice) -> np.ndarray:
        """`[T, h, w, 3]`: LR colour, zero where the frame does not count as rendered."""
        cadence = self.windows.cadence
        if "color" not in self._layers["lr"] or not any(cadence):
            width, height = lr.sequence.size
            size = (height // self.scale, width // self.scale)
            return np.broadcast_to(np.float32(0), (len(cadence), *size, 3))
        color = lr.layers["color"][frames]
        if all(cadence):
            return color
        shown = np.zeros(color.shape, color.dtype)
        for t, rendered in enumerate(cadence):
            if rendered:
                shown[t] = color[t]
        return shown

    def _gbuffer(self, arrays: Arrays, place: str, frames: slice) -> GBuffer:
        """Views `[T, H, W, C]` of the buffers that are needed."""
        layers = self._layers[place]
        return GBuffer(**{f: arrays.layers[n][frames] for n, f in FIELDS.items() if n in layers})  # type: ignore[arg-type]


def buffers_of(needs: Needs, windows: Windows) -> frozenset[str]:
    """What the frames of these windows need, all together."""
    extrapolating = not all(windows.cadence)
    return frozenset().union(*(needs.of(rendered, extrapolating) for rendered in windows.cadence))


def check_windows(windows: Windows) -> None:
    """See that length, cadence, the frames to be made and the warm-up fit each other.

    Raises:
        JaxsrError: they do not; it says what is wrong.
    """
    length = windows.length
    if length < 1:
        raise JaxsrError("no frames in a window", expected="1 or more", found=length)
    if len(windows.cadence) != length:
        raise JaxsrError(
            "the cadence of a window has another length",
            expected=f"{length} flags",
            found=len(windows.cadence),
        )
    if not windows.cadence[0]:
        raise JaxsrError("the first frame of a window must be rendered", found=list(windows.cadence))
    outside = [i for i in windows.made or () if not -length <= i < length]
    if outside or not windows.targets or len({*windows.targets}) < len(windows.targets):
        expected = f"positions from {-length} to {length - 1}, at least one, each once"
        raise JaxsrError("bad frames to be made", expected=expected, found=list(windows.made or ()))
    if not 0 <= windows.warmup < length:
        raise JaxsrError("bad warm-up", expected=f"0 to {length - 1} frames", found=windows.warmup)
    if windows.multiple < 1:
        raise JaxsrError("bad multiple of crops", expected="1 or more", found=windows.multiple)


def stack(windows: Sequence[Window]) -> Window:
    """A batch `[B, T, ...]`: numbers as float32, flags as they are. Here the pixels are read."""

    def leaf(*xs: np.ndarray) -> np.ndarray:
        out = np.empty((len(xs), *xs[0].shape), bool if xs[0].dtype == bool else np.float32)
        for target, x in zip(out, xs, strict=True):
            np.copyto(target, x, casting="unsafe")  # object ids are uint32
        return out

    return jax.tree.map(leaf, *windows)


def _pick(array: np.ndarray, positions: list[int]) -> Any:
    """The frames at these rising positions: a view if they are evenly spaced, else a copy."""
    steps = {b - a for a, b in itertools.pairwise(positions)} or {1}
    if len(steps) > 1:
        return array[positions]
    return array[positions[0] : positions[-1] + 1 : steps.pop()]


def _starts(clip: Clip, length: int, held_back: int) -> list[int]:
    frames = max(len(clip) - held_back, 0)
    cuts = [k for k, info in enumerate(clip.infos[:frames]) if info.reset and k] + [frames]
    starts = [i for i in range(frames) if i + length <= next(c for c in cuts if c > i)]
    if not starts:
        longest = max(b - a for a, b in itertools.pairwise([0, *cuts]))
        raise JaxsrError(
            "fewer frames than a window has",
            where=clip.path,
            expected=f"{length} consecutive frames without a reset"
            + (f" before the last {held_back}, which are held back" if held_back else ""),
            found=longest,
            fix="leave the sequence out, or render more frames",
        )
    return starts


def _check_layer(arrays: Arrays, layer: str, need: str) -> None:
    if wrong := arrays.broken.get(layer):
        what, where = wrong["what"], wrong["where"]
        expected, found = wrong["expected"], wrong["found"]
        fix = "render it again, or leave the sequence out"
        raise JaxsrError(what, where=where, expected=expected, found=found, fix=fix)
    if layer in arrays.layers:
        return
    frame = "" if layer not in arrays.absent else f" in frame {arrays.absent[layer]}"
    raise JaxsrError(
        f"missing layer {layer!r}{frame}",
        where=arrays.sequence.path / arrays.resolution,
        expected=f"what {need} needs: channels " + ", ".join(channels(layer)),
        found="layers " + (", ".join(arrays.layers) or "none"),
        fix="export it (docs/data.md), or leave the sequence out",
    )
