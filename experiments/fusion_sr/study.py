"""Train every network of the fusion paper's tables on the same crops, and measure all on the same frames.

    python experiments/fusion_sr/study.py [NAME ...] [--seeds 0 1] [--data DIR] [--runs DIR]

Names are those of `VARIANTS`: networks, and methods that learn nothing. Each (name, seed) is trained, then
measured on the test clips of the sample, and becomes a file `experiments/results/fusion_sr/NAME-sSEED.json`:
configuration, learning curve, machine, commit, and every metric of every frame. A run with such a file is
skipped unless `--again` is given, and an interrupted training resumes. `tables.py` makes the tables.

The same for all: windows of five frames, their order, crops and flips, number of steps, schedule, clipping,
loss (1 - SSIM + L1 on display-referred colour), exposure, tone map, jittered input. The loss is that of the
last frame of a window, and for RRN, which is trained through its past, the mean over all five: five times the
pixels. The learning rate is the better of two (`rates.py`). One network for all scenes.

The test frames are the last four of each clip of the sample. Every method also runs on the four frames before
them, which are not measured: NSRR uses four previous frames.
"""

import csv
import dataclasses
import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.make_datasets import CACHE, Render, clips_of  # noqa: E402
from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import description  # noqa: E402
from jaxsr.evaluation.measuring import Reference  # noqa: E402
from jaxsr.evaluation.running import Evaluation, Settings, run_method  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.io.sequence import Sequence as FrameSequence  # noqa: E402
from jaxsr.io.truth import Truth  # noqa: E402
from jaxsr.methods import LEARNED, Method, from_json, fusion_sr, to_json  # noqa: E402
from jaxsr.methods.legacy import upgrade  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402
from jaxsr.report.documents import json_value  # noqa: E402
from jaxsr.runtime.load import LoadedMethod, find_method  # noqa: E402
from jaxsr.training.config import TrainConfig  # noqa: E402
from jaxsr.training.loop import train  # noqa: E402

RESULTS = ROOT / "experiments" / "results" / "fusion_sr"
RUNS = ROOT / "experiments" / "cache" / "study"
SCALE, WARM_UP, WINDOW = 4, 4, 5
TRUTH: Truth = "color"
"""That of the paper: aliased."""
CLIPS = 3
"""Training clips of each scene, of the five that the training set has."""
LOSS: dict[str, Any] = {
    "ssim_weight": 1.0,
    "l1_weight": 1.0,
    "perceptual_weight": 0.0,
    "frames": WINDOW,
}
"""As far as the loss of a network has such fields; the last one is RRN's."""
LOSS_NAMES = (*LOSS, "perceptual_crop")
PAPER = {"demodulated": False, "base": "none"}
"""The picture from colour and G-buffer alone, as published; the default corrects a guided upsampling."""
ZERO = PAPER | {"residual": "zero"}
"""The same, its residuals begun at 0: with so few steps the published beginning costs more than a decibel,
which would hide what buffers are worth."""
BUFFERS = fusion_sr.BUFFERS

BUDGET = TrainConfig(
    scale=SCALE,
    truth=TRUTH,
    steps=600,
    batch=4,
    crop=96,
    schedule="cosine",
    clip_norm=1.0,
    eval_every=300,
    save_every=100,
)


@dataclass(frozen=True)
class Variant:
    """One row or column of a table."""

    label: str
    method: str
    changes: dict[str, Any] | None = None
    """Settings of the network other than the defaults; None for a method that learns nothing."""
    learning_rate: float = 1e-3
    """Found by `rates.py`; variants of `fusion` have the rate of `fusion`."""

    def build(self) -> Method:
        """The method with the loss of the study, on windows of one length."""
        assert self.changes is not None
        learned = LEARNED[self.method]
        settings = from_json(learned.options, to_json(learned.options()) | self.changes)
        loss = learned.loss()
        known = {field.name for field in dataclasses.fields(loss)}
        loss = replace(loss, **{name: value for name, value in LOSS.items() if name in known})
        method = learned.method(settings, loss)
        assert method.network is not None
        windows = method.network.windows._replace(length=WINDOW)
        return method._replace(network=method.network._replace(windows=windows))


def without(*names: str) -> dict[str, Any]:
    """The fusion network without these buffers; see "fusion-zero" for why from 0."""
    return ZERO | {"buffers": tuple(name for name in BUFFERS if name not in names)}


VARIANTS = {
    "bicubic": Variant("bicubic", "bicubic"),
    "taau": Variant("TAAU", "taau"),
    "guided-taau": Variant("guided TAAU", "guided-taau"),
    "rcan": Variant("RCAN 5x4x64", "rcan", {"groups": 5, "blocks": 4}),
    "nsrr": Variant("NSRR", "nsrr", {}),
    "rrn": Variant("RRN 5x64", "rrn", {"blocks": 5, "features": 64}, 1e-4),
    "fusion": Variant("fusion", "fusion-sr", PAPER),
    "fusion-guided": Variant("fusion, guided start", "fusion-sr", {}),
    "fusion-zero": Variant("fusion, residuals from 0", "fusion-sr", ZERO),
    "concat": Variant("concat", "fusion-sr", PAPER | {"fusion": "concat"}),
    "add": Variant("add", "fusion-sr", PAPER | {"fusion": "add"}),
    "unet": Variant("single-branch U-Net", "fusion-sr", PAPER | {"architecture": "unet"}),
    "depth-only": Variant("depth only", "fusion-sr", ZERO | {"buffers": ("depth",)}),
    "no-base-color": Variant("no base colour", "fusion-sr", without("base_color")),
    "no-normal": Variant("no normal", "fusion-sr", without("normal")),
    "no-depth": Variant("no depth", "fusion-sr", without("depth")),
    "no-roughness": Variant("no roughness", "fusion-sr", without("roughness")),
    "no-metallic": Variant("no metallic", "fusion-sr", without("metallic")),
}


def chosen(names: tuple[str, ...]) -> dict[str, Variant]:
    """The variants of these names, all by default.

    Raises:
        JaxsrError: there is no such variant.
    """
    if unknown := [name for name in names if name not in VARIANTS]:
        raise JaxsrError(f"no variant {unknown[0]!r}", expected=", ".join(VARIANTS))
    return {name: VARIANTS[name] for name in names or VARIANTS}


def training_clips(data: Path) -> tuple[Path, ...]:
    """The first clips of each scene of the training set.

    Raises:
        JaxsrError: one is missing.
    """
    folders = sorted(data / clip.name for clip in clips_of(Render("train", clips=CLIPS)))
    for folder in folders:
        if not (folder / "sequence.json").is_file():
            raise JaxsrError(
                "no training clip",
                where=folder,
                expected=f"{len(folders)} clips in {data}",
                fix=f"python experiments/make_datasets.py render --set train --clips {CLIPS}, or --data",
            )
    return tuple(folders)


def results_file(name: str, seed: int, results: Path = RESULTS) -> Path:
    """The file with the numbers of a run; a method without a network has one run."""
    return results / (f"{name}.json" if VARIANTS[name].changes is None else f"{name}-s{seed}.json")


def record_of(run: Path) -> dict[str, Any]:
    """What a training was, its learning curve (loss, metrics of the held-back frames) and its time."""
    record = json.loads((run / "config.json").read_text(encoding="utf-8"))
    with (run / "log.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    wanted = ("step", "loss", "eval/psnr", "eval/ssim")
    folders = ("data", "eval_data", "out", "cache", "init")
    return {
        "settings": record["settings"],
        "loss": record["loss"],
        "config": {key: value for key, value in record["config"].items() if key not in folders},
        "sequences": record["sequences"],
        "trained": record["made"] | {"seconds": round(float(rows[-1]["seconds"]), 1)},
        "curve": [{key: round(float(row[key]), 5) for key in wanted if row.get(key)} for row in rows],
    }


def settings_of(run: dict[str, Any]) -> dict[str, Any]:
    """The settings of the network and the weights of its loss that a file of results records.

    Files of version 0.1 have both as "arguments", under earlier names and without the filters' constants.
    """
    if "arguments" not in run:
        return run["settings"] | run["loss"]
    loss = {name: run["arguments"][name] for name in LOSS_NAMES if name in run["arguments"]}
    return upgrade(run["method"], run["arguments"]) | {"ssim_weight": 1.0} | loss  # it was fixed for some


def measure(ready: LoadedMethod, clips: list[Path], frames: Path) -> dict[str, Any]:
    """Every metric of every measured frame, by scene; the frames that were made stay in `frames`."""
    scenes, begun = {}, time.monotonic()
    with Bars() as progress:
        sequences = [FrameSequence.open(clip) for clip in clips]
        advance = progress("measure", 2 * sum(map(len, sequences)))
        for sequence in sequences:
            reference = Reference(sequence, in_regions=True, truth=TRUTH)
            evaluation = Evaluation(sequence, Settings(SCALE, warmup=WARM_UP), reference, advance)
            result = run_method(evaluation, ready, frames / sequence.name)
            assert result.cost is not None
            scenes[sequence.name.split("-")[0]] = {
                "sequence": sequence.name,
                "frames": [info.index for info in sequence.infos[WARM_UP:]],
                "metrics": result.metrics,
                "regions": result.regions,
            }
    measured = description(scale=SCALE, warm_up=WARM_UP, truth=TRUTH)
    measured["seconds"] = round(time.monotonic() - begun, 1)
    return {"measured": measured, "cost": dataclasses.asdict(result.cost), "scenes": scenes}


def run(name: str, seed: int, data: tuple[Path, ...], runs: Path, clips: list[Path]) -> dict[str, Any]:
    """Train and measure one run, and return all that its file records."""
    variant, out = VARIANTS[name], runs / results_file(name, seed).stem
    found: dict[str, Any] = {"name": name, "label": variant.label, "method": variant.method}
    if variant.changes is None:
        ready = find_method(variant.method, SCALE)
    else:
        config = replace(BUDGET, seed=seed, learning_rate=variant.learning_rate, data=data, out=out)
        method = variant.build()
        ready = find_method(str(train(method, config)), SCALE)
        found |= record_of(out) | {"seed": seed}
    return found | measure(ready, clips, out / "frames")


def main(
    names: Positional[tuple[str, ...]] = (),
    seeds: tuple[int, ...] = (0, 1),
    data: Path = CACHE / "train",
    runs: Path = RUNS,
    results: Path = RESULTS,
    again: bool = False,
) -> None:
    """Train and measure these variants, all by default.

    Args:
        names: of the variants.
        seeds: of the trainings.
        data: folder of the training set.
        runs: folder for the runs.
        results: folder for the numbers.
        again: make what has numbers already; trainings that have ended are only measured again.
    """
    todo = [
        (name, seed)
        for seed in seeds
        for name, variant in chosen(names).items()
        if (variant.changes is not None or seed == seeds[0])
        and (again or not results_file(name, seed, results).is_file())
    ]
    if not todo:
        print(f"all is there; tables.py makes the tables of {results}")
        return
    learns = any(VARIANTS[name].changes is not None for name, _ in todo)
    folders = training_clips(data) if learns else ()
    with tempfile.TemporaryDirectory() as folder:
        clips = unpack_sample(Path(folder), "test", scale=SCALE)
        for done, (name, seed) in enumerate(todo, 1):
            file = results_file(name, seed, results)
            print(f"{file.stem} ({done} of {len(todo)})")
            found = run(name, seed, folders, runs, clips)
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file) as temporary:
                temporary.write_text(json.dumps(json_value(found), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        raise SystemExit(130) from None
