"""The pinhole camera of one image: each formula once, for NumPy (`xnp=np`, float64) and for JAX.

`jaxsr.frames.Camera` holds the convention. `jaxsr.ops.geometry` makes the public ops of these functions:
batched, compiled, documented. Readers, writers and checks of files call them with `xnp=np`: then cameras,
jitter and results are float64, whatever the input.

    p + J = (ndc + 1) / 2 * (W, H) - 0.5              the place that pixel p shows, in the unjittered image
    ray   = ((ndc + lens_shift) * tan_half_fov, 1)    in view space, of unit depth
    world = R (depth * ray) + eye                     R, eye: the columns of world_from_view
    x'    = R'^T R ray * depth + R'^T (eye - eye')    in the view space of the previous camera (primes)

Shapes are without batch: images `[h, w, C]`, cameras and jitter of one frame, sizes (H, W). In NumPy a batch
of points of any shape `[..., 3]` will do.
"""

from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from jaxsr.ops.resampling import grid

BEHIND_PX = -1e6
"""Both coordinates of a point at or behind the plane of the eye: finite, and outside every image."""

_NEAR = 1e-6


@runtime_checkable
class Pinhole(Protocol):
    """What `frames.Camera` and the `FrameInfo` of a sequence share."""

    @property
    def world_from_view(self) -> Any: ...
    @property
    def tan_half_fov(self) -> Any: ...
    @property
    def lens_shift(self) -> Any: ...


def rotate(matrix: Any, vectors: Any, xnp: ModuleType = jnp) -> Any:
    """`matrix @ vector` for each of `[..., 3]` vectors."""
    if xnp is np:
        return vectors @ matrix.T
    # Sums of products fuse, and no matrix unit rounds to fewer bits, which would move points by pixels.
    lead = (None,) * (vectors.ndim - 1)
    x, y, z = (vectors[..., k : k + 1] * matrix[:, k][lead] for k in range(3))
    return x + y + z


def unjittered_positions(size: tuple[int, int], jitter: Any, dtype: Any, xnp: ModuleType = jnp) -> Any:
    """`[h, w, 2]`: the position in the unjittered image that each pixel shows, p + J; J may be None."""
    pixels = grid(*size, np.float64 if xnp is np else dtype, xnp)
    return pixels if jitter is None else pixels + _array(jitter, xnp)[None, None]


def view_rays(pixels: Any, camera: Pinhole, size: tuple[int, int], xnp: ModuleType = jnp) -> Any:
    """View-space rays `[..., 3]` of unit view depth through `[..., 2]` positions of the unjittered image."""
    lead = (None,) * (pixels.ndim - 1)
    ndc = (pixels + 0.5) / _width_height(size, pixels, xnp)[lead] * 2 - 1
    xy = (ndc + _array(camera.lens_shift, xnp)[lead]) * _array(camera.tan_half_fov, xnp)[lead]
    return xnp.concatenate([xy, xnp.ones_like(xy[..., :1])], axis=-1)


def world_from_depth(depth_linear: Any, camera: Pinhole, jitter: Any = None, xnp: ModuleType = jnp) -> Any:
    """`[h, w, 3]`: the point that each pixel shows, in world space; 0 for sky."""
    matrix, depth = _array(camera.world_from_view, xnp), _array(depth_linear, xnp)
    size = depth.shape[0], depth.shape[1]
    rays = view_rays(unjittered_positions(size, jitter, depth.dtype, xnp), camera, size, xnp)
    hit = xnp.isfinite(depth)
    point = rotate(matrix[:3, :3], rays * xnp.where(hit, depth, 0.0), xnp) + matrix[None, None, :3, 3]
    return xnp.where(hit, point, 0.0)


def view_from_world(world: Any, camera: Pinhole, xnp: ModuleType = jnp) -> Any:
    """View-space points `[..., 3]` of world-space ones."""
    matrix, points = _array(camera.world_from_view, xnp), _array(world, xnp)
    eye = matrix[(None,) * (points.ndim - 1) + (slice(3), 3)]
    return rotate(matrix[:3, :3].T, points - eye, xnp)  # the difference first: worlds are large


def pixels_from_view(points: Any, camera: Pinhole, size: tuple[int, int], xnp: ModuleType = jnp) -> Any:
    """Where view-space points `[..., 3]` appear in the unjittered image: `[..., 2]`, or `BEHIND_PX` twice."""
    lead = (None,) * (points.ndim - 1)
    depth = points[..., 2:]
    ahead = depth > _NEAR
    plane = xnp.where(ahead, depth, 1.0) * _array(camera.tan_half_fov, xnp)[lead]
    ndc = points[..., :2] / plane - _array(camera.lens_shift, xnp)[lead]
    pixels = (ndc + 1) / 2 * _width_height(size, points, xnp)[lead] - 0.5
    return xnp.where(ahead, pixels, BEHIND_PX)


def pixels_from_world(
    world: Any, camera: Pinhole, size: tuple[int, int], xnp: ModuleType = jnp
) -> tuple[Any, Any]:
    """Where world-space points `[..., 3]` appear in the unjittered image, and their view depth `[..., 1]`."""
    points = view_from_world(world, camera, xnp)
    return pixels_from_view(points, camera, size, xnp), points[..., 2:]


def view_from_view(camera: Pinhole, previous: Pinhole, xnp: ModuleType = jnp) -> tuple[Any, Any]:
    """Rotation and translation from the view space of one camera to that of another."""
    now, then = _array(camera.world_from_view, xnp), _array(previous.world_from_view, xnp)
    turn = rotate(then[:3, :3].T, now[:3, :3].T, xnp).T
    return turn, rotate(then[:3, :3].T, now[:3, 3] - then[:3, 3], xnp)  # the difference first, as above


def still_motion(
    depth_linear: Any, camera: Pinhole, previous: Pinhole, jitter: Any = None, xnp: ModuleType = jnp
) -> Any:
    """`[h, w, 2]`: backward motion, unjittered, of points that stand still; sky follows the rotation alone.

    A point that was behind the eye comes from `BEHIND_PX`.
    """
    depth = _array(depth_linear, xnp)
    size = depth.shape[0], depth.shape[1]
    turn, shift = view_from_view(camera, previous, xnp)
    here = unjittered_positions(size, jitter, depth.dtype, xnp)
    # Homogeneous points ray + shift / depth: at infinite depth only the rotation is left.
    inverse = xnp.where(xnp.isfinite(depth), 1 / xnp.where(depth > _NEAR, depth, _NEAR), 0.0)
    points = rotate(turn, view_rays(here, camera, size, xnp), xnp) + inverse * shift[None, None]
    return here - pixels_from_view(points, previous, size, xnp)


def still_depth(
    depth_linear: Any, camera: Pinhole, previous: Pinhole, jitter: Any = None, xnp: ModuleType = jnp
) -> Any:
    """`[h, w, 1]`: the view depth that points that stand still had in the previous view; +inf for sky."""
    depth = _array(depth_linear, xnp)
    size = depth.shape[0], depth.shape[1]
    turn, shift = view_from_view(camera, previous, xnp)
    rays = view_rays(unjittered_positions(size, jitter, depth.dtype, xnp), camera, size, xnp)
    hit = xnp.isfinite(depth)
    points = rotate(turn, rays * xnp.where(hit, depth, 0.0), xnp) + shift[None, None]
    return xnp.where(hit, points[..., 2:], xnp.inf)


def _array(value: Any, xnp: ModuleType) -> Any:
    return xnp.asarray(value, np.float64 if xnp is np else None)


def _width_height(size: tuple[int, int], like: Any, xnp: ModuleType) -> Any:
    return xnp.asarray((size[1], size[0]), like.dtype)
