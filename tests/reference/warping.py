"""Loops over pixels. Kernels are the piecewise textbook ones, evaluated at every tap's distance."""

import numpy as np

from tests.reference.resampling import kernel, zero_upsample


def backward_warp(image: np.ndarray, motion: np.ndarray, mode: str, boundary: str) -> np.ndarray:
    height, width, channels = image.shape
    out = np.zeros((height, width, channels))
    for y, x in np.ndindex(height, width):
        mx, my = (0.0 if np.isnan(m) else float(m) for m in motion[y, x])
        if mode == "nearest":  # half to even, on the motion
            taps = [(x - int(np.round(mx)), y - int(np.round(my)), 1.0)]
        else:
            px, py = x - mx, y - my
            fx, fy = int(np.floor(px)), int(np.floor(py))
            taps = [
                (tx, ty, kernel(tx - px, mode) * kernel(ty - py, mode))
                for ty in range(fy - 1, fy + 3)
                for tx in range(fx - 1, fx + 3)
            ]
        for tx, ty, weight in taps:
            inside = 0 <= tx < width and 0 <= ty < height
            if inside or boundary == "clamp":
                out[y, x] += weight * image[min(max(ty, 0), height - 1), min(max(tx, 0), width - 1)]
    return out


def warp_zero_upsampled(image: np.ndarray, motion: np.ndarray, scale: int, offset=(0, 0)) -> np.ndarray:
    return backward_warp(zero_upsample(image, scale, offset), motion, "bilinear", "zero")


def compose_motion(motion: np.ndarray, before: np.ndarray) -> np.ndarray:
    """`before` has one pair of channels."""
    height, width, _ = motion.shape
    out = np.zeros(motion.shape)
    for y, x in np.ndindex(height, width):
        px, py = x - float(motion[y, x, 0]), y - float(motion[y, x, 1])
        out[y, x] = motion[y, x]
        for ty in range(int(np.floor(py)), int(np.floor(py)) + 2):
            for tx in range(int(np.floor(px)), int(np.floor(px)) + 2):
                weight = max(0, 1 - abs(tx - px)) * max(0, 1 - abs(ty - py))
                out[y, x] += weight * before[min(max(ty, 0), height - 1), min(max(tx, 0), width - 1)]
    return out


def forward_splat(
    values: np.ndarray, motion: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The splatted values, the mask, and the (y, x) of each winner."""
    height, width, _ = values.shape
    out, mask = np.zeros(values.shape), np.zeros((height, width, 1), bool)
    nearest, winner = np.zeros((height, width)), np.zeros((height, width, 2), int)
    for y, x in np.ndindex(height, width):
        tx, ty = x - int(np.round(motion[y, x, 0])), y - int(np.round(motion[y, x, 1]))
        if not (0 <= tx < width and 0 <= ty < height):
            continue
        z = np.inf if np.isnan(depth[y, x, 0]) else depth[y, x, 0]
        if not mask[ty, tx, 0] or z < nearest[ty, tx]:
            out[ty, tx], mask[ty, tx], nearest[ty, tx], winner[ty, tx] = values[y, x], True, z, (y, x)
    return out, mask, winner


def occlusion_motion(motion: np.ndarray, depth: np.ndarray) -> np.ndarray:
    height, width, _ = motion.shape
    splatted, _, _ = forward_splat(motion, motion, depth)
    out = motion.astype(np.float64)
    for y, x in np.ndindex(height, width):
        tx, ty = x - int(np.round(motion[y, x, 0])), y - int(np.round(motion[y, x, 1]))
        if 0 <= tx < width and 0 <= ty < height:
            out[y, x] = splatted[ty, tx]
    return out
