"""How frames become the inputs of networks: colour, lighting, depth and sample positions, normalised.

The same functions serve training and inference. Images are `[H, W, C]` or `[B, H, W, C]`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

DEPTH_OCTAVES = 16.0
"""Ratio of depths, in octaves, that `normalized_depth` spreads over [0, 1]."""
MAX_COMPRESSED = 0.999
"""Largest value that `expand_lighting` tells apart: lighting of 499, which is white on any screen."""


def normalized_depth(
    depth_linear: Float[Array, "*b H W 1"], octaves: float = DEPTH_OCTAVES
) -> Float[Array, "*b H W 1"]:
    """Linear depth to [0, 1]: `0.5 + log2(d / m) / octaves`, m the geometric mean of the surfaces; sky is 1.

    The result does not depend on the unit of length. A crop shifts all values by a constant. The difference
    between two surfaces depends only on the ratio of their depths.

    Args:
        depth_linear: linear view depth, +inf for sky.
        octaves: the range of ratios that is not clipped.
    """
    solid = jnp.isfinite(depth_linear) & (depth_linear > 0)
    logarithm = jnp.log2(jnp.where(solid, depth_linear, 1.0))
    count = jnp.maximum(jnp.sum(solid, (-3, -2), keepdims=True), 1).astype(logarithm.dtype)
    mean = jnp.sum(logarithm, (-3, -2), keepdims=True) / count
    return jnp.where(solid, jnp.clip(0.5 + (logarithm - mean) / octaves, 0, 1), 1.0)


def compress_lighting(lighting: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """`l = sqrt(L / (1 + L))` in [0, 1). The root spaces dark values about as finely as a display does."""
    lighting = jnp.clip(lighting, 0, 1e6)  # infinite light is white, not NaN
    # The lower bound keeps the slope of the root finite at black.
    return jnp.sqrt(jnp.maximum(lighting / (1 + lighting), 1e-8))


def expand_lighting(compressed: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The inverse of `compress_lighting`. Values of 0.999 and above give L = 499."""
    squared = jnp.minimum(compressed, MAX_COMPRESSED) ** 2
    return squared / (1 - squared)


def sample_offset(jitter_px: Float[Array, "*b 2"], scale: int) -> Int[Array, "*b 2"]:
    """Which pixel (x, y) of its s x s block an LR sample falls on: `s J + (s - 1) / 2`, rounded.

    Args:
        jitter_px: J in LR pixels.
        scale: s, HR size over LR size.
    """
    offset = jnp.floor(scale * jitter_px + scale / 2)
    return jnp.clip(offset, 0, scale - 1).astype(jnp.int32)
