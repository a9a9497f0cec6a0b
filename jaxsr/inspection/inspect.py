"""Check a sequence: its buffers, whether they follow jaxsr's conventions, and which buffers are missing.

`inspect` reads frames (all, or evenly chosen stretches of a long sequence), counts, and tries conventions
(`jaxsr.inspection.conventions`); faults become findings; only a folder that is not a sequence
raises. No file is changed. `print_report` prints the report, `Report.to_json` returns it as plain values.
"""

import dataclasses
import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxsr.errors import JaxsrError
from jaxsr.inspection import conventions as cv
from jaxsr.inspection.images import is_sky
from jaxsr.inspection.verdicts import (
    BufferStats,
    Evidence,
    Finding,
    Level,
    judge_camera,
    judge_files,
    judge_jitter,
    judge_lr_motion,
    judge_motion,
    judge_normal,
    judge_values,
)
from jaxsr.io.description import check_info
from jaxsr.io.exr import read_exr
from jaxsr.io.sequence import Sequence
from jaxsr.io.writing import frame_file
from jaxsr.layers import DERIVED, LAYERS, channels


@dataclass
class Report:
    """The result of `inspect`."""

    path: str
    name: str
    size: tuple[int, int]
    scales: tuple[int, ...]
    frames: int
    frames_read: list[int]
    """Indices of the frames that were read."""
    findings: list[Finding]
    buffers: list[BufferStats]
    missing: dict[str, list[str]]
    """Method -> the buffers that it needs and that the sequence lacks."""

    def finding(self, topic: str) -> Finding:
        """The finding on "files", "motion", "camera", "depth", "normal", "jitter x2", "LR motion x2", ..."""
        return next(f for f in self.findings if f.topic == topic)

    @property
    def level(self) -> Level:
        """The worst of the findings."""
        levels = {f.level for f in self.findings}
        return "bad" if "bad" in levels else "warn" if "warn" in levels else "ok"

    def to_json(self) -> dict[str, Any]:
        """Plain values for `json.dumps`; infinities and NaN are written as strings."""
        return _plain(dataclasses.asdict(self) | {"level": self.level})


def inspect(
    sequence: Sequence, needs: Mapping[str, frozenset[str]] | None = None, *, max_frames: int = 12
) -> Report:
    """Read and judge a sequence.

    Args:
        sequence: open it with `check=False`, or NaN and Inf raise instead of being counted.
        needs: method -> its buffers, such as "lr.color" or "hr.base_color", to report which methods can run.
        max_frames: the largest number of frames to read; they are pairs of neighbours, evenly spread.
    """
    evidence, faults = Evidence(), []
    stats: dict[tuple[str, str], BufferStats] = {}
    chosen = _choose(len(sequence), max_frames)
    last: tuple[int, dict[str, dict[str, np.ndarray]]] | None = None
    pairs = []
    layers: dict[str, dict[int, Set[str]]] = {resolution: {} for resolution in sequence.resolutions}
    for i in chosen:
        images = {}
        for resolution in sequence.resolutions:
            try:
                images[resolution] = _read(sequence, i, resolution, stats)
            except JaxsrError as e:
                faults.append(str(e))
                continue
            layers[resolution][i] = images[resolution].keys()
        _single(sequence, i, images, evidence)
        if last is not None and last[0] == i - 1 and not sequence.infos[i].reset:
            _pair(sequence, i, images, last[1], evidence)
            main = _main(sequence, images)
            if main is not None and main in last[1]:
                pairs.append((i, images[main]))
        last = (i, images)
    absent = _absent(sequence, layers)
    faults += map(str, absent.values())
    findings = [judge_files(sequence, chosen, faults), *judge_values(stats, evidence)]
    motion, convention = judge_motion(evidence.motion)
    findings += [motion, judge_camera(sequence, pairs[-1:], convention)]
    findings += [judge_lr_motion(s, e) for s, e in evidence.lr_motion.items() if e]
    findings += [judge_jitter(s, e) for s, e in evidence.jitter.items()]
    findings += judge_normal(evidence)
    far = [info for info in sequence.infos if np.abs(np.asarray(info.jitter_px)).max() > 0.5 + 1e-6]
    if far:
        x, y = (float(v) for v in far[0].jitter_px)
        text = (
            f"{len(far)} frames state more than half an LR pixel, first frame {far[0].index}: ({x:g}, {y:g})"
        )
        findings.append(Finding("jitter range", "bad", f"{text}; expected each within [-0.5, 0.5]"))
    findings += _judge_matrices(sequence)
    whole = stats.keys() - absent.keys()
    missing = {
        name: _lacks(sequence, set(wanted), whole, stats.keys()) for name, wanted in (needs or {}).items()
    }
    return Report(
        path=str(sequence.path),
        name=sequence.name,
        size=sequence.size,
        scales=sequence.scales,
        frames=len(sequence),
        frames_read=[sequence.infos[i].index for i in chosen],
        findings=findings,
        buffers=list(stats.values()),
        missing=missing,
    )


def print_report(report: Report, console: Console | None = None) -> None:
    """Verdicts first, then the buffers, then the methods: about one screen."""
    console = console or Console()
    marks = {"ok": "[green]✔[/]", "warn": "[yellow]?[/]", "bad": "[red]✘[/]"}
    w, h = report.size
    scales = ", ".join(f"x{s}" for s in report.scales) or "none"
    console.print(
        f"[bold]{escape(report.name)}[/]  {report.frames} frames, HR {w}x{h}, scales {scales}",
        highlight=False,
    )
    verdicts = Table.grid(padding=(0, 1))
    for f in report.findings:
        verdicts.add_row(marks[f.level], f"[bold]{f.topic}[/]", escape(f.text))
    console.print(verdicts, highlight=False)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("buffer", "size", "type", "min", "max", "mean", "NaN", "Inf", "sky"):
        table.add_column(
            title, justify="left" if title in ("buffer", "size", "type") else "right", no_wrap=True
        )
    for b in report.buffers:
        sky = f"{b.sky_share:.0%}" if b.layer == "depth" else ""
        nan = f"[red]{b.nan}[/]" if b.nan else "0"
        numbers = [f"{x:.4g}" for x in (b.low, b.high, b.mean)]
        table.add_row(f"{b.resolution}.{b.layer}", b.size, b.dtype, *numbers, nan, str(b.inf), sky)
    console.print(table)
    able = [name for name, lacks in report.missing.items() if not lacks]
    if able:
        whole = report.level != "bad"
        can = "[green]✔[/] can run" if whole else "[yellow]?[/] have their buffers, once the above is mended"
        console.print(f"{can}: {', '.join(able)}", highlight=False)
    for name, lacks in report.missing.items():
        if lacks:
            console.print(f"[red]✘[/] {name} lacks {', '.join(lacks)}", highlight=False)


def _choose(count: int, most: int) -> list[int]:
    if count <= most:
        return list(range(count))
    starts = np.unique(np.linspace(0, count - 2, max(most // 2, 1)).astype(int))
    return sorted({int(i) for s in starts for i in (s, s + 1)})


def _read(sequence: Sequence, i: int, resolution: str, stats: dict) -> dict[str, np.ndarray]:
    where = frame_file(sequence.path, resolution, sequence.infos[i].index)
    scale = 1 if resolution == "hr" else int(resolution[1:])
    width, height = sequence.size
    because = f"sequence.json: HR {width}x{height}, scale {scale}"
    planes, _ = read_exr(where, size=(height // scale, width // scale), because=because)
    stored = {
        layer: [planes[name] for name in channels(layer)]
        for layer in LAYERS
        if planes.keys() >= set(channels(layer))
    }
    images = {layer: np.stack([p.astype(np.float32) for p in of], -1) for layer, of in stored.items()}
    sky = float(is_sky(images["depth"]).mean()) if "depth" in images else 0.0
    for layer, x in images.items():
        size = f"{x.shape[1]}x{x.shape[0]}"
        new = BufferStats(resolution, layer, size, str(stored[layer][0].dtype))
        stats.setdefault((resolution, layer), new).add(x, sky)
    for layer in LAYERS:
        lost = [name for name in channels(layer) if name not in planes]
        if 0 < len(lost) < len(channels(layer)):
            raise JaxsrError(f"layer {layer!r} lacks channel {lost[0]!r}", where=where, fix="export it again")
    if resolution != "hr" and "color" not in images:
        found = ", ".join(images) or "none that jaxsr knows"
        raise JaxsrError("missing layer 'color'", where=where, found=f"layers {found}")
    return images


def _main(sequence: Sequence, images: Mapping[str, Mapping[str, np.ndarray]]) -> str | None:
    """The largest resolution that has depth and motion in this frame; both are tested there."""
    places = sorted(sequence.resolutions, key=lambda r: 1 if r == "hr" else int(r[1:]))
    return next((p for p in places if images.get(p, {}).keys() >= {"depth", "motion"}), None)


def _judge_matrices(sequence: Sequence) -> list[Finding]:
    """A finding if a camera is not rigid, which opening a sequence without checks accepts."""
    faults = []
    for info in sequence.infos:
        try:
            check_info(replace(info, jitter_px=(0.0, 0.0)), "sequence.json")
        except JaxsrError as e:
            faults.append(str(e))
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return [Finding("camera matrix", "bad", faults[0] + more, {"faults": faults})] if faults else []


def _single(sequence: Sequence, i: int, images: Mapping[str, Mapping[str, np.ndarray]], to: Evidence) -> None:
    info = sequence.infos[i]
    hr = images.get("hr", {})
    for scale in (s for s in sequence.scales if s > 1):
        if "depth" in images.get(f"x{scale}", {}) and "depth" in hr:
            stated = np.asarray(info.jitter_px, float)
            errors, best = cv.jitter_evidence(images[f"x{scale}"], hr, stated, scale)
            to.jitter.setdefault(scale, [])
            if best is not None:
                to.jitter[scale].append((stated, errors, best))
    main = images.get(_main(sequence, images) or "", {})
    if not main:
        return
    finite = main["depth"][np.isfinite(main["depth"])]
    if finite.size and np.isfinite(main["depth"]).all() and is_sky(main["depth"]).any():
        to.sky_values.add(float(finite.max()))
    if "normal" in main:
        solid = ~is_sky(main["depth"])[..., 0]
        if solid.any():
            length = np.linalg.norm(main["normal"][solid].astype(np.float64), axis=-1)
            to.normal_length.append(float(np.quantile(np.abs(length - 1), 0.9)))
        if info.has_camera:
            to.normal.append(cv.normal_evidence(main["depth"], main["normal"], info))


def _pair(
    sequence: Sequence,
    i: int,
    images: Mapping[str, Mapping[str, np.ndarray]],
    before: Mapping[str, Mapping[str, np.ndarray]],
    to: Evidence,
) -> None:
    now, then = sequence.infos[i], sequence.infos[i - 1]
    jitters = np.asarray(now.jitter_px, float), np.asarray(then.jitter_px, float)
    main = _main(sequence, images)
    if main is not None and main == _main(sequence, before):
        delta = jitters[1] - jitters[0] if main != "hr" else np.zeros(2)
        to.motion.append(cv.motion_evidence(images[main], before[main], now, then, delta))
    for scale in (s for s in sequence.scales if s > 1):
        lr, hr = images.get(f"x{scale}", {}), images.get("hr", {})
        if lr.keys() >= {"depth", "motion"} and hr.keys() >= {"depth", "motion"}:
            errors = cv.lr_motion_evidence(lr, hr, *jitters, scale)
            if errors:
                to.lr_motion.setdefault(scale, []).append(errors)


def _absent(
    sequence: Sequence, layers: Mapping[str, Mapping[int, Set[str]]]
) -> dict[tuple[str, str], JaxsrError]:
    """Layers that only some frames have: resolution and layer -> the first frame that lacks it."""
    found = {}
    for resolution, of in layers.items():
        for layer in LAYERS:
            lack = [i for i, have in of.items() if layer not in have]
            if 0 < len(lack) < len(of):
                where = frame_file(sequence.path, resolution, sequence.infos[lack[0]].index)
                others = f"in {len(of) - len(lack)} other frames"
                found[resolution, layer] = JaxsrError(f"missing layer {layer!r}", where=where, found=others)
    return found


def _lacks(
    sequence: Sequence, wanted: set[str], whole: Set[tuple[str, str]], somewhere: Set[tuple[str, str]]
) -> list[str]:
    """The wanted buffers that some frames lack and that cannot be derived.

    Args:
        whole, somewhere: resolutions and layers that all frames have, and that some have.
    """
    have = {f"hr.{layer}" for place, layer in whole if place == "hr"}
    small = [r for r in sequence.resolutions if r != "hr"] or ["hr"]
    have |= {f"lr.{layer}" for layer in LAYERS if all((place, layer) in whole for place in small)}
    if small != ["hr"] and have >= {f"lr.{layer}" for layer in DERIVED}:
        have |= {f"hr.{layer}" for layer in DERIVED if ("hr", layer) not in somewhere}
    return sorted(wanted - have)


def _plain(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, np.ndarray | np.generic):
        return _plain(x.tolist())
    if isinstance(x, float) and not math.isfinite(x):
        return str(x)
    return x
