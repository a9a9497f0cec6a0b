"""Means and spreads of what was measured, per method and sequence, and over sequences.

A mean runs over the finite values of the frames. Identical frames (infinite PSNR) are left out of it and
counted separately; if all frames are identical, the mean is infinite. Spread is the standard deviation over
the frames (of the population, 0 for one frame): it says how much frames differ, not how uncertain the mean
is.
Sections of one task are averaged again: each has the same weight, and the spread is over sections.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.metrics import METRICS
from jaxsr.report.results import ALL, MethodResult, SequenceResult, Values
from jaxsr.runtime.cost import Cost, Timing


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
    return winners({t.name: summary(t, key, positions, region).mean for t in section.methods}, key)


def winners(means: Mapping[str, float | None], key: str) -> set[str]:
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
        means = {k: summarise([score_of(line, k).mean for line in same]) for k in single[0].keys}
        timings = [line.timing for line in same if line.timing]
        costs = [line.cost for line in same if line.cost]
        timing = Timing(*np.mean([list(vars(t).values()) for t in timings], 0).tolist()) if timings else None
        cost = costs[0] if costs else None
        lines.append(Line(name, same[0].note, means, timing, cost))
    return Scores(f"mean, {task}", subset, region, f"{len(sections)} sequences", single[0].keys, lines)


def score_of(line: Line, key: str) -> Summary:
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
