"""Figure 9: a lamp changes its colour on every frame, and methods with a history show the old colour.

    python experiments/fusion_sr/flicker.py [--runs DIR]

Reads all output frames of the methods of `study.py` on the bunker's test clip from the folder of the runs
(seed 0). For each frame t and tile, c is the mean colour of the truth, p that of the previous truth
warped to it by the motion, which is the colour in the history. Tiles count
where |p - c| is more than `CHANGE` (RMS
over channels), that is where the lamp shines and has changed; those that are disoccluded by more than a tenth
(`HIDDEN`) do not. With o the mean colour that a method made and m the mean of the truth's over the whole
clip, least squares over the tiles of a frame give

    o - c = old (p - c) + average (m - c) + rest

`old` is 0 if no colour comes from the previous frame and 1 if all of it does. `average` says how much a
method replaces the lamp's colour by its mean, as a network does that has not learned the colours. Blur
within a tile and other errors are in neither. All colours are display-referred.

Writes experiments/results/fusion_sr/flicker.json and .md, docs/images/fusion_flicker_strip.png (one
row per method, one column per frame), docs/images/fusion_flicker.png (the curves), and the section on flicker
of docs/results_fusion_sr.md.
"""

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from PIL import Image, ImageDraw, ImageFont  # noqa: E402

from experiments.fusion_sr.study import RESULTS, RUNS, SCALE, VARIANTS, results_file  # noqa: E402
from experiments.fusion_sr.tables import IMAGES, PAGE, on_page, write  # noqa: E402
from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import description  # noqa: E402
from jaxsr.evaluation.regions import disocclusions  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.io.images import read_png, write_png  # noqa: E402
from jaxsr.io.sequence import Sequence as FrameSequence  # noqa: E402
from jaxsr.ops import backward_warp  # noqa: E402
from jaxsr.runtime.upscale import display  # noqa: E402

CURRENT = ("bicubic", "rcan", "fusion", "fusion-zero", "fusion-guided")
HISTORY = ("taau", "guided-taau", "nsrr", "rrn")
STRIP = ("taau", "nsrr", "rrn", "fusion-zero", "fusion-guided")
TILE, CHANGE, HIDDEN, LAST = 12, 12 / 255, 0.1, 4
WINDOW = (108, 96)
"""Width and height of the crop in the strip: where most lit tiles are."""
FRAMES = (2, 3, 4, 5, 6, 7)
"""Positions in the clip of the columns."""
ZOOM, LABEL = 2, 90

Curves = dict[str, list["Shares | None"]]
"""By method: of each frame but the first, and of the last four together."""


def tile_means(image: np.ndarray) -> np.ndarray:
    """Means [H / TILE, W / TILE, C]; what is left over at the right and below is dropped."""
    height, width = (n // TILE * TILE for n in image.shape[:2])
    cut = image[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE, -1)
    return cut.mean((1, 3), dtype=np.float64)


class Lamp(NamedTuple):
    """What the lamp does to one frame."""

    color: np.ndarray
    """c, by tile."""
    old: np.ndarray
    """p, by tile."""
    lit: np.ndarray
    """Tiles that count."""


def lamp(truth: np.ndarray, before: np.ndarray, hidden: np.ndarray) -> Lamp:
    """Which tiles the lamp has changed.

    Args:
        truth: display-referred [H, W, 3].
        before: the previous truth, warped to it.
        hidden: mask [H, W] of pixels that the previous frame does not show.
    """
    color, old = tile_means(truth), tile_means(before)
    changed = np.sqrt(np.mean((old - color) ** 2, -1)) > CHANGE
    return Lamp(color, old, changed & (tile_means(hidden[..., None])[..., 0] < HIDDEN))


class Shares(NamedTuple):
    """Shares of the lamp's colour in the output of a method; see above."""

    old: float
    average: float


def shares(images: Sequence[np.ndarray], found: Sequence[Lamp], mean: np.ndarray) -> Shares | None:
    """The shares over frames; None where no tile counts.

    Args:
        images: display-referred.
        found: what the lamp does to these frames.
        mean: m, by tile.
    """
    made, old, average = [], [], []
    for image, one in zip(images, found, strict=True):
        made.append((tile_means(image) - one.color)[one.lit].ravel())
        old.append((one.old - one.color)[one.lit].ravel())
        average.append((mean - one.color)[one.lit].ravel())
    if not sum(map(len, made)):
        return None
    columns = np.stack([np.concatenate(old), np.concatenate(average)], -1)
    solution = np.linalg.lstsq(columns, np.concatenate(made))[0]
    return Shares(*(round(float(v), 4) for v in solution))


def lamps(sequence: FrameSequence) -> list[Lamp]:
    """Of each frame but the first.

    Raises:
        JaxsrError: no lamp changes, so that nothing would be measured.
    """
    found = []
    truths = [display(sequence.truth(i, "color"), sequence.exposure) for i in range(len(sequence))]
    for i in range(1, len(sequence)):
        now, before = (sequence.frame(k, 1, rendered=False) for k in (i, i - 1))
        warped = np.asarray(backward_warp(truths[i - 1], now.hr.motion_px))
        found.append(lamp(truths[i], warped, disocclusions(now, before)))
    if not any(one.lit.any() for one in found):
        raise JaxsrError("no lamp changes its colour", where=sequence.path)
    return found


def frames_of(name: str, runs: Path, clip: str, count: int) -> np.ndarray:
    """What a method made, display-referred.

    Raises:
        JaxsrError: the frames are not there.
    """
    folder = runs / results_file(name, 0).stem / "frames" / clip / "png"
    files = sorted(folder.glob("*.png"))
    if len(files) != count:
        raise JaxsrError(
            f"no frames of {name}",
            where=folder,
            expected=f"{count} frames",
            found=len(files),
            fix=f"python experiments/fusion_sr/study.py {name} --seeds 0 --again --runs {runs}",
        )
    return np.stack([read_png(file) for file in files])


def busiest(found: list[Lamp]) -> tuple[int, int]:
    """Left and top, in pixels, of the window in which most tiles change."""
    height, width = WINDOW[1] // TILE, WINDOW[0] // TILE
    times = np.sum([one.lit for one in found], 0)
    counts = np.lib.stride_tricks.sliding_window_view(times, (height, width)).sum((-2, -1))
    y, x = np.unravel_index(np.argmax(counts), counts.shape)
    return int(x) * TILE, int(y) * TILE


def strip(rows: dict[str, np.ndarray], found: list[Lamp]) -> np.ndarray:
    """The crops, one row per method and one column per frame, `[H, W, 3]` in 8 bits."""
    x, y = busiest(found)
    width, height = WINDOW[0] * ZOOM, WINDOW[1] * ZOOM
    page = Image.new("RGB", (LABEL + len(FRAMES) * (width + 3), 20 + len(rows) * (height + 3)), "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for column, frame in enumerate(FRAMES):
        draw.text((LABEL + column * (width + 3) + 4, 2), f"frame {frame + 1}", fill="black", font=font)
    for row, (name, images) in enumerate(rows.items()):
        top = 20 + row * (height + 3)
        draw.multiline_text((2, top + 4), name.replace(" ", "\n"), fill="black", font=font)
        for column, frame in enumerate(FRAMES):
            crop = images[frame][y : y + WINDOW[1], x : x + WINDOW[0]]
            tile = Image.fromarray(np.rint(255 * crop).astype(np.uint8))
            tile = tile.resize((width, height), Image.Resampling.NEAREST)
            page.paste(tile, (LABEL + column * (width + 3), top))
    return np.asarray(page)


def chart(curves: Curves, file: Path) -> None:
    """The share of the old colour over time: methods of the current frame dashed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, curve in curves.items():
        style = "--" if name in CURRENT else "-"
        old = [np.nan if one is None else 100 * one[0] for one in curve[:-1]]
        axes.plot(range(2, len(old) + 2), old, style, marker=".", label=VARIANTS[name].label)
    axes.set_xlabel("frame")
    axes.set_ylabel("old colour (%)")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", title="dashed: current frame alone")
    with atomic_path(file) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def table(curves: Curves, tiles: Sequence[int]) -> list[str]:
    """One row per method: the old colour in each frame, and both shares over the last four."""
    frames = " | ".join(f"frame {i + 2}" for i in range(len(tiles)))
    lines = [
        f"| method | sees | {frames} | last {LAST}: old | average |",
        "|---|---|" + "---:|" * (len(tiles) + 2),
    ]
    for name, curve in curves.items():
        sees = "current frame" if name in CURRENT else "history"
        *each, together = curve
        values = [None if one is None else one[0] for one in each] + list(together or (None, None))
        cells = ["–" if v is None else f"{100 * v:.0f} %" for v in values]
        lines.append(f"| {VARIANTS[name].label} | {sees} | {' | '.join(cells)} |")
    lines.append(f"| tiles that changed | | {' | '.join(map(str, tiles))} | | |")
    return lines


def main(runs: Path = RUNS) -> None:
    """Make the figure from the frames of the study.

    Args:
        runs: folder of the runs.
    """
    with tempfile.TemporaryDirectory() as folder:
        (clip,) = unpack_sample(Path(folder), "test", ("bunker",), scale=SCALE)
        sequence = FrameSequence.open(clip)
        count = len(sequence)
        found = lamps(sequence)
        truths = np.stack([display(sequence.truth(i, "color"), sequence.exposure) for i in range(count)])
        inputs = [display(sequence.frame(i, SCALE).color_linear, sequence.exposure) for i in range(count)]
    made = {name: frames_of(name, runs, sequence.name, count) for name in (*CURRENT, *HISTORY)}
    mean = np.mean([tile_means(truth) for truth in truths], 0)
    curves: Curves = {}
    for name, (_, *frames) in made.items():
        curves[name] = [shares([frame], [one], mean) for frame, one in zip(frames, found, strict=True)]
        curves[name].append(shares(frames[-LAST:], found[-LAST:], mean))
    tiles = [int(one.lit.sum()) for one in found]
    sources = {name: json.loads(results_file(name, 0).read_text(encoding="utf-8")) for name in made}
    numbers: dict[str, Any] = {
        "sequence": sequence.name,
        "tile_px": TILE,
        "change": CHANGE,
        "tiles": tiles,
        "shares": curves,
        "trained_at": {name: run["trained"]["commit"] for name, run in sources.items() if "trained" in run},
        "measured": description(scale=SCALE, seed=0),
    }
    write(RESULTS / "flicker.json", json.dumps(numbers, indent=1) + "\n")
    low = np.stack([given.repeat(SCALE, 0).repeat(SCALE, 1) for given in inputs])
    rows = {"input": low, **{VARIANTS[name].label: made[name] for name in STRIP}, "truth": truths}
    write_png(IMAGES / "fusion_flicker_strip.png", strip(rows, found))
    chart(curves, IMAGES / "fusion_flicker.png")
    lines = table(curves, tiles)
    write(RESULTS / "flicker.md", "\n".join(["# Figure 9: a lamp that changes its colour", "", *lines, ""]))
    block = [
        *lines,
        "",
        f"Share of the previous frame's colour where the lamp has changed; tiles of {TILE}x{TILE} px; "
        f"networks of seed 0; commit {numbers['measured']['commit']}.",
        "",
        "![A row a method, a column a frame](images/fusion_flicker_strip.png)",
        "",
        "![Old colour over time](images/fusion_flicker.png)",
    ]
    write(PAGE, on_page(PAGE.read_text(encoding="utf-8"), "figure9", block))
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
