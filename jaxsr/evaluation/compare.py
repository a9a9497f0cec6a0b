"""Any folders of frames against the truth: `jaxsr compare A B --truth T`.

PNG and JPEG are taken as they are, display-referred. OpenEXR is linear colour and goes through the tone map
of jaxsr; what the page shows of it is written to `out/frames/` and `out/truth/` as 8-bit PNG. A folder
may be a jaxsr sequence (its HR colour counts) or what `jaxsr upscale` wrote (its `exr/` or `png/`).

Frames are matched by the last number in the file name where all names of a folder have one, else by sorted
name. Memory does not grow with the number of frames, apart from the small FLIP maps of the page.
All files are made in a temporary folder beside `out` and moved at the end: an error leaves `out` as it was.
"""

import contextlib
import dataclasses
import math
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.measuring import Meter, Truth
from jaxsr.io.images import read_color, read_png, write_png
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.io.truth import Truth as TruthLayer
from jaxsr.io.truth import choose_truth
from jaxsr.ops.color import to_display
from jaxsr.progress import Advance, Progress, silent
from jaxsr.report.documents import check_results_folder, write_metrics
from jaxsr.report.page import write_report
from jaxsr.report.results import MethodResult, SequenceResult

_PLAIN = (".png", ".jpg", ".jpeg")
_INNER = ("exr", "png")


class Frames(NamedTuple):
    """The files of a folder in order."""

    folder: Path
    files: tuple[Path, ...]
    numbers: tuple[int, ...] | None
    """The number of each file, or None if the names do not all have one of their own."""


def find_frames(folder: Path, prefer: str = "exr") -> Frames:
    """The frames of a folder: images in it, in `hr/` of a sequence, or in its `exr/` or `png/`.

    Raises:
        JaxsrError: no such folder, no images in it, or images of both kinds.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise JaxsrError("no such folder", where=folder, found="a file" if folder.exists() else None)
    inner = folder
    if (folder / "sequence.json").is_file():
        inner = folder / "hr"
    elif not _images(folder):
        there = [name for name in _INNER if (folder / name).is_dir()]
        inner = folder / (prefer if prefer in there else there[0]) if there else folder
    files = _images(inner)
    if not files:
        raise JaxsrError("no frames in the folder", where=inner, expected="files .exr, .png or .jpg")
    if len({f.suffix.lower() in _PLAIN for f in files}) > 1:
        raise JaxsrError(
            "the folder holds OpenEXR and PNG or JPEG frames",
            where=inner,
            fix="put them into folders of their own",
        )
    digits = [re.findall(r"\d+", f.stem) for f in files]
    if not all(digits) or len({int(d[-1]) for d in digits}) != len(files):
        return Frames(folder, tuple(files), None)
    ordered = sorted((int(d[-1]), f) for d, f in zip(digits, files, strict=True))
    return Frames(folder, tuple(f for _, f in ordered), tuple(n for n, _ in ordered))


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    kinds = (".exr", *_PLAIN)
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in kinds and not f.name.startswith("."))


def check_match(frames: Frames, truth: Frames) -> None:
    """See that a folder has exactly the frames of the truth.

    Raises:
        JaxsrError: it has others, with both counts and the first frame that is missing.
    """
    counts = {"expected": f"{len(truth.files)} frames", "found": f"{len(frames.files)} frames"}
    if frames.numbers is not None and truth.numbers is not None:
        missing = sorted(set(truth.numbers) - set(frames.numbers))
        extra = sorted(set(frames.numbers) - set(truth.numbers))
        if missing:
            file = truth.files[truth.numbers.index(missing[0])].name
            what = f"frame {missing[0]} is missing (truth: {file})"
            raise JaxsrError(what, where=frames.folder, **counts, fix=_renumber(frames, truth))
        if extra:
            file = frames.files[frames.numbers.index(extra[0])].name
            raise JaxsrError(f"frame {extra[0]} ({file}) has no truth", where=frames.folder, **counts)
    elif len(frames.files) != len(truth.files):
        shorter, longer = sorted((frames, truth), key=lambda f: len(f.files))
        first = longer.files[len(shorter.files)].name
        place = "truth" if shorter is truth else "folder"
        raise JaxsrError(
            f"unequal numbers of frames, the {place} has none for {first}", where=frames.folder, **counts
        )


def _renumber(frames: Frames, truth: Frames) -> str | None:
    if len(frames.files) != len(truth.files) or frames.numbers is None or truth.numbers is None:
        return None
    return (
        f"files are numbered from {frames.numbers[0]}, those of the truth from {truth.numbers[0]}: "
        "rename them if they show the same frames"
    )


def labels(folders: Sequence[Path]) -> list[str]:
    """A name for each folder: its own, with as many parents as tell it from the others.

    A last part that only says the kind of file (`exr`, `png`, `hr`) gives way to the folder above.
    """
    parts = []
    for folder in folders:
        path = Path(folder).resolve()
        parts.append((path.parent if path.name in (*_INNER, "hr") and path.parent.name else path).parts)
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-depth:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    raise JaxsrError("the same folder is given twice", found=", ".join(str(f) for f in folders))


def read_display(path: Path, exposure: float, layer: str = "color") -> np.ndarray:
    """A frame as display-referred float32 [H, W, 3] in [0, 1].

    Of an OpenEXR file `layer` is the first choice.

    Raises:
        JaxsrError: unreadable or truncated file, no colour in it, NaN or infinity.
    """
    if path.suffix.lower() != ".exr":
        return read_png(path)
    linear = read_color(path, layer=layer)
    bad = np.argwhere(~np.isfinite(linear).all(axis=-1))
    if len(bad):
        y, x = (int(v) for v in bad[0])
        raise JaxsrError(
            "the frame holds NaN or infinity",
            where=path,
            found=f"{len(bad)} pixels, the first at x={x} y={y}",
        )
    return np.asarray(to_display(linear, exposure))


def _starts(truth: Frames) -> list[bool]:
    """True where a frame does not follow the one before it: a gap in the numbers, or a reset of a sequence.

    A frame follows the one before it if its number is one more, or more by the most common step of the
    folder (the smallest of them, where several are as common).
    """
    if truth.numbers is None:
        return [i == 0 for i in range(len(truth.files))]
    steps = np.diff(truth.numbers)
    values, counts = np.unique(steps, return_counts=True)
    usual = {1, int(values[np.argmax(counts)])} if len(steps) else {1}
    starts = [True, *(int(step) not in usual for step in steps)]
    if (truth.folder / "sequence.json").is_file():
        resets = {info.index for info in FrameSequence.open(truth.folder).infos if info.reset}
        starts = [start or n in resets for start, n in zip(starts, truth.numbers, strict=True)]
    return starts


def _exposures(truth: Frames, exposure: float | None) -> list[float]:
    """The exposure of each frame: the one that is asked for, that of the true sequence, or 1."""
    count = len(truth.files)
    if exposure is not None or not (truth.folder / "sequence.json").is_file():
        return [1.0 if exposure is None else exposure] * count
    sequence = FrameSequence.open(truth.folder)
    of = {info.index: sequence.exposure_at(i) for i, info in enumerate(sequence.infos)}
    return [of.get(number, sequence.exposure) for number in truth.numbers or [-1] * count]


def compare(
    folders: Sequence[Path],
    truth: Path,
    out: Path,
    *,
    exposure: float | None = None,
    layer: TruthLayer | None = None,
    fps: float = 4.0,
    title: str = "",
    meta: Mapping[str, Any] | None = None,
    max_megabytes: float = 18.0,
    keys: Collection[str] | None = None,
    progress: Progress = silent,
) -> SequenceResult:
    """Measure folders of frames against the truth; write report.html, metrics.json, .csv and .md into `out`.

    Args:
        folders: one per method; see the module for what a folder may be.
        truth: the true frames.
        out: where the results go; made if it is not there.
        exposure: factor on linear colour before the tone map; by default that of the truth if it is a
            sequence, else 1.
        layer: of a truth that is a sequence; by default the reference if all frames have one.
        fps: speed at which the page plays at first.
        meta: shown on the page and kept with the numbers.
        max_megabytes: aim for the size of the page.
        keys: the metrics (`jaxsr.metrics.METRICS`); all there are by default.
        progress: for a progress bar.

    Returns:
        What was measured; `rich_tables([section])` prints it.

    Raises:
        JaxsrError: a number that makes no sense, a folder is missing or empty, frames do not match, sizes
            differ, a file cannot be read or written. Nothing is written then.
    """
    for what, value in (("exposure", exposure), ("fps", fps), ("max_megabytes", max_megabytes)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise JaxsrError("must be a number above 0", where=what, found=value)
    if not folders:
        raise JaxsrError("no folders to compare", fix="name at least one folder of frames")
    truth, out = Path(truth), Path(out)
    check_results_folder(out, "frames", "truth")
    true = find_frames(truth)
    kind = "png" if true.files[0].suffix.lower() in _PLAIN else "exr"
    given = [find_frames(Path(folder), prefer=kind) for folder in folders]
    names = labels([Path(folder) for folder in folders])
    for frames in given:
        check_match(frames, true)
    exposures, layer = _exposures(true, exposure), _layer(true, layer)
    starts = _starts(true)
    advance = progress("measuring", len(given) * len(true.files))
    title = title or f"{' · '.join(names)} against {truth.resolve().name}"
    with _staging(out) as folder:
        shown = _Shown(folder, exposures, layer)
        section = SequenceResult(
            title=f"{truth.resolve().name}: {', '.join(names)}" if len(names) < 4 else truth.resolve().name,
            frames=true.numbers or tuple(range(1, len(true.files) + 1)),
            truths=[shown.path("truth", file) for file in true.files],
            methods=[
                _measured(name, frames, true, starts, shown, Meter(keys), advance)
                for name, frames in zip(names, given, strict=True)
            ],
            exposures=exposures,
            meta={
                "truth": str(truth),
                "layer": layer,
                **{name: str(f) for name, f in zip(names, folders, strict=True)},
            },
        )
        write_report(
            folder / "report.html", [section], title=title, meta=meta, fps=fps, max_megabytes=max_megabytes
        )
        write_metrics(folder, [section], title=title, meta=meta)
        _move(folder, out)
    shown = shown._replace(out=out)
    return dataclasses.replace(
        section,
        truths=[shown.path("truth", file) for file in true.files],
        methods=[
            dataclasses.replace(result, images=[shown.path(f"frames/{name}", file) for file in frames.files])
            for result, name, frames in zip(section.methods, names, given, strict=True)
        ],
    )


def _layer(truth: Frames, layer: TruthLayer | None) -> TruthLayer:
    """The layer of the truth that is compared with: of a folder of plain pictures there is one only."""
    if not (truth.folder / "sequence.json").is_file():
        if layer == "reference":
            raise JaxsrError("the truth is no sequence: it has no layers", where=truth.folder)
        return "color"
    return choose_truth([FrameSequence.open(truth.folder)], layer)


@contextlib.contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """A temporary folder on the file system of `out`, gone at the end."""
    place = next(p for p in out.absolute().parents if p.is_dir())
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{out.name}.", suffix=".tmp", dir=place, ignore_cleanup_errors=True
        ) as folder:
            yield Path(folder)
    except OSError as e:
        raise JaxsrError("cannot write", where=out, found=e.strerror or e, fix="check the folder") from e


def _move(folder: Path, out: Path) -> None:
    """Move all files into `out`, over those of the same names: the pictures first, the page last."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    for path in sorted(files, key=lambda p: (p.parent == folder, p.suffix == ".html")):
        target = out / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)


class _Shown(NamedTuple):
    """Where the page finds a frame: a plain picture as it is, OpenEXR as a PNG made from it."""

    out: Path
    exposures: Sequence[float]
    """Of each frame."""
    layer: str
    """Of the truth."""

    def read(self, label: str, file: Path, position: int) -> np.ndarray:
        """The display-referred frame; the PNG of an OpenEXR frame is written on the way."""
        layer = self.layer if label == "truth" else "color"
        image = read_display(file, self.exposures[position], layer)
        path = self.path(label, file)
        if path != file:
            write_png(path, image)
        return image

    def path(self, label: str, file: Path) -> Path:
        if file.suffix.lower() in _PLAIN:
            return file
        return self.out / label / f"{file.stem}.png"


def _measured(
    name: str,
    frames: Frames,
    true: Frames,
    starts: Sequence[bool],
    shown: _Shown,
    meter: Meter,
    advance: Advance,
) -> MethodResult:
    """All metrics of a folder, two frames in memory at a time."""
    size: tuple[int, ...] | None = None
    for i, (file, true_file, start) in enumerate(zip(frames.files, true.files, starts, strict=True)):
        truth, image = shown.read("truth", true_file, i), shown.read(f"frames/{name}", file, i)
        size = size or truth.shape
        for array, path, wanted in ((truth, true_file, size), (image, file, truth.shape)):
            if array.shape != wanted:
                raise JaxsrError(
                    "wrong size",
                    where=path,
                    expected=f"{wanted[1]}x{wanted[0]}",
                    found=f"{array.shape[1]}x{array.shape[0]}",
                )
        meter.add([image], [Truth(truth, {})], [start])
        advance()
    return meter.result(name, [shown.path(f"frames/{name}", file) for file in frames.files])
