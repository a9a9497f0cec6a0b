"""Methods over a sequence on disk: frames out as EXR and PNG, and a `Section` of results.

No method is given the truth; it is read to measure what they made.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.run import check_needs, find_method, observed, rendered_schedule, stream
from jaxsr.evaluation.tables import Section, Timing, measured
from jaxsr.io.exr import write_exr
from jaxsr.io.images import write_png
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.methods import Method
from jaxsr.ops import to_display

Advance = Callable[[], Any]
"""Called once for every frame that is done."""


def display(color_linear: np.ndarray, exposure: float) -> np.ndarray:
    """The display-referred image of jaxsr: sRGB of the ACES tone map, float32 in [0, 1]."""
    return np.asarray(to_display(np.ascontiguousarray(color_linear), exposure))


def upscale(
    sequence: FrameSequence,
    method: Method,
    out: Path,
    *,
    scale: int,
    every: int = 1,
    advance: Advance | None = None,
    keep: bool = True,
) -> tuple[list[np.ndarray], Timing]:
    """Run one method over a sequence and write `out/exr/0001.exr` (linear half) and `out/png/0001.png`.

    Args:
        scale: of the LR frames to start from; 1 takes the HR frames, to make only those between them.
        every: every n-th frame counts as rendered, the others are extrapolated from their G-buffer.
        advance: progress callback.
        keep: return the images; without them memory does not grow with the clip.

    Returns:
        The display-referred images (none unless `keep`), and the time of a frame.

    Raises:
        JaxsrError: what the method needs is not there, a frame cannot be read (those before it stay), or the
            folder holds frames of something else.
    """
    check_needs(method, sequence, scale)
    _check_folder(out, {info.index for info in sequence.infos})
    images, seconds, compile_seconds = [], [], 0.0
    for info, made in zip(sequence.infos, stream(method, observed(sequence, scale, every)), strict=True):
        half = np.clip(made.image, 0, np.finfo(np.float16).max).astype(np.float16)
        channels = {f"color.{c}": half[..., k] for k, c in enumerate("RGB")}
        write_exr(out / "exr" / f"{info.index:04d}.exr", channels)
        image = display(made.image, sequence.exposure)
        write_png(out / "png" / f"{info.index:04d}.png", image)
        if keep:
            images.append(image)
        seconds.append(made.seconds)
        compile_seconds += made.compile_seconds
        if advance is not None:
            advance()
    low, middle, high = np.percentile(seconds, [25, 50, 75]) * 1e3
    return images, Timing(compile_seconds, float(middle), float(high - low))


def _check_folder(out: Path, frames: set[int]) -> None:
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


def run_section(
    sequence: FrameSequence,
    methods: Sequence[str],
    out: Path,
    *,
    scale: int,
    every: int = 1,
    advance: Advance | None = None,
    compiled: dict[Any, float] | None = None,
) -> Section:
    """Several methods over one sequence, each measured against the truth.

    Writes `out/<method>/exr|png/` and `out/truth/png/`.

    Args:
        advance: called twice a frame and method: when it is made, and when it is measured.
        compiled: seconds that compiling took in earlier sections, where it was not needed again; added to.

    Raises:
        JaxsrError: an unknown method, a missing buffer, or a sequence without truth.
    """
    found = [find_method(name) for name in methods]
    truths = [display(sequence.truth(i), sequence.exposure) for i in range(len(sequence))]
    for info, truth in zip(sequence.infos, truths, strict=True):
        write_png(out / "truth" / "png" / f"{info.index:04d}.png", truth)
    schedule = rendered_schedule(sequence, every)
    inputs = [
        display(np.asarray(sequence.frame(i, scale).color_linear), sequence.exposure) if rendered else None
        for i, rendered in enumerate(schedule)
    ]
    starts = [info.cut for info in sequence.infos]
    tracks = []
    for method in found:
        images, timing = upscale(
            sequence, method, out / method.name, scale=scale, every=every, advance=advance
        )
        if images[0].shape != truths[0].shape:
            raise JaxsrError(
                "output and truth differ in size",
                where=sequence.path,
                expected=truths[0].shape,
                found=images[0].shape,
            )
        if compiled is not None:
            key = (method.name, scale, sequence.size)
            compiled[key] = max(timing.compile_s, compiled.get(key, 0.0))
            timing = replace(timing, compile_s=compiled[key])
        tracks.append(
            measured(method.name, images, truths, starts=starts, timing=timing, note=method.summary)
        )
        for _ in images:
            if advance is not None:
                advance()
    task = f"x{scale}" if scale > 1 else "full size"
    if every == 2:
        task += ", every second frame extrapolated"
    elif every > 2:
        task += f", {every - 1} of {every} frames extrapolated"
    elif scale > 1:
        task += ", super-resolution"
    return Section(
        title=f"{sequence.name}, {task}",
        frames=[info.index for info in sequence.infos],
        truths=truths,
        tracks=tracks,
        inputs=inputs,
        extrapolated=[not rendered for rendered in schedule] if every > 1 else (),
        exposure=sequence.exposure,
        meta={"scale": scale, "every": every, "sequence": sequence.name},
    )
