"""The numbers and pictures of README, from the sample that ships with the package.

    python experiments/demo_results.py

Runs the demo at x2 and x4; writes experiments/results/demo.json (every metric of every frame), demo.md
(tables with spread and time), the results in README, and docs/images/demo_<task>.png (crops: input, methods,
truth). LPIPS is among the metrics if the extra `perceptual` is installed.
"""

import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

from jaxsr.data.sample import unpack_sample
from jaxsr.errors import JaxsrError
from jaxsr.evaluation.demo import description, run_demo
from jaxsr.evaluation.running import TRUTH_WORDS
from jaxsr.files import atomic_path
from jaxsr.io.images import write_png
from jaxsr.io.truth import Truth
from jaxsr.progress import Bars
from jaxsr.report.documents import as_json
from jaxsr.report.embedding import ImageOrPath, to_bytes
from jaxsr.report.results import SequenceResult
from jaxsr.report.scores import best, summary
from jaxsr.report.tables import cell, duration, header

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

RESULTS = ROOT / "experiments" / "results"
IMAGES = ROOT / "docs" / "images"

LABELS = {
    "super-resolution": {},
    "extrapolation": {
        "nearest": "`nearest` (last frame held)",
        "bilinear": "`bilinear` (last frame held)",
        "taau": "`taau` (plain warp)",
    },
}
CROP = (64, 40)
BEGIN, END = "<!-- results of experiments/demo_results.py -->", "<!-- end of results -->"


@dataclass(frozen=True)
class Config:
    scales: tuple[int, ...] = (2, 4)
    frame: int = 6
    """The frame shown in the pictures; even frames are extrapolated."""
    truth: Truth | None = None
    """The reference by default."""


def task_of(section: SequenceResult) -> str:
    return "extrapolation" if any(section.extrapolated) else "super-resolution"


def table(sections: list[SequenceResult], task: str) -> list[str]:
    """One table per task: every metric of every method, a block of lines for each scene."""
    chosen = [s for s in sections if task_of(s) == task]
    keys = chosen[0].metric_keys()
    lines = [
        "| scene | method | " + " | ".join(header(k) for k in keys) + " | ms a frame |",
        "|---|---|" + "---:|" * (len(keys) + 1),
    ]
    for section in chosen:
        subset = section.subsets()["extrapolated" if task == "extrapolation" else "all"]
        for result in section.methods:
            cells = []
            for key in keys:
                text = cell(summary(result, key, subset), key)
                cells.append(f"**{text}**" if result.name in best(section, key, subset) else text)
            name = LABELS[task].get(result.name, f"`{result.name}`")
            time_ms = duration(result.timing.median_ms) if result.timing else ""
            scene = str(section.meta["sequence"]).split("-")[0]
            lines.append(f"| {scene} x{section.meta['scale']} | {name} | {' | '.join(cells)} | {time_ms} |")
    return lines


README = {
    "psnr": ("PSNR in dB", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "flip": ("FLIP", 3),
    "tpsnr": ("temporal PSNR in dB", 2),
}
"""The metrics of README: what they are called there, and their digits."""


def readme_block(document: dict[str, Any]) -> str:
    """The results of README: one row per method, one column per scene, from the numbers in demo.json."""
    keys = [key for key in README if key in document["sections"][0]["tracks"][0]["metrics"]]
    names = " · ".join(README[key][0] for key in keys)
    lines = []
    for task, scale, title in (
        ("super-resolution", 2, "Super-resolution x2, all frames"),
        ("super-resolution", 4, "Super-resolution x4, all frames"),
        ("extrapolation", 2, "Every second frame extrapolated from x2 history, extrapolated frames only"),
    ):
        subset = "extrapolated" if task == "extrapolation" else "all"
        chosen = [
            s
            for s in document["sections"]
            if s["meta"]["scale"] == scale and any(s["extrapolated"]) == (task == "extrapolation")
        ]
        scenes = [s["meta"]["sequence"].split("-")[0] for s in chosen]
        lines += [
            f"{title} ({names}):",
            "",
            f"| method | {' | '.join(scenes)} |",
            "|---|" + "---|" * len(scenes),
        ]
        for k, result in enumerate(chosen[0]["tracks"]):
            cells = []
            for section in chosen:
                found = section["tracks"][k]["summary"][subset]
                cells.append(" · ".join(f"{found[key]['mean']:.{README[key][1]}f}" for key in keys))
            name = LABELS[task].get(result["name"], f"`{result['name']}`")
            lines.append(f"| {name} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def pixels(image: ImageOrPath) -> np.ndarray:
    """Of an image in memory or on disk, in [0, 1]."""
    return to_bytes(image).astype(np.float32) / 255


def busiest(truth: np.ndarray, rivals: list[np.ndarray]) -> tuple[int, int]:
    """Top left of the crop where the methods differ most from the truth in sum: the same crop for all."""
    error = sum(((r - truth) ** 2).sum(-1) for r in rivals)
    total = np.pad(np.cumsum(np.cumsum(error, 0), 1), ((1, 0), (1, 0)))
    w, h = CROP
    sums = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    y, x = np.unravel_index(np.argmax(sums), sums.shape)
    return int(x), int(y)


def strip(section: SequenceResult, frame: int) -> np.ndarray:
    """The truth with the crop marked, then the crop of the input, each method and the truth, enlarged."""
    i = list(section.frames).index(frame)
    truth = pixels(section.truths[i])
    results = [t for t in section.methods if t.name not in ("nearest", "bicubic")]
    labels = {n: label.replace("`", "") for n, label in LABELS[task_of(section)].items()}
    images = {labels.get(t.name, t.name): pixels(t.images[i]) for t in results}
    x, y = busiest(truth, list(images.values()))
    (w, h), zoom = CROP, 4
    given = section.inputs[i]
    low = None if given is None else pixels(given)
    if low is not None:
        s = truth.shape[0] // low.shape[0]
        images = {"input": low.repeat(s, 0).repeat(s, 1), **images}
    images["truth"] = truth
    height = h * zoom
    whole = Image.fromarray(np.rint(truth * 255).astype(np.uint8))
    ImageDraw.Draw(whole).rectangle((x - 1, y - 1, x + w, y + h), outline=(255, 60, 60))
    whole = whole.resize((round(truth.shape[1] * height / truth.shape[0]), height), Image.Resampling.LANCZOS)
    tiles = [(str(section.meta["sequence"]).split("-")[0], whole)]
    for name, image in images.items():
        crop = Image.fromarray(np.rint(image[y : y + h, x : x + w] * 255).astype(np.uint8))
        tiles.append((name, crop.resize((w * zoom, height), Image.Resampling.NEAREST)))
    sheet = Image.new("RGB", (sum(t.width + 4 for _, t in tiles), height + 22), (255, 255, 255))
    font = ImageFont.load_default(14)
    left = 0
    for name, tile in tiles:
        ImageDraw.Draw(sheet).text((left + 2, 2), name, fill=(0, 0, 0), font=font)
        sheet.paste(tile, (left, 22))
        left += tile.width + 4
    return np.asarray(sheet)


def picture(sections: list[SequenceResult], task: str, frame: int) -> np.ndarray:
    rows = [strip(s, frame) for s in sections if task_of(s) == task]
    width = max(r.shape[1] for r in rows)
    return np.concatenate(
        [np.pad(r, ((0, 4), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    )


def main(config: Config) -> None:
    start = time.time()
    sections: list[SequenceResult] = []
    with tempfile.TemporaryDirectory() as folder, Bars() as progress:
        for scale in config.scales:
            paths = unpack_sample(Path(folder) / "sample", "test", progress=progress)
            out = Path(folder) / f"x{scale}"
            sections += run_demo(out, paths, scale=scale, lpips=True, truth=config.truth, progress=progress)
        pictures = {}  # while the frames are there
        for task in LABELS:
            shown = [s for s in sections if s.meta["scale"] == (4 if task == "super-resolution" else 2)]
            pictures[task] = picture(shown, task, config.frame)
    meta = description(
        seconds=round(time.time() - start),
        seed="none: nothing is random",
        script="experiments/demo_results.py",
        scales=config.scales,
        truth=sections[0].meta["truth"],
    )
    RESULTS.mkdir(parents=True, exist_ok=True)
    with atomic_path(RESULTS / "demo.json") as temporary:
        document = as_json(sections, title="demo", meta=meta)
        temporary.write_text(json.dumps(document, indent=1) + "\n")
    lines = [
        f"Measured by `experiments/demo_results.py` at {meta['commit']} on {meta['date']} ({meta['device']}, "
        f"jax {meta['jax']}): mean ± standard deviation over frames. Display-referred colour, no crop, "
        f"against {TRUTH_WORDS[meta['truth']]}.",
        "",
    ]
    for task in LABELS:
        which = "extrapolated frames only" if task == "extrapolation" else "all frames"
        lines += [f"{task.capitalize()}, {which}:", "", *table(sections, task), ""]
    with atomic_path(RESULTS / "demo.md") as temporary:
        temporary.write_text("\n".join(lines))
    for task, image in pictures.items():
        write_png(IMAGES / f"demo_{task}.png", image)
    readme = (ROOT / "README.md").read_text()
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not after:
        raise JaxsrError("no place for the results", where="README.md", expected=f"{BEGIN} and {END}")
    with atomic_path(ROOT / "README.md") as temporary:
        temporary.write_text(f"{before}{BEGIN}\n{readme_block(document)}{END}{after}")
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"demo_results: {error}") from None
