"""Results as small values, and as a table, Markdown, JSON and CSV.

A `Section` is one sequence and task, a `Track` one method's frames in it. Images are display-referred, in
[0, 1], `[H, W, 3]`, or the path of a PNG that holds them. Metrics are lists with one value a frame, named as
in `jaxsr.metrics.METRICS`; None where a value is not defined and `inf` for the PSNR of identical images.

A mean runs over the finite values of the frames. Identical frames (infinite PSNR) are left out of it and
counted beside it; were they all identical, the mean is infinite. Spread is the standard deviation over the
frames (of the population, 0 for one frame): how much frames differ, not an uncertainty of the mean.

JSON has no infinity: it is written as the string "inf". None is null.
"""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.embedding import ImageOrPath, flip_jpeg
from jaxsr.io.exr import atomic_path
from jaxsr.metrics import METRICS, flip_map, measure

Values: TypeAlias = Sequence[float | None]


@dataclass(frozen=True)
class Timing:
    """Time of one frame. Compilation happens once and is never part of the median."""

    compile_s: float
    """Seconds of compilation alone, before the first call."""
    median_ms: float
    """Median time of one frame in milliseconds."""
    spread_ms: float
    """Interquartile range of the time of one frame in milliseconds."""


@dataclass(frozen=True)
class Track:
    """One method on one sequence and task."""

    name: str
    images: Sequence[ImageOrPath]
    metrics: Mapping[str, Values]
    timing: Timing | None = None
    note: str = ""
    flip_maps: Sequence[bytes] = ()
    """FLIP error maps for the page as grey JPEG (`flip_jpeg`), one a frame; empty if they are not wanted."""


@dataclass(frozen=True)
class Section:
    """One sequence and task, for instance "bunker, x4, every second frame extrapolated"."""

    title: str
    frames: Sequence[int]
    """Numbers of the frames, as files and people name them."""
    truths: Sequence[ImageOrPath]
    tracks: Sequence[Track]
    inputs: Sequence[ImageOrPath | None] = ()
    """What the methods were given, at its own size; None for a frame that was not rendered."""
    extrapolated: Sequence[bool] = ()
    """True for frames that no method saw rendered; empty if there are none."""
    exposure: float = 1.0
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.frames)
        if n == 0:
            raise JaxsrError("no frames", where=self.title)
        if not self.tracks:
            raise JaxsrError("no tracks", where=self.title)
        names = [t.name for t in self.tracks]
        if len(set(names)) != len(names):
            raise JaxsrError("two tracks have the same name", where=self.title, found=names)
        counts = {"truths": len(self.truths)}
        counts |= {"inputs": len(self.inputs)} if self.inputs else {}
        counts |= {"extrapolated": len(self.extrapolated)} if self.extrapolated else {}
        for track in self.tracks:
            counts[f"images of {track.name}"] = len(track.images)
            counts |= {f"{key} of {track.name}": len(v) for key, v in track.metrics.items()}
            counts |= {f"FLIP maps of {track.name}": len(track.flip_maps)} if track.flip_maps else {}
            for key in track.metrics:
                if key not in METRICS:
                    raise JaxsrError(
                        f"unknown metric '{key}'",
                        where=f"{self.title}, {track.name}",
                        expected=sorted(METRICS),
                    )
        for what, count in counts.items():
            if count != n:
                raise JaxsrError(
                    f"{what}: wrong number", where=self.title, expected=f"{n} (frames)", found=count
                )

    def metric_keys(self) -> list[str]:
        """Keys of the metrics that any track has, in the order of `METRICS`."""
        return [key for key in METRICS if any(key in track.metrics for track in self.tracks)]

    def subsets(self) -> dict[str, list[int]]:
        """Positions of the frames to average over: "all", and "extrapolated" and "rendered" if both exist."""
        everything = list(range(len(self.frames)))
        if not any(self.extrapolated) or all(self.extrapolated):
            return {"all": everything}
        return {
            "extrapolated": [i for i in everything if self.extrapolated[i]],
            "rendered": [i for i in everything if not self.extrapolated[i]],
            "all": everything,
        }


@dataclass(frozen=True)
class Summary:
    """A metric over some frames."""

    mean: float | None
    spread: float | None
    frames: int
    """Number of values in the mean."""
    identical: int
    """Number of infinite values, left out of the mean."""


def measured(
    name: str,
    images: Sequence[np.ndarray],
    truths: Sequence[np.ndarray],
    *,
    starts: Sequence[bool] | None = None,
    timing: Timing | None = None,
    note: str = "",
    flip_maps: bool = True,
) -> Track:
    """A track with every metric of `jaxsr.metrics.measure`, and the FLIP maps for the page if wanted.

    Args:
        images, truths: display-referred float images [H, W, 3], one pair a frame.
        starts: True where a frame does not follow the one before it.
    """
    if len(images) != len(truths):
        raise JaxsrError("unequal number of frames", where=name, expected=len(truths), found=len(images))
    with ThreadPoolExecutor() as pool:  # FLIP is most of the time, and runs outside the interpreter's lock
        maps = list(pool.map(flip_map, images, truths))
        small = list(pool.map(flip_jpeg, maps)) if flip_maps else ()
    found = measure(images, truths, starts=starts, flip_maps=maps)
    return Track(name, images, found, timing, note, small)


def summarise(values: Values) -> Summary:
    """Mean and standard deviation of the finite values; None if no value is defined."""
    defined = [v for v in values if v is not None]
    if any(math.isnan(v) for v in defined):
        raise JaxsrError("a metric is NaN", expected="a number, inf, or None where it is not defined")
    finite = [v for v in defined if math.isfinite(v)]
    identical = len(defined) - len(finite)
    if not finite:
        return Summary(math.inf if identical else None, None, 0, identical)
    mean = math.fsum(finite) / len(finite)
    spread = math.sqrt(math.fsum((v - mean) ** 2 for v in finite) / len(finite))
    return Summary(mean, spread, len(finite), identical)


def summary(track: Track, key: str, positions: Sequence[int]) -> Summary:
    """`summarise` of metric `key` of a track at some positions; nothing defined if the track lacks it."""
    values = track.metrics.get(key)
    return summarise([] if values is None else [values[i] for i in positions])


def best(section: Section, key: str, positions: Sequence[int]) -> set[str]:
    """Names of the tracks with the best mean, as far as the shown digits tell them apart."""
    sign = 1 if METRICS[key].higher_is_better else -1
    means = {t.name: summary(t, key, positions).mean for t in section.tracks}
    shown = {n: round(sign * m, METRICS[key].digits) for n, m in means.items() if m is not None}
    return {n for n, m in shown.items() if m == max(shown.values())} if len(means) > 1 else set()


def number(value: float | None, digits: int) -> str:
    """A value as people read it: "31.42", "∞", or "–" where it is not defined."""
    if value is None:
        return "–"
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def cell(found: Summary, key: str, spread: bool = True) -> str:
    """Mean ± spread, and the identical frames that are not in it (a star if without spread)."""
    digits = METRICS[key].digits
    text = number(found.mean, digits)
    if found.spread is not None and found.frames > 1 and spread:
        text += f" ± {number(found.spread, digits)}"
    if found.identical and found.frames:
        text += f" (+{found.identical} identical)" if spread else "*"
    return text


def header(key: str) -> str:
    """Column title: label, unit, and an arrow towards better."""
    metric = METRICS[key]
    arrow = "↑" if metric.higher_is_better else "↓"
    return f"{metric.label} {arrow}" + (f" [{metric.unit}]" if metric.unit else "")


def duration(ms: float) -> str:
    """Milliseconds with three significant digits, without exponent."""
    digits = 0 if ms >= 100 else 1 if ms >= 10 else 2
    return f"{ms:.{digits}f}"


def rows(
    section: Section, subset: str, spread: bool = True
) -> tuple[list[str], list[list[str]], list[list[bool]]]:
    """Column titles, the cells of each track, and which of those are the best of their column."""
    positions = section.subsets()[subset]
    keys = section.metric_keys()
    winners = {key: best(section, key, positions) for key in keys}
    timed = any(t.timing for t in section.tracks)
    columns = ["Method", *(header(k) for k in keys), *(["Frame [ms]", "Compile [s]"] if timed else [])]
    cells, marks = [], []
    for track in section.tracks:
        line = [track.name, *(cell(summary(track, k, positions), k, spread) for k in keys)]
        mark = [False, *(track.name in winners[k] for k in keys)]
        if timed:
            t = track.timing
            line += [duration(t.median_ms) + (f" ± {duration(t.spread_ms)}" if spread else "") if t else "–"]
            line += [f"{t.compile_s:.1f}" if t else "–"]
            mark += [False, False]
        cells.append(line)
        marks.append(mark)
    return columns, cells, marks


def rich_tables(sections: Sequence[Section], brief: bool = False) -> list[Table]:
    """One table of means a section and subset for the terminal, best values bold and green.

    A star: identical frames, whose PSNR is infinite, are not in the mean.

    Args:
        brief: only the first subset of each section: the extrapolated frames where there are any, else all.
    """
    tables = []
    for section in sections:
        for subset, positions in list(section.subsets().items())[: 1 if brief else None]:
            columns, cells, marks = rows(section, subset, spread=False)
            title = f"{escape(section.title)} · {subset} ({len(positions)} frames)"
            table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD)
            for i, column in enumerate(columns):
                title = escape(column.replace(" [", "\n["))
                table.add_column(
                    title, justify="right" if i else "left", no_wrap=i > 0, min_width=0 if i else 12
                )
            for line, mark in zip(cells, marks, strict=True):
                pairs = zip(line, mark, strict=True)
                table.add_row(*(f"[bold green]{escape(c)}[/]" if m else escape(c) for c, m in pairs))
            tables.append(table)
    return tables


def markdown(sections: Sequence[Section]) -> str:
    """The same tables as GitHub Markdown, best values bold."""
    out = []
    for section in sections:
        for subset, positions in section.subsets().items():
            columns, cells, marks = rows(section, subset)
            out += [f"**{section.title}** · {subset} ({len(positions)} frames)", ""]
            out += ["| " + " | ".join(columns) + " |", "|---" + "|---:" * (len(columns) - 1) + "|"]
            for line, mark in zip(cells, marks, strict=True):
                safe = [c.replace("|", r"\|") for c in line]
                out.append(
                    "| " + " | ".join(f"**{c}**" if m else c for c, m in zip(safe, mark, strict=True)) + " |"
                )
            out.append("")
    return "\n".join(out)


def json_value(value: Any) -> Any:
    """A value that strict JSON can hold: infinity as "inf", NumPy scalars as numbers, paths as text."""
    if isinstance(value, Mapping):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float | np.floating):
        if math.isnan(value):
            raise JaxsrError("a metric is NaN", expected="a number, inf, or None where it is not defined")
        return ("inf" if value > 0 else "-inf") if math.isinf(value) else float(value)
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, Sequence | np.ndarray):
        return [json_value(v) for v in value]
    return str(value)


def as_json(sections: Sequence[Section], *, title: str = "", meta: Mapping[str, Any] | None = None) -> dict:
    """All numbers, without images: per frame, and summarised for each subset of frames."""
    out = []
    for section in sections:
        subsets = section.subsets()
        tracks = []
        for track in section.tracks:
            summaries = {
                name: {k: vars(summary(track, k, where)) for k in track.metrics}
                for name, where in subsets.items()
            }
            timing = vars(track.timing) if track.timing else None
            tracks.append(
                {
                    "name": track.name,
                    "note": track.note,
                    "timing": timing,
                    "metrics": track.metrics,
                    "summary": summaries,
                }
            )
        out.append(
            {
                "title": section.title,
                "frames": section.frames,
                "extrapolated": list(section.extrapolated) or [False] * len(section.frames),
                "exposure": section.exposure,
                "meta": section.meta,
                "tracks": tracks,
            }
        )
    definitions = {k: m._asdict() for k, m in METRICS.items()}
    return json_value(
        {
            "format": "jaxsr-metrics",
            "version": 1,
            "title": title,
            "meta": meta or {},
            "metrics": definitions,
            "sections": out,
        }
    )


def as_csv(sections: Sequence[Section]) -> str:
    """One line a section, method and frame; a metric that is not defined is an empty field."""
    keys = [k for k in METRICS if any(k in s.metric_keys() for s in sections)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["section", "method", "frame", "extrapolated", *keys])
    for section in sections:
        for track in section.tracks:
            for i, frame in enumerate(section.frames):
                flag = int(bool(section.extrapolated and section.extrapolated[i]))
                values = [track.metrics[k][i] if k in track.metrics else None for k in keys]
                shown = ["" if v is None else repr(float(v)) for v in values]
                writer.writerow([section.title, track.name, frame, flag, *shown])
    return text.getvalue()


def write_metrics(
    folder: Path, sections: Sequence[Section], *, title: str = "", meta: Mapping[str, Any] | None = None
) -> None:
    """Write metrics.json, metrics.csv and metrics.md into a folder."""
    texts = {
        "metrics.json": json.dumps(as_json(sections, title=title, meta=meta), indent=1) + "\n",
        "metrics.csv": as_csv(sections),
        "metrics.md": markdown(sections),
    }
    for name, text in texts.items():
        with atomic_path(Path(folder) / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
