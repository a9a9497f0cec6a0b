"""Verdicts from the evidence: which convention fits, how sure this is, and what to do.

Functions of `Evidence` (collected over the frames by `jaxsr.inspection.inspect`); no files.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from jaxsr.inspection import conventions as cv
from jaxsr.inspection import images
from jaxsr.io.sequence import Sequence

Level = Literal["ok", "warn", "bad"]

TIE = 1.15
"""Two readings whose errors differ by less than this factor cannot be told apart."""
OFF_PX = 0.12
"""Measured jitter may differ by this much, because fine texture is aliased in the measured buffers."""
FORWARD_TIE = 1.4
"""The same for forward and backward motion of otherwise one reading."""


@dataclass
class Finding:
    """One verdict. `level`: "ok", "warn" (undecided, or perhaps intended), "bad" (methods would go wrong)."""

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
        if np.isneginf(x).any():
            self.low = -math.inf
        if finite.any():
            values = x[finite].astype(np.float64)
            self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
            self.mean += (float(values.mean()) - self.mean) / (self.frames + 1)
        self.sky_share += (sky - self.sky_share) / (self.frames + 1)
        self.frames += 1


@dataclass
class Evidence:
    """Collected over pairs of frames."""

    motion: list[cv.MotionEvidence] = field(default_factory=list)
    jitter: dict[int, list[tuple[np.ndarray, dict[str, float], np.ndarray]]] = field(default_factory=dict)
    lr_motion: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    normal: list[dict[str, float]] = field(default_factory=list)
    normal_length: list[float] = field(default_factory=list)
    sky_values: set[float] = field(default_factory=set)


def judge_files(sequence: Sequence, chosen: list[int], faults: list[str]) -> Finding:
    if not faults:
        count = len(chosen) * len(sequence.resolutions)
        return Finding(
            "files", "ok", f"{count} of {len(sequence) * len(sequence.resolutions)} read, all whole"
        )
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return Finding("files", "bad", faults[0] + more, {"faults": faults})


def judge_values(stats: Mapping[Any, BufferStats], evidence: Evidence) -> list[Finding]:
    """Invalid values: NaN, Inf, negative depth, colours of surfaces outside 0..1."""
    wrong: list[str] = []
    odd: list[str] = []
    for b in stats.values():
        place = f"{b.resolution}.{b.layer}"
        if b.nan or (b.inf and b.layer != "depth"):
            wrong.append(f"{place} holds {b.nan} NaN and {b.inf} Inf")
        if b.layer == "depth" and b.low <= 0:
            wrong.append(f"{place} goes down to {b.low:.4g}: depth must be positive, +inf for sky")
        if b.layer in ("base_color", "roughness", "metallic") and (b.low < -0.01 or b.high > 1.01):
            odd.append(f"{place} runs from {b.low:.4g} to {b.high:.4g}, outside 0..1")
        if b.layer == "color" and b.high <= 0:
            wrong.append(f"{place} is black")
    if evidence.sky_values:
        value = max(evidence.sky_values)
        wrong.append(f"sky seems to be stored as depth {value:.4g}: it must be +inf")
    if wrong or odd:
        return [
            Finding(
                "values", "bad" if wrong else "warn", "; ".join(wrong + odd), {"wrong": wrong, "odd": odd}
            )
        ]
    return [Finding("values", "ok", "finite and in range in every buffer")]


def judge_motion(evidence: list[cv.MotionEvidence]) -> tuple[Finding, cv.MotionConvention | None]:
    """The convention that fits, or None if it cannot be decided."""
    if not evidence:
        return Finding("motion", "warn", "cannot tell: no two consecutive frames"), None
    change = float(np.mean([e.image_change for e in evidence]))
    camera_px = float(np.mean([e.camera_px for e in evidence]))
    data: dict[str, Any] = {"pairs": len(evidence), "image_change": change, "camera_px": camera_px}
    if not any(e.moves for e in evidence):
        if camera_px > 0.05 or change > 0.05:
            seen = (
                f"the camera moves points by {camera_px:.2g} px" if camera_px > 0.05 else "the images change"
            )
            text = f"zero everywhere, yet {seen}"
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
    # Among equals prefer jaxsr's, then backward: under constant motion forward looks like backward.
    if total[cv.CANONICAL] <= TIE * total[best]:
        best = cv.CANONICAL
    backward = dataclasses.replace(best, forward=False)
    if total[backward] <= FORWARD_TIE * total[best]:
        best = backward
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
        f"{best.name} ({how}: {votes:.0%} of {len(scores)} pairs; judged by {_decided(usable)}, the warp "
        f"leaves {data['image_errors'][best.name]:.0%} of the difference; {second.name!r} is "
        f"{min(margin, 999):.3g} times worse)"
    )
    if rivals:
        text += f"; as good: {' | '.join(c.name for c in rivals[:3])}"
    if best != cv.CANONICAL:
        text += f"; jaxsr takes it for {cv.CANONICAL.name}: convert it"
        return Finding("motion", "bad", text, data), best
    return Finding("motion", "ok" if sure else "warn", text, data), best


def _decided(evidence: list[cv.MotionEvidence]) -> str:
    """The kinds of channels that decided, the most frequent first."""
    return ", ".join(kind for kind, _ in Counter(e.kind for e in evidence).most_common())


def _scores(e: cv.MotionEvidence) -> dict[cv.MotionConvention, float]:
    """Image error relative to no motion, times the camera's where the camera explains the motion."""
    best = min(e.camera.values())
    explains = e.camera_px > 0.05 and best < 0.15 * e.camera_px
    # If even the best error is large, camera or depth are inexact and small differences mean nothing.
    floor = 0.002 + 0.003 * e.camera_px + 4 * best
    return {
        c: (image + 1e-3) * ((e.camera[c] + floor) / (e.camera_px + floor) if explains else 1.0)
        for c, image in e.image.items()
    }


STILL_PX = 0.01
"""Motion in pixels below which a camera, or a point, stands still."""


def judge_camera(
    sequence: Sequence, pairs: list[tuple[int, dict[str, np.ndarray]]], convention: cv.MotionConvention | None
) -> Finding:
    """Whether static points move as camera and depth say; this needs motion of a known convention."""
    if not pairs or convention is None or convention.forward:
        return Finding("camera and depth", "warn", "cannot tell without backward motion that is understood")
    i, hr = pairs[0]
    if not (sequence.infos[i].has_camera and sequence.infos[i - 1].has_camera):
        return Finding("camera and depth", "warn", "cannot tell: the camera is not known")
    h, w = hr["motion"].shape[:2]
    motion = convention.to_pixels(images.finite_or_zero(hr["motion"]), (w, h))
    solid = ~images.is_sky(hr["depth"])[..., 0]
    alone = cv.static_motion(hr["depth"], sequence.infos[i], sequence.infos[i - 1])[solid]
    if solid.any() and np.linalg.norm(alone, axis=-1).max() < STILL_PX:
        share = float(np.mean(np.linalg.norm(motion[solid], axis=-1) > STILL_PX))
        seen: dict[str, Any] = {"camera": None, "depth": None, "moving": share}
        text = f"the camera stands still, and {share:.0%} of the surface moves by itself"
        if share > 0.5:  # a camera that was not exported looks like that
            return Finding("camera and depth", "warn", f"{text}: is it the camera of each frame?", seen)
        return Finding("camera and depth", "ok", f"cannot tell: {text}", seen)
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


def judge_lr_motion(scale: int, evidence: list[dict[str, float]]) -> Finding:
    mean = {name: _mean(e[name] for e in evidence) for name in evidence[0]}
    best, stated = min(mean, key=lambda n: mean[n]), next(iter(mean))
    if mean[stated] <= TIE * mean[best] or mean[stated] < 0.01:
        best = stated
    text = f"{best} (median {mean[best]:.3g} px from the HR motion)"
    data = {"reading": best, "errors_px": mean}
    if mean[best] > 0.3:
        return Finding(f"LR motion x{scale}", "warn", f"does not follow from the HR motion: {text}", data)
    return Finding(f"LR motion x{scale}", "ok" if best == stated else "bad", text, data)


def judge_jitter(scale: int, evidence: list[tuple[np.ndarray, dict[str, float], np.ndarray]]) -> Finding:
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
        fits = off < OFF_PX
        text = "none stated, none found" if fits else f"none stated, but the LR images are shifted: {numbers}"
        return Finding(topic, "ok" if fits else "bad", text, data)
    if best == "as stated" and off < OFF_PX:
        return Finding(topic, "ok", f"the metadata fits: {numbers}", data)
    if best == "as stated":
        return Finding(topic, "warn", f"the metadata fits roughly: {numbers}", data)
    return Finding(topic, "bad", f"the metadata does not fit: LR G-buffers say {best!r}; {numbers}", data)


def judge_normal(evidence: Evidence) -> list[Finding]:
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


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
