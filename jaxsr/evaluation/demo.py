"""`jaxsr demo`: the sample that ships with the package, upscaled and extrapolated, measured and shown."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsr.evaluation.measuring import Reference, metrics_with
from jaxsr.evaluation.running import Evaluation, Settings, run_methods
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.io.truth import Truth, choose_truth
from jaxsr.progress import Progress
from jaxsr.provenance import provenance
from jaxsr.report.documents import check_results_folder, write_metrics
from jaxsr.report.embedding import to_bytes
from jaxsr.report.page import write_report
from jaxsr.report.results import SequenceResult
from jaxsr.report.video import write_video
from jaxsr.runtime.load import find_method, shipped_scales

UPSCALERS = ("nearest", "bilinear", "bicubic", "taau", "guided-taau")
LEARNED = ("fusion-sr", "guided-unet")
"""Those of them upscale too whose weights ship for the scale; the last one is shown in the videos."""
WARMUP = 4
"""Frames at the start that only fill histories, if the sequence has twice as many."""
EXTRAPOLATORS = ("nearest", "bilinear", "taau", "guided", "guided-taau")


def description(**settings: Any) -> dict[str, Any]:
    """What a result must carry: versions, device, date and settings."""
    return {
        **provenance(),
        "display": "sRGB of the ACES tone map (Narkowicz fit) of exposure times linear colour; no crop",
        **settings,
    }


def run_demo(
    out: Path,
    sequences: Sequence[Path],
    *,
    scale: int,
    lpips: bool = False,
    truth: Truth | None = None,
    progress: Progress,
) -> list[SequenceResult]:
    """Run the demo and write frames, videos, metrics and the page into `out`.

    Args:
        truth: "reference" or "color"; by default the best that all frames of all sequences have.
        lpips: measure LPIPS too, if its extra is installed; it takes longer than all the rest.
        progress: told of each frame that is made and measured.

    Raises:
        JaxsrError: a sequence cannot be read or lacks the scale.
    """
    check_results_folder(out)
    opened = [FrameSequence.open(path) for path in sequences]
    learned = [name for name in LEARNED if scale in shipped_scales(name)]
    upscalers = (*UPSCALERS, *learned)
    rivals = ("taau", learned[-1]) if learned else ("bilinear", "guided-taau")
    tasks = (
        _Task("super-resolution", 1, upscalers, rivals),
        _Task("extrapolation", 2, EXTRAPOLATORS, ("taau", "guided-taau")),
    )
    total = sum(len(s) * len(task.methods) for s in opened for task in tasks)
    advance = progress("frames", 2 * total)  # made, and measured
    sections, compiled = [], dict[Any, float]()
    truth = choose_truth(opened, truth)
    for sequence in opened:
        reference = Reference(sequence, truth=truth)
        for task in tasks:
            warmup = min(WARMUP, len(sequence) // 2)
            settings = Settings(scale, task.every, warmup, metrics_with(lpips))
            sections.append(
                run_methods(
                    Evaluation(sequence, settings, reference, advance),
                    [find_method(name, scale) for name in task.methods],
                    out / sequence.name / task.name,
                    compiled=compiled,
                )
            )
    meta = description(scale=scale, truth=truth)
    advance = progress("page", 1)
    write_metrics(out, sections, title="jaxsr demo", meta=meta)
    write_report(out / "report.html", sections, title="jaxsr demo", meta=meta)
    advance()
    advance = progress("videos", len(sections))
    shown = [(sequence, task) for sequence in opened for task in tasks]
    for section, (sequence, task) in zip(sections, shown, strict=True):
        path = out / f"{sequence.name}-{task.name}.mp4"
        _write_video(path, section, task.shown, sequence.fps / 3)
        advance()
    return sections


class _Task(NamedTuple):
    """What the demo does with every sequence."""

    name: str
    every: int
    methods: tuple[str, ...]
    shown: tuple[str, str]
    """Of these, the two in the video."""


def _write_video(path: Path, section: SequenceResult, names: Sequence[str], fps: float) -> None:
    """Input, two methods and truth, two by two; the clip is short and plays four times."""
    images = {result.name: result.images for result in section.methods}
    shown = {"input": enlarged(section), **{n: images[n] for n in names}, "truth": section.truths}
    extrapolated = section.extrapolated or [False] * len(section.frames)
    captions = [
        f"frame {n}{', extrapolated' if e else ''}" for n, e in zip(section.frames, extrapolated, strict=True)
    ]
    columns = {label: list(images) * 4 for label, images in shown.items()}
    write_video(path, columns, fps=fps, per_row=2, captions=captions * 4)


def enlarged(section: SequenceResult) -> list[np.ndarray]:
    """The inputs at the size of the truth by pixel repetition; the last one stays where none was rendered."""
    height = to_bytes(section.truths[0]).shape[0]
    images: list[np.ndarray] = []
    for given in section.inputs:
        if given is None:
            images.append(images[-1])
            continue
        pixels = to_bytes(given)
        factor = height // pixels.shape[0]
        images.append(pixels.repeat(factor, 0).repeat(factor, 1))
    return images
