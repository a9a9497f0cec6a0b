"""Methods over a sequence on disk: frames out as EXR and PNG, and a `SequenceResult` of results.

No method is given the truth; it is read to measure what they made. Memory does not grow with the sequence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.measuring import Meter, Reference
from jaxsr.io.images import write_png
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.progress import Advance
from jaxsr.report.results import MethodResult, SequenceResult
from jaxsr.runtime.load import LoadedMethod
from jaxsr.runtime.record import claim_folder, describe_run, frame_path
from jaxsr.runtime.schedule import check_needs, rendered_schedule
from jaxsr.runtime.upscale import TOGETHER, Clock, display, write_frames


class Settings(NamedTuple):
    """How methods are run over a sequence."""

    scale: int
    """HR size over LR size of the frames to start from; 1 takes the HR frames, to make only those between."""
    every: int = 1
    """Every n-th frame counts as rendered, the others are extrapolated from their G-buffer."""
    warmup: int = 0
    """Number of frames at the start that are made and not measured."""
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


@dataclass(frozen=True)
class Evaluation:
    """What several methods are run over and measured against."""

    sequence: FrameSequence
    settings: Settings
    reference: Reference
    """The truth of the sequence, and the regions that are measured apart."""
    advance: Advance = lambda: None
    """Called twice per frame and method: when the frame is made, and when it is measured."""
    title: str = ""
    """Of the sequence; its name by default."""


def run_method(evaluation: Evaluation, loaded: LoadedMethod, out: Path) -> MethodResult:
    """Run one method over a sequence, write its frames as `upscale` does, and measure them.

    Frames of an earlier run of jaxsr in `out` are replaced.

    Raises:
        JaxsrError: as for `upscale`, and an output that is not of the size of the truth.
    """
    sequence, settings, advance = evaluation.sequence, evaluation.settings, evaluation.advance
    check_needs(loaded.method, sequence, settings.scale, settings.every)
    name = loaded.method.name
    run = describe_run(sequence, settings.scale, settings.every, name, loaded.weights)
    claim_folder(out, run, replace=True)
    clock, meter, cost = Clock(), Meter(settings.metrics), None
    waiting: list[tuple[int, np.ndarray]] = []  # `TOGETHER` frames, which threads measure at once

    for i, made in enumerate(write_frames(sequence, loaded, out, settings.scale, settings.every)):
        clock.add(made)
        cost = made.cost
        advance()
        if i < settings.warmup:
            advance()
            continue
        waiting.append((i, made.image))
        if len(waiting) == TOGETHER or i == len(sequence) - 1:
            _measure(evaluation, meter, waiting)
            waiting.clear()
    images = [frame_path(out, "png", info.index) for info in sequence.infos[settings.warmup :]]
    return meter.result(name, images, clock.timing(), loaded.method.summary, cost)


def _measure(evaluation: Evaluation, meter: Meter, made: Sequence[tuple[int, np.ndarray]]) -> None:
    """Measure frames that were made: positions in the sequence, and images."""
    sequence = evaluation.sequence
    truths = [evaluation.reference(i) for i, _ in made]
    for (_, image), truth in zip(made, truths, strict=True):
        if image.shape != truth.image.shape:
            raise JaxsrError(
                "output and truth differ in size",
                where=sequence.path,
                expected=truth.image.shape,
                found=image.shape,
            )
    meter.add([image for _, image in made], truths, [sequence.infos[i].reset for i, _ in made])
    for _ in made:
        evaluation.advance()


RunMethod = Callable[[Evaluation, LoadedMethod, Path], MethodResult]


def run_methods(
    evaluation: Evaluation,
    methods: Sequence[LoadedMethod],
    out: Path,
    *,
    compiled: dict[Any, float] | None = None,
    run: RunMethod = run_method,
) -> SequenceResult:
    """Run several methods over one sequence and measure each against the truth.

    Writes `out/<method>/exr|png/`, and `out/truth/png/` and `out/input/png/`.

    Args:
        compiled: seconds that compiling took for earlier sequences, where it was not needed again; added to.
        run: what runs and measures one method.

    Raises:
        JaxsrError: a missing buffer, no frame left to measure, a sequence without truth, or a folder with
            files that jaxsr did not write.
    """
    sequence, settings = evaluation.sequence, evaluation.settings
    settings.check(sequence)
    _write_truth_and_input(evaluation, out)
    results = []
    for loaded in methods:
        result = run(evaluation, loaded, out / loaded.method.name)
        if compiled is not None and result.timing is not None:
            key = (loaded.method.name, settings.scale, sequence.size)
            compiled[key] = max(result.timing.compile_s, compiled.get(key, 0.0))
            result = replace(result, timing=replace(result.timing, compile_s=compiled[key]))
        results.append(result)
    task, schedule = describe(settings), rendered_schedule(sequence, settings.every)
    measured = range(settings.warmup, len(sequence))
    indices = [info.index for info in sequence.infos]
    truth = TRUTH_WORDS[evaluation.reference.truth]
    return SequenceResult(
        title=f"{evaluation.title or sequence.name}, {task}, against {truth}",
        frames=[indices[i] for i in measured],
        truths=[frame_path(out / "truth", "png", indices[i]) for i in measured],
        methods=results,
        inputs=[frame_path(out / "input", "png", indices[i]) if schedule[i] else None for i in measured],
        extrapolated=[not schedule[i] for i in measured] if settings.every > 1 else (),
        exposures=[sequence.exposure_at(i) for i in measured],
        meta={
            "scale": settings.scale,
            "every": settings.every,
            "sequence": sequence.name,
            "truth": evaluation.reference.truth,
        },
        task=task,
    )


def _write_truth_and_input(evaluation: Evaluation, out: Path) -> None:
    """The pictures of the truth, and of the frames that count as rendered."""
    sequence, settings = evaluation.sequence, evaluation.settings
    for name in ("truth", "input"):
        run = describe_run(sequence, settings.scale, settings.every, name)
        claim_folder(out / name, run, ["png"], replace=True)
    schedule = rendered_schedule(sequence, settings.every)
    for i, (info, rendered) in enumerate(zip(sequence.infos, schedule, strict=True)):
        write_png(frame_path(out / "truth", "png", info.index), evaluation.reference(i).image)
        if rendered:
            given = np.asarray(sequence.frame(i, settings.scale).color_linear)
            path = frame_path(out / "input", "png", info.index)
            write_png(path, display(given, sequence.exposure_at(i)))


TRUTH_WORDS = {"reference": "the anti-aliased reference", "color": "the aliased truth"}


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
