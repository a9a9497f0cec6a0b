"""`jaxsr demo`: the sample that ships with the package, upscaled and extrapolated, measured and shown."""

import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxsr
from jaxsr.evaluation.report import write_report
from jaxsr.evaluation.tables import Section, write_metrics
from jaxsr.evaluation.upscale import run_section
from jaxsr.evaluation.video import write_video
from jaxsr.io.sequence import Sequence as FrameSequence

UPSCALERS = ("nearest", "bilinear", "bicubic", "taau", "guided-taau")
EXTRAPOLATORS = ("nearest", "bilinear", "taau", "guided", "guided-taau")


def description(**settings: Any) -> dict[str, Any]:
    """What a result must carry: versions, device, date and settings."""
    return {
        "jaxsr": jaxsr.__version__,
        "jax": jax.__version__,
        "device": f"{jax.devices()[0].device_kind}, {platform.machine()}",
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
        "display": "sRGB of the ACES tone map (Narkowicz fit) of exposure times linear colour; no crop",
        **settings,
    }


def run_demo(
    out: Path,
    sequences: Sequence[Path],
    *,
    scale: int,
    progress: Callable[[str, int], Callable[[], Any]],
) -> list[Section]:
    """Run the demo and write frames, videos, metrics and the page into `out`.

    Args:
        progress: called with a title and a number of steps; returns what is called after each step.

    Raises:
        JaxsrError: a sequence cannot be read or lacks the scale.
    """
    opened = [FrameSequence.open(path) for path in sequences]
    tasks = (("super-resolution", 1, UPSCALERS), ("extrapolation", 2, EXTRAPOLATORS))
    total = sum(len(s) * len(methods) for s in opened for _, _, methods in tasks)
    advance = progress("frames", 2 * total)  # made, and measured
    sections, compiled = [], dict[Any, float]()
    for sequence in opened:
        for task, every, methods in tasks:
            folder = out / sequence.name / task
            sections.append(
                run_section(
                    sequence, methods, folder, scale=scale, every=every, advance=advance, compiled=compiled
                )
            )
    meta = description(scale=scale)
    advance = progress("page", 1)
    write_report(out / "report.html", sections, title="jaxsr demo", meta=meta)
    write_metrics(out, sections, title="jaxsr demo", meta=meta)
    advance()
    advance = progress("videos", len(sections))
    names = [
        (s, task, rival)
        for s in opened
        for task, rival in (("super-resolution", "bilinear"), ("extrapolation", "taau"))
    ]
    for section, (sequence, task, rival) in zip(sections, names, strict=True):
        _write_video(out / f"{sequence.name}-{task}.mp4", section, (rival, "guided-taau"), sequence.fps / 3)
        advance()
    return sections


def _write_video(path: Path, section: Section, names: Sequence[str], fps: float) -> None:
    """Input, two methods and truth, two by two; the clip is short and plays four times."""
    tracks = {t.name: t.images for t in section.tracks}
    shown = {"input": _enlarged(section), **{n: tracks[n] for n in names}, "truth": section.truths}
    extrapolated = section.extrapolated or [False] * len(section.frames)
    captions = [
        f"frame {n}{', extrapolated' if e else ''}" for n, e in zip(section.frames, extrapolated, strict=True)
    ]
    columns = {label: [np.asarray(image) for image in images] * 4 for label, images in shown.items()}
    write_video(path, columns, fps=fps, per_row=2, captions=captions * 4)


def _enlarged(section: Section) -> list[np.ndarray]:
    """The inputs at the size of the truth by pixel repetition; the last one stays where none was rendered."""
    height = np.asarray(section.truths[0]).shape[0]
    images: list[np.ndarray] = []
    for given in section.inputs:
        if given is None:
            images.append(images[-1])
            continue
        pixels = np.asarray(given)
        factor = height // pixels.shape[0]
        images.append(pixels.repeat(factor, 0).repeat(factor, 1))
    return images
