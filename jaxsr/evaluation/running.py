"""Methods over a sequence on disk: frames out as EXR and PNG, and a `SequenceResult` of results.

No method is given the truth; it is read to measure what they made. Memory does not grow with the sequence.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.measuring import Meter, Reference, display
from jaxsr.io.exr import write_exr
from jaxsr.io.images import write_png
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.progress import Advance
from jaxsr.report.results import MethodResult, SequenceResult, Timing
from jaxsr.runtime.cost import Cost
from jaxsr.runtime.load import LoadedMethod
from jaxsr.runtime.schedule import check_needs, observed, rendered_schedule
from jaxsr.runtime.stream import stream

TOGETHER = 4
"""Frames that are made before they are measured: threads measure them at once, and disturb no clock."""


class Settings(NamedTuple):
    """How methods are run over a sequence."""

    scale: int
    """Of the LR frames to start from; 1 takes the HR frames, to make only those between them."""
    every: int = 1
    """Every n-th frame counts as rendered, the others are extrapolated from their G-buffer."""
    warmup: int = 0
    """So many frames at the start are made, and not measured."""
    metrics: tuple[str, ...] | None = None
    """Of `jaxsr.metrics.METRICS`; None are all that can be computed here."""

    def check(self, sequence: FrameSequence) -> None:
        """See that there is something to run and measure.

        Raises:
            JaxsrError: an interval below 1, or a warm-up as long as the sequence.
        """
        rendered_schedule(sequence, self.every)
        if not 0 <= self.warmup < len(sequence):
            raise JaxsrError(
                "no frame is left to measure",
                where=f"{sequence.path}, warmup",
                expected=f"a number from 0 to {len(sequence) - 1}",
                found=self.warmup,
            )


class _Made(NamedTuple):
    """A frame that was made and written."""

    image: np.ndarray
    """Display-referred."""
    seconds: float
    compile_seconds: float
    cost: Cost


def _write_frames(
    sequence: FrameSequence, ready: LoadedMethod, out: Path, settings: Settings
) -> Iterator[_Made]:
    """Make all frames of a sequence; each is on disk when it is given."""
    frames = stream(ready.method, observed(sequence, settings.scale, settings.every), ready.net)
    for info, made in zip(sequence.infos, frames, strict=True):
        half = np.clip(made.image, 0, np.finfo(np.float16).max).astype(np.float16)
        channels = {f"color.{c}": half[..., k] for k, c in enumerate("RGB")}
        write_exr(out / "exr" / f"{info.index:04d}.exr", channels)
        image = display(made.image, sequence.exposure)
        write_png(png_file(out, info.index), image)
        yield _Made(image, made.seconds, made.compile_seconds, made.cost)


def png_file(out: Path, index: int) -> Path:
    """Where the display-referred frame of that number lies."""
    return out / "png" / f"{index:04d}.png"


class _Clock:
    """Collects the times of frames."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.compile_seconds = 0.0

    def add(self, made: _Made) -> None:
        self.seconds.append(made.seconds)
        self.compile_seconds += made.compile_seconds

    def timing(self) -> Timing:
        low, middle, high = np.percentile(self.seconds, [25, 50, 75]) * 1e3
        return Timing(self.compile_seconds, float(middle), float(high - low))


def upscale(
    sequence: FrameSequence,
    ready: LoadedMethod,
    out: Path,
    *,
    scale: int,
    every: int = 1,
    advance: Advance | None = None,
) -> Timing:
    """Run one method over a sequence and write `out/exr/0001.exr` (linear half) and `out/png/0001.png`.

    Args:
        scale, every: see `Settings`.
        advance: progress callback.

    Returns:
        The time of a frame.

    Raises:
        JaxsrError: what the method needs is not there, a frame cannot be read (those before it stay), or the
            folder holds frames of something else.
    """
    check_needs(ready.method, sequence, scale)
    check_folder(out, {info.index for info in sequence.infos})
    clock = _Clock()
    for made in _write_frames(sequence, ready, out, Settings(scale, every)):
        clock.add(made)
        if advance is not None:
            advance()
    return clock.timing()


def check_folder(out: Path, frames: set[int]) -> None:
    """See that frames of another sequence do not mix with those to come, before any work is done."""
    for place in (out, *out.parents):
        if place.exists() and not place.is_dir():
            raise JaxsrError("not a folder", where=place, fix="choose another folder with --out")
    for kind in ("exr", "png"):
        for file in sorted((out / kind).glob(f"*.{kind}")):
            if not file.stem.isdigit() or int(file.stem) not in frames:
                raise JaxsrError(
                    f"holds {file.name}, which is not a frame of this sequence",
                    where=out / kind,
                    fix="choose another folder with --out, or remove it",
                )


def run_method(
    sequence: FrameSequence,
    ready: LoadedMethod,
    out: Path,
    settings: Settings,
    reference: Reference,
    advance: Advance = lambda: None,
) -> MethodResult:
    """One method over a sequence, written as by `upscale` and measured against the truth.

    Args:
        advance: called twice a frame: when it is made, and when it is measured.

    Raises:
        JaxsrError: as for `upscale`, and an output that is not of the size of the truth.
    """
    check_needs(ready.method, sequence, settings.scale)
    check_folder(out, {info.index for info in sequence.infos})
    clock, meter, cost = _Clock(), Meter(settings.metrics), None
    waiting: list[tuple[int, np.ndarray]] = []

    def measure() -> None:
        truths = [reference(i) for i, _ in waiting]
        for (_, image), truth in zip(waiting, truths, strict=True):
            if image.shape != truth.image.shape:
                raise JaxsrError(
                    "output and truth differ in size",
                    where=sequence.path,
                    expected=truth.image.shape,
                    found=image.shape,
                )
        meter.add([image for _, image in waiting], truths, [sequence.infos[i].reset for i, _ in waiting])
        for _ in waiting:
            advance()
        waiting.clear()

    for i, made in enumerate(_write_frames(sequence, ready, out, settings)):
        clock.add(made)
        cost = made.cost
        advance()
        if i < settings.warmup:
            advance()
            continue
        waiting.append((i, made.image))
        if len(waiting) == TOGETHER or i == len(sequence) - 1:
            measure()
    images = [png_file(out, info.index) for info in sequence.infos[settings.warmup :]]
    return meter.track(ready.method.name, images, clock.timing(), ready.method.summary, cost)


RunMethod = Callable[[FrameSequence, LoadedMethod, Path, Settings, Reference, Advance], MethodResult]


def run_methods(
    sequence: FrameSequence,
    methods: Sequence[LoadedMethod],
    out: Path,
    settings: Settings,
    *,
    reference: Reference | None = None,
    advance: Advance = lambda: None,
    compiled: dict[Any, float] | None = None,
    run: RunMethod = run_method,
    title: str = "",
) -> SequenceResult:
    """Several methods over one sequence, each measured against the truth.

    Writes `out/<method>/exr|png/`, and `out/truth/png/` and `out/input/png/`.

    Args:
        reference: the truth, and where else it is to be measured; by default the truth.
        advance: called twice a frame and method: when it is made, and when it is measured.
        compiled: seconds that compiling took in earlier sections, where it was not needed again; added to.
        run: what runs and measures one method.
        title: of the sequence; its name by default.

    Raises:
        JaxsrError: a missing buffer, no frame left to measure, or a sequence without truth.
    """
    infos = sequence.infos
    settings.check(sequence)
    reference = reference or Reference(sequence)
    schedule = rendered_schedule(sequence, settings.every)
    truths, inputs = out / "truth", out / "input"
    for i, (info, rendered) in enumerate(zip(infos, schedule, strict=True)):
        write_png(png_file(truths, info.index), reference(i).image)
        if rendered:
            given = np.asarray(sequence.frame(i, settings.scale).color_linear)
            write_png(png_file(inputs, info.index), display(given, sequence.exposure))
    tracks = []
    for ready in methods:
        track = run(sequence, ready, out / ready.method.name, settings, reference, advance)
        if compiled is not None and track.timing is not None:
            key = (ready.method.name, settings.scale, sequence.size)
            compiled[key] = max(track.timing.compile_s, compiled.get(key, 0.0))
            track = replace(track, timing=replace(track.timing, compile_s=compiled[key]))
        tracks.append(track)
    task = describe(settings)
    measured = range(settings.warmup, len(infos))
    return SequenceResult(
        title=f"{title or sequence.name}, {task}",
        frames=[infos[i].index for i in measured],
        truths=[png_file(truths, infos[i].index) for i in measured],
        tracks=tracks,
        inputs=[png_file(inputs, infos[i].index) if schedule[i] else None for i in measured],
        extrapolated=[not schedule[i] for i in measured] if settings.every > 1 else (),
        exposure=sequence.exposure,
        meta={"scale": settings.scale, "every": settings.every, "sequence": sequence.name},
        task=task,
    )


def describe(settings: Settings) -> str:
    """The task in words: "x4, super-resolution"."""
    task = f"x{settings.scale}" if settings.scale > 1 else "full size"
    if settings.every == 2:
        task += ", every second frame extrapolated"
    elif settings.every > 2:
        task += f", {settings.every - 1} of {settings.every} frames extrapolated"
    elif settings.scale > 1:
        task += ", super-resolution"
    return task
