"""The colour formulas on one number at a time, with the standard library only."""

import math


def tone_map(x: float, kind: str) -> float:
    x = max(x, 0.0)
    if kind == "aces":
        return min(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
    return x / (1 + x) if kind == "reinhard" else math.log(1 + x)


def srgb_from_linear(x: float) -> float:
    x = max(x, 0.0)
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


def to_display(x: float, exposure: float) -> float:
    return srgb_from_linear(tone_map(x * exposure, "aces"))


def luminance(r: float, g: float, b: float) -> float:
    return 0.2126 * r + 0.7152 * g + 0.0722 * b
