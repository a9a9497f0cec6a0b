"""What a training is: one frozen dataclass, checked, and kept as `config.json` beside the result.

Options of the network and its loss are not here: they are those of the method (`jaxsr.methods.LEARNED`).
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence as List
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path
from jaxsr.io.sequence import Sequence
from jaxsr.methods import Method
from jaxsr.provenance import changes, provenance


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training that do not depend on the method."""

    data: tuple[Path, ...] = ()
    """Sequences, or folders of sequences, to train on; by default the training frames of the sample."""
    eval_data: tuple[Path, ...] = ()
    """Sequences to evaluate on; by default the last frame of each training sequence, held back."""
    out: Path = Path("jaxsr-train")
    """Folder for checkpoints, weights, pictures and logs. A folder that holds a training goes on with it."""
    cache: Path | None = None
    """Folder for converted sequences; ~/.cache/jaxsr by default."""
    scale: int = 4
    """HR size over LR size."""
    steps: int = 500
    """Updates of the weights."""
    batch: int = 8
    """Crops in a step, over all devices."""
    crop: int = 96
    """Side of the square crops, in HR pixels."""
    learning_rate: float = 1e-3
    """Of Adam, at the start."""
    schedule: Literal["exponential", "cosine", "constant"] = "exponential"
    """exponential: the paper's factor 0.98 an epoch for 100 epochs, stretched over all steps."""
    clip_norm: float = 0.0
    """Largest norm of the gradient of all weights together; 0 does not clip."""
    ema: float = 0.0
    """Decay of the averaged weights that are evaluated and released, such as 0.999; 0 keeps none."""
    flips: bool = True
    """Mirror every second crop left to right."""
    seed: int = 0
    """Of the first weights, the order of the data, the crops and the flips."""
    eval_every: int = 50
    """Steps between evaluations, with pictures and weights; the last step always has one."""
    save_every: int = 50
    """Steps between checkpoints; the last step always has one."""
    init: Path | None = None
    """Weights to start from (.safetensors)."""

    def check(self) -> None:
        """Raise JaxsrError, which names the option, if a value is out of range."""
        for name, low in (("scale", 1), ("steps", 1), ("batch", 1), ("crop", 1), ("seed", 0)):
            _check(name, getattr(self, name) >= low, f"a whole number from {low}", getattr(self, name))
        for name in ("eval_every", "save_every"):
            _check(name, getattr(self, name) >= 1, "a whole number from 1", getattr(self, name))
        rate, clip, ema = self.learning_rate, self.clip_norm, self.ema
        _check("learning_rate", math.isfinite(rate) and rate > 0, "a number above 0", rate)
        _check("clip_norm", math.isfinite(clip) and clip >= 0, "0, or a number above it", clip)
        _check("ema", 0 <= ema < 1, "a number from 0, below 1", ema)
        _check("schedule", self.schedule in SCHEDULES, " | ".join(SCHEDULES), self.schedule)
        _check("crop", self.crop % self.scale == 0, f"a multiple of the scale {self.scale}", self.crop)


SCHEDULES = ("exponential", "cosine", "constant")
MAY_CHANGE = frozenset({"out", "cache", "data", "eval_data", "eval_every", "save_every", "init"})
"""What a training can be resumed with another value of: nothing that the weights depend on.

Of the data, the sequences count (`identity`), and of the weights that it began with their numbers, wherever
these files lie. `steps` is not among them, for the schedule ends there."""
MISSING = "missing"
"""In place of the hash of `init`, where the file is no longer there."""


def _check(name: str, good: bool, expected: str, found: object) -> None:
    if not good:
        raise JaxsrError(f"bad {name}", where=f"--{name.replace('_', '-')}", expected=expected, found=found)


def describe(
    method: Method, config: TrainConfig, trained_on: List[Path], evaluated_on: List[Path]
) -> dict[str, Any]:
    """All that `config.json` records, as JSON types."""
    assert method.network is not None
    return {
        "method": method.name,
        "settings": dict(method.network.settings),
        "loss": dict(method.network.loss_settings),
        "config": json.loads(json.dumps(dataclasses.asdict(config), default=str)),
        "sequences": [identity(path) for path in trained_on],
        "evaluated": [identity(path) for path in evaluated_on],
        "init": _hash_of(config.init),
        "made": provenance(),
    }


def identity(path: Path) -> str:
    """Name of a sequence, and a hash of its description: it may move, but not change."""
    digest = hashlib.sha256((path / "sequence.json").read_bytes()).hexdigest()
    return f"{Sequence.open(path).name} {digest[:12]}"


def _hash_of(file: Path | None) -> str | None:
    if file is None:
        return None
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12] if file.is_file() else MISSING


def enter(out: Path, new: dict[str, Any]) -> list[str]:
    """Begin or resume the training of this description in the folder `out`.

    Returns:
        What is different from when it began, and does not forbid to go on: other versions, another device.

    Raises:
        JaxsrError: the folder holds another training (the differences are named), or other files.
    """
    file = out / "config.json"
    if out.is_dir() and not file.is_file():
        stray = next((p.name for p in sorted(out.iterdir()) if not p.name.startswith(".")), None)
        if stray is not None:
            raise JaxsrError(
                "the folder is not empty and holds no training",
                where=out,
                found=stray,
                fix="choose another --out",
            )
    if file.is_file():
        try:
            old = json.loads(file.read_text(encoding="utf-8"))
            found = differences(old, new)
            made = old["made"]
        except (ValueError, KeyError, TypeError, AttributeError) as e:
            raise JaxsrError(
                "not the description of a training", where=file, found=e, fix="choose another --out"
            ) from e
        if found:
            raise JaxsrError(
                "the folder holds a training with another configuration",
                where=out,
                found=", ".join(found),
                fix="choose another --out (with --init, to start from these weights), or give the old values",
            )
        changed = changes(made, new["made"])
        return [f"not to the bit as if it had never stopped: {', '.join(changed)}"] if changed else []
    with atomic_path(file) as temporary:
        temporary.write_text(json.dumps(new, indent=1) + "\n", encoding="utf-8")
    return []


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """ "field: old -> new" for all that may not differ when a training is resumed."""

    def flat(record: dict[str, Any]) -> dict[str, Any]:
        kept = {k: v for k, v in record["config"].items() if k not in MAY_CHANGE}
        data = {k: record[k] for k in ("method", "sequences", "evaluated")} | {"init": record.get("init")}
        return data | kept | record["settings"] | record["loss"]

    a, b = flat(old), flat(new)
    if b["init"] == MISSING and a["init"] is not None:  # it has served
        b["init"] = a["init"]
    return [
        f"{name}: {_short(a.get(name))} -> {_short(b.get(name))}"
        for name in dict.fromkeys([*a, *b])
        if a.get(name) != b.get(name)
    ]


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 120 else text[:117] + "..."
