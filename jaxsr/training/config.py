"""What a training is: one frozen dataclass, checked, and kept as `config.json` beside the result.

Options of networks and of their losses belong to the methods (`jaxsr.methods.LEARNED`).
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence as List
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from jaxsr.data.loader import check_crop
from jaxsr.errors import JaxsrError
from jaxsr.files import read_json, write_text
from jaxsr.io.sequence import Sequence
from jaxsr.io.truth import TRUTHS
from jaxsr.methods import Method
from jaxsr.provenance import changes, provenance
from jaxsr.training.initial import hashes, same_hashes

Schedule = Literal["exponential", "cosine", "constant"]
Score = Literal["psnr", "psnr_rendered", "psnr_extrapolated", "ssim", "ssim_rendered", "ssim_extrapolated"]
"""A number of an evaluation."""


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training that do not depend on the method."""

    data: tuple[Path, ...] = ()
    """Sequences, or folders of sequences, to train on; by default the training frames of the sample."""
    eval_data: tuple[Path, ...] = ()
    """Sequences to evaluate on; by default the last frame of each training sequence, held back."""
    out: Path = Path("jaxsr-train")
    """Folder for checkpoints, weights, pictures and logs. A training that it holds is resumed."""
    cache: Path | None = None
    """Folder for converted sequences; ~/.cache/jaxsr by default."""
    scale: int = 4
    """HR size over LR size."""
    truth: Literal["reference", "color", "best"] = "best"
    """HR colour to train on: "reference" is anti-aliased, "color" is not. "best": the reference where all
    frames have one."""
    steps: int = 500
    """Updates of the weights."""
    batch: int = 8
    """Crops in a step, over all devices."""
    crop: int = 96
    """Side of the square crops, in HR pixels."""
    learning_rate: float = 1e-3
    """Of Adam, at the start."""
    schedule: Schedule = "exponential"
    """exponential: the paper's factor 0.98 per epoch for 100 epochs, stretched over all steps after the hold.
    cosine: down to `end_rate` at the last step."""
    hold_steps: int = 0
    """Steps at the start with the full learning rate, before it falls."""
    end_rate: float = 0.0
    """Learning rate at the end of the cosine."""
    clip_norm: float = 0.0
    """Largest norm of the gradient of all weights together; 0 does not clip."""
    ema: float = 0.0
    """Decay of averaged weights, such as 0.999, which are then evaluated and released; 0 keeps none."""
    flips: bool = True
    """Mirror every second crop left to right."""
    seed: int = 0
    """Of the first weights, the order of the data, the crops and the flips."""
    eval_every: int = 50
    """Steps between evaluations, with pictures and weights; the last step always has one."""
    save_every: int = 50
    """Steps between checkpoints; the last step always has one."""
    best_by: Score = "psnr"
    """Number of the evaluations that decides which weights are the best. "psnr" and "ssim" are means over all
    frames that are measured, the others over those of one kind where windows have both."""
    init: tuple[str, ...] = ()
    """Weights to start from: FILE for the whole network, PART=FILE for a part of it. Later ones replace
    earlier ones."""

    def check(self, multiple: int = 1) -> None:
        """Raise JaxsrError, which names the option, if a value is out of range.

        Args:
            multiple: what the LR sides of crops must be multiples of.
        """
        for name in ("scale", "steps", "batch", "crop", "eval_every", "save_every"):
            _check(name, getattr(self, name) >= 1, "a whole number from 1", getattr(self, name))
        _check("seed", 0 <= self.seed < 2**32, "a whole number from 0 to 2**32 - 1", self.seed)
        _check("init", isinstance(self.init, tuple | list), "a list of FILE or PART=FILE", self.init)
        rate, end, clip, ema = self.learning_rate, self.end_rate, self.clip_norm, self.ema
        _check("learning_rate", math.isfinite(rate) and rate > 0, "a number above 0", rate)
        _check("clip_norm", math.isfinite(clip) and clip >= 0, "0, or a number above it", clip)
        _check("ema", 0 <= ema < 1, "a number from 0, below 1", ema)
        _check("truth", self.truth in (*TRUTHS, "best"), "reference, color or best", self.truth)
        for name, kind in (("schedule", Schedule), ("best_by", Score)):
            choices = get_args(kind)
            _check(name, getattr(self, name) in choices, " | ".join(choices), getattr(self, name))
        hold = self.hold_steps
        _check("hold_steps", 0 <= hold < self.steps, f"0, or fewer than the {self.steps} steps", hold)
        if self.schedule == "cosine":
            _check("end_rate", 0 <= end <= rate, f"a number from 0 to the learning rate {rate}", end)
        else:
            _check("end_rate", end == 0, "0, unless --schedule cosine", end)
        check_crop(self.crop, self.scale, multiple, "--crop")


MAY_CHANGE = frozenset({"out", "cache", "data", "eval_data", "eval_every", "save_every", "init"})
"""Options that may have another value when a training is resumed: the weights do not depend on them.

Of the data, the sequences count (`identity`), and of the weights to start from, the content of the files:
where they lie does not matter. `steps` is not among these options, since the schedule depends on it."""


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
        "config": _json(config),
        "sequences": [identity(path) for path in trained_on],
        "evaluated": [identity(path) for path in evaluated_on],
        "init": hashes(config.init),
        "made": provenance(),
    }


def _json(config: TrainConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def identity(path: Path) -> str:
    """Name of a sequence and a hash of its description, which stay the same when the folder moves."""
    digest = hashlib.sha256((path / "sequence.json").read_bytes()).hexdigest()
    return f"{Sequence.open(path).name} {digest[:12]}"


def enter(out: Path, new: dict[str, Any]) -> list[str]:
    """Begin or resume the training of this description in the folder `out`.

    Returns:
        Differences that do not forbid to resume, as lines for the user: other versions, another device.

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
            old = read_json(file, dict)
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
                fix="choose another --out (with --init to start from these weights), or give the old values",
            )
        changed = changes(made, new["made"])
        if not changed:
            return []
        return [f"the result may differ from that of a training without a stop: {', '.join(changed)}"]
    write_text(file, json.dumps(new, indent=1) + "\n")
    return []


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """ "field: old -> new" for all that may not differ when a training is resumed."""

    # Of options that did not exist when an old training began; the only truth then was the colour.
    defaults = _json(dataclasses.replace(TrainConfig(), truth="color"))

    def flat(record: dict[str, Any]) -> dict[str, Any]:
        kept = {k: v for k, v in (defaults | record["config"]).items() if k not in MAY_CHANGE}
        data = {k: record[k] for k in ("method", "sequences", "evaluated")} | {"init": record.get("init")}
        return data | kept | record["settings"] | record["loss"]

    a, b = flat(old), flat(new)
    if same_hashes(a["init"], b["init"]):  # perhaps the file is gone, which only the first step needed
        b["init"] = a["init"]
    return [
        f"{name}: {_short(a.get(name))} -> {_short(b.get(name))}"
        for name in dict.fromkeys([*a, *b])
        if a.get(name) != b.get(name)
    ]


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 120 else text[:117] + "..."
