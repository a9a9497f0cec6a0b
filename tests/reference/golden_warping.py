"""Writes golden_warping.npz: what OpenCV and PyTorch make of the same image and motion.

    pip install torch==2.13.0 opencv-python-headless==5.0.0.93
    python -m tests.reference.golden_warping

The tests need only the .npz. OpenCV's bilinear remap is compared on motions in 32ths of a pixel, which every
version of it represents exactly. Bicubic: both libraries' warps have a = -0.75 where ours is -0.5, so the
golden is PyTorch's antialiased enlargement, which has a = -0.5; enlarging by 4 and keeping every fourth pixel
from (i, j) is a warp by a constant motion ((3 - 2 i) / 8, ...).
"""

from pathlib import Path

import numpy as np

SCALE = 4


def image() -> np.ndarray:
    return np.sin(np.arange(11 * 14 * 3, dtype=np.float64) ** 1.5).reshape(11, 14, 3).astype(np.float32)


def motion() -> np.ndarray:
    """Up to eight pixels, some out of the image; multiples of 1/32, none of them a half."""
    t = np.arange(11 * 14, dtype=np.float64)
    unit = np.stack([t * 0.6180339887 % 1, t * 0.7548776662 % 1], -1).reshape(11, 14, 2)
    steps = np.round((unit - 0.5) * 16 * 32)
    return ((steps + (steps % 32 == 16)) / 32).astype(np.float32)


def constant_motion(phase: int) -> float:
    """Sampling the enlarged image at 4 x + phase is sampling ours at x + (phase + 0.5) / 4 - 0.5."""
    return 0.5 - (phase + 0.5) / SCALE


def main() -> None:
    import cv2
    import torch
    import torch.nn.functional as F

    h, w, _ = image().shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    at = np.stack([x, y], -1) - motion()
    nchw = torch.tensor(image()).permute(2, 0, 1)[None]
    grid = torch.tensor((at + 0.5) / np.array([w, h], np.float32) * 2 - 1)[None]
    out = {}
    for boundary, border, padding in (
        ("clamp", cv2.BORDER_REPLICATE, "border"),
        ("zero", cv2.BORDER_CONSTANT, "zeros"),
    ):
        for mode, flag in (("bilinear", cv2.INTER_LINEAR), ("nearest", cv2.INTER_NEAREST)):
            out[f"opencv_{mode}_{boundary}"] = cv2.remap(
                image(), at[..., 0], at[..., 1], flag, borderMode=border
            )
            sampled = F.grid_sample(nchw, grid, mode=mode, padding_mode=padding, align_corners=False)
            out[f"pytorch_{mode}_{boundary}"] = sampled[0].permute(1, 2, 0).numpy()
    big = F.interpolate(nchw, scale_factor=SCALE, mode="bicubic", align_corners=False, antialias=True)
    for phase_y, phase_x in ((0, 1), (3, 2)):
        kept = big[0, :, phase_y::SCALE, phase_x::SCALE]
        out[f"pytorch_bicubic_{phase_y}{phase_x}"] = kept.permute(1, 2, 0).numpy()
    np.savez_compressed(Path(__file__).with_suffix(".npz"), **out)


if __name__ == "__main__":
    main()
