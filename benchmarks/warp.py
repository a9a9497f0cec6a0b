"""Backward warp of a 3-channel image: ours against NumPy, OpenCV, PyTorch and dm-pix.

    python -m benchmarks.warp [--quick]

Questions: the forward pass (bilinear, bicubic), and forward with the gradients of image and motion. The peer
is OpenCV's remap for the forward pass; it has no gradients. Peers are given sample positions, made outside of
the timing; ours starts from the motion. Bicubic is a = -0.5 here and -0.75 there, which is the same work.

Tried for ours: planar channels (6 times slower), one gather of 2x2 windows (forward equal, gradient of the
image 0.7 times the time, but more memory and no export), RGBA padding (forward 0.9-2.4 times).
"""

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Inputs, Prepared, Variant
from jaxsr.ops import backward_warp


def ours(mode: str) -> Variant:
    return Variant(
        "jaxsr", lambda inputs: _common.compiled(lambda i, m: backward_warp(i, m, mode=mode), inputs[:2])
    )


def ours_gradient(mode: str) -> Variant:
    def loss(image: jax.Array, motion: jax.Array) -> jax.Array:
        return jnp.square(backward_warp(image, motion, mode=mode)).sum()

    return Variant(
        "jaxsr",
        lambda inputs: _common.compiled(jax.value_and_grad(loss, (0, 1)), inputs[:2]),
    )


def _positions(motion: np.ndarray) -> np.ndarray:
    height, width, _ = motion.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([x, y], -1) - motion


def numpy_bilinear(inputs: Inputs) -> Prepared:
    image, positions = inputs[0], _positions(inputs[1])
    height, width, channels = image.shape

    def call() -> np.ndarray:
        low = np.floor(positions)
        fx, fy = np.moveaxis(positions - low, -1, 0)[..., None]
        x, y = np.moveaxis(low.astype(np.int32), -1, 0)
        x0, x1 = np.clip(x, 0, width - 1), np.clip(x + 1, 0, width - 1)
        y0, y1 = np.clip(y, 0, height - 1) * width, np.clip(y + 1, 0, height - 1) * width
        pixels = image.reshape(-1, channels)
        top = pixels[y0 + x0] * (1 - fx) + pixels[y0 + x1] * fx
        bottom = pixels[y1 + x0] * (1 - fx) + pixels[y1 + x1] * fx
        return top * (1 - fy) + bottom * fy

    return Prepared(call)


def opencv(mode: str) -> Variant:
    def build(inputs: Inputs) -> Prepared:
        import cv2

        flag = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}[mode]
        x, y = (np.ascontiguousarray(p) for p in np.moveaxis(_positions(inputs[1]), -1, 0))
        return Prepared(lambda: cv2.remap(inputs[0], x, y, flag, borderMode=cv2.BORDER_REPLICATE))

    return Variant("OpenCV", build)


def pytorch(mode: str, gradient: bool = False) -> Variant:
    def build(inputs: Inputs) -> Prepared:
        import torch
        import torch.nn.functional as F

        image = torch.tensor(inputs[0]).permute(2, 0, 1)[None].contiguous()
        height, width, _ = inputs[0].shape
        grid = (_positions(inputs[1]) + 0.5) / np.array([width, height], np.float32) * 2 - 1
        grid = torch.tensor(grid)[None]

        def forward() -> Any:
            return F.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=False)

        def backward() -> Any:
            image.grad = grid.grad = None
            forward().square().sum().backward()
            return None

        if gradient:
            image.requires_grad_(), grid.requires_grad_()
            return Prepared(backward)
        return Prepared(lambda: forward().shape)

    return Variant("PyTorch", build)


def dm_pix(gradient: bool = False) -> Variant:
    def forward(image: jax.Array, positions: jax.Array) -> jax.Array:
        import dm_pix

        at = [positions[..., 1], positions[..., 0]]
        channels = [dm_pix.flat_nd_linear_interpolate(image[..., c], jnp.stack(at)) for c in range(3)]
        return jnp.stack(channels, -1)

    def build(inputs: Inputs) -> Prepared:
        arrays = inputs[0], _positions(inputs[1])
        if not gradient:
            return _common.compiled(forward, arrays)
        loss = jax.value_and_grad(lambda i, p: jnp.square(forward(i, p)).sum(), (0, 1))
        return _common.compiled(loss, arrays)

    return Variant("dm-pix", build)


def main() -> None:
    args = _common.arguments(__doc__)
    has = {name: importlib.util.find_spec(name) is not None for name in ("cv2", "torch", "dm_pix")}
    questions = {
        "bilinear": [
            ours("bilinear"),
            *([opencv("bilinear")] if has["cv2"] else []),
            *([pytorch("bilinear")] if has["torch"] else []),
            *([dm_pix()] if has["dm_pix"] else []),
            Variant("NumPy", numpy_bilinear),
        ],
        "bicubic": [
            ours("bicubic"),
            *([opencv("bicubic")] if has["cv2"] else []),
            *([pytorch("bicubic")] if has["torch"] else []),
        ],
        "bilinear and gradients": [
            ours_gradient("bilinear"),
            *([pytorch("bilinear", gradient=True)] if has["torch"] else []),
            *([dm_pix(gradient=True)] if has["dm_pix"] else []),
        ],
    }
    references = {"bilinear": "OpenCV", "bicubic": "OpenCV", "bilinear and gradients": "PyTorch"}
    _common.run(__file__, questions, references, args, [name for name, found in has.items() if not found])


if __name__ == "__main__":
    main()
