"""One method over a sequence on disk: its frames out as OpenEXR and PNG, each step timed.

The method is not given the truth. Memory does not grow with the length of the sequence.

The clock runs while nothing else does: `TOGETHER` frames at a time are decoded by threads, and only when all
of them are in memory and the threads rest is the method run on them. So a time is that of the step alone,
its inputs on the device and its program compiled.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.io.exr import write_exr
from jaxsr.io.images import write_png
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.methods import Method
from jaxsr.ops import to_display
from jaxsr.progress import Advance
from jaxsr.runtime.cost import Cost, Timing
from jaxsr.runtime.load import LoadedMethod
from jaxsr.runtime.record import claim_folder, describe_run, frame_path
from jaxsr.runtime.schedule import check_needs, readers, rendered_schedule
from jaxsr.runtime.stream import stream

TOGETHER = 4
"""Frames that are read before the method is run on them."""


class MadeFrame(NamedTuple):
    """A frame that was made and written."""

    image: np.ndarray
    """Display-referred."""
    seconds: float
    compile_seconds: float
    cost: Cost


class Clock:
    """Collects the times of frames."""

    def __init__(self) -> None:
        self._seconds: list[float] = []
        self._compile_seconds = 0.0

    def add(self, made: MadeFrame) -> None:
        self._seconds.append(made.seconds)
        self._compile_seconds += made.compile_seconds

    def timing(self) -> Timing:
        """Of the frames so far, at least one."""
        low, middle, high = np.percentile(self._seconds, [25, 50, 75]) * 1e3
        return Timing(self._compile_seconds, float(middle), float(high - low))


def display(color_linear: np.ndarray, exposure: float) -> np.ndarray:
    """The display-referred image of jaxsr: sRGB of the ACES tone map, float32 in [0, 1]."""
    return np.asarray(to_display(np.ascontiguousarray(color_linear), exposure))


def frames_in_memory(sequence: FrameSequence, method: Method, scale: int, every: int = 1) -> Iterator[Frame]:
    """The frames as a method may see them; no thread runs while the caller works on one.

    Threads decode the next `TOGETHER` frames, and rest before the first of these is given.

    Args:
        method: it says which buffers are read.
        scale, every: as for `upscale`.
    """
    reads = readers(sequence, method, scale, every)
    with ThreadPoolExecutor(TOGETHER) as pool:
        for first in range(0, len(reads), TOGETHER):
            read = [pool.submit(each) for each in reads[first : first + TOGETHER]]
            wait(read)
            while read:
                yield read.pop(0).result()  # an error arrives where its frame would have been


def write_frames(
    sequence: FrameSequence, loaded: LoadedMethod, out: Path, scale: int, every: int
) -> Iterator[MadeFrame]:
    """Make all frames of a sequence; each is on disk when it is given."""
    frames = stream(loaded.method, frames_in_memory(sequence, loaded.method, scale, every), loaded.net)
    for i, (info, made) in enumerate(zip(sequence.infos, frames, strict=True)):
        _check_image(made.image, f"{loaded.method.name}, {sequence.path}, frame {info.index}")
        half = np.clip(made.image, 0, np.finfo(np.float16).max).astype(np.float16)
        channels = {f"color.{c}": half[..., k] for k, c in enumerate("RGB")}
        write_exr(frame_path(out, "exr", info.index), channels)
        image = display(made.image, sequence.exposure_at(i))
        write_png(frame_path(out, "png", info.index), image)
        yield MadeFrame(image, made.seconds, made.compile_seconds, made.cost)


def _check_image(image: np.ndarray, where: str) -> None:
    """See that a frame that was made is finite, before it is written.

    Raises:
        JaxsrError: it is not; says how much of it.
    """
    bad = ~np.isfinite(image).all(-1)
    if bad.any():
        raise JaxsrError(
            "the method made NaN or Inf, and the frame is not written",
            where=where,
            expected="finite colour",
            found=f"{bad.mean():.2%} of the pixels" if bad.mean() >= 1e-4 else f"{int(bad.sum())} pixels",
            fix="run jaxsr inspect on the sequence; very bright input and damaged weights cause this",
        )


def upscale(
    sequence: FrameSequence,
    loaded: LoadedMethod,
    out: Path,
    *,
    scale: int,
    every: int = 1,
    advance: Advance = lambda: None,
) -> Timing:
    """Run one method over a sequence: `out/exr/0001.exr` (linear half), `out/png/0001.png`, `out/run.json`.

    The same run again replaces its own frames.

    Args:
        scale: HR size over LR size of the frames to start from; 1 takes the HR frames, to make only those
            between them.
        every: every n-th frame counts as rendered, the others are extrapolated from their G-buffer.
        advance: called once per frame.

    Returns:
        The time of a frame.

    Raises:
        JaxsrError: what the method needs is not there, a frame cannot be read, or comes out as NaN or Inf
            (the frames before it stay), or the folder holds frames of another run or files that jaxsr did
            not write (`claim_folder`).
    """
    rendered_schedule(sequence, every)
    check_needs(loaded.method, sequence, scale, every)
    claim_folder(out, describe_run(sequence, scale, every, loaded.method.name, loaded.weights))
    clock = Clock()
    for made in write_frames(sequence, loaded, out, scale, every):
        clock.add(made)
        advance()
    return clock.timing()
