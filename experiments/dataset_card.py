"""Writes docs/data_card.md from the sequences on disk and the measured noise floors."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path
from jaxsr.io.images import write_png
from jaxsr.io.sequence import Sequence
from jaxsr.io.truth import choose_truth
from jaxsr.ops.color import to_display

SETS = ("sample", "train", "test")

_TEXT = """# Data card

Made by `python experiments/make_datasets.py card` from the files themselves.

Three procedural scenes, built by `experiments/scenes/` in Blender and rendered by Cycles on the CPU:
**bunker** (interior: metal, spot lamps, machines), **forest** (foliage, sun and sky, thin geometry) and
**docks** (quay, ships, wet planks, water). They are named after the scenes of the papers, which are not
public, and share nothing with them but the subject. Everything is generated from code and a seed; there are
no textures or models from elsewhere. Licence of all pictures: {license}.

{pictures}

## What a frame holds

HR colour (a truth, aliased) and HR G-buffer without jitter; LR colour and LR G-buffer at each scale,
jittered by Halton (2, 3) of length 32. The G-buffer: linear depth, backward motion, world normal, base
colour, roughness, metallic, object id. All are point samples at pixel centres: no anti-aliasing, motion blur,
depth of field or tone mapping. The G-buffer is a render of its own at one sample per pixel; colour has the
samples below.

The `reference` is the other truth: HR colour of the same scene, frame and camera, without jitter,
anti-aliased by a Blackman-Harris filter (1.5 pixels in Blender, which is a support of 3 pixels), and denoised
where the colour is. Its samples per pixel:

| scene | training clips | test set | test clips of the sample |
|---|---|---|---|
{references}

## Sequences

| set | sequence | frames | HR size | scales | samples | denoised | bounces | seed | MB | CPU seconds |
|---|---|---|---|---|---|---|---|---|---|---|
{rows}

Total: {frames} frames, {megabytes:.1f} MB, {cpu:.0f} CPU seconds{note}. Blender {blender}.
References that were joined to sequences of an archive are not in the CPU seconds. The script can render two
more training clips of each scene (3 and 4), which the archives do not hold.
Training and test clips have camera paths, scene seeds and layouts of their own: they share no frames.

## Noise of the two truths

Two renders with different seeds; PSNR of display-referred colour with half their mean squared difference,
which estimates one render's distance from the noiseless image. For denoised clips the bias of the denoiser,
which both renders share, is not in it. Differences between methods near or above this number mean nothing.
The samples of a pixel of the reference are spread over more than a pixel, so it needs more of them than the
colour for the same noise. It is measured as the sample has it; the test set has fewer samples in its
references (see above), and its floor was not measured.

| truth | clip | samples | floor (dB) | by frame | size |
|---|---|---|---|---|---|
{floors}

## Limits

- Synthetic, three scenes; no characters, no transparency or refraction, constant focal length. The haze of
  the forest is light added by distance, not a volume; part of the ambient light of all scenes is emission.
- The archives are quantised; the table in `jaxsr/io/archive_coding.py` gives the errors of each layer.
- Mirror-like reflections move otherwise than the motion vectors, which follow the surface.
"""


def _size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*.exr"))


def _strip(sequences: list[Sequence], path: Path, width: int = 256) -> None:
    """The middle frame of each side by side, every few pixels of it."""
    shown = []
    for seq in sequences:
        truth = seq.truth(len(seq) // 2, choose_truth([seq]))
        image = np.asarray(to_display(truth, seq.exposure))
        height = round(width * seq.size[1] / seq.size[0])
        rows = (np.arange(height) * seq.size[1]) // height
        columns = (np.arange(width) * seq.size[0]) // width
        shown.append(image[rows][:, columns])
    write_png(path, np.concatenate([x[: min(s.shape[0] for s in shown)] for x in shown], 1))


def floor_rows(measured: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of the table of noise, from what `make_datasets.py floor` measured: by truth, then by clip."""
    return [
        f"| {truth} | {clip} | {e['samples']} | {e['psnr_db']} | "
        + ", ".join(f"{f}: {db}" for f, db in e["frames"].items())
        + f" | {e['size'][0]}x{e['size'][1]} |"
        for truth, clips in measured.items()
        for clip, e in clips.items()
    ]


def write(out: Path, floors: Path, docs: Path, references: Mapping[str, Iterable[int]]) -> Path:
    """Write the card and its pictures; returns its path.

    Args:
        out: the folder of the sets.
        floors: the file that `make_datasets.py floor` wrote.
        docs: the folder of the card.
        references: samples per pixel of the references of each scene, in the order of their table.

    Raises:
        JaxsrError: no sequences below `out`.
    """
    found = [(name, p.parent) for name in SETS for p in sorted((out / name).glob("*/sequence.json"))]
    if not found:
        raise JaxsrError("no sequences", where=out, fix="render some first")
    rows, pictures, total, cpu, frames, unknown = [], [], 0, 0.0, 0, 0
    versions, licenses = set(), set()
    by_kind: dict[str, dict[str, Sequence]] = {}
    for name, folder in found:
        seq, size = Sequence.open(folder), _size(folder)
        made: dict[str, Any] = seq.generator
        cost_file = folder / "render.json"
        cost = json.loads(cost_file.read_text())["cpu_seconds"] if cost_file.is_file() else None
        unknown += cost is None
        shown = "?" if cost is None else f"{cost:.0f}"
        scales = ", ".join(f"x{s}" for s in seq.scales)
        cells = [name, seq.name, len(seq), f"{seq.size[0]}x{seq.size[1]}", scales, made.get("samples", "?")]
        cells += ["yes" if made.get("denoise") else "no", made.get("bounces", "?"), made.get("seed", "?")]
        rows.append("| " + " | ".join(map(str, [*cells, f"{size / 1e6:.1f}", shown])) + " |")
        total, cpu, frames = total + size, cpu + (cost or 0), frames + len(seq)
        versions.add(str(made.get("blender", "?")))
        licenses.add(seq.license or "?")
        scene, split, _ = seq.name.rsplit("-", 2)
        by_kind.setdefault(split, {}).setdefault(scene, seq)
    for split, scenes in sorted(by_kind.items()):
        picture = docs / "images" / f"data_{split}.png"
        _strip(list(scenes.values()), picture)
        pictures.append(f"![{', '.join(scenes)}: {split} clips](images/{picture.name})")
    measured = json.loads(floors.read_text()) if floors.is_file() else {}
    text = _TEXT.format(
        license=", ".join(sorted(licenses)),
        pictures="\n\n".join(pictures),
        rows="\n".join(rows),
        frames=frames,
        megabytes=total / 1e6,
        cpu=cpu,
        note=f" ({unknown} sequences came from an archive, without their cost)" if unknown else "",
        blender=", ".join(sorted(versions)),
        references="\n".join(f"| {s} | {' | '.join(map(str, n))} |" for s, n in references.items()),
        floors="\n".join(floor_rows(measured)) or "| not measured | | | | | |",
    )
    path = docs / "data_card.md"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path
