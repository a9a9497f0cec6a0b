"""Crops and flips of whole windows, NumPy: what is left obeys `jaxsr.frames` as if rendered that way.

Nothing is done to colours: exposure and noise are what the renderer made them. Arrays are `[T, ...]` (any
leading axes); images come back as views wherever no number changes. What is None (buffers, the camera, the LR
truth) stays None.

A crop narrows the camera's field of view and moves its axis. A flip shows the mirrored scene. To keep
`world_from_view` a rigid transform the world is mirrored, too: with M the mirror of the image axis in view
space (diag(-1, 1, 1), or diag(1, -1, 1)) and D = diag(-1, 1, 1) in the world,

    view' = M view    world' = D world    world_from_view' = D world_from_view M    normal' = D normal

D leaves y and z alone, so that whichever of them is up stays up. Both flips together turn the camera by half
a turn in the world as it was (D D = 1).
"""

from typing import Any

import jax
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, GBuffer, Window

_WORLD = np.array([-1, 1, 1])


def crop(window: Window, x: int, y: int, size: tuple[int, int]) -> Window:
    """Cut out HR pixels x .. x + W - 1, y .. y + H - 1 and the LR pixels over them; jitter stays.

    Args:
        window: frames of one size.
        x, y: the left and top HR pixel, multiples of the scale.
        size: (H, W) in HR pixels, multiples of the scale.

    Raises:
        JaxsrError: not multiples, or outside the frames.
    """
    frames, scale = window.frames, window.frames.scale
    height, width = window.truth_linear.shape[-3:-1]
    h, w = size
    if any(n % scale for n in (x, y, h, w)):
        raise JaxsrError(
            "the crop does not lie on whole LR pixels",
            expected=f"multiples of {scale}",
            found=f"{w}x{h} at x={x} y={y}",
        )
    if not (0 <= x <= width - w and 0 <= y <= height - h and w > 0 and h > 0):
        raise JaxsrError(
            "the crop is outside the frame",
            expected=f"within {width}x{height}",
            found=f"{w}x{h} at x={x} y={y}",
        )

    def cut_out(s: int) -> Any:
        rows, columns = slice(y // s, (y + h) // s), slice(x // s, (x + w) // s)
        return lambda image: image[..., rows, columns, :]

    # (ndc' + 1) (w, h) / 2 + (x, y) = (ndc + 1) (W, H) / 2, put into ndc + shift = (x, y) / (z tan).
    part = np.array([w / width, h / height])
    offset = np.array([(2 * x + w - width) / w, (2 * y + h - height) / h])
    camera = frames.camera
    if camera is not None:
        camera = camera._replace(
            tan_half_fov=camera.tan_half_fov * part, lens_shift=camera.lens_shift / part + offset
        )
    return Window(
        frames._replace(
            color_linear=cut_out(scale)(frames.color_linear),
            lr=jax.tree.map(cut_out(scale), frames.lr),
            hr=jax.tree.map(cut_out(1), frames.hr),
            camera=camera,
        ),
        cut_out(1)(window.truth_linear),
        None if window.lr_truth_linear is None else cut_out(scale)(window.lr_truth_linear),
    )


def flip(window: Window, *, horizontal: bool = False, vertical: bool = False) -> Window:
    """Mirror left and right (x), top and bottom (y), or both, with all that has a direction."""
    if not (horizontal or vertical):
        return window
    frames = window.frames
    image = np.array([-1 if horizontal else 1, -1 if vertical else 1])
    view = np.array([*image, 1])
    world = _WORLD if horizontal != vertical else np.ones(3, int)

    def mirrored(x: Any) -> Any:
        return x[..., :: image[1], :: image[0], :]

    def buffers(g: GBuffer) -> GBuffer:
        g = jax.tree.map(mirrored, g)
        return g._replace(
            motion_px=None if g.motion_px is None else _signed(g.motion_px, image),
            normal=None if g.normal is None else _signed(g.normal, world),
        )

    camera = frames.camera
    if camera is not None:
        matrix = camera.world_from_view * np.outer([*world, 1], [*view, 1]).astype(float)
        camera = Camera(matrix, camera.tan_half_fov, _signed(camera.lens_shift, image))
    return Window(
        frames._replace(
            color_linear=mirrored(frames.color_linear),
            lr=buffers(frames.lr),
            hr=buffers(frames.hr),
            jitter_px=_signed(frames.jitter_px, image),
            hr_jitter_px=_signed(frames.hr_jitter_px, image),
            camera=camera,
        ),
        mirrored(window.truth_linear),
        None if window.lr_truth_linear is None else mirrored(window.lr_truth_linear),
    )


def random_crop(
    window: Window,
    rng: np.random.Generator,
    *,
    crop_px: int,
    flips: bool = False,
    vertical_flips: bool = False,
) -> Window:
    """A square crop anywhere on the LR grid, mirrored with probability one half along each axis allowed."""
    scale = window.frames.scale
    height, width = window.truth_linear.shape[-3:-1]
    # All numbers are always drawn: the crops are the same with and without flips.
    x, y = (scale * int(rng.integers((n - crop_px) // scale + 1)) for n in (width, height))
    horizontal, vertical = (bool(rng.integers(2)) for _ in range(2))
    window = crop(window, x, y, (crop_px, crop_px))
    return flip(window, horizontal=flips and horizontal, vertical=vertical_flips and vertical)


def _signed(x: Any, signs: np.ndarray) -> Any:
    return x * signs.astype(x.dtype)
