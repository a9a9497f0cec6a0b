"""`jaxsr evaluate`: methods over sequences, each against the truth; tables, the comparison page, all numbers.

Writes `out/<sequence>/<method>/` (frames, error maps, results), and into `out` report.html, metrics.json,
.csv and .md. What is finished is kept (`kept.py`): the same command continues an interrupted evaluation.
"""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.compare import labels
from jaxsr.evaluation.kept import check_results, run_kept
from jaxsr.evaluation.measuring import Reference
from jaxsr.evaluation.running import Evaluation, Settings, run_methods
from jaxsr.io.find import find_sequences
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.io.truth import Truth, choose_truth
from jaxsr.progress import Progress
from jaxsr.report.documents import check_results_folder, write_metrics
from jaxsr.report.page import write_report
from jaxsr.report.results import SequenceResult
from jaxsr.runtime.load import LoadedMethod, find_method
from jaxsr.runtime.schedule import check_needs


def find_methods(names: Sequence[str], scale: int) -> list[LoadedMethod]:
    """The methods of these names or files of weights, each with a name of its own.

    Raises:
        JaxsrError: as for `find_method`; no name; two that would be called the same.
    """
    methods: dict[str, LoadedMethod] = {}
    for name in names:
        loaded = find_method(name, scale)
        if loaded.method.name in methods:
            raise JaxsrError(
                f"two methods are called {loaded.method.name!r}",
                where="--methods",
                found=", ".join(names),
                fix="name each once; rename a file of weights",
            )
        methods[loaded.method.name] = loaded
    if not methods:
        raise JaxsrError("no methods to evaluate", where="--methods", fix="name at least one")
    return list(methods.values())


def part(sequence: FrameSequence, frames: tuple[int, int] | None) -> FrameSequence:
    """A sequence of those frames alone whose numbers are in a range, ends included; the first one is a reset.

    Raises:
        JaxsrError: there are none, or not all.
    """
    if frames is None:
        return sequence
    infos = [info for info in sequence.infos if frames[0] <= info.index <= frames[1]]
    if not infos or frames[0] < sequence.infos[0].index or frames[1] > sequence.infos[-1].index:
        raise JaxsrError(
            "the range has frames that the sequence does not have" if infos else "no frame in the range",
            where=sequence.path,
            expected=f"some of {sequence.infos[0].index}:{sequence.infos[-1].index}",
            found=f"{frames[0]}:{frames[1]}",
        )
    some = copy.copy(sequence)
    some.infos = [dataclasses.replace(infos[0], reset=True), *infos[1:]]
    return some


def _check(sequence: FrameSequence, methods: Sequence[LoadedMethod], settings: Settings) -> None:
    """See that every method can be run and measured, before any work is done."""
    settings.check(sequence)
    for loaded in methods:
        check_needs(loaded.method, sequence, settings.scale, settings.every)


def evaluate(
    places: Sequence[Path],
    methods: Sequence[str],
    out: Path,
    settings: Settings,
    *,
    frames: tuple[int, int] | None = None,
    truth: Truth | None = None,
    title: str = "jaxsr evaluation",
    meta: Mapping[str, Any] | None = None,
    progress: Progress,
) -> list[SequenceResult]:
    """Run methods over sequences, measure them, and write frames, numbers and the page into `out`.

    Args:
        places: sequences, or folders of sequences.
        methods: names, or files of weights, as for `find_method`.
        frames: numbers of the first and the last frame; all by default.
        truth: "reference" or "color"; by default the best that all frames of all sequences have.
        meta: shown on the page and kept with the numbers.
        progress: told of each frame that is made and measured.

    Returns:
        One result per sequence; `rich_tables` prints them.

    Raises:
        JaxsrError: see `find_sequences`, `find_methods`, `part`, `choose_truth`, `check_needs` and
            `run_methods`.
    """
    check_results_folder(out)
    loaded = find_methods(methods, settings.scale)
    paths = find_sequences(places)
    names = labels(paths)
    sequences = [part(FrameSequence.open(path), frames) for path in paths]
    truth = choose_truth(sequences, truth)
    for sequence in sequences:
        _check(sequence, loaded, settings)
    for name, sequence in zip(names, sequences, strict=True):
        check_results(sequence, settings, loaded, out / name)
    advance = progress("frames", 2 * len(loaded) * sum(map(len, sequences)))  # made, and measured
    compiled: dict[Any, float] = {}
    sections = [
        run_methods(
            Evaluation(sequence, settings, Reference(sequence, in_regions=True, truth=truth), advance, name),
            loaded,
            out / name,
            compiled=compiled,
            run=run_kept,
        )
        for name, sequence in zip(names, sequences, strict=True)
    ]
    advance = progress("page", 1)
    meta = {**(meta or {}), "truth": truth}
    write_metrics(out, sections, title=title, meta=meta)
    write_report(out / "report.html", sections, title=title, meta=meta)
    advance()
    return sections
