"""Figure 9: a lamp changes its colour on every frame; who looks at past frames shows the wrong one.

    python experiments/fusion_sr/flicker.py [--runs DIR]

Reads what the methods of `study.py` made of the bunker's test clip, all of its frames, from the folder of the
runs (seed 0). The frame is cut into tiles; those count that the lamp lights, whose mean colour in the truth
changes by more than `CHANGE` from one frame to the next. The error of a frame is the distance (RMS over
channels) between the mean colours of a tile in the output and in the truth, averaged over these tiles: blur
within a tile does not count, a wrong colour does. Display-referred, in units of 1/255.

Writes experiments/results/fusion_sr/flicker.json, docs/images/fusion_flicker_strip.png, a row a method and a
column a frame, docs/images/fusion_flicker.png, the curves, and its part of docs/results_fusion_sr.md.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from PIL import Image, ImageDraw, ImageFont  # noqa: E402

from experiments.fusion_sr.study import RESULTS, RUNS, SCALE, VARIANTS, results_file  # noqa: E402
from experiments.fusion_sr.tables import IMAGES, PAGE, on_page, write  # noqa: E402
from experiments.provenance import commit  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import description  # noqa: E402
from jaxsr.evaluation.measuring import display  # noqa: E402
from jaxsr.evaluation.sample import unpack_sample  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.io.images import read_png, write_png  # noqa: E402
from jaxsr.io.sequence import Sequence as FrameSequence  # noqa: E402

CURRENT = ("bicubic", "rcan", "fusion", "fusion-guided")
HISTORY = ("taau", "guided-taau", "nsrr", "rrn")
STRIP = ("taau", "nsrr", "rrn", "fusion")
TILE, CHANGE = 12, 12 / 255
WINDOW = (108, 96)
"""Width and height of the crop in the strip: where most lit tiles are."""
FRAMES = (2, 3, 4, 5, 6, 7)
"""Positions in the clip of the columns."""
ZOOM, LABEL = 2, 90


def tile_means(image: np.ndarray) -> np.ndarray:
    """Mean colours [H / TILE, W / TILE, 3]; what is left over at the right and below is dropped."""
    height, width = (n // TILE * TILE for n in image.shape[:2])
    cut = image[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE, 3)
    return cut.mean((1, 3), dtype=np.float64)


def lit_tiles(truths: np.ndarray) -> np.ndarray:
    """Which tiles the lamp lights, from display-referred frames [T, H, W, 3].

    Raises:
        JaxsrError: none, so that nothing would be measured.
    """
    colors = np.stack([tile_means(truth) for truth in truths])
    chroma = colors - colors.mean(-1, keepdims=True)
    lit = np.sqrt(np.mean(np.diff(chroma, axis=0) ** 2, -1)).max(0) > CHANGE
    if not lit.any():
        raise JaxsrError("no lamp changes its colour", where="the truth", expected=f"tiles above {CHANGE}")
    return lit


def errors(frames: np.ndarray, truths: np.ndarray, lit: np.ndarray) -> list[float]:
    """The error of each frame, in 1/255."""
    found = []
    for frame, truth in zip(frames, truths, strict=True):
        apart = np.sqrt(np.mean((tile_means(frame) - tile_means(truth)) ** 2, -1))
        found.append(round(255 * float(apart[lit].mean()), 3))
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
            fix=f"python experiments/fusion_sr/study.py {name} --seeds 0 --again",
        )
    return np.stack([read_png(file) for file in files])


def busiest(lit: np.ndarray) -> tuple[int, int]:
    """Left and top, in pixels, of the window with the most lit tiles."""
    height, width = WINDOW[1] // TILE, WINDOW[0] // TILE
    counts = np.lib.stride_tricks.sliding_window_view(lit, (height, width)).sum((-2, -1))
    y, x = np.unravel_index(np.argmax(counts), counts.shape)
    return int(x) * TILE, int(y) * TILE


def strip(rows: dict[str, np.ndarray], lit: np.ndarray) -> np.ndarray:
    """The crops, a row a method and a column a frame, `[H, W, 3]` in 8 bits."""
    x, y = busiest(lit)
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


def chart(curves: dict[str, list[float]], file: Path) -> None:
    """The error over time: methods of the current frame dashed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, curve in curves.items():
        style = "--" if name in CURRENT else "-"
        axes.plot(range(1, len(curve) + 1), curve, style, marker=".", label=VARIANTS[name].label)
    axes.set_xlabel("frame")
    axes.set_ylabel("colour error of lit tiles (1/255)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", title="dashed: current frame alone")
    with atomic_path(file) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def table(curves: dict[str, list[float]]) -> list[str]:
    """A row a method: the error of each frame, and the mean over those with a full history."""
    count = len(next(iter(curves.values())))
    lines = [
        "| method | sees | " + " | ".join(f"frame {i + 1}" for i in range(count)) + " | mean of 5 to 8 |",
        "|---|---|" + "---:|" * (count + 1),
    ]
    for name, curve in curves.items():
        sees = "current frame" if name in CURRENT else "history"
        numbers = [f"{v:.1f}" for v in (*curve, np.mean(curve[4:]))]
        lines.append(f"| {VARIANTS[name].label} | {sees} | {' | '.join(numbers)} |")
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
        truths = np.stack([display(sequence.truth(i), sequence.exposure) for i in range(count)])
        inputs = [display(sequence.frame(i, SCALE).color_linear, sequence.exposure) for i in range(count)]
    lit = lit_tiles(truths)
    made = {name: frames_of(name, runs, sequence.name, count) for name in (*CURRENT, *HISTORY)}
    curves = {name: errors(frames, truths, lit) for name, frames in made.items()}
    found: dict[str, Any] = {
        "sequence": sequence.name,
        "tiles": int(lit.sum()),
        "tile_px": TILE,
        "unit": "1/255, display-referred",
        "errors": curves,
        "measured": description(commit=commit(), scale=SCALE, seed=0),
    }
    write(RESULTS / "flicker.json", json.dumps(found, indent=1) + "\n")
    low = np.stack([given.repeat(SCALE, 0).repeat(SCALE, 1) for given in inputs])
    rows = {"input": low, **{VARIANTS[name].label: made[name] for name in STRIP}, "truth": truths}
    write_png(IMAGES / "fusion_flicker_strip.png", strip(rows, lit))
    chart(curves, IMAGES / "fusion_flicker.png")
    lines = table(curves)
    block = [
        *lines,
        "",
        f"{found['tiles']} lit tiles of {TILE}x{TILE} px; seed 0; commit {found['measured']['commit']}.",
        "",
        "![A row a method, a column a frame](images/fusion_flicker_strip.png)",
        "",
        "![Error over time](images/fusion_flicker.png)",
    ]
    write(PAGE, on_page(PAGE.read_text(encoding="utf-8"), "figure9", block))
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
