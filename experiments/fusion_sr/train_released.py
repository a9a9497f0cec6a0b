"""Train the networks that ship with the package; an interrupted run resumes.

    python experiments/fusion_sr/train_released.py [NAME ...] [--truth TRUTH] [--data DIR] [--runs DIR]

`--data` is the training set of `experiments/make_datasets.py render --set train` (15 clips of 12 frames). The
last frame of each clip is held back from training. Runs that start from others come after them. The loss is
the paper's, 1 - SSIM + 0.2 LPIPS, plus the mean absolute error, since PSNR is reported as well. Budget and
crops are far below the paper's: these are for two CPU cores.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.make_datasets import CACHE, Render, clips_of  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.methods import fusion_sr  # noqa: E402
from jaxsr.methods.image_loss import ImageLoss  # noqa: E402
from jaxsr.training.config import TrainConfig  # noqa: E402
from jaxsr.training.loop import train  # noqa: E402

OPTIONS, LOSS = fusion_sr.Options(), ImageLoss(l1_weight=1.0, perceptual_crop=48)
BASE = TrainConfig(
    steps=2500,
    batch=8,
    crop=96,
    schedule="cosine",
    clip_norm=1.0,
    ema=0.998,
    eval_every=250,
    save_every=125,
)
TUNE = replace(BASE, steps=500, learning_rate=3e-4, ema=0.99)


@dataclass(frozen=True)
class Run:
    """One training: its configuration, the scenes it sees, and the run whose weights it starts from."""

    config: TrainConfig
    scenes: tuple[str, ...] = ("bunker", "docks", "forest")
    start: str | None = None


RUNS = {
    "fusion-sr-x4": Run(BASE),
    "fusion-sr-x2": Run(replace(TUNE, steps=1000, scale=2, learning_rate=5e-4), start="fusion-sr-x4"),
    "fusion-sr-bunker-x4": Run(TUNE, ("bunker",), "fusion-sr-x4"),
    "fusion-sr-docks-x4": Run(TUNE, ("docks",), "fusion-sr-x4"),
    "fusion-sr-forest-x4": Run(TUNE, ("forest",), "fusion-sr-x4"),
}


def chosen(names: tuple[str, ...]) -> dict[str, Run]:
    """The runs of these names, all by default, in the order in which they can be made.

    Raises:
        JaxsrError: there is no such run.
    """
    if unknown := [name for name in names if name not in RUNS]:
        raise JaxsrError(f"no run {unknown[0]!r}", expected=", ".join(RUNS))
    return {name: run for name, run in RUNS.items() if not names or name in names}


def folders_of(scenes: tuple[str, ...], data: Path) -> tuple[Path, ...]:
    """The training clips of these scenes.

    Raises:
        JaxsrError: one is missing.
    """
    folders = [data / clip.name for clip in sorted(clips_of(Render("train", scenes)), key=lambda c: c.name)]
    for folder in folders:
        if not (folder / "sequence.json").is_file():
            raise JaxsrError(
                "no training clip",
                where=folder,
                expected=f"{len(folders)} clips of {', '.join(scenes)} in {data}",
                fix="python experiments/make_datasets.py render --set train, or --data",
            )
    return tuple(folders)


def main(
    names: Positional[tuple[str, ...]] = (),
    truth: Literal["reference", "color", "best"] = "best",
    data: Path = CACHE / "train",
    runs: Path = ROOT / "experiments" / "cache" / "runs",
) -> None:
    """Train these runs, all by default.

    Args:
        names: of the runs.
        truth: what to train on: "reference" is anti-aliased, "color" is not. "best": the reference where all
            frames have one.
        data: folder of the training set.
        runs: folder for the runs.
    """
    for name, run in chosen(names).items():
        start = () if run.start is None else (str(runs / run.start / "weights.safetensors"),)
        config = replace(
            run.config, data=folders_of(run.scenes, data), out=runs / name, init=start, truth=truth
        )
        print(f"{name}: {train(fusion_sr.method(OPTIONS, LOSS), config)}")


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
