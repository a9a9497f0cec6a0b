"""HR depth and motion from LR ones, as the upscalers of engines make them.

An export often has depth and motion at render size only. A pixel of the output at the border of a moving
object must follow the object and not what lies behind it: each LR pixel first takes depth and motion of the
nearest of its 3x3 neighbours ("dilated" motion; Karis 2014, AMD FSR 2), and HR pixels then read the LR pixel
that they lie in.

Differentiable in motion and depth, but not in jitter, which chooses pixels.
"""

import functools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.ops._batch import over_batch

_NEIGHBOURS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


@jax.jit
def dilate_motion(
    depth_linear: Float[Array, "*b h w 1"], motion_px: Float[Array, "*b h w 2"]
) -> tuple[Float[Array, "*b h w 1"], Float[Array, "*b h w 2"]]:
    """Depth and motion of the nearest of each pixel's 3x3 neighbours.

    Where several are equally near, the pixel itself comes first, and then the others row by row. Beyond the
    border there are no neighbours.

    Args:
        depth_linear: above 0, +inf for sky.
        motion_px: of the same image.
    """
    return _dilate(depth_linear, motion_px, jnp)


@functools.partial(jax.jit, static_argnames=("scale",))
def hr_from_lr(
    depth_linear: Float[Array, "*b h w 1"],
    motion_px: Float[Array, "*b h w 2"],
    jitter_px: Float[Array, "*b 2"],
    scale: int,
) -> tuple[Float[Array, "*b h2 w2 1"], Float[Array, "*b h2 w2 2"]]:
    """Unjittered HR depth and motion from jittered LR ones.

    The HR pixel p lies at `(p + 0.5) / scale - 0.5 - J` in the jittered LR image (`I_J(p) = I_N(p + J)`) and
    takes the dilated depth and motion of the LR pixel there. Nothing is interpolated: every depth and
    motion is that of some surface. Motion is multiplied by the scale.

    Args:
        depth_linear: LR, above 0, +inf for sky.
        motion_px: LR, in LR pixels.
        jitter_px: J in LR pixels.
        scale: HR size divided by LR size.

    Returns:
        HR depth, and HR motion in HR pixels.
    """
    read = functools.partial(_hr_from_lr, scale=scale, xnp=jnp)
    return over_batch(read, depth_linear, motion_px, jitter_px)


def hr_from_lr_on_host(
    depth_linear: Float[np.ndarray, "h w 1"],
    motion_px: Float[np.ndarray, "h w 2"],
    jitter_px: tuple[float, float],
    scale: int,
) -> tuple[Float[np.ndarray, "h2 w2 1"], Float[np.ndarray, "h2 w2 2"]]:
    """`hr_from_lr` of one image in NumPy, for frames that are read in a thread."""
    return _hr_from_lr(depth_linear, motion_px, np.asarray(jitter_px), scale=scale, xnp=np)


def _dilate(depth_linear: Any, motion_px: Any, xnp: ModuleType) -> tuple[Any, Any]:
    h, w = depth_linear.shape[-3:-1]
    rows, columns = np.arange(h), np.arange(w)
    nearest, motion = depth_linear, motion_px
    for dy, dx in _NEIGHBOURS:
        y, x = np.clip(rows + dy, 0, h - 1), np.clip(columns + dx, 0, w - 1)
        depth = _pixels(depth_linear, y, x, xnp)
        nearer = depth < nearest
        nearest = xnp.where(nearer, depth, nearest)
        motion = xnp.where(nearer, _pixels(motion_px, y, x, xnp), motion)
    return nearest, motion


def _hr_from_lr(depth_linear: Any, motion_px: Any, jitter_px: Any, scale: int, xnp: ModuleType) -> Any:
    h, w = depth_linear.shape[:2]

    def lr_pixels(count: int, jitter: Any) -> Any:
        centre = ((np.arange(count * scale) + 0.5) / scale - 0.5).astype(depth_linear.dtype)
        at = xnp.floor(centre - jitter.astype(depth_linear.dtype) + 0.5)
        return xnp.clip(at, 0, count - 1).astype(xnp.int32)

    depth, motion = _dilate(depth_linear, motion_px, xnp)
    y, x = lr_pixels(h, jitter_px[1]), lr_pixels(w, jitter_px[0])
    return _pixels(depth, y, x, xnp), _pixels(motion, y, x, xnp) * scale


def _pixels(image: Any, rows: Any, columns: Any, xnp: ModuleType) -> Any:
    return xnp.take(xnp.take(image, rows, axis=-3), columns, axis=-2)
