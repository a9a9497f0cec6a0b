"""Results as a table, Markdown, JSON and CSV.

A mean runs over the finite values of the frames. Identical frames (infinite PSNR) are left out of it and
counted separately; if all frames are identical, the mean is infinite. Spread is the standard deviation over
the frames (of the population, 0 for one frame): it says how much frames differ, not how uncertain the mean
is.
Sections of one task are averaged again: each has the same weight, and the spread is over sections.

JSON has no infinity: it is written as the string "inf". None is null.
"""

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, read_json
from jaxsr.metrics import METRICS
from jaxsr.report.results import ALL, MethodResult, SequenceResult, Values
from jaxsr.runtime.cost import Cost, Timing

FORMAT = "jaxsr-metrics"


@dataclass(frozen=True)
class Summary:
    """A metric over some frames."""

    mean: float | None
    spread: float | None
    frames: int
    """Number of values in the mean."""
    identical: int
    """Number of infinite values, left out of the mean."""


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


def summary(result: MethodResult, key: str, positions: Sequence[int], region: str = ALL) -> Summary:
    """`summarise` for the metric `key` of a method at some positions; undefined if the method lacks it."""
    values = result.over(region).get(key)
    return summarise([] if values is None else [values[i] for i in positions])


def best(section: SequenceResult, key: str, positions: Sequence[int], region: str = ALL) -> set[str]:
    """Names of the methods with the best mean, as far as the shown digits tell them apart."""
    return _winners({t.name: summary(t, key, positions, region).mean for t in section.methods}, key)


def _winners(means: Mapping[str, float | None], key: str) -> set[str]:
    sign = 1 if METRICS[key].higher_is_better else -1
    shown = {n: round(sign * m, METRICS[key].digits) for n, m in means.items() if m is not None}
    return {n for n, m in shown.items() if m == max(shown.values())} if len(means) > 1 else set()


@dataclass(frozen=True)
class Line:
    """The row of one method in a table."""

    name: str
    note: str
    summaries: Mapping[str, Summary]
    timing: Timing | None
    cost: Cost | None


@dataclass(frozen=True)
class Scores:
    """A table before it is formatted: some frames and pixels of one section, or of all of one task."""

    title: str
    subset: str
    region: str
    count: str
    """The number of frames or sequences in each mean."""
    keys: Sequence[str]
    lines: Sequence[Line]

    @property
    def about(self) -> str:
        """Which frames and pixels."""
        return f"{self.subset} ({self.count})" + (f" · {self.region}" if self.region != ALL else "")


def scores(section: SequenceResult, subset: str, region: str = ALL) -> Scores:
    """The means of a section over the frames of one of its subsets and the pixels of one of its regions."""
    positions, keys = section.subsets()[subset], section.metric_keys()
    lines = [
        Line(t.name, t.note, {k: summary(t, k, positions, region) for k in keys}, t.timing, t.cost)
        for t in section.methods
    ]
    count = f"{len(positions)} frame{'s' if len(positions) != 1 else ''}"
    return Scores(section.title, subset, region, count, keys, lines)


def groups(sections: Sequence[SequenceResult]) -> dict[str, list[SequenceResult]]:
    """The sections of each task that has several."""
    tasks: dict[str, list[SequenceResult]] = {}
    for section in sections:
        if section.task:
            tasks.setdefault(section.task, []).append(section)
    return {task: same for task, same in tasks.items() if len(same) > 1}


def mean_scores(task: str, sections: Sequence[SequenceResult], subset: str, region: str = ALL) -> Scores:
    """The mean over sections of the methods that all of them have."""
    single = [scores(section, subset, region) for section in sections]
    by_name = [{line.name: line for line in one.lines} for one in single]
    lines = []
    for name in (n for n in by_name[0] if all(n in one for one in by_name)):
        same = [one[name] for one in by_name]
        means = {k: summarise([_of(line, k).mean for line in same]) for k in single[0].keys}
        timings = [line.timing for line in same if line.timing]
        costs = [line.cost for line in same if line.cost]
        timing = Timing(*np.mean([list(vars(t).values()) for t in timings], 0).tolist()) if timings else None
        cost = costs[0] if costs else None
        lines.append(Line(name, same[0].note, means, timing, cost))
    return Scores(f"mean, {task}", subset, region, f"{len(sections)} sequences", single[0].keys, lines)


def _of(line: Line, key: str) -> Summary:
    return line.summaries.get(key, summarise([]))


def all_scores(sections: Sequence[SequenceResult], brief: bool = False) -> Iterator[Scores]:
    """All tables of some sections: each section, then the means of each task.

    Args:
        brief: only the first subset of the frames (the extrapolated ones where there are any, else all), and
            regions only of what comes last.
    """
    means = groups(sections)
    for section in sections:
        for subset in list(section.subsets())[: 1 if brief else None]:
            for region in section.regions()[: 1 if brief and section.task in means else None]:
                yield scores(section, subset, region)
    for task, same in means.items():
        subsets = [s for s in same[0].subsets() if all(s in section.subsets() for section in same)]
        for subset in subsets[: 1 if brief else None]:
            for region in same[0].regions():
                yield mean_scores(task, same, subset, region)


def number(value: float | None, digits: int) -> str:
    """A value as text: "31.42", "∞", or "–" where it is not defined."""
    if value is None:
        return "–"
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def cell(values: Summary, key: str, spread: bool = True) -> str:
    """Mean ± spread, and the number of identical frames left out (only a star if without spread)."""
    digits = METRICS[key].digits
    text = number(values.mean, digits)
    if values.spread is not None and values.frames > 1 and spread:
        text += f" ± {number(values.spread, digits)}"
    if values.identical and values.frames:
        text += f" (+{values.identical} identical)" if spread else "*"
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
    table: Scores, spread: bool = True, costs: bool = True
) -> tuple[list[str], list[list[str]], list[list[bool]]]:
    """Column titles, the cells of each method, and which of those are the best of their column.

    Args:
        spread: of metrics and times, beside their mean.
        costs: time and size too.
    """
    winners = {key: _winners({n.name: _of(n, key).mean for n in table.lines}, key) for key in table.keys}
    more = _cost_columns(table, spread) if costs else {}
    columns = ["Method", *(header(k) for k in table.keys), *more]
    cells = [[n.name, *(cell(_of(n, k), k, spread) for k in table.keys)] for n in table.lines]
    cells = [[*line, *(values[i] for values in more.values())] for i, line in enumerate(cells)]
    marks = [[False, *(n.name in winners[k] for k in table.keys), *[False] * len(more)] for n in table.lines]
    return columns, cells, marks


def _cost_columns(table: Scores, spread: bool) -> dict[str, list[str]]:
    """Title and cells of the columns of time and, if any method has a network, of size."""
    timings, costs = [n.timing for n in table.lines], [n.cost for n in table.lines]
    columns = {}
    if any(timings):
        columns["Frame [ms]"] = [_frame_time(t, spread) if t else "–" for t in timings]
        columns["Compile [s]"] = [f"{t.compile_s:.1f}" if t else "–" for t in timings]
    if any(c is not None and c.parameters for c in costs):
        columns["Parameters"] = [f"{c.parameters:,}" if c and c.parameters else "–" for c in costs]
        columns["MAC / px"] = [f"{c.multiply_adds_per_px:,.0f}" if c and c.parameters else "–" for c in costs]
    return columns


def _frame_time(timing: Timing, spread: bool) -> str:
    return duration(timing.median_ms) + (f" ± {duration(timing.spread_ms)}" if spread else "")


def rich_tables(sections: Sequence[SequenceResult], brief: bool = False) -> list[Table]:
    """Tables of means for the terminal, best values bold and green; time and size come last.

    A star: identical frames, whose PSNR is infinite, are not in the mean.

    Args:
        brief: fewer of them, see `all_scores`.
    """
    all_tables = list(all_scores(sections, brief))
    tables = []
    for one in all_tables:
        columns, cells, marks = rows(one, spread=False, costs=False)
        table = _table(f"{one.title} · {one.about}", columns)
        for line, mark in zip(cells, marks, strict=True):
            pairs = zip(line, mark, strict=True)
            table.add_row(*(f"[bold green]{escape(c)}[/]" if m else escape(c) for c, m in pairs))
        tables.append(table)
    averaged = {section.title for same in groups(sections).values() for section in same}
    last = {one.title: one for one in reversed(all_tables) if one.title not in averaged}
    for title, one in reversed(last.items()):
        costs = _cost_columns(one, spread=False)
        if costs:
            table = _table(f"{title} · cost of a frame", ["Method", *costs])
            for i, line_ in enumerate(one.lines):
                table.add_row(escape(line_.name), *(values[i] for values in costs.values()))
            tables.append(table)
    return tables


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=escape(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for i, column in enumerate(columns):
        name = escape(column.replace(" [", "\n["))
        table.add_column(name, justify="right" if i else "left", no_wrap=i > 0, min_width=0 if i else 12)
    return table


def markdown(sections: Sequence[SequenceResult]) -> str:
    """The same tables as GitHub Markdown, best values bold."""
    out = []
    for one in all_scores(sections):
        columns, cells, marks = rows(one)
        out += [f"**{one.title}** · {one.about}", ""]
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


def as_json(
    sections: Sequence[SequenceResult], *, title: str = "", meta: Mapping[str, Any] | None = None
) -> dict:
    """All numbers, without images: per frame, and summarised for each subset of frames and each region."""
    out = []
    for section in sections:
        subsets = section.subsets()
        results = []
        for result in section.methods:

            def summaries(region: str, result: MethodResult = result) -> dict[str, Any]:
                return {
                    name: {k: vars(summary(result, k, where, region)) for k in result.over(region)}
                    for name, where in subsets.items()  # noqa: B023 (called before the next turn)
                }

            results.append(
                {
                    "name": result.name,
                    "note": result.note,
                    "timing": vars(result.timing) if result.timing else None,
                    "cost": vars(result.cost) if result.cost else None,
                    "metrics": result.metrics,
                    "summary": summaries(ALL),
                    "regions": {
                        region: {"metrics": result.over(region), "summary": summaries(region)}
                        for region in result.regions
                    },
                }
            )
        out.append(
            {
                "title": section.title,
                "task": section.task,
                "frames": section.frames,
                "extrapolated": list(section.extrapolated) or [False] * len(section.frames),
                "exposure": section.exposure,
                "meta": section.meta,
                "tracks": results,
            }
        )
    means = [
        {
            "task": task,
            "sections": [s.title for s in same],
            "subset": subset,
            "region": region,
            "tracks": [
                {"name": line.name, "summary": {k: vars(v) for k, v in line.summaries.items()}}
                for line in mean_scores(task, same, subset, region).lines
            ],
        }
        for task, same in groups(sections).items()
        for subset in same[0].subsets()
        for region in same[0].regions()
    ]
    definitions = {k: m._asdict() for k, m in METRICS.items()}
    return json_value(
        {
            "format": FORMAT,
            "version": 1,
            "title": title,
            "meta": meta or {},
            "metrics": definitions,
            "sections": out,
            "means": means,
        }
    )


def as_csv(sections: Sequence[SequenceResult]) -> str:
    """One line per section, method, frame and region; a metric that is not defined is an empty field."""
    keys = [k for k in METRICS if any(k in s.metric_keys() for s in sections)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["section", "method", "frame", "extrapolated", "pixels", *keys])
    for section in sections:
        for result in section.methods:
            for i, frame in enumerate(section.frames):
                flag = int(bool(section.extrapolated and section.extrapolated[i]))
                for region in (ALL, *result.regions):
                    values = [result.over(region)[k][i] if k in result.over(region) else None for k in keys]
                    shown = ["" if v is None else repr(float(v)) for v in values]
                    writer.writerow([section.title, result.name, frame, flag, region, *shown])
    return text.getvalue()


def check_results_folder(out: Path, *others: str) -> None:
    """Refuse a folder with results of another program, before any work is done.

    Args:
        out: the folder of the results; it may not exist yet.
        others: names of the files that will be written beside the page and the metrics.

    Raises:
        JaxsrError: not a folder; or a file has the name of a result and there is no metrics.json of jaxsr.
    """
    fix = "choose another folder with --out"
    if out.exists() and not out.is_dir():
        raise JaxsrError("not a folder", where=out, fix=fix)
    names = ("metrics.json", "report.html", "metrics.csv", "metrics.md", *others)
    there = [name for name in names if (out / name).exists()]
    if there and not _is_metrics(out / "metrics.json"):
        raise JaxsrError(f"holds {there[0]}, which jaxsr did not write", where=out, fix=fix)


def _is_metrics(path: Path) -> bool:
    try:
        return path.is_file() and read_json(path, dict).get("format") == FORMAT
    except JaxsrError:
        return False


def write_metrics(
    folder: Path,
    sections: Sequence[SequenceResult],
    *,
    title: str = "",
    meta: Mapping[str, Any] | None = None,
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
