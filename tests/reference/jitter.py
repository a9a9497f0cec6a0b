"""Halton by digits of fractions, and an analytic moving pattern that can be asked for any frame anywhere."""

from fractions import Fraction

import numpy as np


def halton(index: int, base: int) -> float:
    value, place = Fraction(0), Fraction(1, base)
    while index:
        value += place * (index % base)
        index //= base
        place /= base
    return float(value)


class MovingPattern:
    """I_N,t(p) as a function: a texture that a non-uniform flow carries, exactly, in LR pixels.

    A point with label q is seen at time 0 at q and at time 1 at q + v(q). The image is the texture at
    the label of what is seen. All in float64.
    """

    def displacement(self, q: np.ndarray) -> np.ndarray:
        x, y = q[..., 0], q[..., 1]
        return np.stack([1.7 + 0.4 * np.sin(0.3 * y), -0.9 + 0.3 * np.cos(0.25 * x)], -1)

    def label(self, p: np.ndarray, time: int) -> np.ndarray:
        q = p
        for _ in range(200 if time else 0):  # q + v(q) = p: v is a contraction
            q = p - self.displacement(q)
        return q

    def texture(self, q: np.ndarray) -> np.ndarray:
        x, y = q[..., 0], q[..., 1]
        return np.stack([np.sin(0.9 * x + 0.2 * y), np.cos(0.7 * y - 0.4 * x), np.sin(0.5 * x * 0.3 * y)], -1)

    def image(self, p: np.ndarray, time: int) -> np.ndarray:
        """I_N,t at LR positions p."""
        return self.texture(self.label(p, time))

    def jittered_image(self, p: np.ndarray, time: int, jitter: np.ndarray) -> np.ndarray:
        """I_J,t: the camera is displaced, so pixel p sees p + J."""
        return self.image(p + jitter, time)

    def motion(self, p: np.ndarray) -> np.ndarray:
        """MV_N at time 1: p less where the same point was at time 0."""
        return p - self.label(p, 1)
