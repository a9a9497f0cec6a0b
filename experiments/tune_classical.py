"""Find the constants of the classical methods on training frames.

    python experiments/tune_classical.py reprojection          # the training part of the sample
    python experiments/tune_classical.py taau --data DIR       # training clips, rendered by make_datasets.py

Reprojection: sigma_guide (one for base colour and normal) and sigma_space, the whole grid. The true colour
of frame t - 1 is reprojected to t, demodulated and modulated, and measured against the truth of t: PSNR of
display colour over the whole frame, the mean over all pairs and scenes.

TAAU and guided TAAU: coordinate search over their options on the super-resolution of whole clips, every scale
of the sequences alike, all frames but the first two. The three frames of the sample's training part are too
few for that, because a history forms over more frames.

Test frames are not used. It writes experiments/results/tune_<what>.json, .md and a figure. The defaults of
`jaxsr.ops.reproject` are the optimum, those in `jaxsr.methods` lie within 0.15 dB of it: a longer memory than
the best PSNR asks for keeps still images steadier.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import tyro
from rich.progress import track

from jaxsr.data.sample import unpack_sample
from jaxsr.errors import JaxsrError
from jaxsr.evaluation.demo import description
from jaxsr.evaluation.running import TRUTH_WORDS
from jaxsr.files import atomic_path
from jaxsr.frames import Frame
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.io.truth import Truth, choose_truth
from jaxsr.methods import METHODS, Method, accumulation, guided, guided_taau, taau
from jaxsr.methods.base import step as step_of
from jaxsr.ops import backward_warp, demodulate, modulate, reproject, to_display
from jaxsr.runtime.schedule import observed

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

RESULTS = ROOT / "experiments" / "results"

SIGMA_GUIDE = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5)
SIGMA_SPACE = (0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.4, 2.0, 4.0)
TEMPORAL_GRID: dict[str, tuple[float, ...]] = {
    "sample_sigma": (0.25, 0.4, 0.55, 0.7, 1.0),
    "box": (0.75, 1.0, 1.25, 2.0),
    "memory": (0.5, 1.0, 2.0, 4.0, 8.0),
    "floor": (0.005, 0.02, 0.1),
    "depth_tolerance": (0.005, 0.01, 0.02, 0.04),
    "light_block": (2, 4, 8),
    "light_tolerance": (0.05, 0.1, 0.2, 0.4),
}
KERNEL_GRID: dict[str, tuple[float, ...]] = {"kernel_sigma": (0.25, 0.35, 0.5, 0.7)}
TAAU_GRID = KERNEL_GRID | TEMPORAL_GRID
GUIDED_GRID = KERNEL_GRID | {"sigma_guide": (0.1, 0.15, 0.2, 0.3, 0.4, 0.6)}


@dataclass(frozen=True)
class Config:
    what: Annotated[Literal["reprojection", "taau"], tyro.conf.Positional]
    data: Path | None = None
    """Folder with training sequences; the sample's training part by default."""
    clips: int = 1
    """Clips per scene, for TAAU."""
    rounds: int = 1
    """Passes over the constants of TAAU."""
    truth: Truth | None = None
    """The reference by default, if all frames have one."""
    out: Path = RESULTS


class Pair:
    """A frame, its predecessor's buffers and both truths, on the device."""

    def __init__(self, sequence: FrameSequence, i: int, truth: Truth):
        self.frame: Frame = jax.device_put(sequence.frame(i, max(sequence.scales)))
        self.previous: Frame = jax.device_put(sequence.frame(i - 1, max(sequence.scales)))
        self.truth = jnp.asarray(sequence.truth(i, truth))
        self.previous_truth = jnp.asarray(sequence.truth(i - 1, truth))
        self.exposure = sequence.exposure


def psnr(image: jax.Array, truth: jax.Array, exposure: float) -> jax.Array:
    """PSNR in dB of display-referred colour."""
    error = to_display(image, exposure) - to_display(truth, exposure)
    return -10 * jnp.log10(jnp.mean(error**2))


@jax.jit
def _reprojected(pair: Any, sigma_guide: jax.Array, sigma_space: jax.Array) -> jax.Array:
    frame, previous, truth, previous_truth, exposure = pair
    lighting, _ = reproject(
        demodulate(previous_truth, previous.hr.base_color, surface=jnp.isfinite(previous.hr.depth_linear)),
        frame.hr.motion_px,
        guided.guide(frame.hr),
        guided.guide(previous.hr),
        sigma_guide=sigma_guide,
        sigma_space=sigma_space,
    )
    surface = jnp.isfinite(frame.hr.depth_linear)
    return psnr(modulate(lighting, frame.hr.base_color, surface=surface), truth, exposure)


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


Clip = tuple[list[Frame], jax.Array, float]


def score(method: Method, clips: Sequence[Clip]) -> float:
    """Mean PSNR of super-resolution over all frames but the first two of each clip."""
    step = jax.jit(step_of(method))
    values = []
    for frames, truths, exposure in clips:
        state = method.init(frames[0])
        for i, frame in enumerate(frames):
            state, image = step(None, state, frame)
            if i >= 2:
                values.append(psnr(image, truths[i], exposure))
    return float(np.mean(values))


def coordinate_search(
    start: Any, grid: dict[str, tuple[float, ...]], of: Callable[[Any], float], rounds: int, title: str
) -> dict[str, Any]:
    """The best options found by varying one field at a time, and all trials."""
    best, value = start, of(start)
    trials = [{"key": "start", "psnr": value}]
    for _ in range(rounds):
        before = best
        for key, candidates in grid.items():
            for candidate in track(candidates, f"{title} {key}"):
                options = replace(best, **{key: candidate})
                if options == best:
                    continue
                found = of(options)
                trials.append({"key": key, "value": candidate, "psnr": found})
                if found > value:
                    best, value = options, found
        if best == before:
            break
    return {"options": asdict(best), "psnr": value, "start_psnr": trials[0]["psnr"], "trials": trials}


def tune_taau(sequences: Sequence[FrameSequence], rounds: int, truth: Truth) -> dict[str, Any]:
    clips: list[Clip] = [
        (
            [jax.device_put(f) for f in observed(s, METHODS["guided-taau"], scale)],
            jnp.stack([jnp.asarray(s.truth(i, truth)) for i in range(len(s))]),
            s.exposure,
        )
        for s in sequences
        for scale in s.scales
    ]
    plain = coordinate_search(
        taau.Options(), TAAU_GRID, lambda o: score(taau.method(o), clips), rounds, "taau"
    )
    start = guided_taau.Options()
    temporal = coordinate_search(
        start.temporal,
        TEMPORAL_GRID,
        lambda o: score(guided_taau.method(replace(start, temporal=o)), clips),
        rounds,
        "guided-taau",
    )
    start = replace(start, temporal=accumulation.Accumulation(**temporal["options"]))
    guide = coordinate_search(
        start.upsampling,
        GUIDED_GRID,
        lambda o: score(guided_taau.method(replace(start, upsampling=o)), clips),
        1,
        "guided-taau",
    )
    bilinear = score(METHODS["bilinear"], clips)
    return {
        "taau": plain,
        "taau_start": plain["start_psnr"],
        "guided_taau": guide,
        "guided_taau_start": temporal["start_psnr"],
        "guided_taau_temporal": temporal,
        "bilinear_psnr": bilinear,
    }


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


def training_sequences(config: Config, temporary: Path) -> list[FrameSequence]:
    if config.data is None:
        paths = unpack_sample(temporary, "train")
    else:
        paths = sorted(path.parent for path in config.data.rglob("*-train-*/sequence.json"))
        if not paths:
            raise JaxsrError("no training sequences", where=config.data, expected="folders *-train-*")
    if config.what == "taau":
        by_scene: dict[str, list[Path]] = {}
        for path in paths:
            by_scene.setdefault(path.name.split("-")[0], []).append(path)
        paths = [path for found in by_scene.values() for path in found[: config.clips]]
    return [FrameSequence.open(path) for path in paths]


def report(config: Config, result: dict[str, Any]) -> list[str]:
    """The lines of the Markdown file after its head."""
    if config.what == "reprojection":
        figure(config.out / "tune_reprojection.png", result)
        return [
            f"sigma_guide = {result['sigma_guide']:g} and sigma_space = {result['sigma_space']:g} px give "
            f"{result['psnr']:.2f} dB on {result['pairs']} pairs; the plain backward warp of the colour "
            f"{result['plain_warp_psnr']:.2f} dB.",
            "",
            "![PSNR over both sigmas](tune_reprojection.png)",
        ]
    lines = [f"Bilinear interpolation reaches {result['bilinear_psnr']:.2f} dB.", ""]
    for name in ("taau", "guided_taau"):
        options = result[name]["options"]
        flat = {**options.pop("temporal", {}), **options} if name == "guided_taau" else options
        lines += [
            f"{name}: " + ", ".join(f"{k} = {v:g}" for k, v in flat.items()) + ":",
            f"{result[name]['psnr']:.2f} dB; the defaults give {result[name + '_start']:.2f} dB.",
            "",
        ]
    return lines


def main(config: Config) -> None:
    start = time.time()
    with tempfile.TemporaryDirectory() as temporary:
        sequences = training_sequences(config, Path(temporary))
        truth = choose_truth(sequences, config.truth)
        if config.what == "reprojection":
            pairs = [Pair(s, i, truth) for s in sequences for i in range(1, len(s)) if not s.infos[i].reset]
            result = tune_reprojection(pairs)
        else:
            result = tune_taau(sequences, config.rounds, truth)
    meta = description(
        script=f"experiments/tune_classical.py {config.what}",
        truth=truth,
        seconds=round(time.time() - start),
        sequences=[f"{s.name}: {len(s)} frames {s.size[0]}x{s.size[1]}" for s in sequences],
        seed="none: the search is deterministic",
    )
    config.out.mkdir(parents=True, exist_ok=True)
    with atomic_path(config.out / f"tune_{config.what}.json") as file:
        file.write_text(json.dumps({"meta": meta, **result}, indent=1) + "\n")
    lines = [
        f"# Constants of {'guided reprojection' if config.what == 'reprojection' else 'TAAU'}",
        "",
        f"`{meta['script']}` at {meta['commit']} on {meta['date']}, {meta['device']}, {meta['seconds']} s; "
        f"training frames: {', '.join(meta['sequences'])}. PSNR of display colour, whole frames, "
        f"against {TRUTH_WORDS[truth]}.",
        "",
        *report(config, result),
        "",
    ]
    with atomic_path(config.out / f"tune_{config.what}.md") as file:
        file.write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"tune_classical: {error}") from None
