"""Results that are kept: a method that was run and measured over a sequence is not run again.

`out/<method>/result.json` holds what was measured, and the key: all that it depends on, as hashes where that
is long. A record without results, as an interrupted run leaves it, or with another key, is made anew. The key
covers the code of a method of the user's own too (`code.py`), and the machine, whose times are in the record.

Only files that `run.json` names are ever replaced or deleted (`runtime/record.py`).
"""

import importlib.resources
import json
import math
import os
import platform
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.evaluation.code import UnknownCodeError, method_digest
from jaxsr.evaluation.running import Evaluation, Settings, run_method
from jaxsr.files import atomic_path, digest, file_digest, read_json, write_text
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.metrics import available
from jaxsr.provenance import device, machine, versions
from jaxsr.report.documents import json_value
from jaxsr.report.results import MethodResult
from jaxsr.runtime.cost import Cost, Timing
from jaxsr.runtime.load import LoadedMethod
from jaxsr.runtime.record import check_folder, claim_folder, describe_run, frame_path, read_run

RECORD = "result.json"
FORMAT = "jaxsr-result"
KINDS = ("exr", "png", "flip")
NOT_CODE = (
    "cli.py",
    "training",
    "data",
    "inspection",
    "blender",
    "report/page.py",
    "report/tables.py",
    "report/scores.py",
)
"""Parts of the package that results do not depend on."""


def run_kept(evaluation: Evaluation, loaded: LoadedMethod, out: Path) -> MethodResult:
    """`run_method`, or its kept result of the same settings, code, files and machine.

    Warns:
        UserWarning: the code of the method cannot be told from other code; its results are not kept.

    Raises:
        JaxsrError: as `run_method`; a file result.json that jaxsr did not write.
    """
    sequence, settings = evaluation.sequence, evaluation.settings
    key = _key(evaluation, loaded)
    measured = [info.index for info in sequence.infos[settings.warmup :]]
    images = [frame_path(out, "png", index) for index in measured]
    flips = [frame_path(out, "flip", index) for index in measured]
    _check_record(out / RECORD)
    kept = _load(out / RECORD, key, images, flips) if key is not None else None
    if kept is not None:
        for _ in range(2 * len(sequence)):
            evaluation.advance()
        return kept
    name = loaded.method.name
    run = describe_run(sequence, settings.scale, settings.every, name, loaded.weights)
    claim_folder(out, run, KINDS, replace=True)
    _write(out / RECORD, key)
    result = run_method(evaluation, loaded, out)
    for file, flip in zip(flips, result.flip_maps, strict=True):
        with atomic_path(file) as temporary:
            temporary.write_bytes(flip)
    _write(out / RECORD, key, result)
    return result


def check_results(
    sequence: FrameSequence, settings: Settings, methods: Sequence[LoadedMethod], out: Path
) -> None:
    """See that all results of a sequence can be written into `out`; changes nothing.

    Raises:
        JaxsrError: a folder has files that jaxsr did not write.
    """
    names = [("truth", None), ("input", None), *((one.method.name, one.weights) for one in methods)]
    for name, weights in names:
        _check_record(out / name / RECORD)
        run = describe_run(sequence, settings.scale, settings.every, name, weights)
        check_folder(out / name, run, replace=True)


def _key(evaluation: Evaluation, loaded: LoadedMethod) -> dict[str, Any] | None:
    """All that a result depends on; None if that cannot be told."""
    sequence, settings = evaluation.sequence, evaluation.settings
    try:
        method = method_digest((loaded.method, None if loaded.weights else loaded.net))
    except UnknownCodeError as error:
        warnings.warn(
            f"results of {loaded.method.name!r} are not kept, because its code holds {error}", stacklevel=2
        )
        return None
    files = [file for name in sequence.resolutions for file in sorted((sequence.path / name).iterdir())]
    stats = [(file.parent.name, file.name, file.stat()) for file in files]
    listing = [f"{folder}/{name} {stat.st_size} {stat.st_mtime_ns}" for folder, name, stat in stats]
    package = Path(str(importlib.resources.files(jaxsr)))
    names = ((file.relative_to(package).as_posix(), file) for file in sorted(package.rglob("*.py")))
    code = [file for name, file in names if not name.startswith(NOT_CODE)]
    return {
        "jaxsr": jaxsr.__version__,
        "python": platform.python_version(),
        "packages": versions(),
        "device": device(),
        "cpu": machine(),
        "x64": bool(jax.config.read("jax_enable_x64")),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "code": digest(file.read_bytes() for file in code),
        "method": loaded.method.name,
        "method_code": method,
        "weights": None if loaded.weights is None else file_digest(loaded.weights),
        "sequence": digest([(sequence.path / "sequence.json").read_bytes(), *(s.encode() for s in listing)]),
        "frames": [info.index for info in sequence.infos],
        "settings": settings._replace(metrics=settings.metrics or available())._asdict(),
        "regions": evaluation.reference.in_regions,
        "truth": evaluation.reference.truth,
    }


def _as_json(result: MethodResult) -> dict[str, Any]:
    return {
        "name": result.name,
        "note": result.note,
        "timing": vars(result.timing) if result.timing else None,
        "cost": vars(result.cost) if result.cost else None,
        "metrics": result.metrics,
        "regions": result.regions,
    }


def _check_record(path: Path) -> None:
    """See that a file result.json is jaxsr's, or a damaged one beside frames of jaxsr.

    Raises:
        JaxsrError: it is of another program.
    """
    if not path.exists():
        return
    try:
        ours = read_json(path, dict).get("format") == FORMAT
    except JaxsrError:
        ours = path.is_file() and read_run(path.parent) is not None
    if not ours:
        raise JaxsrError("not a result of jaxsr", where=path, fix="choose another folder with --out")


def _load(record: Path, key: Mapping[str, Any], images: list[Path], flips: list[Path]) -> MethodResult | None:
    """The result of a record, if it is finished, has this key, and its pictures are there."""
    try:
        read = read_json(record, dict)
        if read["key"] != json.loads(json.dumps(json_value(key))) or not all(p.is_file() for p in images):
            return None
        result = read["result"]
        return MethodResult(
            result["name"],
            images,
            _numbers(result["metrics"]),
            Timing(**result["timing"]) if result["timing"] else None,
            result["note"],
            [file.read_bytes() for file in flips],
            {region: _numbers(values) for region, values in result["regions"].items()},
            Cost(**result["cost"]) if result["cost"] else None,
        )
    except (OSError, ValueError, KeyError, TypeError):  # not there, unfinished or damaged
        return None


def _numbers(metrics: Mapping[str, list[Any]]) -> dict[str, list[float | None]]:
    return {key: [math.inf if v == "inf" else v for v in values] for key, values in metrics.items()}


def _write(path: Path, key: Mapping[str, Any] | None, result: MethodResult | None = None) -> None:
    record = {"format": FORMAT, "key": key, "result": None if result is None else _as_json(result)}
    write_text(path, json.dumps(json_value(record), indent=1) + "\n")
