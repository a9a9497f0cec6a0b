"""One small batch of two for every public op: what a check of all ops runs on."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsr import ops
from jaxsr.frames import Camera, GBuffer

ON_THE_HOST = {"SamplePositions", "halton", "jitter_sequence", "pixel_grid"}
"""Public names that take no batch."""


class Example(NamedTuple):
    fn: Callable[..., Any]
    arguments: tuple[Any, ...]
    """Pytrees of arrays, each with a leading axis of 2."""
    differentiable: tuple[int, ...] = (0,)
    """Arguments with a gradient at which the op is smooth."""


def _camera(rng: np.random.Generator, dtype: Any) -> Camera:
    matrices = np.tile(np.eye(4), (2, 1, 1))
    for matrix in matrices:
        turn, _ = np.linalg.qr(np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
        matrix[:3, :3] = turn * np.sign(np.diag(turn))
        matrix[:3, 3] = 0.1 * rng.normal(size=3)
    fov, shift = np.array([[0.8, 0.6]] * 2), np.array([[0.05, -0.02]] * 2)
    return Camera(*(a.astype(dtype) for a in (matrices, fov, shift)))


def examples(dtype: Any = np.float32) -> dict[str, Example]:
    """By name, all that `jaxsr.ops` exports but for `ON_THE_HOST`."""
    rng = np.random.default_rng(0)
    h, w = 6, 8

    def image(channels: int, scale: int = 1, low: float = 0.1, high: float = 0.9) -> np.ndarray:
        return rng.uniform(low, high, (2, h * scale, w * scale, channels)).astype(dtype)

    color, base, motion, depth = image(3), image(3), image(2, low=0.6, high=1.4), image(1, low=2.0, high=3.0)
    normal = image(3)
    jitter, before = rng.uniform(-0.4, 0.4, (2, 2, 2)).astype(dtype)
    camera, camera_before = _camera(rng, dtype), _camera(rng, dtype)
    objects = np.ones_like(depth)
    gbuffer = GBuffer(depth, motion, normal, base, object_id=objects)
    surface = depth > 2.2
    both = (0, 1)
    found = {
        "backward_warp": Example(ops.backward_warp, (color, motion), both),
        "blend_mask": Example(
            ops.blend_mask, (color, image(3, 2), base, image(3, 2), normal, image(3, 2)), ()
        ),
        "camera_motion": Example(ops.camera_motion, (depth, camera, camera_before, jitter), (0, 1, 2, 3)),
        "compose_motion": Example(ops.compose_motion, (motion, image(4)), both),
        "current_positions": Example(
            functools.partial(ops.current_positions, size=(12, 16), scale=2), (jitter,)
        ),
        "demodulate": Example(
            lambda c, b, f, s: ops.demodulate(c, b, surface=f, specular=s),
            (color, base, surface, depth),
            both,
        ),
        "demodulation_divisor": Example(lambda b, f: ops.demodulation_divisor(b, surface=f), (base, surface)),
        "depth_mask": Example(ops.depth_mask, (depth, depth, motion), ()),
        "dilate_motion": Example(ops.dilate_motion, (depth, motion), both),
        "disocclusion_mask": Example(
            ops.disocclusion_mask, (gbuffer, gbuffer, camera, camera_before, jitter, before), ()
        ),
        "forward_splat": Example(ops.forward_splat, (color, motion, depth)),
        "from_display": Example(ops.from_display, (color,)),
        "hr_from_lr": Example(functools.partial(ops.hr_from_lr, scale=2), (depth, motion, jitter), both),
        "inverse_tone_map": Example(ops.inverse_tone_map, (color,)),
        "jittered_motion": Example(ops.jittered_motion, (motion, jitter, before), (0, 1, 2)),
        "linear_from_srgb": Example(ops.linear_from_srgb, (color,)),
        "luminance": Example(ops.luminance, (color,)),
        "modulate": Example(lambda c, b, f: ops.modulate(c, b, surface=f), (color, base, surface), both),
        "normal_mask": Example(ops.normal_mask, (normal, image(3)), ()),
        "occlusion_motion": Example(ops.occlusion_motion, (motion, depth), ()),
        "pixel_shuffle": Example(functools.partial(ops.pixel_shuffle, block=2), (image(8),)),
        "pixel_unshuffle": Example(functools.partial(ops.pixel_unshuffle, block=2), (color,)),
        "position_mask": Example(
            ops.position_mask, (depth, depth, normal, motion, camera, camera_before, jitter, before), ()
        ),
        "positions_from_jittered_motion": Example(
            ops.positions_from_jittered_motion, (motion, jitter, before), (0, 1, 2)
        ),
        "positions_from_motion": Example(ops.positions_from_motion, (motion, jitter, before), (0, 1, 2)),
        "previous_depth": Example(ops.previous_depth, (depth, camera, camera_before, jitter), (0, 1, 3)),
        "project": Example(
            lambda p, c: ops.project(p, c, (h, w)), (image(3, low=1.0, high=2.0), camera), both
        ),
        "reproject": Example(
            functools.partial(ops.reproject, strides=(1,), sigma_guide=0.5),
            (color, motion, base, image(3)),
            both,
        ),
        "resize": Example(functools.partial(ops.resize, size=(5, 9), mode="bicubic"), (color,)),
        "rgb_from_ycocg": Example(ops.rgb_from_ycocg, (color,)),
        "sample": Example(ops.sample, (color, motion), both),
        "sample_jittered": Example(
            functools.partial(ops.sample_jittered, size=(12, 16)), (color, jitter), both
        ),
        "srgb_from_linear": Example(ops.srgb_from_linear, (color,)),
        "stencil_mask": Example(ops.stencil_mask, (objects, objects), ()),
        "to_display": Example(ops.to_display, (color,)),
        "tone_map": Example(ops.tone_map, (color,)),
        "unjittered_motion": Example(ops.unjittered_motion, (motion, jitter, before), (0, 1, 2)),
        "upsample": Example(functools.partial(ops.upsample, scale=2, mode="bicubic"), (color,)),
        "view_directions": Example(lambda c, j: ops.view_directions(c, (h, w), j), (camera, jitter), both),
        "warp_zero_upsampled": Example(
            functools.partial(ops.warp_zero_upsampled, scale=2), (color, image(2, 2, 0.6, 1.4)), both
        ),
        "world_position": Example(ops.world_position, (depth, camera, jitter), (0, 1, 2)),
        "ycocg_from_rgb": Example(ops.ycocg_from_rgb, (color,)),
        "zero_upsample": Example(functools.partial(ops.zero_upsample, scale=2), (color,)),
    }
    assert set(found) == set(ops.__all__) - ON_THE_HOST
    return found


def floats(tree: Any) -> list[Any]:
    """The leaves of floating point type."""
    return [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]


def total(example: Example, arguments: Sequence[Any]) -> Any:
    """A curved function of all results, with `arguments` in place of the differentiable ones."""
    full = jax.tree.map(jnp.asarray, list(example.arguments))
    for i, argument in zip(example.differentiable, arguments, strict=True):
        full[i] = argument
    return functools.reduce(jnp.add, [jnp.sum(jnp.sin(3 * a)) for a in floats(example.fn(*full))])
