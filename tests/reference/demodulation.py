"""The guarded divisor, one pixel and channel at a time."""

import numpy as np


def divisor(
    base: np.ndarray, specular: np.ndarray | None, metallic: np.ndarray | None, eps: float
) -> np.ndarray:
    out = np.zeros(base.shape)
    for y in range(base.shape[0]):
        for x in range(base.shape[1]):
            pixel = [float(v) for v in base[y, x]]
            if specular is not None:
                metal = 0.0 if metallic is None else float(metallic[y, x, 0])
                pixel = [v + 0.08 * float(specular[y, x, 0]) * (1 - metal) for v in pixel]
            if not any(v > 0 for v in pixel):
                out[y, x] = 1.0
            else:
                out[y, x] = [max(v, eps) for v in pixel]
    return out
