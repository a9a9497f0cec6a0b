"""What each part of guided-taau is worth, against both truths, in motion and at rest.

    python experiments/make_datasets.py render --set train --clips 1
    python experiments/rest_clips.py REST
    python experiments/antialiasing.py --motion DATASETS/train --rest REST

Every variant changes one thing. Motion: clip 0 of each training scene, frames 5 to 12. Rest: the last four
frames of the clips at rest, where variants with jittered HR G-buffers take those. PSNR of display-referred
colour, the mean over frames. Test frames are not used: the constants were chosen on the same clips.

Writes experiments/results/antialiasing.json and .md.
"""

import json
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import jax  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.files import atomic_path  # noqa: E402
from jaxsr.io.sequence import Sequence  # noqa: E402
from jaxsr.io.truth import TRUTHS  # noqa: E402
from jaxsr.methods import METHODS, Method, guided_taau, taau  # noqa: E402
from jaxsr.metrics import psnr  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402
from jaxsr.provenance import provenance  # noqa: E402
from jaxsr.runtime.upscale import display  # noqa: E402

RESULTS = ROOT / "experiments" / "results"
SCENES = ("bunker", "docks", "forest")
OPTIONS = guided_taau.Options()
NONE = 1e-6
"""A weight or a memory of practically nothing."""


def guided(light: dict[str, float] | None = None, **image: object) -> Method:
    """guided-taau with changed constants: of the lighting's history, and of the image's."""
    return guided_taau.method(
        replace(
            OPTIONS,
            temporal=replace(OPTIONS.temporal, **(light or {})),
            antialiasing=replace(OPTIONS.antialiasing, **image),  # type: ignore[arg-type]
        )
    )


VARIANTS: dict[str, tuple[Method, bool]] = {
    "bilinear": (METHODS["bilinear"], False),
    "taau": (taau.method(), False),
    "taau, motion not dilated": (taau.method(taau.Options(dilated=False, depth_tolerance=0.01)), False),
    "taau, nothing of the smooth image": (taau.method(taau.Options(smooth=0.0)), False),
    "guided samples alone": (
        guided(memory=NONE, sample_weight=0.0, smooth=0.0, pixel_sigma=0.2, centred=0.0), False
    ),
    "smooth image alone": (guided(memory=NONE, sample_weight=0.0, smooth=1e4), False),
    "guided-taau": (guided(), False),
    "without LR samples": (guided(sample_weight=0.0), False),
    "without the smooth image": (guided(smooth=0.0), False),
    "without history of the lighting": (guided(light={"memory": NONE}), False),
    "without history of the image": (guided(memory=NONE), False),
    "motion not dilated": (guided(dilated=False), False),
    "samples not moved to the pixel": (guided(centred=0.0), False),
    "no longer memory at rest": (guided(rest_memory=1.0, rest_box=1.0), False),
    "guided-taau, jittered HR G-buffers": (guided(), True),
}  # fmt: skip
"""Name -> method, and whether it takes jittered HR G-buffers where there are some."""


@dataclass(frozen=True)
class Config:
    motion: Path | None = None
    """Folder with training clips, `<scene>-train-0`."""
    rest: Path | None = None
    """Folder that `rest_clips.py` wrote."""
    scales: tuple[int, ...] = (2, 4)
    variants: tuple[str, ...] = tuple(VARIANTS)


def clips(config: Config, jittered: bool) -> Iterable[tuple[str, str, Path, int]]:
    """(kind, scene, folder, first position that is measured)."""
    for scene in SCENES:
        if config.motion is not None and not jittered:
            yield "motion", scene, config.motion / f"{scene}-train-0", 4
        if config.rest is not None:
            yield "rest", scene, config.rest / f"{scene}-rest{'-jittered' * jittered}", -4


def measured(method: Method, sequence: Sequence, scale: int, first: int) -> dict[str, float]:
    """PSNR against each truth, the mean over the frames from `first` on."""
    upscale, state = jax.jit(method.upscale), None
    scores: dict[str, list[float]] = {truth: [] for truth in TRUTHS}
    start = first % len(sequence)
    for i in range(len(sequence)):
        frame = sequence.frame(i, scale, needs=method.needs.rendered)
        state = method.init(jax.tree.map(jax.numpy.asarray, frame)) if state is None else state
        state, image = upscale(None, state, frame)
        if i >= start:
            exposure = sequence.exposure_at(i)
            shown = display(np.asarray(image), exposure)
            for truth in TRUTHS:
                scores[truth].append(float(psnr(shown, display(sequence.truth(i, truth), exposure))))
    return {truth: round(float(np.mean(values)), 3) for truth, values in scores.items()}


def table(found: dict[str, dict[str, dict[str, float]]], kind: str, truth: str) -> list[str]:
    """One row per variant: scenes at each scale."""
    columns = [key for key in next(iter(found.values())) if key.startswith(kind)] or [
        key for row in found.values() for key in row if key.startswith(kind)
    ]
    columns = list(dict.fromkeys(columns))
    heads = [f"{key.split('/')[2]} x{key.split('/')[1]}" for key in columns]
    lines = ["| variant | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(columns)]
    for name, row in found.items():
        if any(key in row for key in columns):
            cells = [f"{row[key][truth]:.2f}" if key in row else "" for key in columns]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def main(config: Config) -> None:
    if config.motion is None and config.rest is None:
        raise JaxsrError("no clips", expected="--motion or --rest, or both")
    unknown = sorted(set(config.variants) - set(VARIANTS))
    if unknown:
        raise JaxsrError(f"unknown variant {unknown[0]!r}", expected=", ".join(VARIANTS))
    start, found = time.monotonic(), dict[str, dict[str, dict[str, float]]]()
    work = [
        (name, scale, clip)
        for name in config.variants
        for scale in config.scales
        for clip in clips(config, VARIANTS[name][1])
    ]
    with Bars() as bars:
        bar = bars.start("clips", len(work), unit="clip")
        for done, (name, scale, (kind, scene, folder, first)) in enumerate(work):
            bar.update(done, f"{name}, {scene} x{scale}")
            scores = measured(VARIANTS[name][0], Sequence.open(folder), scale, first)
            found.setdefault(name, {})[f"{kind}/{scale}/{scene}"] = scores
        bar.update(len(work))
    document = {
        "made": provenance(),
        "seconds": round(time.monotonic() - start),
        "seed": "none: nothing is random",
        "data": "clip 0 of each training scene, frames 5 to 12; clips at rest, the last four of their frames",
        "psnr": found,
    }
    with atomic_path(RESULTS / "antialiasing.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")
    made = provenance()
    where = f"at {made['commit']} on {made['date']} ({made['device']})"
    lines = [f"Measured by `experiments/antialiasing.py` {where}."]
    words = {"reference": "anti-aliased reference", "color": "aliased truth"}
    for kind in ("motion", "rest"):
        for truth in TRUTHS:
            rows = table(found, kind, truth)
            if len(rows) > 2:
                where = "Camera in motion" if kind == "motion" else "Camera at rest"
                lines += ["", f"{where}, PSNR in dB against the {words[truth]}:", "", *rows]
    with atomic_path(RESULTS / "antialiasing.md") as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"antialiasing: {error}") from None
