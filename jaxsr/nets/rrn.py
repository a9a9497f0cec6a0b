"""RRN, recurrent super-resolution of a video (Isobe et al., BMVC 2020); sees colour alone.

    I_{t-1}, I_t    previous and current LR frame
    h_{t-1}         hidden state, at LR
    o_{t-1}         previous output, at HR; enters as space-to-depth

    x   = blocks(relu(first([I_{t-1}, I_t, h_{t-1}, o_{t-1}])))
    h_t = relu(hidden(x))
    o_t = pixel_shuffle(output(x)) + bilinear(I_t)

Contract: colour `[B, h, w, 3]` of any range, hidden state `[B, h, w, n]`, output `[B, s h, s w, 3]`, float32,
for any h and w; nothing is clipped. Nothing is warped either: what moves must be found by convolutions. The
first step of a video has zeros as hidden state and as output.
"""

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.nets.blocks import LoopConv, check_counts
from jaxsr.ops import pixel_shuffle, pixel_unshuffle, upsample

INIT = nnx.initializers.variance_scaling(0.02, "fan_in", "normal")
"""As published, a tenth of He's: the network begins as bilinear upsampling, and the recurrence is tame."""


def check_sizes(scale: int, blocks: int, features: int) -> None:
    """Raise JaxsrError unless networks of these sizes exist."""
    check_counts(least=2, scale=scale)
    check_counts(blocks=blocks, features=features)


class Block(nnx.Module):
    """`x + conv(relu(conv(x)))`: information of the past reaches the state through the identity."""

    def __init__(self, features: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        self.conv1 = LoopConv(features, features, init=INIT, dtype=dtype, rngs=rngs)
        self.conv2 = LoopConv(features, features, init=INIT, dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w n"]) -> Float[Array, "b h w n"]:
        return x + self.conv2(nnx.relu(self.conv1(x)))


class RRN(nnx.Module):
    """One step of the recurrence; 3,364,400 parameters with the defaults, 1,888,560 with 5 blocks.

    Args:
        scale: s, output size over input size.
        blocks: residual blocks; the paper's RRN-L has 10, its RRN-S 5.
        features: channels, of the hidden state as well.
        dtype: what convolutions compute in; parameters, state and output stay float32.

    Raises:
        JaxsrError: sizes of which there is no network.
    """

    def __init__(
        self,
        *,
        scale: int = 4,
        blocks: int = 10,
        features: int = 128,
        dtype: DTypeLike = jnp.float32,
        rngs: nnx.Rngs,
    ):
        check_sizes(scale, blocks, features)
        self.scale, n = scale, features
        self.first = LoopConv(3 + 3 + n + 3 * scale**2, n, init=INIT, dtype=dtype, rngs=rngs)
        self.blocks = nnx.List([Block(n, dtype=dtype, rngs=rngs) for _ in range(blocks)])
        self.hidden = LoopConv(n, n, init=INIT, dtype=dtype, rngs=rngs)
        self.output = LoopConv(n, 3 * scale**2, init=INIT, dtype=dtype, rngs=rngs)

    def __call__(
        self,
        previous: Float[Array, "b h w 3"],
        color: Float[Array, "b h w 3"],
        hidden: Float[Array, "b h w n"],
        output: Float[Array, "b H W 3"],
    ) -> tuple[Float[Array, "b H W 3"], Float[Array, "b h w n"]]:
        """The output o_t and the hidden state h_t, from I_{t-1}, I_t, h_{t-1} and o_{t-1}."""
        previous, color, hidden, output = (x.astype(jnp.float32) for x in (previous, color, hidden, output))
        x = jnp.concatenate([previous, color, hidden, pixel_unshuffle(output, self.scale)], axis=-1)
        x = nnx.relu(self.first(x))
        for block in self.blocks:
            x = block(x)
        made = pixel_shuffle(self.output(x).astype(jnp.float32), self.scale)
        return made + upsample(color, self.scale), nnx.relu(self.hidden(x)).astype(jnp.float32)
