"""What inspection reads from images: features that move with a surface, derivatives, values between pixels.

Pure NumPy, on `[H, W, C]` arrays in float64.
"""

from collections.abc import Mapping

import numpy as np

Layers = Mapping[str, np.ndarray]


def kinds(layers: Layers) -> dict[str, np.ndarray]:
    """Properties that move with a surface: base colour (else log colour), normal, disparity; 0 for sky."""
    found = {}
    textured = "base_color" in layers and gradient(layers["base_color"]).mean() > 1e-3
    if textured:
        found["base colour"] = layers["base_color"]
    elif "color" in layers:
        found["colour"] = np.log1p(np.maximum(layers["color"], 0))
    if "normal" in layers:
        found["normal"] = layers["normal"]
    with np.errstate(divide="ignore"):
        found["disparity"] = np.where(is_sky(layers["depth"]), 0, 1 / layers["depth"])
    return {name: finite_or_zero(x) for name, x in found.items()}


def features(layers: Layers, scale: np.ndarray | None = None) -> np.ndarray:
    """All `kinds` as channels."""
    out = np.concatenate(list(kinds(layers).values()), -1)
    return out if scale is None else out * scale


def channels_of(layers: Layers) -> dict[str, slice]:
    """Where each of the `kinds` lies among the channels of `features`."""
    ends, last = {}, 0
    for name, x in kinds(layers).items():
        ends[name] = slice(last, last + x.shape[-1])
        last += x.shape[-1]
    return ends


def finite_or_zero(x: np.ndarray) -> np.ndarray:
    """float64, with 0 for NaN and Inf, which are counted elsewhere and must not stop this test."""
    return np.nan_to_num(x.astype(np.float64), posinf=0, neginf=0)


def is_sky(depth: np.ndarray) -> np.ndarray:
    """`[H, W, 1]`: infinite depth, or a depth so large that it must mean sky."""
    return ~(depth < 1e9)


def normalise(current: np.ndarray) -> np.ndarray:
    """Factors for each channel that make an error of 1 about one pixel of displacement; 0 for flat ones."""
    step = gradient(current).reshape(-1, current.shape[-1]).mean(0)
    return np.where(step > 1e-4, 1 / np.maximum(step, 1e-4), 0) / max(int((step > 1e-4).sum()), 1)


def blur(x: np.ndarray) -> np.ndarray:
    """Two 3x3 binomials: point samples of fine texture alias, which would hide sub-pixel differences."""
    for _ in range(2):
        for axis in (0, 1):
            padded = np.pad(x, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
            n = x.shape[axis]
            a, b, c = (np.take(padded, np.arange(k, k + n), axis) for k in range(3))
            x = 0.25 * a + 0.5 * b + 0.25 * c
    return x


def gradients(x: np.ndarray) -> np.ndarray:
    """`[2, h, w, c]`: derivatives along x and y."""
    return np.stack([np.gradient(x, axis=k) if x.shape[k] > 1 else np.zeros_like(x) for k in (1, 0)])


def gradient(x: np.ndarray) -> np.ndarray:
    return np.abs(gradients(finite_or_zero(x))).sum(0)


def interior(h: int, w: int) -> np.ndarray:
    mask = np.zeros((h, w), bool)
    mask[1:-1, 1:-1] = True
    return mask


def pick(mask: np.ndarray, texture: np.ndarray, samples: int) -> np.ndarray:
    """`[n, 2]` pixels (x, y): of the textured half of `mask`, at most `samples`, evenly by number."""
    values = texture[mask]
    if not values.size or values.max() <= 0:
        return np.zeros((0, 2), int)
    y, x = np.nonzero(mask & (texture >= np.median(values)) & (texture > 0))
    take = np.random.default_rng(0).permutation(len(x))[:samples]
    return np.stack([x[take], y[take]], -1)


def inside(p: np.ndarray, w: int, h: int) -> np.ndarray:
    return np.all((p >= -0.5) & (p <= np.array([w, h]) - 0.5), -1)


def error(target: np.ndarray, image: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.abs(bilinear(image, p) - target).sum(-1)


def bilinear(image: np.ndarray, p: np.ndarray) -> np.ndarray:
    h, w = image.shape[:2]
    p = np.clip(p, 0, (w - 1, h - 1))
    x0, y0 = np.minimum(p.astype(int), (max(w - 2, 0), max(h - 2, 0))).T
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    fx, fy = (p[:, 0] - x0)[:, None], (p[:, 1] - y0)[:, None]
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    return top * (1 - fy) + (image[y1, x0] * (1 - fx) + image[y1, x1] * fx) * fy
