"""Pictures of the networks and the other methods, as in the paper's Figures 6 to 8: one per scene.

    python experiments/fusion_sr/figures.py [--network fusion-sr | fusion-sr-{scene} | FILE.safetensors]

Runs the methods over the test clips of the sample and writes docs/images/fusion_sr_<scene>.png: the truth of
one frame with two crops marked, and the crops of the input, of what each method made, and of the truth. As in
the paper, the truth is the aliased colour.
PSNR and LPIPS of that whole frame stand below, with the best in black. The crops are not picked by hand: they
lie where the squared error, summed over all methods, is largest.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from PIL import Image, ImageDraw, ImageFont  # noqa: E402

from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.io.images import write_png  # noqa: E402
from jaxsr.io.sequence import Sequence as FrameSequence  # noqa: E402
from jaxsr.metrics import METRICS, available, measure_frame  # noqa: E402
from jaxsr.runtime.load import LoadedMethod, find_method  # noqa: E402
from jaxsr.runtime.schedule import check_needs, observed  # noqa: E402
from jaxsr.runtime.stream import stream  # noqa: E402
from jaxsr.runtime.upscale import display  # noqa: E402

METHODS = ("bicubic", "taau", "guided-taau")
COLORS = ((230, 60, 50), (40, 150, 255))
"""Colours of the two crops."""
PARTS = (6, 4.5)
"""A crop is this much narrower and lower than the frame."""
TILE, GAP, LINE = 192, 4, 17
MOST_BYTES = 700_000


@dataclass(frozen=True)
class Config:
    network: str = "fusion-sr"
    """Name of weights that ship, or a file of weights; {scene} in it stands for the scene's name."""
    scale: int = 4
    frame: int = 6
    """Position in the clip, counted from 1; the temporal methods see those before it."""
    scenes: tuple[str, ...] = ()
    """Scenes of the sample; the default is all."""
    out: Path = ROOT / "docs" / "images"


@dataclass(frozen=True)
class Shown:
    """One column: a name, a frame, and what was measured on it."""

    name: str
    image: np.ndarray
    """Display-referred, at the size of the truth."""
    values: dict[str, float | None]


def columns(sequence: FrameSequence, methods: Sequence[LoadedMethod], scale: int, frame: int) -> list[Shown]:
    """The input (enlarged), what each method makes of a frame, and the truth.

    Raises:
        JaxsrError: the clip is too short, or lacks what a method needs.
    """
    if not 1 <= frame <= len(sequence):
        raise JaxsrError("no such frame", where=sequence.path, expected=f"1 to {len(sequence)}", found=frame)
    truth = display(sequence.truth(frame - 1, "color"), sequence.exposure)
    given = display(np.asarray(sequence.frame(frame - 1, scale).color_linear), sequence.exposure)
    keys = [key for key in ("psnr", "lpips") if key in available()]
    found = [Shown("input", given.repeat(scale, 0).repeat(scale, 1), {})]
    for ready in methods:
        check_needs(ready.method, sequence, scale)
        frames = (
            seen for seen, _ in zip(observed(sequence, ready.method, scale), range(frame), strict=False)
        )
        for made in stream(ready.method, frames, ready.net):
            image = display(made.image, sequence.exposure)
        found.append(Shown(ready.method.name, image, measure_frame(image, truth, keys=keys)["all"]))
    return [*found, Shown("truth", truth, {})]


def crops(shown: Sequence[Shown]) -> list[tuple[int, int, int, int]]:
    """Left, top, right and bottom of the two windows, apart from each other, with the largest error."""
    truth = shown[-1].image
    error = np.sum([np.sum((s.image - truth) ** 2, -1) for s in shown[1:-1]], 0, dtype=np.float64)
    width, height = (max(int(n / part), 1) for n, part in zip(truth.shape[1::-1], PARTS, strict=True))
    total = np.pad(np.cumsum(np.cumsum(error, 0), 1), ((1, 0), (1, 0)))
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width]
    sums += total[:-height, :-width]
    found = []
    for _ in COLORS:
        y, x = (int(v) for v in np.unravel_index(np.argmax(sums), sums.shape))
        found.append((x, y, x + width, y + height))
        # The second crop lies at least one crop width away, so that it shows something else.
        sums[max(y - 2 * height + 1, 0) : y + 2 * height, max(x - 2 * width + 1, 0) : x + 2 * width] = -1
    return found


def sheet(title: str, shown: Sequence[Shown]) -> np.ndarray:
    """The picture, `[H, W, 3]` in 8 bits."""
    truth = shown[-1].image
    windows = crops(shown)
    left, top, right, bottom = windows[0]
    tile = (TILE, round(TILE * (bottom - top) / (right - left)))
    height = 2 * tile[1] + GAP
    whole = (round(truth.shape[1] * height / truth.shape[0]), height)
    size = (whole[0] + len(shown) * (GAP + TILE), height + 3 * LINE)
    page = Image.new("RGB", size, (255, 255, 255))
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(14)

    def text(x: int, width: int, line: int, words: str, color: tuple[int, int, int]) -> None:
        at = (x + (width - draw.textlength(words, font)) / 2, height + LINE * line + 1)
        draw.text(at, words, fill=color, font=font)

    page.paste(_picture(truth).resize(whole, Image.Resampling.LANCZOS))
    factor = height / truth.shape[0]
    for window, color in zip(windows, COLORS, strict=True):
        draw.rectangle([round(v * factor) for v in window], outline=color, width=3)
    text(0, whole[0], 0, title, (0, 0, 0))
    names = [METRICS[key].label for key in shown[1].values]
    text(0, whole[0], 1, f"beneath: {' and '.join(names)} of the whole frame", (110, 110, 110))
    best = {key: _best(key, [s.values.get(key) for s in shown]) for key in shown[1].values}
    for column, one in enumerate(shown):
        x = whole[0] + GAP + column * (GAP + TILE)
        for row, (window, color) in enumerate(zip(windows, COLORS, strict=True)):
            crop = _picture(one.image).crop(window).resize(tile, Image.Resampling.NEAREST)
            ImageDraw.Draw(crop).rectangle((0, 0, tile[0] - 1, tile[1] - 1), outline=color, width=2)
            page.paste(crop, (x, row * (tile[1] + GAP)))
        text(x, TILE, 0, one.name, (0, 0, 0))
        for line, (key, value) in enumerate(one.values.items(), 1):
            if value is not None:
                words = f"{value:.{METRICS[key].digits - (key == 'lpips')}f} {METRICS[key].unit}".strip()
                text(x, TILE, line, words, (0, 0, 0) if value == best[key] else (130, 130, 130))
    return np.asarray(page)


def _picture(image: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(255 * image).astype(np.uint8))


def _best(key: str, values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return (max if METRICS[key].higher_is_better else min)(known, default=None)


def write_figure(sequence: FrameSequence, config: Config) -> Path:
    """The picture of one scene.

    Raises:
        JaxsrError: as for `columns` and `find_method`; a picture too large for the documentation.
    """
    scene = sequence.name.split("-")[0]
    names = (*METHODS, config.network.replace("{scene}", scene))
    methods = [find_method(name, config.scale) for name in names]
    shown = columns(sequence, methods, config.scale, config.frame)
    file = config.out / f"fusion_sr_{scene}.png"
    write_png(file, sheet(f"{sequence.name}, frame {config.frame}, x{config.scale}", shown))
    if file.stat().st_size > MOST_BYTES:
        raise JaxsrError("too large", where=file, expected=f"{MOST_BYTES} bytes", found=file.stat().st_size)
    return file


def main(config: Config) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for path in unpack_sample(Path(folder), "test", config.scenes, config.scale):
            print(write_figure(FrameSequence.open(path), config))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"figures: {error}") from None
