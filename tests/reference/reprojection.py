"""The guided reprojection twice: a NumPy loop in float64, and the few lines of JAX that a reader follows.

The JAX form gathers `[N, G]` candidates for every pixel: right, differentiable, and far too large and slow
for whole frames. `benchmarks/reproject.py` measures it beside the library's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Result(NamedTuple):
    image: np.ndarray
    confidence: np.ndarray
    margin: np.ndarray
    """Relative gap between the log-weights of the last candidate kept and the first one left out."""


def offsets(strides: tuple[int, ...], radius: int) -> list[tuple[int, int]]:
    found = [(0, 0)]
    for s in strides:
        for l in range(-radius, radius + 1):
            for k in range(-radius, radius + 1):
                if (k * s, l * s) not in found:
                    found.append((k * s, l * s))
    return found


def reproject(
    previous, motion, guide, previous_guide, sigma_guide, sigma_space, strides=(1, 3, 5, 9), radius=1, count=4
) -> Result:
    previous, motion, guide, previous_guide = (
        np.asarray(a, np.float64) for a in (previous, motion, guide, previous_guide)
    )
    height, width, _ = previous.shape
    image, confidence = np.zeros(previous.shape), np.zeros((height, width, 1))
    margin = np.full((height, width), np.inf)
    for y, x in np.ndindex(height, width):
        known = not np.isnan(motion[y, x]).any()
        m = motion[y, x] if known else np.zeros(2)
        whole = np.round(np.clip(m, -1e6, 1e6)).astype(int)
        candidates = []  # (log-weight, number, y, x)
        for number, (dx, dy) in enumerate(offsets(strides, radius)):
            cx, cy = x - whole[0] + dx, y - whole[1] + dy
            if not (known and 0 <= cx < width and 0 <= cy < height):
                continue
            difference = guide[y, x] - previous_guide[cy, cx]
            if not np.isfinite(difference).all():
                continue
            distance2 = (x - m[0] - cx) ** 2 + (y - m[1] - cy) ** 2
            log_weight = (
                -np.sum((difference / np.broadcast_to(sigma_guide, difference.shape)) ** 2) / 2
                - distance2 / sigma_space**2 / 2
            )
            candidates.append((-log_weight, number, cy, cx))
        if not candidates:
            cx, cy = x - whole[0], y - whole[1]
            image[y, x] = previous[min(max(cy, 0), height - 1), min(max(cx, 0), width - 1)]
            continue
        candidates.sort()
        kept, rest = candidates[:count], candidates[count:]
        weights = np.array([np.exp(kept[0][0] - c[0]) for c in kept])
        weights /= weights.sum()
        image[y, x] = sum(weight * previous[c[2], c[3]] for weight, c in zip(weights, kept, strict=True))
        at_centre = np.sum((m - whole) ** 2) / sigma_space**2 / 2
        confidence[y, x] = np.exp(at_centre - kept[0][0])
        if rest:
            last, first = kept[-1][0] - at_centre, rest[0][0] - at_centre
            margin[y, x] = (first - last) / max(first, 1e-9)
    return Result(image, confidence, margin)


def reproject_plain(
    previous,
    motion,
    guide,
    previous_guide,
    *,
    sigma_guide,
    sigma_space,
    strides=(1, 3, 5, 9),
    radius=1,
    count=4,
):
    """For finite guides and motion. Every pixel by itself: gather, weigh, `top_k`, softmax."""
    height, width, _ = previous.shape
    steps = jnp.array(offsets(strides, radius))
    size = jnp.array([width, height])

    def pixel(position, m, g):
        whole = jnp.round(m)
        y = (position - whole.astype(jnp.int32))[None, :] + steps  # [N, 2] as (x, y)
        inside = ((y >= 0) & (y < size[None, :])).all(-1)
        at = jnp.clip(y, 0, size[None, :] - 1)
        difference = (g[None, :] - previous_guide[at[:, 1], at[:, 0]]) / sigma[None, :]
        to_candidate = (whole - m)[None, :] - steps.astype(m.dtype)  # xbar - y
        log_weight = -(difference**2).sum(-1) / 2 - (to_candidate**2).sum(-1) / (2 * sigma_space**2)
        log_weight = jnp.where(inside, log_weight, -1e30)
        _, kept = jax.lax.top_k(jax.lax.stop_gradient(log_weight), min(count, len(steps)))
        weights = jnp.where(inside[kept], jax.nn.softmax(log_weight[kept]), 0)
        valid = inside.any()
        values = previous[at[kept, 1], at[kept, 0]]
        centre = previous[at[0, 1], at[0, 0]]
        best = log_weight[kept[0]] + ((whole - m) ** 2).sum() / (2 * sigma_space**2)
        return jnp.where(valid, weights @ values, centre), jnp.where(valid, jnp.exp(best), 0)[None]

    sigma = jnp.broadcast_to(jnp.asarray(sigma_guide, guide.dtype), guide.shape[-1:])
    grid = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), -1)
    return jax.vmap(jax.vmap(pixel))(grid, motion, guide)
