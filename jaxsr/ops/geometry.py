"""Pinhole geometry: rays, world positions, projection, and the motion of everything that stands still.

`jaxsr.frames.Camera` holds the convention: view space is x right, y down, z forward, depth is linear view
depth, +inf for sky. Sizes are (H, W). A jitter argument is in pixels of the image at hand (LR jitter times
the scale, for an HR image): pixel p shows what the unjittered camera has at p + J. None means unjittered.

The functions are differentiable in depth and camera. Sky has finite results and finite (zero) gradients.
"""

import functools

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from jaxsr.ops._batch import over_batch
from jaxsr.ops.resampling import pixel_grid

BEHIND_PX = -1e6
"""Both coordinates of a point at or behind the plane of the eye: finite, and outside every image."""

_NEAR = 1e-6


def rotate(matrix: Array, vectors: Array) -> Array:
    """`matrix @ vector` for each of `[..., 3]` vectors."""
    # Sums of products fuse, and no matrix unit rounds to fewer bits, which would move points by pixels.
    lead = (None,) * (vectors.ndim - 1)
    x, y, z = (vectors[..., k : k + 1] * matrix[:, k][lead] for k in range(3))
    return x + y + z


def view_rays(pixels: Array, camera: Camera, size: tuple[int, int]) -> Array:
    """View-space rays of unit view depth through `[h, w, 2]` positions of the unjittered image."""
    ndc = (pixels + 0.5) * jnp.array([2 / size[1], 2 / size[0]], pixels.dtype)[None, None] - 1
    xy = (ndc + camera.lens_shift[None, None]) * camera.tan_half_fov[None, None]
    return jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)


def unjittered_positions(size: tuple[int, int], jitter: Array | None, dtype: DTypeLike) -> Array:
    """The position in the unjittered image that each pixel shows: p + J."""
    grid = pixel_grid(*size, dtype)
    return grid if jitter is None else grid + jitter[None, None]


def view_from_view(camera: Camera, previous: Camera) -> tuple[Array, Array]:
    """Rotation and translation from the view space of one camera to that of another."""
    now, then = jnp.asarray(camera.world_from_view), jnp.asarray(previous.world_from_view)
    turn = jnp.matmul(then[:3, :3].T, now[:3, :3], precision=jax.lax.Precision.HIGHEST)
    return turn, rotate(then[:3, :3].T, now[:3, 3] - then[:3, 3])  # difference first: worlds are large


def _project_view(points: Array, camera: Camera, size: tuple[int, int]) -> tuple[Array, Array]:
    """Pixels and depth of view-space points."""
    lead = (None,) * (points.ndim - 1)
    depth = points[..., 2:]
    before = depth > _NEAR
    ndc = (
        points[..., :2] / jnp.where(before, depth, 1.0) / camera.tan_half_fov[lead] - camera.lens_shift[lead]
    )
    half_size = jnp.array([size[1] / 2, size[0] / 2], points.dtype)[lead]
    return jnp.where(before, (ndc + 1) * half_size - 0.5, BEHIND_PX), depth


def _check_size(where: str, size: tuple[int, int]) -> None:
    if len(size) != 2 or min(size) < 1:
        raise JaxsrError("bad size", where=where, expected="(H, W), at least 1 x 1", found=size)


@functools.partial(jax.jit, static_argnames=("size",))
def view_directions(
    camera: Camera, size: tuple[int, int], jitter_px: Float[Array, "*b 2"] | None = None
) -> Float[Array, "*b h w 3"]:
    """World-space rays through the pixels, of unit view depth: `position = eye + depth * direction`.

    They are not unit vectors. The eye is `camera.world_from_view[..., :3, 3]`.

    Args:
        camera: of the frame.
        size: (H, W).
        jitter_px: J in pixels of this image.

    Raises:
        JaxsrError: bad size.
    """
    _check_size("view_directions", size)

    def one(matrix: Array, camera: Camera, jitter: Array | None) -> Array:
        return rotate(
            matrix[:3, :3], view_rays(unjittered_positions(size, jitter, matrix.dtype), camera, size)
        )

    return over_batch(one, jnp.asarray(camera.world_from_view), camera, jitter_px, ndim=2)


@jax.jit
def world_position(
    depth_linear: Float[Array, "*b h w 1"], camera: Camera, jitter_px: Float[Array, "*b 2"] | None = None
) -> Float[Array, "*b h w 3"]:
    """The point that each pixel shows, in world space; 0 for sky, which has none (nor a gradient).

    Args:
        depth_linear: linear view depth, +inf for sky.
        camera: of the same frame.
        jitter_px: J in pixels of this image.
    """

    def one(depth: Array, camera: Camera, jitter: Array | None) -> Array:
        matrix = jnp.asarray(camera.world_from_view)
        size = (depth.shape[0], depth.shape[1])
        rays = rotate(
            matrix[:3, :3], view_rays(unjittered_positions(size, jitter, depth.dtype), camera, size)
        )
        hit = jnp.isfinite(depth)
        point = matrix[None, None, :3, 3] + jnp.where(hit, depth, 0.0) * rays
        return jnp.where(hit, point, 0.0)

    return over_batch(one, depth_linear, camera, jitter_px)


@functools.partial(jax.jit, static_argnames=("size",))
def project(
    world: Float[Array, "*bn 3"], camera: Camera, size: tuple[int, int]
) -> tuple[Float[Array, "*bn 2"], Float[Array, "*bn 1"]]:
    """Where world-space points appear in the unjittered image.

    Args:
        world: points; the batch axes of the camera lead, any others follow.
        camera: the observer.
        size: (H, W).

    Returns:
        Pixels (x, y), which may lie outside the image, and linear view depth. A point at or behind the plane
        of the eye has no pixel: it gets `BEHIND_PX` twice and its own depth.

    Raises:
        JaxsrError: bad size.
    """
    _check_size("project", size)

    def one(matrix: Array, camera: Camera, world: Array) -> tuple[Array, Array]:
        offset = world - matrix[(None,) * (world.ndim - 1) + (slice(3), 3)]
        return _project_view(rotate(matrix[:3, :3].T, offset), camera, size)

    return over_batch(one, jnp.asarray(camera.world_from_view), camera, world, ndim=2)


@jax.jit
def camera_motion(
    depth_linear: Float[Array, "*b h w 1"],
    camera: Camera,
    previous_camera: Camera,
    jitter_px: Float[Array, "*b 2"] | None = None,
) -> Float[Array, "*b h w 2"]:
    """Backward motion, unjittered, of points that stand still; sky follows the rotation alone.

    `p_prev = p - motion`, where p is the position without jitter, so that the result is MV_N whether or
    not the depth buffer is jittered (jitter only says where each pixel looked).

    Args:
        depth_linear: of the current frame, +inf for sky.
        camera: of the current frame.
        previous_camera: of the frame before; its field of view may differ.
        jitter_px: J of the depth buffer in its own pixels.

    Returns:
        Motion in pixels of the depth buffer. A point that was behind the eye has `p_prev = BEHIND_PX`.
    """

    def one(depth: Array, camera: Camera, before: Camera, jitter: Array | None) -> Array:
        size = (depth.shape[0], depth.shape[1])
        turn, shift = view_from_view(camera, before)
        here = unjittered_positions(size, jitter, depth.dtype)
        # Homogeneous points ray + shift / depth: at infinite depth only the rotation is left.
        inverse = jnp.where(jnp.isfinite(depth), 1 / jnp.where(depth > _NEAR, depth, _NEAR), 0.0)
        points = rotate(turn, view_rays(here, camera, size)) + inverse * shift[None, None]
        pixels, _ = _project_view(points, before, size)
        return here - pixels

    return over_batch(one, depth_linear, camera, previous_camera, jitter_px)
