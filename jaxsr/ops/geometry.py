"""Pinhole geometry: rays, world positions, projection, and the motion of everything that stands still.

`jaxsr.frames.Camera` holds the convention: view space is x right, y down, z forward, depth is linear view
depth, +inf for sky. Sizes are (H, W). A jitter argument is in pixels of the image at hand (LR jitter times
the scale, for an HR image): pixel p shows what the unjittered camera has at p + J. None means unjittered.

The functions are differentiable in depth and camera. Sky has finite results and finite (zero) gradients.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from jaxsr.ops import pinhole
from jaxsr.ops._batch import over_batch


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
        pixels = pinhole.unjittered_positions(size, jitter, matrix.dtype)
        return pinhole.rotate(matrix[:3, :3], pinhole.view_rays(pixels, camera, size))

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
    return over_batch(pinhole.world_from_depth, depth_linear, camera, jitter_px)


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
        of the eye has no pixel: it gets `pinhole.BEHIND_PX` twice and its own depth.

    Raises:
        JaxsrError: bad size.
    """
    _check_size("project", size)

    def one(_: Array, camera: Camera, world: Array) -> tuple[Array, Array]:
        return pinhole.pixels_from_world(world, camera, size)

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
        Motion in pixels of the depth buffer. A point that was behind the eye comes from `pinhole.BEHIND_PX`.
    """
    return over_batch(pinhole.still_motion, depth_linear, camera, previous_camera, jitter_px)


@jax.jit
def previous_depth(
    depth_linear: Float[Array, "*b h w 1"],
    camera: Camera,
    previous_camera: Camera,
    jitter_px: Float[Array, "*b 2"] | None = None,
) -> Float[Array, "*b h w 1"]:
    """The linear view depth that the point of each pixel had in the previous view, if it stands still.

    What was seen at the end of the motion can be compared with it: the same surface has this depth there.

    Args:
        depth_linear: of the current frame, +inf for sky.
        camera: of the current frame.
        previous_camera: of the frame before.
        jitter_px: J of the depth buffer in its own pixels.

    Returns:
        Depth in the view of `previous_camera`, +inf for sky, with no gradient there. It is 0 or less for a
        point that was at or behind the plane of the eye.
    """
    return over_batch(pinhole.still_depth, depth_linear, camera, previous_camera, jitter_px)
