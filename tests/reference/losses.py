"""Losses as loops over images, pixels, channels and neighbours, in float64."""

import math

import numpy as np


def charbonnier(pred, target):
    total = 0.0
    for index in np.ndindex(pred.shape):
        total += math.sqrt((float(pred[index]) - float(target[index])) ** 2 + 1e-6)
    return total / pred.size


def feature_census(a, b, size=3):
    """The mean is over all pixels; those nearer than half a patch to the border give 0."""
    batch, height, width, channels = a.shape
    r, total = size // 2, 0.0

    def ternary(image, n, y, x, c, dy, dx):
        d = float(image[n, y + dy, x + dx, c]) - float(image[n, y, x, c])
        return d / math.sqrt(0.81 + d * d)

    for n, y, x, c in np.ndindex(batch, height, width, channels):
        if not (r <= y < height - r and r <= x < width - r):
            continue
        for dy in range(-r, r + 1):
            for dx in range(-r, r + 1):
                square = (ternary(a, n, y, x, c, dy, dx) - ternary(b, n, y, x, c, dy, dx)) ** 2
                total += square / (0.1 + square) / size**2
    return total / a.size


def census(pred, target):
    grey = [x.astype(np.float64).mean(-1, keepdims=True) for x in (pred, target)]
    return feature_census(*grey, size=7)


def hole_l1(pred, target, mask):
    total, area = 0.0, 0
    for n, y, x in np.ndindex(pred.shape[:3]):
        if mask[n, y, x, 0] == 0:
            area += 1
            total += np.abs(pred[n, y, x].astype(np.float64) - target[n, y, x]).mean()
    return total / area if area else 0.0


def hard_l1(pred, target, fraction):
    batch, height, width, channels = pred.shape
    count = max(math.floor(fraction * height * width), 1)
    means = []
    for n in range(batch):
        for c in range(channels):
            errors = np.abs(pred[n, ..., c].astype(np.float64) - target[n, ..., c]).ravel()
            means.append(sum(sorted(errors, reverse=True)[:count]) / count)
    return sum(means) / len(means)


def ssim(pred, target):
    """Window by window, with the weighted mean, variance and covariance of each."""
    axis = [math.exp(-0.5 * ((k - 5) / 1.5) ** 2) for k in range(11)]
    weights = np.array([[a * b for b in axis] for a in axis])
    weights /= weights.sum()
    batch, height, width, channels = pred.shape
    values = []
    for n, y, x, c in np.ndindex(batch, height - 10, width - 10, channels):
        p = pred[n, y : y + 11, x : x + 11, c].astype(np.float64)
        t = target[n, y : y + 11, x : x + 11, c].astype(np.float64)
        mean_p, mean_t = (weights * p).sum(), (weights * t).sum()
        variance = (weights * (p - mean_p) ** 2).sum() + (weights * (t - mean_t) ** 2).sum()
        covariance = (weights * (p - mean_p) * (t - mean_t)).sum()
        values.append(
            (2 * mean_p * mean_t + 0.01**2)
            / (mean_p**2 + mean_t**2 + 0.01**2)
            * (2 * covariance + 0.03**2)
            / (variance + 0.03**2)
        )
    return sum(values) / len(values)
