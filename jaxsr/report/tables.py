"""Results as tables: on the terminal, as Markdown, and the cells of the page."""

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from jaxsr.metrics import METRICS
from jaxsr.report.results import SequenceResult
from jaxsr.report.scores import Scores, Summary, all_scores, groups, score_of, winners
from jaxsr.runtime.cost import Timing


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
    won = {key: winners({n.name: score_of(n, key).mean for n in table.lines}, key) for key in table.keys}
    more = _cost_columns(table, spread) if costs else {}
    columns = ["Method", *(header(k) for k in table.keys), *more]
    cells = [[n.name, *(cell(score_of(n, k), k, spread) for k in table.keys)] for n in table.lines]
    cells = [[*line, *(values[i] for values in more.values())] for i, line in enumerate(cells)]
    marks = [[False, *(n.name in won[k] for k in table.keys), *[False] * len(more)] for n in table.lines]
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
