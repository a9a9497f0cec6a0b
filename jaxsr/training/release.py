"""The files of weights that a training writes, with a header that says how they were made."""

from pathlib import Path
from typing import Any

from flax import nnx

from jaxsr.methods.base import Net
from jaxsr.training.initial import parse
from jaxsr.weights.file import new_header, save_weights

WEIGHTS = "weights.safetensors"
"""Those of the last evaluation."""
BEST = "best.safetensors"
"""Those of the evaluation with the best `TrainConfig.best_by` so far."""
_FOLDERS = frozenset({"data", "eval_data", "out", "cache"})
"""Options that mean nothing on another machine."""


def release(
    out: Path, record: dict[str, Any], run: dict[str, Any], net: Net, metrics: dict[str, float], step: int
) -> None:
    """Write the weights, and a second time if they are the best so far.

    Args:
        out: folder of the training.
        record: what config.json says (`jaxsr.training.config.describe`).
        run: of the training so far; "best" and "best_step" of it are updated.
        net: state of the network.
        metrics: of the evaluation.
        step: after how many updates.
    """
    config = {name: value for name, value in record["config"].items() if name not in _FOLDERS}
    files = map(parse, config["init"])
    config["init"] = [source.named(source.file.name) for source in files]
    training = {name: record[name] for name in ("sequences", "evaluated", "made", "loss")}
    training |= {"config": config, "steps": step, "seconds": round(run["seconds"], 1)}
    training["metrics"] = {name: round(value, 4) for name, value in metrics.items()}
    training["best_by"] = config["best_by"]
    header = new_header(record["method"], record["settings"], config["scale"], training=training)
    lasting = nnx.filter_state(net, nnx.Not(nnx.RngState))  # random streams are for training alone
    save_weights(out / WEIGHTS, lasting, header)
    score = metrics[config["best_by"]]
    if run["best"] is None or score > run["best"]:
        run |= {"best": score, "best_step": step}
        save_weights(out / BEST, lasting, header)
