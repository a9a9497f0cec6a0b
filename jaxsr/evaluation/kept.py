"""Results that are kept: a method that was run and measured over a sequence is not run again.

`out/<method>/result.json` holds what was measured, and the key: all that it depends on, as hashes where that
is long. A record without results, as an interrupted run leaves it, or with another key, is made anew.
"""

import importlib.resources
import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jaxsr
from jaxsr.evaluation.measuring import Reference
from jaxsr.evaluation.running import Settings, check_folder, png_file, run_method
from jaxsr.files import atomic_path, digest
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.metrics import available
from jaxsr.progress import Advance
from jaxsr.provenance import device, versions
from jaxsr.report.results import MethodResult, Timing
from jaxsr.report.tables import json_value
from jaxsr.runtime.cost import Cost
from jaxsr.runtime.load import LoadedMethod

RECORD = "result.json"
FOLDERS = ("exr", "png", "flip")
NOT_CODE = ("cli.py", "training", "data", "report/page.py", "report/tables.py")
"""Of the package, what results do not depend on; who edits a method wants new ones."""


def run_kept(
    sequence: FrameSequence,
    ready: LoadedMethod,
    out: Path,
    settings: Settings,
    reference: Reference,
    advance: Advance = lambda: None,
) -> MethodResult:
    """`run_method`, or what it gave when it was last run with the same settings on the same files."""
    key = _key(sequence, ready, settings, reference)
    measured = sequence.infos[settings.warmup :]
    images = [png_file(out, info.index) for info in measured]
    flips = [out / "flip" / f"{info.index:04d}.jpg" for info in measured]
    track = _load(out / RECORD, key, images, flips)
    if track is not None:
        for _ in range(2 * len(sequence)):
            advance()
        return track
    if (out / RECORD).is_file():  # ours, hence also what lies beside it
        for name in FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
    check_folder(out, {info.index for info in sequence.infos})
    _write(out / RECORD, {"key": key})
    track = run_method(sequence, ready, out, settings, reference, advance)
    for file, flip in zip(flips, track.flip_maps, strict=True):
        with atomic_path(file) as temporary:
            temporary.write_bytes(flip)
    _write(out / RECORD, {"key": key, "track": _as_json(track)})
    return track


def _key(
    sequence: FrameSequence, ready: LoadedMethod, settings: Settings, reference: Reference
) -> dict[str, Any]:
    files = [file for name in sequence.resolutions for file in sorted((sequence.path / name).iterdir())]
    stats = [(file.parent.name, file.name, file.stat()) for file in files]
    listing = [f"{folder}/{name} {stat.st_size} {stat.st_mtime_ns}" for folder, name, stat in stats]
    package = Path(str(importlib.resources.files(jaxsr)))
    names = ((file.relative_to(package).as_posix(), file) for file in sorted(package.rglob("*.py")))
    code = [file for name, file in names if not name.startswith(NOT_CODE)]
    return {
        "jaxsr": jaxsr.__version__,
        "packages": versions(),
        "device": device(),
        "code": digest(file.read_bytes() for file in code),
        "method": ready.method.name,
        "weights": None if ready.weights is None else digest([ready.weights.read_bytes()]),
        "sequence": digest([(sequence.path / "sequence.json").read_bytes(), *(s.encode() for s in listing)]),
        "frames": [info.index for info in sequence.infos],
        "settings": settings._replace(metrics=settings.metrics or available())._asdict(),
        "regions": reference.in_regions,
    }


def _as_json(track: MethodResult) -> dict[str, Any]:
    return {
        "name": track.name,
        "note": track.note,
        "timing": vars(track.timing) if track.timing else None,
        "cost": vars(track.cost) if track.cost else None,
        "metrics": track.metrics,
        "regions": track.regions,
    }


def _load(record: Path, key: Mapping[str, Any], images: list[Path], flips: list[Path]) -> MethodResult | None:
    """The track of a record, if it is finished, has this key, and its pictures are there."""
    try:
        found = json.loads(record.read_text(encoding="utf-8"))
        if found["key"] != json.loads(json.dumps(json_value(key))) or not all(p.is_file() for p in images):
            return None
        track = found["track"]
        return MethodResult(
            track["name"],
            images,
            _numbers(track["metrics"]),
            Timing(**track["timing"]) if track["timing"] else None,
            track["note"],
            [file.read_bytes() for file in flips],
            {region: _numbers(values) for region, values in track["regions"].items()},
            Cost(**track["cost"]) if track["cost"] else None,
        )
    except (OSError, ValueError, KeyError, TypeError):  # not there, unfinished or damaged
        return None


def _numbers(metrics: Mapping[str, list[Any]]) -> dict[str, list[float | None]]:
    return {key: [math.inf if v == "inf" else v for v in values] for key, values in metrics.items()}


def _write(path: Path, value: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(json_value(value), indent=1) + "\n", encoding="utf-8")
