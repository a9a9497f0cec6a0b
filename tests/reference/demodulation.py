"""The guarded divisor, one pixel and channel at a time."""

import math

import numpy as np


def divisor(
    base: np.ndarray,
    surface: np.ndarray | None,
    specular: np.ndarray | None,
    metallic: np.ndarray | None,
    eps: float,
) -> np.ndarray:
    def number(v: float) -> float:
        return 0.0 if math.isnan(v) else float(v)

    out = np.zeros(base.shape)
    for y in range(base.shape[0]):
        for x in range(base.shape[1]):
            pixel = [number(v) for v in base[y, x]]
            if specular is not None:
                metal = 0.0 if metallic is None else number(metallic[y, x, 0])
                pixel = [v + 0.08 * number(specular[y, x, 0]) * (1 - metal) for v in pixel]
            sky = surface is not None and not surface[y, x, 0]
            out[y, x] = 1.0 if sky else [max(v, eps) for v in pixel]
    return out
