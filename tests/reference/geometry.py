"""Pinhole geometry of one pixel at a time, straight from the docstring of `jaxsr.frames.Camera`."""

import numpy as np


def ray(camera, size, pixel, jitter=(0.0, 0.0)) -> np.ndarray:
    """World-space direction of unit view depth."""
    h, w = size
    ndc_x = 2 * (pixel[0] + jitter[0] + 0.5) / w - 1
    ndc_y = 2 * (pixel[1] + jitter[1] + 0.5) / h - 1
    tan, shift = (np.asarray(v, np.float64) for v in camera[1:])
    view = np.array([(ndc_x + shift[0]) * tan[0], (ndc_y + shift[1]) * tan[1], 1.0])
    return np.asarray(camera[0], np.float64)[:3, :3] @ view


def project(camera, size, point) -> tuple[np.ndarray, float]:
    h, w = size
    x, y, z, _ = np.linalg.inv(np.asarray(camera[0], np.float64)) @ np.append(point, 1.0)
    if z <= 0:
        return np.array([-1e6, -1e6]), z
    tan, shift = (np.asarray(v, np.float64) for v in camera[1:])
    ndc = np.array([x / (z * tan[0]) - shift[0], y / (z * tan[1]) - shift[1]])
    return (ndc + 1) / 2 * np.array([w, h]) - 0.5, z


def world_position(depth, camera, jitter) -> np.ndarray:
    h, w, _ = depth.shape
    out = np.zeros((h, w, 3))
    for y in range(h):
        for x in range(w):
            if np.isfinite(depth[y, x, 0]):
                eye = np.asarray(camera[0], np.float64)[:3, 3]
                out[y, x] = eye + float(depth[y, x, 0]) * ray(camera, (h, w), (x, y), jitter)
    return out


def camera_motion(depth, camera, before, jitter) -> np.ndarray:
    h, w, _ = depth.shape
    out = np.zeros((h, w, 2))
    for y in range(h):
        for x in range(w):
            z = min(float(depth[y, x, 0]), 1e9)  # the sky is far away
            point = np.asarray(camera[0], np.float64)[:3, 3] + z * ray(camera, (h, w), (x, y), jitter)
            out[y, x] = np.array([x, y]) + jitter - project(before, (h, w), point)[0]
    return out


def previous_depth(depth, camera, before, jitter) -> np.ndarray:
    h, w, _ = depth.shape
    out = np.full((h, w, 1), np.inf)
    for y in range(h):
        for x in range(w):
            z = float(depth[y, x, 0])
            if np.isfinite(z):
                point = np.asarray(camera[0], np.float64)[:3, 3] + z * ray(camera, (h, w), (x, y), jitter)
                out[y, x] = project(before, (h, w), point)[1]
    return out
