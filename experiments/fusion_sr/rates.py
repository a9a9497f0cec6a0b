"""Find the learning rate of each architecture of `study.py`: the best of a few after a short training.

    python experiments/fusion_sr/rates.py [NAME ...] [--steps N] [--rates 1e-3 ...] [--data DIR]

The best rate has the highest SSIM on the held-back frames of the training clips, because SSIM is most of the
loss. The test frames are not used. The seed is 100, which no table uses. Variants of `fusion` (other buffers,
fusion or base, one branch) have the rate of `fusion`. Each training is stored in a file in
experiments/results/fusion_sr/rates/ and is not repeated.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.fusion_sr.study import BUDGET, RESULTS, RUNS, chosen, record_of, training_clips  # noqa: E402
from experiments.fusion_sr.tables import write  # noqa: E402
from experiments.make_datasets import CACHE  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.training.loop import train  # noqa: E402

SEED = 100
ARCHITECTURES = {
    "rcan": (150, (1e-3, 3e-4)),
    "nsrr": (150, (1e-3, 3e-4)),
    "rrn": (600, (1e-3, 1e-4)),
    "fusion": (150, (1e-3, 3e-4)),
}
"""Steps and rates. RRN starts with small weights and learns little in the first 150 steps."""


def main(
    names: Positional[tuple[str, ...]] = tuple(ARCHITECTURES),
    steps: int = 0,
    rates: tuple[float, ...] = (),
    data: Path = CACHE / "train",
    runs: Path = RUNS,
) -> None:
    """Train each variant with each rate.

    Args:
        names: of the variants.
        steps: of each training; by default as in `ARCHITECTURES`.
        rates: to try; by default as there.
        data: folder of the training set.
        runs: folder for the runs.
    """
    clips = training_clips(data)
    for name, variant in chosen(names).items():
        long, several = ARCHITECTURES.get(name, (150, (1e-3, 3e-4)))
        for rate in rates or several:
            file = RESULTS / "rates" / f"{name}-{rate:g}.json"
            if not file.is_file():
                out = runs / f"rates-{name}-{rate:g}"
                config = replace(BUDGET, steps=steps or long, learning_rate=rate, seed=SEED)
                train(variant.build(), replace(config, data=clips, out=out))
                file.parent.mkdir(parents=True, exist_ok=True)
                write(file, json.dumps({"name": name} | record_of(out), indent=1) + "\n")
            found = json.loads(file.read_text(encoding="utf-8"))
            last = found["curve"][-1]
            words = f"PSNR {last['eval/psnr']:.2f} dB, SSIM {last['eval/ssim']:.4f}"
            print(f"{name} {rate:g}, {found['config']['steps']} steps: {words}")


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
