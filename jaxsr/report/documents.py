"""Results as files: metrics.json, metrics.csv and metrics.md.

JSON has no infinity: it is written as the string "inf". None is null.
"""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, read_json
from jaxsr.metrics import METRICS
from jaxsr.report.results import ALL, MethodResult, SequenceResult
from jaxsr.report.scores import groups, mean_scores, summary
from jaxsr.report.tables import markdown

FORMAT = "jaxsr-metrics"


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
                "exposure": section.exposures[0] if len(set(section.exposures)) == 1 else section.exposures,
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
