"""Where history can be trusted: masks that are 1 where valid and 0 in holes, and ExtraSS' blend mask.

Masks are `[..., H, W, 1]` in the dtype of the first argument, exactly 0 or 1, and carry no gradient. The
tests are those of ExtraNet (Guo et al. 2021): a change of object, for moving objects a change of normal, for
static ones the distance in world space to the nearest of the four bilinear taps; and a test of depth alone,
where no camera is known. A pixel that comes from outside the previous image is a hole. Sky only matches sky.

Motion is backward, in pixels of its own image, between the two images as they are: for jittered G-buffers
pass `jitter.jittered_motion`, except to `disocclusion_mask`, which takes the jitters and does it itself.
A tap counts if its bilinear weight exceeds 1 %, so that motion of 1e-4 px does not read a neighbour.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, GBuffer
from jaxsr.ops._batch import over_batch
from jaxsr.ops.geometry import camera_motion
from jaxsr.ops.jitter import jittered_motion
from jaxsr.ops.pinhole import rotate, unjittered_positions, view_from_view, view_rays
from jaxsr.ops.resampling import gather_pixels, pixel_grid, upsample
from jaxsr.ops.warping import backward_warp

_MIN_WEIGHT = 0.01


def _as_mask(valid: Array, like: Array) -> Array:
    return valid.astype(like.dtype)


def _dot(a: Array, b: Array) -> Array:
    """The sum over the channels, `[..., 1]`. Written out, it is 80 times faster on a CPU than a reduction."""
    return functools.reduce(jnp.add, [a[..., c : c + 1] * b[..., c : c + 1] for c in range(a.shape[-1])])


def _cosine(a: Array, b: Array) -> Array:
    """Cosine of two normals; 1 where both are missing, 0 where one is. No gradient."""
    a, b = jax.lax.stop_gradient((a, b))
    length_a, length_b = jnp.sqrt(_dot(a, a)), jnp.sqrt(_dot(b, b))
    product = length_a * length_b
    cosine = _dot(a, b) / jnp.where(product > 0, product, 1.0)
    return jnp.where((length_a == 0) & (length_b == 0), 1.0, cosine)


def _in_frame(positions: Array, height: int, width: int) -> Array:
    """True where a position lies within the pixels of the image, up to their outer edges."""
    x, y = positions[..., 0:1], positions[..., 1:2]
    return (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)


def _taps(positions: Array, height: int, width: int) -> list[tuple[Array, Array, Array]]:
    """The four bilinear taps: clamped x, y, and whether the tap counts."""
    safe = jnp.clip(
        jnp.nan_to_num(positions, nan=-4.0),
        -4.0,
        jnp.array([width + 3.0, height + 3.0], positions.dtype)[None, None],
    )
    base = jnp.floor(safe)
    fraction = safe - base
    corner = base.astype(jnp.int32)
    taps = []
    for dy in (0, 1):
        for dx in (0, 1):
            weight = jnp.abs(1 - dx - fraction[..., 0]) * jnp.abs(1 - dy - fraction[..., 1])
            x, y = corner[..., 0] + dx, corner[..., 1] + dy
            counts = weight > _MIN_WEIGHT
            taps.append((jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1), counts[..., None]))
    return taps


@jax.jit
def stencil_mask(
    object_id: Float[Array, "*b h w 1"], warped_previous_object_id: Float[Array, "*b h w 1"]
) -> Float[Array, "*b h w 1"]:
    """Valid where the object is the same as where the pixel came from (ExtraNet's stencil test).

    Args:
        object_id: whole numbers, 0 for sky.
        warped_previous_object_id: the previous object numbers, warped with "nearest" (numbers do not mix).
    """
    return _as_mask(jnp.abs(object_id - warped_previous_object_id) < 0.5, object_id)


@functools.partial(jax.jit, static_argnames=("threshold",))
def normal_mask(
    normal: Float[Array, "*b h w 3"], warped_normal: Float[Array, "*b h w 3"], threshold: float = 0.98
) -> Float[Array, "*b h w 1"]:
    """Valid where the cosine between the normals is at least `threshold` (0.98 is 11.5 degrees).

    Lengths do not matter. Two missing normals (sky) agree; one missing normal does not. 0.98 is ExtraNet's.

    Args:
        normal: world space, of the current frame, 0 for sky.
        warped_normal: those of the previous frame, warped, likewise.
        threshold: smallest cosine.
    """
    return _as_mask(_cosine(normal, warped_normal) >= threshold, normal)


@functools.partial(jax.jit, static_argnames=("tolerance",))
def depth_mask(
    depth_linear: Float[Array, "*b h w 1"],
    previous_depth_linear: Float[Array, "*b h w 1"],
    motion_px: Float[Array, "*b h w 2"],
    *,
    tolerance: float = 0.05,
) -> Float[Array, "*b h w 1"]:
    """Valid where a tap of the previous depth is near the current one; needs no camera.

    `min over taps |d_prev - d| / min(d_prev, d) <= tolerance`. Depths change when the camera or the object
    advances: the tolerance must exceed that change in one frame.

    Args:
        depth_linear: of the current frame, +inf for sky.
        previous_depth_linear: of the previous one, in the same unit.
        motion_px: backward motion between the two images as they are, jitter included.
        tolerance: largest relative difference.
    """

    def one(depth: Array, previous: Array, motion: Array) -> Array:
        height, width, _ = depth.shape
        positions = pixel_grid(height, width, motion.dtype) - motion
        valid = jnp.zeros(depth.shape, bool)
        for x, y, counts in _taps(positions, height, width):
            tap = gather_pixels(previous, x, y)
            near = (tap == depth) | (jnp.abs(tap - depth) <= tolerance * jnp.minimum(tap, depth))
            valid |= counts & near
        return _as_mask(valid & _in_frame(positions, height, width), depth)

    return over_batch(one, depth_linear, previous_depth_linear, motion_px)


@functools.partial(jax.jit, static_argnames=("tolerance",))
def position_mask(
    depth_linear: Float[Array, "*b h w 1"],
    previous_depth_linear: Float[Array, "*b h w 1"],
    normal: Float[Array, "*b h w 3"] | None,
    motion_px: Float[Array, "*b h w 2"],
    camera: Camera,
    previous_camera: Camera,
    jitter_px: Float[Array, "*b 2"] | None = None,
    previous_jitter_px: Float[Array, "*b 2"] | None = None,
    *,
    tolerance: float = 1.5,
) -> Float[Array, "*b h w 1"]:
    """For static points: valid where one of the four taps shows nearly the same point in space.

    The smallest distance in world space between the point of the pixel and the points of the taps must not
    exceed `tolerance * footprint / max(|N.V|, 1/8)`, where the footprint is the size of a pixel at that
    depth, `2 depth max(tan_half_fov / size)`, N the normal and V the direction to the eye. On a plane a
    tap is at most 0.71 pixels away, which is 0.71 footprints seen head-on and 1 / |N.V| times as much at
    a slant: the threshold follows the spacing of the samples at any unit of length and any resolution.
    (ExtraNet's code has centimetres instead, 7.5 |N.V| + 45 (1 - |N.V|) + 50 depth: a factor of 6 at a
    grazing angle, where this has 8.)

    Args:
        depth_linear: of the current frame, +inf for sky.
        previous_depth_linear: of the previous frame.
        normal: world space, of the current frame. None counts as |N.V| = 1/2.
        motion_px: backward motion between the two images as they are, jitter included.
        camera: of the current frame.
        previous_camera: of the previous frame.
        jitter_px: J_t in pixels of the depth buffer, None if unjittered.
        previous_jitter_px: J_{t-1}.
        tolerance: in footprints.
    """

    def one(
        depth: Array,
        previous: Array,
        normal: Array | None,
        motion: Array,
        camera: Camera,
        before: Camera,
        jitter: Array | None,
        jitter_before: Array | None,
    ) -> Array:
        height, width, _ = depth.shape
        size = (height, width)
        hit = jnp.isfinite(depth)
        rays = view_rays(unjittered_positions(size, jitter, depth.dtype), camera, size)
        if normal is None:
            slant: Array | float = 0.5
        else:
            slant = jnp.abs(_cosine(normal, rotate(jnp.asarray(camera.world_from_view)[:3, :3], rays)))
        pixel = 2 * jnp.max(camera.tan_half_fov / jnp.array([width, height], camera.tan_half_fov.dtype))
        threshold = tolerance * pixel * jnp.where(hit, depth, 1.0) / jnp.maximum(slant, 1 / 8)
        # Distances are the same in the previous view space, where a tap is its depth times its ray.
        turn, shift = view_from_view(camera, before)
        point = rotate(turn, rays * jnp.where(hit, depth, 1.0)) + shift[None, None]
        positions = pixel_grid(height, width, motion.dtype) - motion
        valid = jnp.zeros(depth.shape, bool)
        for x, y, counts in _taps(positions, height, width):
            tap = gather_pixels(previous, x, y)
            tap_hit = jnp.isfinite(tap)
            seen = jnp.stack([x, y], axis=-1).astype(point.dtype)
            seen = seen if jitter_before is None else seen + jitter_before[None, None]
            offset = jnp.where(tap_hit, tap, 1.0) * view_rays(seen, before, size) - point
            near = _dot(offset, offset) <= threshold * threshold
            valid |= counts & (tap_hit == hit) & (near | ~hit)
        return _as_mask(valid & _in_frame(positions, height, width), depth)

    return over_batch(
        one,
        depth_linear,
        previous_depth_linear,
        normal,
        motion_px,
        camera,
        previous_camera,
        jitter_px,
        previous_jitter_px,
    )


@functools.partial(jax.jit, static_argnames=("tolerance", "threshold", "moving_px"))
def disocclusion_mask(
    gbuffer: GBuffer,
    previous: GBuffer,
    camera: Camera,
    previous_camera: Camera,
    jitter_px: Float[Array, "*b 2"] | None = None,
    previous_jitter_px: Float[Array, "*b 2"] | None = None,
    *,
    tolerance: float = 1.5,
    threshold: float = 0.98,
    moving_px: float = 0.1,
) -> Float[Array, "*b h w 1"]:
    """All tests together, each where it applies (ExtraNet section 3): 1 valid, 0 hole.

    An object moves where its motion differs from `camera_motion`. `position_mask` tests static pixels, and
    `normal_mask` with "nearest" normals tests moving ones. For both, `stencil_mask` must hold and the pixel
    must come from inside the frame. A test is left out if its buffer (normal, object_id) is None in either
    frame.

    Args:
        gbuffer: of the current frame; `motion_px` unjittered as always.
        previous: of the previous frame, of the same size.
        camera: of the current frame.
        previous_camera: of the previous frame.
        jitter_px: J_t in pixels of these buffers; None for both if they are unjittered.
        previous_jitter_px: J_{t-1}.
        tolerance: of `position_mask`.
        threshold: of `normal_mask`.
        moving_px: smallest difference in motion, in pixels, that counts as moving.

    Raises:
        JaxsrError: one jitter without the other.
    """
    if (jitter_px is None) != (previous_jitter_px is None):
        raise JaxsrError("one jitter is missing", where="disocclusion_mask", expected="both or none")
    motion = gbuffer.motion_px
    if jitter_px is not None and previous_jitter_px is not None:
        motion = jittered_motion(motion, jitter_px, previous_jitter_px)
    height, width = motion.shape[-3:-1]
    positions = jnp.broadcast_to(pixel_grid(height, width, motion.dtype), motion.shape) - motion
    static_motion = camera_motion(gbuffer.depth_linear, camera, previous_camera, jitter_px)
    off = gbuffer.motion_px - static_motion
    moving = _dot(off, off) > moving_px**2

    same_place = position_mask(
        gbuffer.depth_linear,
        previous.depth_linear,
        gbuffer.normal,
        motion,
        camera,
        previous_camera,
        jitter_px,
        previous_jitter_px,
        tolerance=tolerance,
    )
    same_normal = jnp.ones_like(same_place)
    if gbuffer.normal is not None and previous.normal is not None:
        same_normal = normal_mask(
            gbuffer.normal, backward_warp(previous.normal, motion, mode="nearest"), threshold
        )
    mask = jnp.where(moving, same_normal, same_place) * _as_mask(
        _in_frame(positions, height, width), same_place
    )
    if gbuffer.object_id is not None and previous.object_id is not None:
        mask *= stencil_mask(gbuffer.object_id, backward_warp(previous.object_id, motion, mode="nearest"))
    return mask


@functools.partial(jax.jit, static_argnames=("delta_similar", "delta_different"))
def blend_mask(
    low_image: Float[Array, "*b hl wl 3"],
    image: Float[Array, "*b h w 3"],
    low_base_color: Float[Array, "*b hl wl 3"],
    base_color: Float[Array, "*b h w 3"],
    low_normal: Float[Array, "*b hl wl 3"],
    normal: Float[Array, "*b h w 3"],
    *,
    delta_similar: float = 0.1,
    delta_different: float = 0.1,
) -> Float[Array, "*b h w 1"]:
    """ExtraSS' choice (Wu et al. 2023) between FRNet's low-resolution image (1) and the guided warp (0).

        m = [(1 - |U(a-) - a| / sqrt 3) <U(n-), n> > d1]  and  [|U(i-) - i^| / |U(i-)| > d2]

    The first bracket: both show the same surface (base colour a, normal n). The second: the shading of the
    warp is wrong enough to give up its detail; it is compared as `|U(i-) - i^| > d2 |U(i-)|`, so nothing
    is divided. U is nearest upsampling. Two missing normals (sky) agree, their product being 1.

    Args:
        low_image: FRNet's result i-, before upsampling.
        image: the guided warp i^.
        low_base_color: a-, at the size of `low_image`.
        base_color: a, in [0, 1].
        low_normal: n-, unit or 0.
        normal: n.
        delta_similar: d1.
        delta_different: d2 (0.1 by the paper; a public re-implementation has 0.9).

    Raises:
        JaxsrError: the size of `image` is no whole multiple of that of `low_image`.
    """
    (low_h, low_w), (height, width) = low_image.shape[-3:-1], image.shape[-3:-1]
    scale = height // low_h
    if (height, width) != (low_h * scale, low_w * scale):
        raise JaxsrError(
            "sizes do not match",
            where="blend_mask",
            expected=f"a whole multiple of {low_h} x {low_w}",
            found=f"{height} x {width}",
        )

    def norm(v: Array) -> Array:
        return jnp.sqrt(_dot(v, v))

    up_image, up_base, up_normal = jax.lax.stop_gradient(
        tuple(upsample(x, scale, "nearest") for x in (low_image, low_base_color, low_normal))
    )
    image, base_color, normal = jax.lax.stop_gradient((image, base_color, normal))
    similarity = (1 - norm(up_base - base_color) / 3**0.5) * _cosine(up_normal, normal)
    different = norm(up_image - image) > delta_different * norm(up_image)
    return _as_mask((similarity > delta_similar) & different, image)
