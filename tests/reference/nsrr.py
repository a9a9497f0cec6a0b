"""The networks of NSRR as loops over pixels, for one frame; weights by the names of their files."""

from collections.abc import Mapping

import numpy as np

from tests.reference.resampling import resize

Weights = Mapping[str, np.ndarray]


def conv(image: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    """3x3, zeros outside the image."""
    kernel, bias = weights[f"{name}.kernel"], weights[f"{name}.bias"]
    height, width, _ = image.shape
    out = np.zeros((height, width, len(bias)))
    for y, x in np.ndindex(height, width):
        out[y, x] = bias
        for j, i in np.ndindex(3, 3):
            if 0 <= y + j - 1 < height and 0 <= x + i - 1 < width:
                out[y, x] += image[y + j - 1, x + i - 1] @ kernel[j, i]
    return out


def convs(image: np.ndarray, weights: Weights, *names: str) -> np.ndarray:
    """A ReLU after each."""
    for name in names:
        image = np.maximum(conv(image, weights, name), 0)
    return image


def features(rgbd: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    return np.concatenate([rgbd, convs(rgbd, weights, *(f"{name}.conv{k}" for k in (1, 2, 3)))], -1)


def max_pool(image: np.ndarray) -> np.ndarray:
    height, width, channels = image.shape
    out = np.zeros((height // 2, width // 2, channels))
    for y, x in np.ndindex(height // 2, width // 2):
        out[y, x] = image[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].max((0, 1))
    return out


def beside_upsampled(skip: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    return np.concatenate([skip, resize(coarse, skip.shape[:2], "bilinear")], -1)


def reconstruct(current: np.ndarray, previous: list[np.ndarray], weights: Weights) -> np.ndarray:
    height, width, channels = current.shape
    padded = []
    for image in (current, *previous):
        whole = np.zeros((-(-height // 4) * 4, -(-width // 4) * 4, channels))
        whole[:height, :width] = image
        padded.append(whole)
    x = np.concatenate([image[..., :4] for image in padded], -1)
    x = conv(convs(x, weights, "reweighting.conv1", "reweighting.conv2"), weights, "weights")
    for k in range(len(previous)):
        padded[1 + k] = padded[1 + k] * (10 * (np.tanh(x[..., k : k + 1]) + 1) / 2)
    f1 = convs(np.concatenate(padded, -1), weights, "encoder.0.conv1", "encoder.0.conv2")
    f2 = convs(max_pool(f1), weights, "encoder.1.conv1", "encoder.1.conv2")
    f3 = convs(max_pool(f2), weights, "encoder.2.conv1", "encoder.2.conv2")
    x = convs(beside_upsampled(f2, f3), weights, "decoder2.conv1", "decoder2.conv2")
    x = convs(beside_upsampled(f1, x), weights, "decoder1")
    return conv(x, weights, "color")[:height, :width]
