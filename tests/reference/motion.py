"""Derived HR depth and motion, one pixel at a time."""

import math

import numpy as np


def dilate_motion(depth, motion):
    height, width, _ = depth.shape
    nearest, out = depth.copy(), motion.copy()
    for y, x in np.ndindex(height, width):
        best = (y, x)
        for v in range(max(y - 1, 0), min(y + 2, height)):
            for u in range(max(x - 1, 0), min(x + 2, width)):
                if depth[v, u, 0] < depth[best][0]:
                    best = (v, u)
        nearest[y, x], out[y, x] = depth[best], motion[best]
    return nearest, out


def hr_from_lr(depth, motion, jitter, scale):
    height, width, _ = depth.shape
    nearest, dilated = dilate_motion(depth, motion)
    hr_depth = np.zeros((height * scale, width * scale, 1))
    hr_motion = np.zeros((height * scale, width * scale, 2))
    for y, x in np.ndindex(hr_depth.shape[:2]):
        v = math.floor((y + 0.5) / scale - 0.5 - float(jitter[1]) + 0.5)
        u = math.floor((x + 0.5) / scale - 0.5 - float(jitter[0]) + 0.5)
        at = min(max(v, 0), height - 1), min(max(u, 0), width - 1)
        hr_depth[y, x], hr_motion[y, x] = nearest[at], scale * dilated[at]
    return hr_depth, hr_motion
