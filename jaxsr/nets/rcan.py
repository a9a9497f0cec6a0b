"""RCAN, super-resolution of one image by a very deep network (Zhang et al., ECCV 2018); sees colour alone.

    F_0 = head(I - mean)
    F_g = F_{g-1} + H_g(F_{g-1}),  g = 1 .. G       residual groups of residual blocks (section 3.2)
    O   = mean + tail(up(F_0 + last(F_G)))          the long skip, pixel-shuffle

Blocks scale their residual, channel by channel, by a gate that sees the means of all channels (sections 3.3
and 3.4). These means are over the whole image, so a crop of the input does not quite make a crop of the
output.

Contract: colour `[B, h, w, 3]` in about [0, 1] in, `[B, s h, s w, 3]` out, float32, for any h and w; the
output is not clipped. `MEAN` is that of DIV2K, on which RCAN was published: constants, not parameters.
Parameters of the blocks have two leading axes, group and block, and the program has one block in two loops:
with 400 convolutions one after the other it would take minutes to make and to compile.
"""

import math

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.nets.blocks import LoopConv, SqueezeExcite, check_counts, stacked, through
from jaxsr.ops import pixel_shuffle

MEAN = (0.4488, 0.4371, 0.4040)
UPS = {2: (2,), 3: (3,), 4: (2, 2), 8: (2, 2, 2)}
"""The steps in which each scale is reached."""
INIT = nnx.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
"""As published, PyTorch's default; with Xavier's larger kernels first pictures have values of thousands."""


def check_sizes(scale: int, groups: int, blocks: int, features: int, reduction: int) -> None:
    """Raise JaxsrError unless networks of these sizes exist."""
    if scale not in UPS:
        expected = " | ".join(map(str, UPS))
        raise JaxsrError("bad scale", where="scale", expected=expected, found=scale)
    check_counts(groups=groups, blocks=blocks, features=features, reduction=reduction)
    if reduction > features:
        raise JaxsrError("bad reduction", where="reduction", expected=f"at most {features}", found=reduction)


class Block(nnx.Module):
    """A residual channel attention block (RCAB, section 3.4): `F + gate * conv(relu(conv(F)))`."""

    def __init__(self, features: int, reduction: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        self.conv1 = LoopConv(features, features, init=INIT, dtype=dtype, rngs=rngs)
        self.conv2 = LoopConv(features, features, init=INIT, dtype=dtype, rngs=rngs)
        self.attention = SqueezeExcite(features, reduction, bias=True, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w n"]) -> Float[Array, "b h w n"]:
        return x + self.attention(self.conv2(nnx.relu(self.conv1(x))))


class Group(nnx.Module):
    """A residual group (section 3.2): blocks, a convolution, and the short skip around them."""

    def __init__(self, blocks: int, features: int, reduction: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        self.blocks = stacked(blocks, lambda rngs: Block(features, reduction, dtype=dtype, rngs=rngs), rngs)
        self.last = LoopConv(features, features, init=INIT, dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w n"]) -> Float[Array, "b h w n"]:
        return x + self.last(through(x, self.blocks))


class RCAN(nnx.Module):
    """The network of section 3.1; 15,592,355 parameters with the defaults.

    Args:
        scale: s, output size over input size: 2, 3, 4 or 8.
        groups: residual groups, G.
        blocks: of each group.
        features: channels.
        reduction: channels over those in the middle of the attention.
        dtype: what convolutions compute in; parameters and output stay float32.

    Raises:
        JaxsrError: sizes of which there is no network.
    """

    def __init__(
        self,
        *,
        scale: int = 4,
        groups: int = 10,
        blocks: int = 20,
        features: int = 64,
        reduction: int = 16,
        dtype: DTypeLike = jnp.float32,
        rngs: nnx.Rngs,
    ):
        check_sizes(scale, groups, blocks, features, reduction)
        n = features
        self.head = LoopConv(3, n, init=INIT, dtype=dtype, rngs=rngs)
        self.groups = stacked(groups, lambda rngs: Group(blocks, n, reduction, dtype=dtype, rngs=rngs), rngs)
        self.last = LoopConv(n, n, init=INIT, dtype=dtype, rngs=rngs)
        ups = UPS[scale]
        self.ups = nnx.List([LoopConv(n, n * up**2, init=INIT, dtype=dtype, rngs=rngs) for up in ups])
        self.tail = LoopConv(n, 3, init=INIT, dtype=dtype, rngs=rngs)

    def __call__(self, color: Float[Array, "b h w 3"]) -> Float[Array, "b H W 3"]:
        """Make the HR colour."""
        mean = jnp.array(MEAN, jnp.float32).reshape(1, 1, 1, 3)
        first = self.head(color.astype(jnp.float32) - mean)
        x = first + self.last(through(first, self.groups))
        for up in self.ups:
            x = up(x)
            x = pixel_shuffle(x, math.isqrt(x.shape[-1] // first.shape[-1]))
        return self.tail(x).astype(jnp.float32) + mean
