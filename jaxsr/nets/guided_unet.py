"""A small U-Net that corrects an image of full size, given what is known of each pixel.

    F_0 = head(unshuffle(X))                       blocks of 2 x 2 pixels become channels: half the size
    F_l = block(down(F_{l-1})),  l = 1, 2          a quarter, an eighth
    F_l = block(F_l + up(F_{l+1}))                 and back
    O   = shuffle(tail(F_0)) / 10

`block(F) = F + conv(leaky(conv(F)))`. Most of the work is done at half the size, where each filter costs a
quarter of what it costs at full size: 46 thousand multiply-adds per pixel with the default widths.

Contract: `X` is `[B, H, W, C]` in about [-1, 1], the output `[B, H, W, 3]` float32, not clipped, for any H
and W. The tail begins at 0: an untrained network corrects nothing. Its first steps are large all the same,
since all of its weights move at once. They kill plain ReLUs, and the network then corrects nothing for ever
(seen after 20 steps of Adam at 6e-4). Hence leaky ones, and a tenth. The network computes no means over the
image, so a crop of the input makes a crop of the output, but for 60 pixels at the border.
"""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.nets.blocks import UpConv, check_channels, check_counts, conv
from jaxsr.ops import pixel_shuffle, pixel_unshuffle

TAIL = 0.1
WIDTHS = (48, 64, 96)
"""Channels at half the size, a quarter and an eighth."""


def leaky(x: Array) -> Array:
    """A leaky ReLU with a slope of 0.1."""
    return jnp.maximum(x, 0.1 * x)


class Block(nnx.Module):
    """`F + conv(leaky(conv(F)))`."""

    def __init__(self, features: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        self.conv1 = conv(features, features, dtype=dtype, rngs=rngs)
        self.conv2 = conv(features, features, dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w n"]) -> Float[Array, "b h w n"]:
        return x + self.conv2(leaky(self.conv1(x)))


class GuidedUNet(nnx.Module):
    """The network.

    Args:
        channels: C, of the input.
        widths: features at half the size, a quarter, and so on.
        dtype: of the convolutions; parameters are float32.
        rngs: for the first weights.

    Raises:
        JaxsrError: a number out of range.
    """

    def __init__(
        self,
        channels: int,
        widths: Sequence[int] = WIDTHS,
        *,
        dtype: DTypeLike = jnp.float32,
        rngs: nnx.Rngs,
    ):
        check_counts(channels=channels, levels=len(widths))
        for width in widths:
            check_counts(features=width)
        if len(widths) > 5:
            raise JaxsrError("too many levels", where="widths", expected="at most 5", found=len(widths))
        self.channels = channels
        self.head = conv(4 * channels, widths[0], dtype=dtype, rngs=rngs)
        self.blocks = nnx.List([Block(width, dtype=dtype, rngs=rngs) for width in widths])
        steps = list(itertools.pairwise(widths))
        self.downs = nnx.List([conv(a, b, stride=2, dtype=dtype, rngs=rngs) for a, b in steps])
        self.ups = nnx.List([UpConv(b, a, dtype=dtype, rngs=rngs) for a, b in steps])
        self.merges = nnx.List([Block(a, dtype=dtype, rngs=rngs) for a, _ in steps])
        self.tail = conv(widths[0], 12, dtype=dtype, rngs=rngs)
        self.tail.kernel[...] = jnp.zeros_like(self.tail.kernel[...])

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w 3"]:
        """The correction.

        Raises:
            JaxsrError: another number of channels.
        """
        check_channels(x, self.channels)
        height, width = x.shape[1:3]
        multiple = 2 ** len(self.blocks)
        rows, columns = -height % multiple, -width % multiple
        if rows or columns:
            x = jnp.pad(x, ((0, 0), (0, rows), (0, columns), (0, 0)), mode="edge")
        features = leaky(self.head(pixel_unshuffle(x, 2)))
        skips = []
        for level, block in enumerate(self.blocks):
            if level:
                skips.append(features)
                features = leaky(self.downs[level - 1](features))
            features = block(features)
        for level in reversed(range(len(self.ups))):
            features = self.merges[level](skips[level] + self.ups[level](features))
        correction = TAIL * pixel_shuffle(self.tail(features), 2)
        return correction[:, :height, :width].astype(jnp.float32)
