"""The table of layers: what a buffer is called, measured in, stored as, and what it holds for sky.

One row per layer drives reading, writing, archives, inspection, training data and the inputs of networks. It
needs neither JAX nor NumPy, so that a renderer's own Python can import it; `jaxsr.frames` offers it as well.
A new buffer is one row here and one field of `jaxsr.frames.GBuffer`.
"""

import math
from typing import Literal, NamedTuple

MAX_JITTER = 0.5 + 1e-4
"""Largest jitter along an axis, in LR pixels; a little more than half a pixel, for rounding."""
MAX_HR_JITTER = 8.0
"""Largest jitter of HR buffers along an axis, in HR pixels: half an LR pixel at the largest scale, 16."""
RIGID_TOLERANCE = 1e-3
"""How far the entries of R'R may be from those of the identity, R the rotation of a camera."""

DERIVED = frozenset({"depth", "motion"})
"""HR layers that are made from the LR ones where there are none (`jaxsr.ops.hr_from_lr`)."""


class Layer(NamedTuple):
    """One row: a buffer of an image, or its colour."""

    name: str
    """In files and on command lines: `motion`."""
    letters: str
    """One per channel: the file has `motion.X` and `motion.Y`."""
    field: str
    """Of `GBuffer` in memory: `motion_px`; of `Frame` for the colour; empty where no frame carries it."""
    unit: str
    """Unit and space, in words."""
    low: float
    high: float
    """Smallest and largest value that can be meant."""
    stored: Literal["half", "float", "uint"]
    """How a writer stores it unless it is told otherwise."""
    sky: float | None
    """Its value where there is no surface; None where sky has one of its own."""


_ROWS = (
    Layer("color", "RGB", "color_linear", "scene-linear colour", -math.inf, math.inf, "half", None),
    Layer("reference", "RGB", "", "anti-aliased scene-linear colour", -math.inf, math.inf, "half", None),
    Layer("depth", "Z", "depth_linear", "linear view depth", 0.0, math.inf, "float", math.inf),
    Layer("motion", "XY", "motion_px", "backward, pixels of its image", -math.inf, math.inf, "float", None),
    Layer("normal", "XYZ", "normal", "unit vector, world space", -1.0, 1.0, "half", 0.0),
    Layer("base_color", "RGB", "base_color", "linear", 0.0, 1.0, "half", 0.0),
    Layer("roughness", "V", "roughness", "", 0.0, 1.0, "half", 0.0),
    Layer("metallic", "V", "metallic", "", 0.0, 1.0, "half", 0.0),
    Layer("object_id", "V", "object_id", "whole number", 0.0, float(2**32 - 1), "half", 0.0),
    Layer("position", "XYZ", "", "world space", -math.inf, math.inf, "float", 0.0),
)

LAYERS: dict[str, Layer] = {layer.name: layer for layer in _ROWS}
"""By name, in the order of files."""

FIELDS: dict[str, str] = {
    layer.name: layer.field for layer in _ROWS if layer.field not in ("", "color_linear")
}
"""Layer -> field of `GBuffer`."""


def channels(name: str) -> tuple[str, ...]:
    """The channels of a layer in a file: `("motion.X", "motion.Y")`."""
    return tuple(f"{name}.{letter}" for letter in LAYERS[name].letters)


def needed(places: frozenset[str], place: str) -> frozenset[str]:
    """The layers that a set of needs such as `{"lr.color", "hr.motion"}` names for "lr" or "hr"."""
    return frozenset(need.partition(".")[2] for need in places if need.startswith(f"{place}."))


def is_rigid(matrix: list[list[float]]) -> bool:
    """Whether a 4 x 4 matrix is a rotation and a translation, but for `RIGID_TOLERANCE`; NaN is not."""
    x, y, z = columns = [[row[k] for row in matrix[:3]] for k in range(3)]
    products = [(sum(map(float.__mul__, a, b)), a is b) for a in columns for b in columns]
    right_handed = sum(z[k] * (x[k - 2] * y[k - 1] - x[k - 1] * y[k - 2]) for k in range(3))
    return (
        all(abs(product - same) <= RIGID_TOLERANCE for product, same in products)
        and all(abs(v - w) <= RIGID_TOLERANCE for v, w in zip(matrix[3], (0, 0, 0, 1), strict=True))
        and right_handed > 0
    )
