"""Loops over output pixels; the kernels in their textbook, piecewise form."""

import numpy as np


def kernel(x: float, mode: str) -> float:
    """Weight of a tap at distance x; `nearest` takes the upper one at halves, so it is not symmetric."""
    if mode == "nearest":
        return 1.0 if -0.5 < x <= 0.5 else 0.0
    x = abs(x)
    if mode == "bilinear":
        return max(0.0, 1.0 - x)
    a = -0.5  # Keys
    if x <= 1:
        return (a + 2) * x**3 - (a + 3) * x**2 + 1
    if x < 2:
        return a * x**3 - 5 * a * x**2 + 8 * a * x - 4 * a
    return 0.0


def sample(image: np.ndarray, positions: np.ndarray, mode: str, boundary: str) -> np.ndarray:
    height, width, channels = image.shape
    out = np.zeros((*positions.shape[:-1], channels))
    for index in np.ndindex(positions.shape[:-1]):
        px, py = (float(v) for v in positions[index])
        for y in range(int(np.floor(py)) - 2, int(np.floor(py)) + 4):
            for x in range(int(np.floor(px)) - 2, int(np.floor(px)) + 4):
                # The sign makes the tap above a half the nearest one.
                weight = kernel(x - px, mode) * kernel(y - py, mode)
                inside = 0 <= x < width and 0 <= y < height
                if weight == 0 or (boundary == "zero" and not inside):
                    continue
                out[index] += weight * image[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
    return out


def resize(image: np.ndarray, size: tuple[int, int], mode: str, jitter=(0.0, 0.0)) -> np.ndarray:
    positions = np.zeros((*size, 2))
    for y in range(size[0]):
        for x in range(size[1]):
            positions[y, x, 0] = (x + 0.5) * image.shape[1] / size[1] - 0.5 - jitter[0]
            positions[y, x, 1] = (y + 0.5) * image.shape[0] / size[0] - 0.5 - jitter[1]
    return sample(image, positions, mode, "clamp")


def zero_upsample(image: np.ndarray, scale: int, offset=(0, 0)) -> np.ndarray:
    height, width, channels = image.shape
    out = np.zeros((height * scale, width * scale, channels))
    for y in range(height * scale):
        for x in range(width * scale):
            if y % scale == offset[1] and x % scale == offset[0]:
                out[y, x] = image[y // scale, x // scale]
    return out


def pixel_unshuffle(image: np.ndarray, block: int) -> np.ndarray:
    height, width, channels = image.shape
    out = np.zeros((height // block, width // block, channels * block * block))
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                out[y // block, x // block, (c * block + y % block) * block + x % block] = image[y, x, c]
    return out
