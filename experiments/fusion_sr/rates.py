"""Which learning rate each architecture of `study.py` gets: the better of a few after a short training.

    python experiments/fusion_sr/rates.py [NAME ...] [--steps 200] [--rates 1e-3 3e-4] [--data DIR]

The judge is the PSNR of the held-back frames of the training clips; the test frames are not looked at. Seed
100, which no table uses. Writes experiments/results/fusion_sr/rates.json; goes on where it was stopped.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.fusion_sr.study import BUDGET, RESULTS, RUNS, chosen, log_of, training_clips  # noqa: E402
from experiments.fusion_sr.tables import write  # noqa: E402
from experiments.make_datasets import CACHE  # noqa: E402
from experiments.provenance import commit  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.training.config import device  # noqa: E402
from jaxsr.training.loop import train  # noqa: E402

SEED = 100


def main(
    names: Positional[tuple[str, ...]] = ("rcan", "nsrr", "rrn", "fusion"),
    steps: int = 200,
    rates: tuple[float, ...] = (1e-3, 3e-4),
    data: Path = CACHE / "train",
    runs: Path = RUNS,
) -> None:
    """Train each variant with each rate.

    Args:
        names: of the variants.
        steps: of each training.
        rates: to try.
        data: folder of the training set.
        runs: folder for the runs.
    """
    clips, file = training_clips(data), RESULTS / "rates.json"
    for name, variant in chosen(names).items():
        for rate in rates:
            out = runs / f"rates-{name}-{rate:g}"
            config = replace(BUDGET, steps=steps, learning_rate=rate, seed=SEED, eval_every=steps // 2)
            train(variant.build(), replace(config, data=clips, out=out))
            curve, seconds = log_of(out)
            last = [row for row in curve if "eval/psnr" in row][-1]
            found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
            found[f"{name} {rate:g}"] = {
                "steps": steps,
                "psnr": last["eval/psnr"],
                "ssim": last["eval/ssim"],
                "loss": last["loss"],
                "seconds": round(seconds, 1),
                "device": device(),
                "commit": commit(),
                "date": time.strftime("%Y-%m-%d"),
            }
            write(file, json.dumps(found, indent=1) + "\n")
            print(f"{name} {rate:g}: PSNR {last['eval/psnr']:.2f} dB, SSIM {last['eval/ssim']:.4f}")


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
