"""The pinhole camera of `jaxsr.frames` in NumPy, float64: pixels to the image plane and back.

For files and checks. The methods use `jaxsr.ops.geometry`, which is JAX, differentiable and float32.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


@runtime_checkable
class Pinhole(Protocol):
    """What `frames.Camera` and `writing.FrameInfo` share."""

    @property
    def world_from_view(self) -> Any: ...
    @property
    def tan_half_fov(self) -> Any: ...
    @property
    def lens_shift(self) -> Any: ...


def image_plane(
    size: tuple[int, int], camera: Pinhole, jitter_px: tuple[float, float] = (0.0, 0.0)
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w 2"]]:
    """Where each pixel of an image `(w, h)` looks: in pixels, jitter included, and (x, y) at view depth 1."""
    w, h = size
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    p = np.stack([x + jitter_px[0], y + jitter_px[1]], -1)
    ndc = (p + 0.5) / (w, h) * 2 - 1
    return p, (ndc + np.asarray(camera.lens_shift)) * np.asarray(camera.tan_half_fov)


def to_pixels(
    xy: Float[np.ndarray, "*n 2"], z: Float[np.ndarray, "*n 1"], camera: Pinhole, size: tuple[int, int]
) -> Float[np.ndarray, "*n 2"]:
    """Pixels, in an image `(w, h)`, of view-space points (x, y) at depth z; z must not be 0."""
    ndc = xy / (z * np.asarray(camera.tan_half_fov)) - np.asarray(camera.lens_shift)
    return (ndc + 1) / 2 * size - 0.5


def world_position(
    depth_linear: Float[np.ndarray, "h w 1"], camera: Pinhole, jitter_px: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "h w 3"]:
    """World position of what each pixel sees, float32, from linear depth; 0 for sky."""
    h, w = depth_linear.shape[:2]
    z = np.where(np.isfinite(depth_linear), depth_linear, 0).astype(np.float64)
    xy = image_plane((w, h), camera, jitter_px)[1] * z
    matrix = np.asarray(camera.world_from_view, np.float64)
    world = np.concatenate([xy, z], -1) @ matrix[:3, :3].T + matrix[:3, 3]
    return np.where(np.isfinite(depth_linear), world, 0).astype(np.float32)
