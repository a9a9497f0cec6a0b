"""`run.json`: what made the frames in a folder, so that frames of two runs never mix.

    {"format": "jaxsr-run", "version": 1, "method": "taau", "weights": null, "scale": 2, "every": 1,
     "frames": [1, 2, 3], "sequence": {"name": "bunker", "digest": "..."}, "kinds": ["exr", "png"],
     "made": {...}}

`weights` and `digest` are SHA-256. `kinds` names the folders beside run.json that hold one file per frame:
`exr/0001.exr`, `png/0001.png`, `flip/0001.jpg`. These files, and no others, may be replaced or deleted later.
`made` is where and with which versions it was made; it does not tell two runs apart.
"""

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsr.errors import JaxsrError
from jaxsr.files import digest, file_digest, read_json, write_text
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.provenance import provenance

RECORD = "run.json"
FORMAT, VERSION = "jaxsr-run", 1
SUFFIXES = {"exr": ".exr", "png": ".png", "flip": ".jpg"}
"""The suffix of the files of each kind."""
_IDENTITY = ("method", "weights", "scale", "every", "frames", "sequence")
_FIX = "choose another folder with --out"


def frame_path(out: Path, kind: str, index: int) -> Path:
    """Where a file of a frame lies: `out/exr/0001.exr`."""
    return out / kind / f"{index:04d}{SUFFIXES[kind]}"


def describe_run(
    sequence: FrameSequence, scale: int, every: int, method: str, weights: Path | None = None
) -> dict[str, Any]:
    """What tells a run of a method over a sequence from another run, as JSON types.

    Args:
        method: its name.
        weights: the file of its weights, if it has one.
    """
    return {
        "method": method,
        "weights": None if weights is None else file_digest(weights),
        "scale": scale,
        "every": every,
        "frames": [info.index for info in sequence.infos],
        "sequence": {
            "name": sequence.name,
            "digest": digest([(sequence.path / "sequence.json").read_bytes()]),
        },
    }


def claim_folder(
    out: Path, run: Mapping[str, Any], kinds: Sequence[str] = ("exr", "png"), *, replace: bool = False
) -> None:
    """See that a run may write its frames into a folder, before any work is done, and write `run.json`.

    Args:
        out: the folder; made if it is not there.
        run: what tells this run from others (`describe_run`).
        kinds: of the files that this run writes, see `SUFFIXES`.
        replace: delete the frames of another run that `run.json` names, instead of refusing.

    Raises:
        JaxsrError: frames of another run, files that jaxsr did not write here, or a path that is no folder.
            Nothing is changed then.
    """
    before = check_folder(out, run, replace=replace)
    if before is not None and _difference(before, run):
        for file in _files(out, before):
            file.unlink(missing_ok=True)
        before = None
    kinds = sorted({*kinds, *(before or {}).get("kinds", ())})
    record = {"format": FORMAT, "version": VERSION, **run, "kinds": kinds, "made": provenance()}
    write_text(out / RECORD, json.dumps(record, indent=1) + "\n")


def check_folder(out: Path, run: Mapping[str, Any], *, replace: bool = False) -> dict[str, Any] | None:
    """See that `claim_folder` would let the run write there; changes nothing.

    Returns:
        The record of the folder, if it has one.

    Raises:
        JaxsrError: as `claim_folder`.
    """
    for place in (out, *out.parents):
        if place.exists() and not place.is_dir():
            raise JaxsrError("not a folder", where=place, fix=_FIX)
    before = read_run(out)
    ours = set() if before is None else _files(out, before)
    for kind in SUFFIXES:
        if (out / kind).exists() and not (out / kind).is_dir():
            raise JaxsrError("not a folder", where=out / kind, fix=_FIX)
        for file in sorted((out / kind).glob("*")):
            if file not in ours and not file.name.startswith("."):
                raise JaxsrError(
                    f"holds {file.name}, which no {RECORD} of jaxsr names", where=out / kind, fix=_FIX
                )
    if before is not None and not replace and (difference := _difference(before, run)):
        raise JaxsrError("the folder holds frames of another run", where=out, **difference, fix=_FIX)
    return before


def read_run(out: Path) -> dict[str, Any] | None:
    """The record of a folder, or None if it has none.

    Raises:
        JaxsrError: a file run.json that is not a record of jaxsr, or of a later version.
    """
    path = out / RECORD
    if not path.exists():
        return None
    record = None
    with contextlib.suppress(JaxsrError):
        record = read_json(path, dict)
    frames, kinds = (record or {}).get("frames"), (record or {}).get("kinds")
    if (
        record is None
        or (record.get("format"), record.get("version")) != (FORMAT, VERSION)
        or not isinstance(frames, list)
        or not all(isinstance(n, int) and 0 <= n < 10**9 for n in frames)
        or not isinstance(kinds, list)
        or not all(isinstance(kind, str) and kind in SUFFIXES for kind in kinds)
    ):
        raise JaxsrError("not a record of a run of this version of jaxsr", where=path, fix=_FIX)
    return record


def _files(out: Path, record: Mapping[str, Any]) -> set[Path]:
    return {frame_path(out, kind, index) for kind in record["kinds"] for index in record["frames"]}


def _difference(before: Mapping[str, Any], run: Mapping[str, Any]) -> dict[str, str]:
    """What the error says of two runs: the fields that differ, of this run and of the one before it."""
    names = [name for name in _IDENTITY if before.get(name) != run.get(name)]
    if not names:
        return {}

    def words(record: Mapping[str, Any]) -> str:
        return ", ".join(f"{name} {_short(record.get(name))}" for name in names)

    return {"expected": words(run), "found": words(before)}


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{value.get('name')} ({str(value.get('digest'))[:8]})"
    if isinstance(value, list) and value:
        return f"{value[0]} to {value[-1]}"
    return "none" if value is None else str(value)[:40]
