"""Find the constants of the classical methods on the training part of the sample, by coordinate search.

    python experiments/tune_classical.py

Reprojection: sigma_guide (one for base colour and normal) and sigma_space. The true colour of frame t - 1 is
reprojected to t, demodulated and modulated, and measured against the truth of t: PSNR of display colour over
the whole frame, the mean over all pairs and scenes. TAAU: all constants of `taau.Options`, on the
super-resolution of the clips, at every scale of the sequences alike. Test frames are not touched.

Writes experiments/results/tune_classical.json, .md and .png. The defaults in `jaxsr.ops.reprojection` and
`jaxsr.methods.taau` are the rounded optima.
"""

import json
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import tyro
from rich.progress import track

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.demo import description
from jaxsr.evaluation.run import observed
from jaxsr.evaluation.sample import unpack_sample
from jaxsr.frames import Frame
from jaxsr.io.exr import atomic_path
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.methods import guided, taau
from jaxsr.ops import backward_warp, demodulate, modulate, reproject, to_display

matplotlib.use("Agg")
import matplotlib.pyplot as plt

RESULTS = Path(__file__).resolve().parent / "results"

SIGMA_GUIDE = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5)
SIGMA_SPACE = (0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.4, 2.0, 4.0)
TAAU_GRID: dict[str, tuple[float, ...]] = {
    "kernel_sigma": (0.2, 0.25, 0.3, 0.35, 0.4, 0.5),
    "sample_sigma": (0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.7),
    "box": (0.75, 1.0, 1.25, 1.5, 2.0),
    "memory": (1.0, 2.0, 4.0, 8.0, 16.0),
    "floor": (0.005, 0.02, 0.05, 0.1, 0.2),
    "depth_tolerance": (0.005, 0.01, 0.02, 0.05),
}


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """Folder with training sequences; the sample's training part by default."""
    rounds: int = 2
    """Passes over the constants of TAAU."""
    out: Path = RESULTS


class Pair:
    """A frame, its predecessor's buffers and both truths, on the device."""

    def __init__(self, sequence: FrameSequence, i: int):
        self.frame: Frame = jax.device_put(sequence.frame(i, max(sequence.scales)))
        self.previous: Frame = jax.device_put(sequence.frame(i - 1, max(sequence.scales)))
        self.truth = jnp.asarray(sequence.truth(i))
        self.previous_truth = jnp.asarray(sequence.truth(i - 1))
        self.exposure = sequence.exposure


def psnr(image: jax.Array, truth: jax.Array, exposure: float) -> jax.Array:
    """PSNR in dB of display-referred colour."""
    error = to_display(image, exposure) - to_display(truth, exposure)
    return -10 * jnp.log10(jnp.mean(error**2))


@jax.jit
def _reprojected(pair: Any, sigma_guide: jax.Array, sigma_space: jax.Array) -> jax.Array:
    frame, previous, truth, previous_truth, exposure = pair
    lighting, _ = reproject(
        demodulate(previous_truth, previous.hr.base_color),
        frame.hr.motion_px,
        guided.guide(frame.hr),
        guided.guide(previous.hr),
        sigma_guide=sigma_guide,
        sigma_space=sigma_space,
    )
    return psnr(modulate(lighting, frame.hr.base_color), truth, exposure)


def tune_reprojection(pairs: Sequence[Pair]) -> dict[str, Any]:
    """The whole grid: PSNR for every sigma_guide and sigma_space, and of the plain warp."""
    surface = np.zeros((len(SIGMA_GUIDE), len(SIGMA_SPACE)))
    leaves = [(p.frame, p.previous, p.truth, p.previous_truth, p.exposure) for p in pairs]
    for i, sigma_guide in enumerate(track(SIGMA_GUIDE, "reprojection")):
        for j, sigma_space in enumerate(SIGMA_SPACE):
            values = [_reprojected(x, jnp.float32(sigma_guide), jnp.float32(sigma_space)) for x in leaves]
            surface[i, j] = float(np.mean(values))
    i, j = np.unravel_index(surface.argmax(), surface.shape)
    warp = [psnr(backward_warp(p.previous_truth, p.frame.hr.motion_px), p.truth, p.exposure) for p in pairs]
    return {
        "sigma_guide": SIGMA_GUIDE[i],
        "sigma_space": SIGMA_SPACE[j],
        "psnr": float(surface[i, j]),
        "plain_warp_psnr": float(np.mean(warp)),
        "pairs": len(pairs),
        "grid": {"sigma_guide": SIGMA_GUIDE, "sigma_space": SIGMA_SPACE, "psnr": surface.tolist()},
    }


def taau_score(clips: Sequence[tuple[list[Frame], jax.Array, float]]) -> Callable[[taau.Options], float]:
    """Mean PSNR of super-resolution over all frames but the first two of each clip."""

    def score(options: taau.Options) -> float:
        method = taau.method(options)
        step = jax.jit(method.step)
        values = []
        for frames, truths, exposure in clips:
            state = method.init(frames[0])
            for i, frame in enumerate(frames):
                state, image = step(None, state, frame)
                if i >= 2:
                    values.append(psnr(image, truths[i], exposure))
        return float(np.mean(values))

    return score


def tune_taau(clips: Sequence[tuple[list[Frame], jax.Array, float]], rounds: int) -> dict[str, Any]:
    """Coordinate search from the defaults of `taau.Options`."""
    score = taau_score(clips)
    best = taau.Options()
    value = score(best)
    trials = [{**asdict(best), "psnr": value}]
    for _ in range(rounds):
        before = best
        for key, grid in TAAU_GRID.items():
            for candidate in track(grid, f"TAAU {key}"):
                options = replace(best, **{key: candidate})
                if options == best:
                    continue
                found = score(options)
                trials.append({**asdict(options), "psnr": found})
                if found > value:
                    best, value = options, found
        if best == before:
            break
    return {"options": asdict(best), "psnr": value, "trials": trials}


def figure(path: Path, reprojection: dict[str, Any]) -> None:
    """The surface of the reprojection grid."""
    surface = np.array(reprojection["grid"]["psnr"])
    fig, axes = plt.subplots(figsize=(6, 4.2), constrained_layout=True)
    image = axes.imshow(surface, cmap="viridis", aspect="auto", vmin=np.percentile(surface, 20))
    axes.set_xticks(range(len(SIGMA_SPACE)), [f"{s:g}" for s in SIGMA_SPACE])
    axes.set_yticks(range(len(SIGMA_GUIDE)), [f"{s:g}" for s in SIGMA_GUIDE])
    axes.set(xlabel="sigma_space [px]", ylabel="sigma_guide", title="Guided reprojection, training frames")
    fig.colorbar(image, label="PSNR [dB], display-referred")
    with atomic_path(path) as temporary:
        fig.savefig(temporary, format="png", dpi=120)
    plt.close(fig)


def main(config: Config) -> None:
    start = time.time()
    with tempfile.TemporaryDirectory() as temporary:
        sequences = [FrameSequence.open(path) for path in training_sequences(config, Path(temporary))]
        run(config, sequences, start)


def training_sequences(config: Config, temporary: Path) -> list[Path]:
    """The folders to search on."""
    if config.data is None:
        return unpack_sample(temporary, "train")
    paths = sorted(path.parent for path in config.data.rglob("*-train-*/sequence.json"))
    if not paths:
        raise JaxsrError("no training sequences", where=config.data, expected="folders *-train-*")
    return paths


def run(config: Config, sequences: list[FrameSequence], start: float) -> None:
    """Search, and write the results."""
    pairs = [Pair(s, i) for s in sequences for i in range(1, len(s)) if not s.infos[i].cut]
    reprojection = tune_reprojection(pairs)
    clips = [
        (
            [jax.device_put(f) for f in observed(s, scale)],
            jnp.stack([jnp.asarray(s.truth(i)) for i in range(len(s))]),
            s.exposure,
        )
        for s in sequences
        for scale in s.scales
    ]
    temporal = tune_taau(clips, config.rounds)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=RESULTS, capture_output=True, text=True, check=False
    ).stdout.strip()
    meta = description(
        commit=commit,
        processor=platform.processor() or platform.machine(),
        seconds=round(time.time() - start),
        sequences=[f"{s.name}: {len(s)} frames {s.size[0]}x{s.size[1]}" for s in sequences],
        seed="none: the search is deterministic",
        rounds=config.rounds,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    with atomic_path(config.out / "tune_classical.json") as temporary:
        text = json.dumps({"meta": meta, "reprojection": reprojection, "taau": temporal}, indent=1)
        temporary.write_text(text + "\n")
    figure(config.out / "tune_classical.png", reprojection)
    lines = [
        "# Constants of the classical methods",
        "",
        f"Measured by `experiments/tune_classical.py` at {commit} on {meta['date']}, {meta['device']}, "
        f"{meta['seconds']} s, on the training part of the sample. PSNR of display colour, whole frames.",
        "",
        f"Guided reprojection of the true previous frame, {reprojection['pairs']} pairs: sigma_guide = "
        f"{reprojection['sigma_guide']:g}, sigma_space = {reprojection['sigma_space']:g} px give "
        f"{reprojection['psnr']:.2f} dB; the plain backward warp of the colour "
        f"{reprojection['plain_warp_psnr']:.2f} dB.",
        "",
        "TAAU, super-resolution, mean over scales, clips and all frames but the first two: "
        + ", ".join(f"{k} = {v:g}" for k, v in temporal["options"].items())
        + f" give {temporal['psnr']:.2f} dB; the starting point {temporal['trials'][0]['psnr']:.2f} dB.",
        "",
        "![PSNR over both sigmas](tune_classical.png)",
        "",
    ]
    with atomic_path(config.out / "tune_classical.md") as temporary:
        temporary.write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"tune_classical: {error}") from None
