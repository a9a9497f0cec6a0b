"""Windows of consecutive frames over many sequences, as a random-access source for Grain.

A window is not read when it is made: its images are views of memory maps (`jaxsr.data.cache`) in the types
of the files, and cropping and flipping (`jaxsr.data.augment`) give views again. `stack`, which makes a batch,
touches the pixels that are left, once, and turns them into float32.
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
from jaxsr.layers import FIELDS, LAYERS, channels
from jaxsr.progress import Progress, silent

NEEDS = frozenset(f"{place}.{layer}" for place in ("lr", "hr") for layer in ("color", *FIELDS))
"""All that a method can need: "lr.color", "hr.depth", ... The truth is "hr.color", and is always there."""


class WindowSource:
    """Item i is a `Window` of `length` consecutive frames; no window crosses a reset.

    Buffers that are not needed are None; depth, motion and LR colour, which a `Frame` always has, are then
    zeros that take no memory. All frames are `rendered`. The first frame of a window is a `cut` only if the
    sequence has one there: otherwise it has a past that the window leaves out. At scale 1 the HR images are
    the LR ones, and the jitter is 0. Cameras and jitter are float64 until the batch is made.

    Args:
        sequences: folders of sequences.
        scale: HR size divided by LR size, one that all of them have.
        needs: buffers, from `NEEDS`.
        length: frames in a window.
        held_back: frames at the end of each sequence that are in no window.
        cache, progress: as in `open_arrays`.

    Raises:
        JaxsrError: no sequences; one that lacks the scale or a layer, or has no `length` frames without a
            cut; unknown needs; what `open_arrays` raises.
    """

    def __init__(
        self,
        sequences: Iterable[str | Path],
        *,
        scale: int,
        needs: frozenset[str],
        length: int = 1,
        held_back: int = 0,
        cache: Path | None = None,
        progress: Progress = silent,
    ):
        unknown = sorted(needs - NEEDS)
        if unknown:
            raise JaxsrError(f"unknown buffer {unknown[0]!r}", expected=f"some of {sorted(NEEDS)}")
        if length < 1:
            raise JaxsrError("no frames in a window", expected="1 or more", found=length)
        if held_back < 0:
            raise JaxsrError("bad number of held-back frames", expected="0 or more", found=held_back)
        self.scale, self.needs, self.length = scale, needs, length
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
            self._starts.append(_starts(clip, length, held_back))
        for path in paths:
            found = open_arrays(path, self.resolutions, cache=cache, progress=progress)
            self._arrays.append((found[lr], found["hr"]))
            for need in sorted(needs | {"hr.color"}):
                place, layer = need.split(".")
                _check_layer(found[lr if place == "lr" else "hr"], layer, need)
        self._cameras = all(info.has_camera for clip in self.sequences for info in clip.infos)
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
        frames = slice(start, start + self.length)
        lr, hr = self._arrays[k]
        infos = clip.infos[frames]
        jitter: Any = np.array([info.jitter_px for info in infos], float) * (self.scale > 1)
        flags: Any = (np.array([info.reset for info in infos]), np.ones(len(infos), bool))
        exposure: Any = np.array([clip.exposure_at(start + t) for t in range(self.length)])
        camera: Any = None
        if self._cameras:
            camera = Camera(
                *(np.array([getattr(info, n) for info in infos], float) for n in Camera._fields)  # type: ignore
            )
        low, high = self._images(lr, "lr", frames), self._images(hr, "hr", frames)
        color = low.pop("color")
        high.pop("color")
        return Window(
            Frame(
                color_linear=color,
                lr=GBuffer(**low),
                hr=GBuffer(**high),
                jitter_px=jitter,
                camera=camera,
                reset=flags[0],
                rendered=flags[1],
                exposure=exposure,
                factor=Scale(self.scale),
            ),
            hr.layers["color"][frames],  # type: ignore[arg-type]
        )

    def _images(self, arrays: Arrays, place: str, frames: slice) -> dict[str, Any]:
        """Field of the frame -> `[T, H, W, C]` views: those that are needed, and those that it must have."""
        w, h = arrays.sequence.size
        scale = self.scale if place == "lr" else 1
        zeros = np.broadcast_to(np.float32(0), (self.length, h // scale, w // scale, 1))
        images: dict[str, Any] = {}
        for layer, field in ({"color": "color"} | FIELDS).items():
            if f"{place}.{layer}" in self.needs:
                images[field] = arrays.layers[layer][frames]
            elif layer in ("color", "depth", "motion"):
                images[field] = np.broadcast_to(zeros, (*zeros.shape[:3], len(LAYERS[layer].letters)))
        return images


def stack(windows: Sequence[Window]) -> Window:
    """A batch `[B, T, ...]`: numbers as float32, flags as they are. Here the pixels are read."""

    def leaf(*xs: np.ndarray) -> np.ndarray:
        out = np.empty((len(xs), *xs[0].shape), bool if xs[0].dtype == bool else np.float32)
        for target, x in zip(out, xs, strict=True):
            np.copyto(target, x, casting="unsafe")  # object ids are uint32
        return out

    return jax.tree.map(leaf, *windows)


def _starts(clip: Clip, length: int, held_back: int) -> list[int]:
    frames = max(len(clip) - held_back, 0)
    cuts = [k for k, info in enumerate(clip.infos[:frames]) if info.reset and k] + [frames]
    starts = [i for i in range(frames) if i + length <= next(c for c in cuts if c > i)]
    if not starts:
        longest = max(b - a for a, b in itertools.pairwise([0, *cuts]))
        raise JaxsrError(
            "fewer frames than a window has",
            where=clip.path,
            expected=f"{length} consecutive frames without a cut"
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
