"""Camera jitter: its sequence, its place in motion vectors, and where a temporal upscaler reads.

Notation: I_N is an unjittered image, I_J a jittered one, J_t the jitter of frame t, MV_N the backward motion
without jitter and MV_J the one that counts jitter as motion. Equation numbers are those of the article
"jitter and motion vectors in temporal super-resolution", whose two shaders `positions_from_jittered_motion`
and `positions_from_motion` are, in pixels instead of texture coordinates:

    (1) I_J,t(p) = I_N,t(p + J_t)                      hence I_N,t(p) = I_J,t(p - J_t)
    (2) I_N,t(p) = I_N,t-1(p - MV_N,t(p))
    (6) MV_J,t = MV_N,t + J_{t-1} - J_t
    (7) I_N,t(p) = I_J,t-1(p - J_t - MV_J,t)
    (8) I_N,t(p) = I_N,t-1(p - MV_J,t + J_{t-1} - J_t)

The article has two misprints. Equation (8) is printed with `p - J_t - MV_J,t + ...`, one J_t too many: put
(6) into (2), or read the shader line under it, which is right. The right half of (5) needs I_J,t(p), not
I_J,t(p - J_t), on its left. The article also makes one approximation: a motion buffer belongs to the
jittered frame, so that MV_N,t(p) is found in it at p - J_t. The first shader reads it at p, which is exact
only where neighbouring pixels move alike; the second reads it at p - J_t.

Everything is in pixels of its own image. Jitter and motion are in LR pixels unless a docstring says
otherwise, and J is in [-0.5, 0.5]. The positions are differentiable in motion and jitter.
`resampling.sample` reads an image at such positions; `sample_jittered` computes them and reads, for the
current frame.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.ops.resampling import pixel_grid, sample


class SamplePositions(NamedTuple):
    """Where the content of each output pixel lies. All (x, y), integers are pixel centres."""

    current: Float[Array, "*b h w 2"]
    """In the jittered LR frame t, in LR pixels."""
    previous: Float[Array, "*b h w 2"]
    """In the jittered LR frame t-1, in LR pixels."""
    previous_output: Float[Array, "*b h w 2"]
    """In the unjittered output of frame t-1, in its own pixels, those of the output."""


def halton(index: int | Int[np.ndarray, "*n"], base: int) -> Float[np.ndarray, "*n"]:
    """The radical inverse of `index` in `base` (Halton 1960), in [0, 1). NumPy float64; computed on the host.

    Raises:
        JaxsrError: a negative index, or a base below 2.
    """
    remaining = np.asarray(index, np.int64)
    if base < 2:
        raise JaxsrError("bad base", where="halton", expected="at least 2", found=base)
    if np.any(remaining < 0):
        raise JaxsrError("negative index", where="halton", expected="0 or more", found=int(remaining.min()))
    value, place = np.zeros(remaining.shape), 1.0
    while np.any(remaining > 0):
        place /= base
        value = value + place * (remaining % base)
        remaining = remaining // base
    return np.asarray(value)


def jitter_sequence(count: int, length: int = 32) -> Float[np.ndarray, "count 2"]:
    """Jitter (x, y) of `count` frames: Halton(2, 3) from index 1 on, less one half, repeating (Karis 2014).

    Args:
        count: number of frames.
        length: period.

    Returns:
        NumPy float32 in (-0.5, 0.5), in LR pixels.

    Raises:
        JaxsrError: a negative count, or a length below 1.
    """
    if count < 0 or length < 1:
        raise JaxsrError(
            "bad sequence", where="jitter_sequence", expected="count >= 0, length >= 1", found=(count, length)
        )
    index = np.arange(count) % length + 1
    return np.stack([halton(index, 2), halton(index, 3)], axis=-1).astype(np.float32) - np.float32(0.5)


def _at_pixels(jitter: Array) -> Array:
    return jitter[..., None, None, :]


@jax.jit
def jittered_motion(
    motion_px: Float[Array, "*b h w 2"],
    jitter_px: Float[Array, "*b 2"],
    previous_jitter_px: Float[Array, "*b 2"],
) -> Float[Array, "*b h w 2"]:
    """Motion between two jittered frames: `MV_J = MV_N + J_{t-1} - J_t` (eq. 6).

    With it, `I_J,t(p) = I_J,t-1(p - MV_J,t(p))`, where both buffers belong to the jittered frame t.

    Args:
        motion_px: MV_N, backward, in pixels of its image.
        jitter_px: J_t in pixels of the same image (LR jitter times the scale, for HR motion).
        previous_jitter_px: J_{t-1}, likewise.
    """
    return motion_px + _at_pixels(previous_jitter_px - jitter_px)


@jax.jit
def unjittered_motion(
    motion_jittered_px: Float[Array, "*b h w 2"],
    jitter_px: Float[Array, "*b 2"],
    previous_jitter_px: Float[Array, "*b 2"],
) -> Float[Array, "*b h w 2"]:
    """The inverse of `jittered_motion`: `MV_N = MV_J - J_{t-1} + J_t` (eq. 6); all in its image's pixels."""
    return motion_jittered_px - _at_pixels(previous_jitter_px - jitter_px)


def _output_pixels(shape: tuple[int, ...], scale: float, dtype: DTypeLike) -> Array:
    """p of the equations: output pixels in pixels of the unjittered LR image (`ori_uv`)."""
    return jnp.broadcast_to((pixel_grid(shape[-3], shape[-2], dtype) + 0.5) / scale - 0.5, shape)


def _to_output(position: Array, scale: float) -> Array:
    return (position + 0.5) * scale - 0.5


@functools.partial(jax.jit, static_argnames=("size", "scale"))
def current_positions(
    jitter_px: Float[Array, "*b 2"], size: tuple[int, int], scale: float = 1
) -> Float[Array, "*b h w 2"]:
    """Where each pixel of the output lies in the jittered LR frame: `p - J_t` (eq. 1; `new_uv`, `cur_uv`).

    Read LR colour, and the LR motion that the functions below want, here.

    Args:
        jitter_px: J_t in LR pixels.
        size: (H, W) of the output.
        scale: output size divided by LR size.
    """
    shape = (*jitter_px.shape[:-1], *size, 2)
    return _output_pixels(shape, scale, jitter_px.dtype) - _at_pixels(jitter_px)


@functools.partial(jax.jit, static_argnames=("size", "mode", "boundary"))
def sample_jittered(
    image: Float[Array, "*b h w c"],
    jitter_px: Float[Array, "*b 2"],
    size: tuple[int, int],
    mode: str = "bilinear",
    boundary: str = "clamp",
) -> Float[Array, "*b h2 w2 c"]:
    """The unjittered image at a larger (or equal) size, read from a jittered LR image at `current_positions`.

    `I_N(p) = I_J(p - J)` (eq. 1).

    Args:
        image: the jittered LR image, any range.
        jitter_px: J in pixels of `image`.
        size: (H, W) of the result.
        mode: as in `sample`.
        boundary: as in `sample`.

    Raises:
        JaxsrError: a size of another shape than the image, or unknown mode or boundary.
    """
    height, width = image.shape[-3:-1]
    if size[0] * width != size[1] * height:
        raise JaxsrError(
            "sizes do not match",
            where="sample_jittered",
            expected=f"the same scale along both axes of {height} x {width}",
            found=f"{size[0]} x {size[1]}",
        )
    return sample(image, current_positions(jitter_px, size, size[0] / height), mode=mode, boundary=boundary)


@functools.partial(jax.jit, static_argnames=("scale",))
def positions_from_jittered_motion(
    motion_jittered_px: Float[Array, "*b h w 2"],
    jitter_px: Float[Array, "*b 2"],
    previous_jitter_px: Float[Array, "*b 2"],
    scale: float = 1,
) -> SamplePositions:
    """The first shader: motion vectors that include jitter.

    Args:
        motion_jittered_px: MV_J for each pixel of the output, in LR pixels.
        jitter_px: J_t in LR pixels.
        previous_jitter_px: J_{t-1} in LR pixels.
        scale: output size divided by LR size.
    """
    p = _output_pixels(motion_jittered_px.shape, scale, motion_jittered_px.dtype)
    now, before = _at_pixels(jitter_px), _at_pixels(previous_jitter_px)
    return SamplePositions(
        current=p - now,  # eq. 1; new_uv
        previous=p - now - motion_jittered_px,  # eq. 7; pre_juv
        previous_output=_to_output(p - motion_jittered_px - (now - before), scale),  # eq. 8; pre_njuv
    )


@functools.partial(jax.jit, static_argnames=("scale",))
def positions_from_motion(
    motion_px: Float[Array, "*b h w 2"],
    jitter_px: Float[Array, "*b 2"],
    previous_jitter_px: Float[Array, "*b 2"],
    scale: float = 1,
) -> SamplePositions:
    """The second shader: motion vectors without jitter, the convention of `jaxsr.frames`.

    Args:
        motion_px: MV_N for each pixel of the output, in LR pixels (HR motion divided by the scale).
        jitter_px: J_t in LR pixels.
        previous_jitter_px: J_{t-1} in LR pixels.
        scale: output size divided by LR size.
    """
    p = _output_pixels(motion_px.shape, scale, motion_px.dtype)
    return SamplePositions(
        current=p - _at_pixels(jitter_px),  # eq. 1; cur_uv
        previous=p - motion_px - _at_pixels(previous_jitter_px),  # eq. 4; pre_uv
        previous_output=_to_output(p - motion_px, scale),  # eq. 2; pre_sr_uv
    )
