"""The masks one pixel at a time. Cameras enter as the world positions and rays that `geometry` gives."""

import numpy as np


def taps(position, height, width):
    """(y, x) of the bilinear taps whose weight exceeds 1 %, borders repeated."""
    px, py = (float(v) for v in position)
    x0, y0 = int(np.floor(px)), int(np.floor(py))
    for y in (y0, y0 + 1):
        for x in (x0, x0 + 1):
            if (1 - abs(px - x)) * (1 - abs(py - y)) > 0.01:
                yield min(max(y, 0), height - 1), min(max(x, 0), width - 1)


def in_frame(position, height, width) -> bool:
    return -0.5 <= position[0] <= width - 0.5 and -0.5 <= position[1] <= height - 0.5


def cosine(a, b) -> float:
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if not a.any() and not b.any():
        return 1.0
    if not a.any() or not b.any():
        return 0.0
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def normal_mask(normal, warped, threshold):
    height, width, _ = normal.shape
    out = np.zeros((height, width, 1))
    for y, x in np.ndindex(height, width):
        out[y, x] = cosine(normal[y, x], warped[y, x]) >= threshold
    return out


def depth_mask(depth, previous, motion, tolerance):
    height, width, _ = depth.shape
    out = np.zeros(depth.shape)
    for y, x in np.ndindex(height, width):
        position = np.array([x, y]) - motion[y, x]
        if not in_frame(position, height, width):
            continue
        d = float(depth[y, x, 0])
        for tap in taps(position, height, width):
            before = float(previous[tap][0])
            if before == d or (
                np.isfinite(d) and np.isfinite(before) and abs(before - d) <= tolerance * min(before, d)
            ):
                out[y, x] = 1
    return out


def position_mask(depth, previous, normal, motion, points, previous_points, rays, pixel, tolerance):
    """`points` are world positions, `rays` directions, `pixel` the angle of a pixel (footprint / depth)."""
    height, width, _ = depth.shape
    out = np.zeros(depth.shape)
    for y, x in np.ndindex(height, width):
        position = np.array([x, y]) - motion[y, x]
        if not in_frame(position, height, width):
            continue
        sky = not np.isfinite(depth[y, x, 0])
        slant = max(abs(cosine(normal[y, x], rays[y, x])), 1 / 8)
        for tap in taps(position, height, width):
            tap_sky = not np.isfinite(previous[tap][0])
            if sky or tap_sky:
                out[y, x] = max(out[y, x, 0], float(sky and tap_sky))
                continue
            distance = np.linalg.norm(previous_points[tap] - points[y, x])
            if distance <= tolerance * pixel * float(depth[y, x, 0]) / slant:
                out[y, x] = 1
    return out


def blend_mask(low_image, image, low_base, base, low_normal, normal, d1, d2):
    height, width, _ = image.shape
    scale = height // low_image.shape[0]
    out = np.zeros((height, width, 1))
    for y, x in np.ndindex(height, width):
        low = y // scale, x // scale
        similar = 1 - np.linalg.norm(low_base[low] - base[y, x]) / np.sqrt(3)
        up, here = low_image[low], image[y, x]
        size = np.linalg.norm(up)
        change = np.linalg.norm(up - here)
        different = change > 0 if size == 0 else change / size > d2
        out[y, x] = similar * cosine(low_normal[low], normal[y, x]) > d1 and different
    return out
