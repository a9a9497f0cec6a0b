"""Find the conventions that buffers follow: try each reading on the pixels and compare the errors.

Pure NumPy functions on `[H, W, C]` arrays of two consecutive images; they read no files and print
nothing (see `jaxsr.inspection.inspect`). Motion: the previous image (base colour or colour, normals,
disparity) is warped by every reading of the stored vectors and compared with the current image; independently
of that, camera and depth give the previous position of static points. Jitter: the LR G-buffer is looked up in
the HR one. Errors are capped, so that disocclusions and moving shadows do not dominate the mean.
"""

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from jaxsr.inspection import images
from jaxsr.inspection.images import Layers
from jaxsr.io.writing import FrameInfo
from jaxsr.ops.pinhole import still_motion, unjittered_positions, view_rays, world_from_depth

Size = tuple[int, int]
FLAT_PX = 0.02
"""Warp error without motion below which a kind of channel hardly changes."""

UNITS = {
    "pixels": lambda w, h: (1.0, 1.0),
    "half pixels (times 2)": lambda w, h: (2.0, 2.0),
    "double pixels (times 0.5)": lambda w, h: (0.5, 0.5),
    "quarter pixels (times 4)": lambda w, h: (4.0, 4.0),
    "quadruple pixels (times 0.25)": lambda w, h: (0.25, 0.25),
    "UV (times width, height)": lambda w, h: (float(w), float(h)),
    "NDC (times half width, half height)": lambda w, h: (w / 2, h / 2),
    "widths (times width)": lambda w, h: (float(w), float(w)),
}


@dataclass(frozen=True)
class MotionConvention:
    """A reading of stored motion vectors. The default is jaxsr's: `p_prev = p - motion`, pixels, y down."""

    unit: str = "pixels"
    signs: tuple[int, int] = (1, 1)
    swapped: bool = False
    forward: bool = False

    @property
    def name(self) -> str:
        parts = ["forward" if self.forward else "backward", self.unit]
        parts += {
            (1, 1): ["y down"],
            (1, -1): ["y up"],
            (-1, 1): ["y down", "x flipped"],
            (-1, -1): ["y down", "both signs flipped"],
        }[self.signs]
        return ", ".join(parts + ["axes swapped"] * self.swapped)

    def to_pixels(self, stored: np.ndarray, size: Size) -> np.ndarray:
        """`p - p_prev` (or `p_next - p` when `forward`) in pixels, y down, from stored `[..., 2]`."""
        vectors = stored[..., ::-1] if self.swapped else stored
        return vectors * (np.array(UNITS[self.unit](*size)) * self.signs)


CANONICAL = MotionConvention()
CONVENTIONS = [
    MotionConvention(unit, signs, swapped, forward)
    for forward, swapped, unit, signs in itertools.product(
        (False, True), (False, True), UNITS, itertools.product((1, -1), (1, -1))
    )
]


@dataclass
class MotionEvidence:
    """Errors of the conventions on one pair of frames."""

    moves: bool
    """True if any stored vector is not zero."""
    camera_px: float
    """How far the camera alone moves points, median in pixels."""
    image_change: float
    """Warp error without motion: 0 where the images are equal or flat; in pixels, about."""
    image: dict[MotionConvention, float] = field(default_factory=dict)
    """Warp error relative to no motion."""
    camera: dict[MotionConvention, float] = field(default_factory=dict)
    """Median distance in pixels to the previous position of a static point."""
    kind: str = ""
    """Which of `images.kinds` tells most, and so decided `image`."""


def motion_evidence(
    current: Layers,
    previous: Layers,
    info: FrameInfo,
    info_previous: FrameInfo,
    jitter_delta: np.ndarray | tuple[float, float] = (0.0, 0.0),
    samples: int = 4000,
) -> MotionEvidence:
    """Try every convention on one pair of images.

    Args:
        current, previous: layers `[H, W, C]`: depth and motion, and base_color, normal, color where there.
        info, info_previous: their cameras, if they are known.
        jitter_delta: jitter of the previous image minus that of the current one, in their pixels.
        samples: the number of pixels to compare.
    """
    h, w = current["depth"].shape[:2]
    directions = {
        False: (current, previous, info, info_previous),
        True: (previous, current, info_previous, info),
    }
    scale = images.normalise(images.blur(images.features(current)))
    solid = ~images.is_sky(current["depth"])[..., 0]
    known = info.has_camera and info_previous.has_camera
    still_motion = static_motion(current["depth"], info, info_previous)[solid] if known else np.zeros((1, 2))
    evidence = MotionEvidence(
        moves=bool(np.abs(images.finite_or_zero(current["motion"])).max(initial=0) > 1e-7),
        camera_px=float(np.median(np.linalg.norm(still_motion, axis=-1))) if solid.any() else 0.0,
        image_change=0.0,
    )
    parts = images.channels_of(current)
    judged: dict[str, dict[MotionConvention, float]] = {name: {} for name in parts}
    changes = dict.fromkeys(parts, 0.0)
    for forward, (here, there, info_here, info_there) in directions.items():
        f_here, f_there = (images.blur(images.features(x)) * scale for x in (here, there))
        motion = images.finite_or_zero(here["motion"])
        length = np.abs(motion).sum(-1)
        moving = ~images.is_sky(here["depth"])[..., 0]
        if (moving & (length > 0)).any():
            moving &= length >= 0.1 * np.quantile(length[moving & (length > 0)], 0.95)
        p = images.pick(moving & images.interior(h, w), images.gradient(f_here).sum(-1), samples)
        if not len(p):
            continue
        expected = np.full((len(p), 2), np.nan)
        if known:
            expected = static_motion(here["depth"], info_here, info_there)[p[:, 1], p[:, 0]]
        # p - shift in the other image shows the same point as p.
        shift = np.asarray(jitter_delta) * (-1 if forward else 1)
        if not forward:
            evidence.camera_px = float(np.median(np.linalg.norm(expected, axis=-1))) if known else 0.0
        for c in CONVENTIONS:
            if c.forward == forward:
                vectors = c.to_pixels(motion[p[:, 1], p[:, 0]], (w, h)) * (-1 if forward else 1)
                evidence.camera[c] = float(np.median(np.linalg.norm(vectors - expected, axis=-1)))
        for name, part in parts.items():
            errors, none = _relative_errors(f_here[..., part], f_there[..., part], motion, p, shift, forward)
            judged[name] |= errors
            if not forward:
                changes[name] = none
    complete = [name for name in parts if len(judged[name]) == len(CONVENTIONS)]
    if complete:
        # Depth in few codes, or depth that changes because the camera advances, fits no reading: it must not
        # outvote colour. A kind that hardly changes says nothing.
        telling = [name for name in complete if changes[name] > FLAT_PX] or complete
        evidence.kind = min(telling, key=lambda name: min(judged[name].values()))
        evidence.image, evidence.image_change = judged[evidence.kind], changes[evidence.kind]
    return evidence


def _relative_errors(
    here: np.ndarray,
    there: np.ndarray,
    motion: np.ndarray,
    p: np.ndarray,
    shift: np.ndarray,
    forward: bool,
) -> tuple[dict[MotionConvention, float], float]:
    """Warp errors of each convention relative to no motion, in some channels; and that of no motion."""
    h, w = here.shape[:2]
    target = here[p[:, 1], p[:, 0]]
    still = images.error(target, there, p - shift)
    cap = 2 * float(still.mean())
    none = float(np.minimum(still, cap).mean())
    errors = {}
    for c in CONVENTIONS:
        if c.forward != forward:
            continue
        vectors = c.to_pixels(motion[p[:, 1], p[:, 0]], (w, h)) * (-1 if forward else 1)
        error = np.minimum(images.error(target, there, p - vectors - shift), cap)
        error[~images.inside(p - vectors - shift, w, h)] = cap
        errors[c] = float(error.mean()) / none if none > 0 else 1.0
    return errors, none


def static_motion(depth: np.ndarray, info: FrameInfo, info_previous: FrameInfo) -> np.ndarray:
    """`[h, w, 2]`: backward motion, in pixels, of static points; 0 for sky."""
    sky = images.is_sky(depth)
    return np.where(sky, 0, still_motion(np.where(sky, np.inf, depth), info, info_previous, xnp=np))


CAMERAS = {
    "as stated": lambda m: m,
    "OpenGL axes (y up, z backward)": lambda m: m @ np.diag([1.0, -1.0, -1.0, 1.0]),
    "inverted (view_from_world)": lambda m: np.linalg.pinv(m),
    "transposed": lambda m: m.T,
    "inverted, OpenGL axes": lambda m: np.linalg.pinv(m) @ np.diag([1.0, -1.0, -1.0, 1.0]),
}
DEPTHS = {
    "linear view depth": lambda d, ray: d,
    "distance along the ray": lambda d, ray: d / ray,
    "reciprocal of depth": lambda d, ray: 1 / d,
    "view depth in centimetres": lambda d, ray: d / 100,
}


def camera_evidence(
    depth: np.ndarray, motion_px: np.ndarray, info: FrameInfo, info_previous: FrameInfo
) -> dict[tuple[str, str], float]:
    """Median distance, relative to the motion, between the motion and what camera and depth imply.

    Args:
        depth, motion_px: `[h, w, 1]` and `[h, w, 2]`, the motion already converted to jaxsr's convention.

    Returns:
        (camera, depth) -> error; 0 is perfect, 1 is as bad as no motion.
    """
    h, w = depth.shape[:2]
    solid = ~images.is_sky(depth)[..., 0]
    if not solid.any():
        return {}
    rays = view_rays(unjittered_positions((h, w), None, np.float64, np), info, (h, w), np)
    ray = np.linalg.norm(rays, axis=-1, keepdims=True)
    size = float(np.median(np.linalg.norm(motion_px[solid], axis=-1)))
    out = {}
    for (camera, turn), (kind, convert) in itertools.product(CAMERAS.items(), DEPTHS.items()):
        infos = [
            replace(x, world_from_view=turn(np.asarray(x.world_from_view, float)))
            for x in (info, info_previous)
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(solid[..., None], convert(depth, ray), np.inf)
        difference = (static_motion(z, infos[0], infos[1]) - motion_px)[solid]
        out[camera, kind] = float(np.median(np.linalg.norm(difference, axis=-1))) / max(size, 1e-9)
    return out


JITTERS = {
    "as stated": lambda x, y, s: (x, y),
    "no jitter": lambda x, y, s: (0.0, 0.0),
    "x flipped": lambda x, y, s: (-x, y),
    "y flipped": lambda x, y, s: (x, -y),
    "both signs flipped": lambda x, y, s: (-x, -y),
    "axes swapped": lambda x, y, s: (y, x),
    "stated in HR pixels": lambda x, y, s: (x / s, y / s),
}


def jitter_evidence(
    lr: Layers, hr: Layers, jitter_px: np.ndarray, scale: int, samples: int = 4000
) -> tuple[dict[str, float], np.ndarray | None]:
    """Look the LR G-buffer up in the HR one, displaced by every reading of the stated jitter.

    Returns:
        reading -> error (about LR pixels; empty if the images are flat), and the jitter that fits best.
    """
    lr = {k: v for k, v in lr.items() if k != "color"}  # colour may be noisy or lit differently
    hr = {k: v for k, v in hr.items() if k != "color"}
    shared = set(lr) & set(hr)
    f_lr, f_hr = (images.features({k: x[k] for k in shared}) for x in (lr, hr))
    if f_lr.shape[-1] != f_hr.shape[-1]:  # the base colour of one image has no texture
        f_lr, f_hr = (images.features({k: x[k] for k in shared - {"base_color"}}) for x in (lr, hr))
    weight = images.normalise(f_hr) / scale
    f_lr, f_hr = f_lr * weight, f_hr * weight
    h, w = f_lr.shape[:2]
    p = images.pick(images.interior(h, w), images.gradient(f_lr).sum(-1), samples)
    if not len(p) or not weight.any():
        return {}, None
    target = f_lr[p[:, 1], p[:, 0]]

    def residual(jitter: np.ndarray) -> np.ndarray:
        return images.bilinear(f_hr, (p + jitter + 0.5) * scale - 0.5) - target

    def error(jitter: np.ndarray, cap: float) -> float:
        return float(np.minimum(np.abs(residual(jitter)).sum(-1), cap).mean())

    cap = 2 * float(np.median(np.abs(residual(np.array([0.5, 0.5]))).sum(-1))) + 1e-6
    x, y = (float(v) for v in jitter_px)
    errors = {name: error(np.array(read(x, y, scale)), cap) for name, read in JITTERS.items()}

    best = np.array(JITTERS[min(errors, key=lambda n: errors[n])](x, y, scale))
    slope = (images.gradients(f_hr)) * scale
    for _ in range(8):  # Gauss-Newton on the pixels with the smaller errors
        r = residual(best)
        keep = np.abs(r).sum(-1) <= np.quantile(np.abs(r).sum(-1), 0.6)
        at = (p + best + 0.5) * scale - 0.5
        g = np.stack([images.bilinear(slope[k], at)[keep].ravel() for k in (0, 1)], -1)
        step = np.linalg.lstsq(g, r[keep].ravel(), rcond=None)[0]
        best = np.clip(best - step, -1, 1)
        if np.abs(step).max() < 1e-4:
            break
    return errors, best


LR_MOTIONS = {
    "LR pixels, unjittered": lambda m, s, dj: m / s,
    "HR pixels": lambda m, s, dj: m,
    "jitter counted in": lambda m, s, dj: m / s + dj,
    "jitter counted in, sign flipped": lambda m, s, dj: m / s - dj,
    "zero everywhere: it was not exported": lambda m, s, dj: 0 * m,
}


def lr_motion_evidence(
    lr: Layers, hr: Layers, jitter_px: np.ndarray, jitter_previous: np.ndarray, scale: int
) -> dict[str, float]:
    """Median distance, in LR pixels, between LR motion and HR motion read in several ways."""
    h, w = lr["depth"].shape[:2]
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2)
    at = np.rint((grid + jitter_px + 0.5) * scale - 0.5).astype(int)
    at = at.clip(0, (w * scale - 1, h * scale - 1))
    m = images.finite_or_zero(hr["motion"])[at[:, 1], at[:, 0]]
    stored = images.finite_or_zero(lr["motion"]).reshape(-1, 2)
    solid = ~images.is_sky(lr["depth"]).ravel() & ~images.is_sky(hr["depth"])[at[:, 1], at[:, 0], 0]
    if not solid.any() or not np.abs(m[solid]).max() > 1e-7:
        return {}
    # MV_J,t = MV_N,t + J_{t-1} - J_t (docs/conventions.md)
    delta = np.asarray(jitter_previous, float) - np.asarray(jitter_px, float)
    return {
        name: float(np.median(np.linalg.norm(stored - read(m, scale, delta), axis=-1)[solid]))
        for name, read in LR_MOTIONS.items()
    }


NORMALS = {
    "world space": lambda n, r: n,
    "world space, pointing inwards": lambda n, r: -n,
    "view space (y down, z forward)": lambda n, r: n @ r.T,
    "view space, OpenGL (y up, z backward)": lambda n, r: (n * (1, -1, -1)) @ r.T,
    "world space, y up": lambda n, r: np.stack([n[..., 0], -n[..., 2], n[..., 1]], -1),
    "0..1 encoded world space": lambda n, r: 2 * n - 1,
}


def normal_evidence(depth: np.ndarray, normal: np.ndarray, info: FrameInfo) -> dict[str, float]:
    """Median angle in degrees between stored normals, read in several ways, and the surface in the depth."""
    position = world_from_depth(np.where(images.is_sky(depth), np.inf, depth), info, xnp=np)
    dx, dy = position[1:-1, 2:] - position[1:-1, :-2], position[2:, 1:-1] - position[:-2, 1:-1]
    surface = np.cross(dx, dy)
    middle = np.where(images.is_sky(depth), np.inf, depth)[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        bend = [
            np.abs(1 / a + 1 / b - 2 / middle[1:-1, 1:-1]) * middle[1:-1, 1:-1]
            for a, b in ((middle[1:-1, 2:], middle[1:-1, :-2]), (middle[2:, 1:-1], middle[:-2, 1:-1]))
        ]
        smooth = (bend[0] < 0.01) & (bend[1] < 0.01) & np.isfinite(middle[1:-1, 1:-1])
    if smooth.sum() < 16:
        return {}
    matrix = np.asarray(info.world_from_view, float)
    surface, seen = surface[smooth], position[1:-1, 1:-1][smooth] - matrix[:3, 3]
    surface *= np.where(np.sum(surface * seen, -1, keepdims=True) > 0, -1, 1)
    surface /= np.maximum(np.linalg.norm(surface, axis=-1, keepdims=True), 1e-12)
    stored, out = images.finite_or_zero(normal)[1:-1, 1:-1][smooth], {}
    for name, read in NORMALS.items():
        n = read(stored, matrix[:3, :3])
        n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)
        out[name] = float(np.degrees(np.median(np.arccos(np.clip(np.sum(n * surface, -1), -1, 1)))))
    return out
