"""Look through a sequence: what is in it, whether it means what jaxsr takes it for, what is missing.

`inspect` reads frames (all, or evenly chosen stretches of a long sequence), counts, and tries conventions
(`jaxsr.evaluation.conventions`); faults become findings, not exceptions, except where there is no sequence
at all. It changes nothing. `print_report` shows it to a person, `Report.to_json` to a machine.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxsr.errors import JaxsrError
from jaxsr.evaluation import conventions as cv
from jaxsr.io.exr import read_exr
from jaxsr.io.sequence import Sequence
from jaxsr.io.writing import LAYERS, frame_file

Level = Literal["ok", "warn", "bad"]

TIE = 1.15
"""Two readings whose errors differ by less than this factor cannot be told apart."""


@dataclass
class Finding:
    """One verdict. `level`: "ok", "warn" (cannot tell, or may be meant), "bad" (methods would go wrong)."""

    topic: str
    level: Level
    text: str
    data: dict[str, Any] = field(default_factory=dict)


@dataclass
class BufferStats:
    """One layer of one resolution over the frames that were read. Range and mean are of finite values."""

    resolution: str
    layer: str
    size: str
    dtype: str
    low: float = math.inf
    high: float = -math.inf
    mean: float = 0.0
    nan: int = 0
    inf: int = 0
    sky_share: float = 0.0
    frames: int = 0

    def add(self, x: np.ndarray, sky: float) -> None:
        finite = np.isfinite(x)
        self.nan += int(np.isnan(x).sum())
        self.inf += int(np.isinf(x).sum())
        if finite.any():
            values = x[finite].astype(np.float64)
            self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
            self.mean += (float(values.mean()) - self.mean) / (self.frames + 1)
        self.sky_share += (sky - self.sky_share) / (self.frames + 1)
        self.frames += 1


@dataclass
class Report:
    """What `inspect` found."""

    path: str
    name: str
    size: tuple[int, int]
    scales: tuple[int, ...]
    frames: int
    frames_read: list[int]
    """Indices of the frames that were looked at."""
    findings: list[Finding]
    buffers: list[BufferStats]
    missing: dict[str, list[str]]
    """Method -> buffers that it needs and the sequence lacks."""

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


@dataclass
class _Evidence:
    """Collected over pairs of frames."""

    motion: list[cv.MotionEvidence] = field(default_factory=list)
    jitter: dict[int, list[tuple[np.ndarray, dict[str, float], np.ndarray]]] = field(default_factory=dict)
    lr_motion: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    normal: list[dict[str, float]] = field(default_factory=list)
    normal_length: list[float] = field(default_factory=list)
    sky_values: set[float] = field(default_factory=set)


def inspect(
    sequence: Sequence, needs: Mapping[str, frozenset[str]] | None = None, *, max_frames: int = 12
) -> Report:
    """Read and judge a sequence.

    Args:
        sequence: open it with `check=False`, or NaN and Inf raise instead of being counted.
        needs: method -> buffers such as "lr.color", "hr.base_color"; to say which methods can run.
        max_frames: how many frames are read at most; pairs of neighbours, evenly spread.
    """
    evidence, faults = _Evidence(), []
    stats: dict[tuple[str, str], BufferStats] = {}
    chosen = _choose(len(sequence), max_frames)
    last: tuple[int, dict[str, dict[str, np.ndarray]]] | None = None
    pairs = []
    for i in chosen:
        images = {}
        for resolution in sequence.resolutions:
            try:
                images[resolution] = _read(sequence, i, resolution, stats)
            except JaxsrError as e:
                faults.append(str(e))
        _single(sequence, i, images, evidence)
        if last is not None and last[0] == i - 1 and not sequence.infos[i].cut:
            _pair(sequence, i, images, last[1], evidence)
            if "hr" in images and "hr" in last[1]:
                pairs.append((i, images["hr"]))
        last = (i, images)
    findings = [_files(sequence, chosen, faults), *_values(stats, evidence)]
    motion, convention = _judge_motion(evidence.motion)
    findings += [motion, _judge_camera(sequence, pairs[-1:], convention)]
    findings += [_judge_lr_motion(s, e) for s, e in evidence.lr_motion.items() if e]
    findings += [_judge_jitter(s, e) for s, e in evidence.jitter.items()]
    findings += _judge_normal(evidence)
    missing = {name: _lacks(sequence, set(wanted), stats) for name, wanted in (needs or {}).items()}
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
        console.print(f"[green]✔[/] can run: {', '.join(able)}", highlight=False)
    for name, lacks in report.missing.items():
        if lacks:
            console.print(f"[red]✘[/] {name} lacks {', '.join(lacks)}", highlight=False)


def _choose(count: int, most: int) -> list[int]:
    if count <= most:
        return list(range(count))
    starts = np.unique(np.linspace(0, count - 2, max(most // 2, 1)).astype(int))
    return sorted({int(i) for s in starts for i in (s, s + 1)})


def _read(sequence: Sequence, i: int, resolution: str, stats: dict) -> dict[str, np.ndarray]:
    channels, _ = read_exr(frame_file(sequence.path, resolution, sequence.infos[i].index))
    stored = {
        layer: [channels[f"{layer}.{c}"] for c in letters]
        for layer, letters in LAYERS.items()
        if all(f"{layer}.{c}" in channels for c in letters)
    }
    images = {layer: np.stack([p.astype(np.float32) for p in planes], -1) for layer, planes in stored.items()}
    sky = float(cv.is_sky(images["depth"]).mean()) if "depth" in images else 0.0
    for layer, x in images.items():
        size = f"{x.shape[1]}x{x.shape[0]}"
        new = BufferStats(resolution, layer, size, str(stored[layer][0].dtype))
        stats.setdefault((resolution, layer), new).add(x, sky)
    scale = 1 if resolution == "hr" else int(resolution[1:])
    expected = (sequence.size[1] // scale, sequence.size[0] // scale)
    where = frame_file(sequence.path, resolution, sequence.infos[i].index)
    for layer in ("depth", "motion") if resolution == "hr" else ("color", "depth", "motion"):
        if layer not in images:
            found = ", ".join(images) or "none that jaxsr knows"
            raise JaxsrError(f"missing layer {layer!r}", where=where, found=f"layers {found}")
    for layer, x in images.items():
        if x.shape[:2] != expected:
            raise JaxsrError(
                f"layer {layer!r} has the wrong size", where=where, expected=expected, found=x.shape[:2]
            )
    return images


def _single(
    sequence: Sequence, i: int, images: Mapping[str, Mapping[str, np.ndarray]], to: _Evidence
) -> None:
    info = sequence.infos[i]
    for scale in (s for s in sequence.scales if s > 1):
        if f"x{scale}" in images and "hr" in images:
            stated = np.asarray(info.jitter_px, float)
            errors, best = cv.jitter_evidence(images[f"x{scale}"], images["hr"], stated, scale)
            to.jitter.setdefault(scale, [])
            if best is not None:
                to.jitter[scale].append((stated, errors, best))
    hr = images.get("hr", {})
    if not hr:
        return
    finite = hr["depth"][np.isfinite(hr["depth"])]
    if finite.size and np.isfinite(hr["depth"]).all() and cv.is_sky(hr["depth"]).any():
        to.sky_values.add(float(finite.max()))
    if "normal" in hr:
        solid = ~cv.is_sky(hr["depth"])[..., 0]
        if solid.any():
            length = np.linalg.norm(hr["normal"][solid].astype(np.float64), axis=-1)
            to.normal_length.append(float(np.quantile(np.abs(length - 1), 0.9)))
        to.normal.append(cv.normal_evidence(hr["depth"], hr["normal"], info))


def _pair(
    sequence: Sequence,
    i: int,
    images: Mapping[str, Mapping[str, np.ndarray]],
    before: Mapping[str, Mapping[str, np.ndarray]],
    to: _Evidence,
) -> None:
    now, then = sequence.infos[i], sequence.infos[i - 1]
    if "hr" in images and "hr" in before:
        to.motion.append(cv.motion_evidence(images["hr"], before["hr"], now, then))
    for scale in (s for s in sequence.scales if s > 1):
        if f"x{scale}" in images and "hr" in images:
            jitters = np.asarray(now.jitter_px, float), np.asarray(then.jitter_px, float)
            errors = cv.lr_motion_evidence(images[f"x{scale}"], images["hr"], *jitters, scale)
            if errors:
                to.lr_motion.setdefault(scale, []).append(errors)


def _files(sequence: Sequence, chosen: list[int], faults: list[str]) -> Finding:
    if not faults:
        count = len(chosen) * len(sequence.resolutions)
        return Finding(
            "files", "ok", f"{count} of {len(sequence) * len(sequence.resolutions)} read, all whole"
        )
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return Finding("files", "bad", faults[0] + more, {"faults": faults})


def _values(stats: Mapping[Any, BufferStats], evidence: _Evidence) -> list[Finding]:
    """Numbers that cannot be meant: NaN, Inf, negative depth, colours of surfaces outside 0..1."""
    wrong: list[str] = []
    for b in stats.values():
        place = f"{b.resolution}.{b.layer}"
        if b.nan or (b.inf and b.layer != "depth"):
            wrong.append(f"{place} holds {b.nan} NaN and {b.inf} Inf")
        if b.layer == "depth" and b.low <= 0:
            wrong.append(f"{place} goes down to {b.low:.4g}: depth must be positive, +inf for sky")
        if b.layer in ("base_color", "roughness", "metallic") and (b.low < -0.01 or b.high > 1.01):
            wrong.append(f"{place} runs from {b.low:.4g} to {b.high:.4g}, outside 0..1")
        if b.layer == "color" and b.high <= 0:
            wrong.append(f"{place} is black")
    if evidence.sky_values:
        value = max(evidence.sky_values)
        wrong.append(f"sky seems to be stored as depth {value:.4g}: it must be +inf")
    if wrong:
        return [Finding("values", "bad", "; ".join(wrong), {"wrong": wrong})]
    return [Finding("values", "ok", "finite and in range in every buffer")]


def _judge_motion(evidence: list[cv.MotionEvidence]) -> tuple[Finding, cv.MotionConvention | None]:
    """Which convention fits; None where there is no telling."""
    if not evidence:
        return Finding("motion", "warn", "cannot tell: no two consecutive frames"), None
    change = float(np.mean([e.image_change for e in evidence]))
    camera_px = float(np.mean([e.camera_px for e in evidence]))
    data: dict[str, Any] = {"pairs": len(evidence), "image_change": change, "camera_px": camera_px}
    if not any(e.moves for e in evidence):
        if camera_px > 0.05 or change > 0.05:
            text = f"zero everywhere, yet the images change (the camera moves points by {camera_px:.2g} px)"
            fix = ": it was not exported (Blender writes zeros when motion blur is on)"
            return Finding("motion", "bad", text + fix, data | {"convention": None}), None
        return Finding("motion", "warn", "cannot tell: nothing moves", data | {"convention": None}), None

    usable = [e for e in evidence if len(e.image) == len(cv.CONVENTIONS)]
    if not usable:
        return Finding(
            "motion", "warn", "cannot tell: the images are flat", data | {"convention": None}
        ), None
    scores = [_scores(e) for e in usable]
    total = {
        c: float(np.exp(np.mean([np.log(s[c]) for s in scores]))) for c in cv.CONVENTIONS if c in scores[0]
    }
    best = min(total, key=lambda c: total[c])
    # Under constant motion forward and backward look alike; of equals take ours, then the backward one.
    for preferred in (cv.CANONICAL, dataclasses.replace(best, forward=False)):
        if total[preferred] <= TIE * total[best]:
            best = preferred
            break
    ranked = sorted(total, key=lambda c: total[c])
    rivals = [c for c in ranked if c != best and total[c] < TIE * total[best]]
    second = next((c for c in ranked if c != best and c not in rivals), ranked[-1])
    margin = total[second] / total[best]
    votes = sum(s[best] <= TIE * min(s.values()) for s in scores) / len(scores)
    sure = not rivals and votes >= 0.7 and total[best] < 0.8
    data |= {
        "convention": best.name,
        "sure": sure,
        "error": total[best],
        "second": second.name,
        "margin": margin,
        "votes": votes,
        "rivals": [c.name for c in rivals],
        "errors": {c.name: total[c] for c in ranked[:12]},
        "image_errors": {c.name: _mean(e.image[c] for e in usable) for c in ranked[:12]},
        "camera_errors_px": {c.name: _mean(e.camera[c] for e in usable) for c in ranked[:12]},
    }
    if total[best] >= 0.8:
        texture = (
            "the images are flat or hardly change" if change < 0.05 else "no reading explains the images"
        )
        data["convention"] = None
        return Finding("motion", "warn" if change < 0.05 else "bad", f"cannot tell: {texture}", data), None
    how = "sure" if sure else "not quite sure"
    text = (
        f"{best.name} ({how}: {votes:.0%} of {len(scores)} pairs; the warp leaves "
        f"{data['image_errors'][best.name]:.0%} of the difference; {second.name!r} is {min(margin, 999):.3g} "
        "times worse)"
    )
    if rivals:
        text += f"; as good: {' | '.join(c.name for c in rivals[:3])}"
    if best != cv.CANONICAL:
        text += f"; jaxsr takes it for {cv.CANONICAL.name}: convert it"
        return Finding("motion", "bad", text, data), best
    return Finding("motion", "ok" if sure else "warn", text, data), best


def _scores(e: cv.MotionEvidence) -> dict[cv.MotionConvention, float]:
    """Image error relative to no motion, times the camera's where the camera explains the motion."""
    floor = 0.002 + 0.003 * e.camera_px
    explains = e.camera_px > 0.05 and min(e.camera.values()) < 0.15 * e.camera_px
    return {
        c: (image + 1e-3) * ((e.camera[c] + floor) / (e.camera_px + floor) if explains else 1.0)
        for c, image in e.image.items()
    }


def _judge_camera(
    sequence: Sequence, pairs: list[tuple[int, dict[str, np.ndarray]]], convention: cv.MotionConvention | None
) -> Finding:
    """Does what stands still move as camera and depth say? Needs a motion whose convention is known."""
    if not pairs or convention is None or convention.forward:
        return Finding("camera and depth", "warn", "cannot tell without backward motion that is understood")
    i, hr = pairs[0]
    motion = convention.to_pixels(cv.finite_or_zero(hr["motion"]), sequence.size)
    errors = cv.camera_evidence(hr["depth"], motion, sequence.infos[i], sequence.infos[i - 1])
    if not errors:
        return Finding("camera and depth", "warn", "cannot tell: all is sky")
    camera, depth = best = min(errors, key=lambda k: errors[k])
    stated = next(iter(errors))
    data = {"camera": camera, "depth": depth, "error": errors[best], "error_as_stated": errors[stated]}
    if errors[stated] <= max(TIE * errors[best], 0.01):
        best, (camera, depth) = stated, stated
    data |= {"camera": camera, "depth": depth}
    if errors[best] > 0.25:
        text = (
            "points do not move as camera and depth say: one of them is wrong, or everything moves by itself"
        )
        return Finding(
            "camera and depth", "warn", f"{text} (median error {errors[best]:.0%} of motion)", data
        )
    text = f"static points agree with the motion (median error {errors[best]:.2%} of it)"
    if best == stated:
        return Finding("camera and depth", "ok", f"linear view depth, camera as stated: {text}", data)
    return Finding(
        "camera and depth", "bad", f"depth reads as {depth}, camera as {camera}: then {text}", data
    )


def _judge_lr_motion(scale: int, evidence: list[dict[str, float]]) -> Finding:
    mean = {name: _mean(e[name] for e in evidence) for name in evidence[0]}
    best, stated = min(mean, key=lambda n: mean[n]), next(iter(mean))
    if mean[stated] <= TIE * mean[best] or mean[stated] < 0.01:
        best = stated
    text = f"{best} (median {mean[best]:.3g} px from the HR motion)"
    data = {"reading": best, "errors_px": mean}
    if mean[best] > 0.3:
        return Finding(f"LR motion x{scale}", "warn", f"does not follow from the HR motion: {text}", data)
    return Finding(f"LR motion x{scale}", "ok" if best == stated else "bad", text, data)


def _judge_jitter(scale: int, evidence: list[tuple[np.ndarray, dict[str, float], np.ndarray]]) -> Finding:
    topic = f"jitter x{scale}"
    if not evidence:
        return Finding(topic, "warn", "cannot tell: the G-buffers are flat", {"reading": None})
    mean = {name: _mean(e[name] for _, e, _ in evidence) for name in evidence[0][1]}
    stated = np.array([s for s, _, _ in evidence])
    found = np.array([b for _, _, b in evidence])
    off = float(np.median(np.abs(found - stated).max(-1)))
    ranked = sorted(mean, key=lambda n: mean[n])
    best = "as stated" if mean["as stated"] <= TIE * mean[ranked[0]] else ranked[0]
    data = {"reading": best, "errors": mean, "median_off_px": off, "found": found, "stated": stated}
    numbers = f"stated and measured differ by {off:.3g} LR px (median of {len(evidence)} frames)"
    if not np.abs(stated).max() > 1e-6:
        fits = off < 0.06
        text = "none stated, none found" if fits else f"none stated, but the LR images are shifted: {numbers}"
        return Finding(topic, "ok" if fits else "bad", text, data)
    if best == "as stated" and off < 0.06:
        return Finding(topic, "ok", f"the metadata fits: {numbers}", data)
    if best == "as stated":
        return Finding(topic, "warn", f"the metadata fits roughly: {numbers}", data)
    return Finding(topic, "bad", f"the metadata does not fit: LR G-buffers say {best!r}; {numbers}", data)


def _judge_normal(evidence: _Evidence) -> list[Finding]:
    if not evidence.normal:
        return []
    length = _mean(evidence.normal_length) if evidence.normal_length else 0.0
    known = [e for e in evidence.normal if e]
    if not known:
        return [Finding("normal", "warn", "cannot tell: no smooth surface", {"off_unit_length": length})]
    mean = {name: _mean(e[name] for e in known) for name in known[0]}
    best, stated = min(mean, key=lambda n: mean[n]), next(iter(mean))
    best = stated if mean[stated] <= mean[best] + 2 else best
    data = {"reading": best, "angles": mean, "off_unit_length": length}
    text = f"{best} (median {mean[best]:.2g} degrees from the surface in depth)"
    if best != stated and mean[best] < 20:
        return [Finding("normal", "bad", f"{text}; jaxsr takes it for {stated}: convert it", data)]
    if mean[best] >= 20:
        text = f"does not agree with depth and camera in any space: at best {text}"
        return [Finding("normal", "warn", text, data)]
    if length > 0.02:
        return [Finding("normal", "bad", f"{text}, but not of unit length (off by {length:.2g})", data)]
    return [Finding("normal", "ok", f"{text}, unit length", data)]


def _lacks(sequence: Sequence, wanted: set[str], stats: Mapping[tuple[str, str], BufferStats]) -> list[str]:
    have = {f"hr.{layer}" for place, layer in stats if place == "hr"}
    small = [r for r in sequence.resolutions if r != "hr"] or ["hr"]
    have |= {f"lr.{layer}" for layer in LAYERS if all((place, layer) in stats for place in small)}
    return sorted(wanted - have)


def _mean(values: Any) -> float:
    return float(np.mean(list(values)))


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
