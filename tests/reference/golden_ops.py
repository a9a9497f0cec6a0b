"""Writes golden_ops.npz: numbers of independent libraries that the tests of the pure ops compare with.

    pip install torch==2.13.0 opencv-python-headless colour-science==0.4.7
    python tests/reference/golden_ops.py

The tests need only the .npz.
"""

from pathlib import Path

import numpy as np


def image(h: int, w: int, c: int) -> np.ndarray:
    """A reproducible rough image in [-1, 1]."""
    return np.sin(np.arange(h * w * c, dtype=np.float64) ** 1.5).reshape(h, w, c).astype(np.float32)


def positions(n: int, h: int, w: int) -> np.ndarray:
    """(x, y) inside and up to two pixels outside an image."""
    t = np.arange(n, dtype=np.float64)
    unit = np.stack([t * 0.6180339887 % 1, t * 0.7548776662 % 1], -1)
    return (unit * [w + 4, h + 4] - 2).astype(np.float32)


def rgb() -> np.ndarray:
    return np.abs(image(4, 5, 3)).astype(np.float32)


def points() -> np.ndarray:
    return image(4, 5, 3).reshape(-1, 3) * np.float32(2) + np.array([0.5, -0.3, 5.0], np.float32)


ROTATION_VECTOR = (0.2, -0.35, 0.1)
TRANSLATION = (0.4, -0.2, 1.5)
TAN_HALF_FOV = (0.7, 0.5)
LENS_SHIFT = (0.1, -0.05)
SIZE = (90, 160)


def main() -> None:
    import colour
    import cv2
    import torch
    import torch.nn.functional as F

    def nchw(x):
        return torch.tensor(x).permute(2, 0, 1)[None]

    def hwc(x):
        return x[0].permute(1, 2, 0).numpy()

    out = {}
    x = nchw(image(5, 7, 3))
    for size in ((3, 11), (10, 14), (2, 4)):
        name = f"{size[0]}x{size[1]}"
        out[f"nearest_{name}"] = hwc(F.interpolate(x, size, mode="nearest-exact"))
        out[f"bilinear_{name}"] = hwc(F.interpolate(x, size, mode="bilinear", align_corners=False))
    # antialias=True is the one with a = -0.5; padding undoes its renormalised border.
    padded = F.pad(x, (4, 4, 4, 4), mode="replicate")
    big = F.interpolate(padded, scale_factor=3, mode="bicubic", align_corners=False, antialias=True)
    out["bicubic_15x21"] = hwc(big[..., 12:-12, 12:-12])
    out["unshuffle"] = hwc(F.pixel_unshuffle(nchw(image(4, 6, 3)), 2))
    p = positions(40, 5, 7)
    grid = torch.tensor((p + 0.5) / np.array([7, 5], np.float32) * 2 - 1)[None, None]
    for mode in ("nearest", "bilinear"):
        for boundary, padding in (("clamp", "border"), ("zero", "zeros")):
            sampled = F.grid_sample(x, grid, mode=mode, padding_mode=padding, align_corners=False)
            out[f"sample_{mode}_{boundary}"] = hwc(sampled)[0]

    colors = rgb().astype(np.float64)
    out["srgb"] = colour.models.eotf_inverse_sRGB(colors)
    out["linear"] = colour.models.eotf_sRGB(colors)
    out["ycocg"] = colour.models.RGB_to_YCoCg(colors)

    (h, w), tan, shift = SIZE, TAN_HALF_FOV, LENS_SHIFT
    intrinsics = np.array(
        [
            [w / (2 * tan[0]), 0, w / 2 * (1 - shift[0]) - 0.5],
            [0, h / (2 * tan[1]), h / 2 * (1 - shift[1]) - 0.5],
            [0, 0, 1],
        ]
    )
    rotation, translation = np.array(ROTATION_VECTOR), np.array(TRANSLATION)
    pixels, _ = cv2.projectPoints(points().astype(np.float64), rotation, translation, intrinsics, None)
    out["projected"] = pixels[:, 0]
    out["view_from_world"] = np.eye(4)
    out["view_from_world"][:3, :3] = cv2.Rodrigues(rotation)[0]
    out["view_from_world"][:3, 3] = translation
    np.savez_compressed(Path(__file__).with_suffix(".npz"), **out)


if __name__ == "__main__":
    main()
