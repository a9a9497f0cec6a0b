"""Train and release guided-unet: weights in the package, a model card, and all numbers on the sample.

    python experiments/make_datasets.py render --set train --clips 3
    python experiments/guided_unet/release.py train DATASETS/train --runs RUNS
    python experiments/guided_unet/release.py release --runs RUNS

`train` runs both trainings, x4 first, since x2 starts from its weights; an interrupted one resumes. `release`
writes `jaxsr/weights/released/NAME.safetensors` (float16), `docs/models/NAME.md` and
`experiments/results/NAME.json`.
"""

import json
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402

from experiments.fusion_sr.release import CARDS, RESULTS, WEIGHTS, table, write  # noqa: E402
from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import description  # noqa: E402
from jaxsr.evaluation.evaluate import evaluate  # noqa: E402
from jaxsr.evaluation.running import TRUTH_WORDS, Settings  # noqa: E402
from jaxsr.methods import guided_unet  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402
from jaxsr.report.documents import as_json  # noqa: E402
from jaxsr.training.config import TrainConfig  # noqa: E402
from jaxsr.training.loop import train  # noqa: E402
from jaxsr.weights.file import load_weights, save_weights  # noqa: E402

OPTIONS, LOSS = guided_unet.Options(), guided_unet.Loss()
BASE = TrainConfig(
    truth="reference",
    steps=1400,
    batch=4,
    crop=96,
    learning_rate=6e-4,
    schedule="cosine",
    clip_norm=1.0,
    ema=0.99,
    eval_every=100,
    save_every=100,
)
RUNS = {
    "guided-unet-x4": BASE,
    "guided-unet-x2": replace(BASE, scale=2, steps=500, learning_rate=4e-4),
}
START = {"guided-unet-x2": "guided-unet-x4"}
"""Runs that start from the weights of others."""
RIVALS = ("bilinear", "taau", "guided-taau", "fusion-sr")
WARMUP = 4
MAX_MEGABYTES = 2.0


@dataclass(frozen=True)
class Train:
    """Train the networks."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder with the training clips."""
    runs: Path = ROOT / "experiments" / "cache" / "guided_unet"
    cache: Path | None = None


@dataclass(frozen=True)
class Release:
    """Release the networks of finished runs."""

    runs: Path = ROOT / "experiments" / "cache" / "guided_unet"
    names: tuple[str, ...] = tuple(RUNS)


def train_all(config: Train) -> None:
    """The verb `train`."""
    for name, run in RUNS.items():
        start = (str(config.runs / START[name] / "weights.safetensors"),) if name in START else ()
        training = replace(run, data=(config.data,), out=config.runs / name, init=start, cache=config.cache)
        print(f"{name}: {train(guided_unet.method(OPTIONS, LOSS), training)}")


def release(config: Release, name: str) -> None:
    """Put the weights of a run into the package, measure them as they ship, and write card and numbers."""
    run, file = RUNS[name], config.runs / name / "weights.safetensors"
    arrays, head = load_weights(file)
    if head["training"]["steps"] != run.steps:
        raise JaxsrError(
            "the run has not ended",
            where=file,
            expected=f"{run.steps} steps",
            found=head["training"]["steps"],
        )
    target = WEIGHTS / f"{name}.safetensors"
    save_weights(target, arrays, head, half=True)
    if (size := target.stat().st_size / 1e6) > MAX_MEGABYTES:
        raise JaxsrError("too large", where=target, expected=f"{MAX_MEGABYTES} MB", found=f"{size:.1f} MB")
    truth = head["training"]["config"]["truth"]
    with tempfile.TemporaryDirectory() as folder, Bars() as progress:
        sections = evaluate(
            unpack_sample(Path(folder) / "sample", "test", scale=run.scale, progress=progress),
            [*RIVALS, str(target)],
            Path(folder) / "out",
            Settings(scale=run.scale, warmup=WARMUP),
            truth=truth,
            title=name,
            progress=progress,
        )
    meta = description(weights=target.name, truth=truth, warmup=WARMUP)
    write(RESULTS / f"{name}.json", json.dumps(as_json(sections, title=name, meta=meta), indent=1) + "\n")
    write(CARDS / f"{name}.md", card(name, head, "\n".join(table(sections)), target))
    print(f"{target.name}: {size:.2f} MB")


def card(name: str, head: dict[str, Any], numbers: str, file: Path) -> str:
    """The model card as Markdown."""
    training, settings = head["training"], head["settings"]
    arrays, _ = load_weights(file)
    values = {**settings, **training["loss"], **training["config"], **training["made"]}
    values |= {
        "name": name,
        "truth": TRUTH_WORDS[training["config"]["truth"]],
        "weights": f"{sum(math.prod(a.shape) for a in arrays.values()):,}",
        "megabytes": f"{file.stat().st_size / 1e6:.2f}",
        "widths": ", ".join(map(str, settings["widths"])),
        "clips": len(training["sequences"]),
        "minutes": round(training["seconds"] / 60),
        "origin": f"; starts from the weights of [`{START[name]}`]({START[name]}.md)"
        if name in START
        else "",
        "table": numbers,
        "measured": time.strftime("%Y-%m-%d"),
        "day": training["made"]["date"][:10],
    }
    return (Path(__file__).parent / "model_card.md.in").read_text(encoding="utf-8").format(**values)


def main() -> None:
    command = tyro.conf.subcommand
    config: Any = tyro.cli(
        Annotated[Train, command("train")] | Annotated[Release, command("release")],  # type: ignore[arg-type]
        config=(tyro.conf.OmitArgPrefixes,),
    )
    if isinstance(config, Train):
        return train_all(config)
    for name in config.names:
        release(config, name)


if __name__ == "__main__":
    try:
        main()
    except JaxsrError as error:
        raise SystemExit(f"release: {error}") from None
