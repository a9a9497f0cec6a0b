"""The sRGB transfer function (IEC 61966-2-1), once for NumPy (`xnp=np`) and for JAX. Needs NumPy only.

Exact in both pieces, in the precision of the input. Below 0 counts as 0, nothing is clipped above 1, and NaN
stays NaN. `jaxsr.ops` has the compiled forms.
"""

from types import ModuleType
from typing import Any

import numpy as np


def srgb_from_linear(linear: Any, xnp: ModuleType = np) -> Any:
    """Display-referred values of linear ones."""
    x = at_least(linear, 0.0, xnp)
    curved = 1.055 * at_least(x, 0.0031308, xnp) ** (1 / 2.4) - 0.055  # x^(1/2.4) has no slope at 0
    return xnp.where(x <= 0.0031308, 12.92 * x, curved)


def linear_from_srgb(srgb: Any, xnp: ModuleType = np) -> Any:
    """Linear values of display-referred ones: the inverse of `srgb_from_linear`."""
    x = at_least(srgb, 0.0, xnp)
    curved = ((at_least(x, 0.04045, xnp) + 0.055) / 1.055) ** 2.4
    return xnp.where(x <= 0.04045, x / 12.92, curved)


def at_least(x: Any, low: float, xnp: ModuleType) -> Any:
    """`maximum(x, low)` with the whole gradient at the bound itself, where black pixels are; NaN is kept."""
    return xnp.where(x < low, xnp.asarray(low, x.dtype), x)
