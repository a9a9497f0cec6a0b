"""Super-resolution by a single-branch U-Net: what the fusion of `fusion_sr` is compared with.

Section 4.4.3 and Figure 11 of the paper. Contract and inputs are those of `fusion_sr`; here the
zero-upsampled colour and the G-buffer are concatenated first and share one encoder. No batch norm.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxsr.nets.blocks import (
    ShallowFeatures,
    UpConcat,
    check_channels,
    check_shape,
    count_channels,
    encoder,
    whole_levels,
)
from jaxsr.ops import zero_upsample

SHALLOW = 36  # channels after the shallow features
WIDTHS = ((64, 32), (64, 64), (128, 128))  # channels of the two convolutions of each level


class UNetSR(nnx.Module):
    """The U-Net of Figure 11; 506,907 trainable parameters with the defaults. Arguments as `FusionSR`."""

    def __init__(
        self,
        *,
        scale: int | None = None,
        buffers: Sequence[str] = ("depth", "base_color", "normal", "roughness", "metallic"),
        down_kernel: int = 3,
        dtype: DTypeLike = jnp.float32,
        rngs: nnx.Rngs,
    ):
        check_shape(scale, down_kernel)
        self.scale, self.channels = scale, count_channels(buffers)
        inputs = 3 + self.channels
        self.shallow = ShallowFeatures(inputs, SHALLOW - inputs, dtype=dtype, rngs=rngs)
        self.encoder = nnx.List(encoder(SHALLOW, WIDTHS, down_kernel, dtype=dtype, rngs=rngs))
        self.decoder2 = UpConcat(128, 64, 64, 64, dtype=dtype, rngs=rngs)
        self.decoder1 = UpConcat(64, 32, 32, 3, dtype=dtype, rngs=rngs)

    def __call__(
        self,
        color: Float[Array, "b h w 3"],
        gbuffer: Float[Array, "b H W c"],
        offset: Int[Array, "b 2"] | None = None,
    ) -> Float[Array, "b H W 3"]:
        """Make the HR colour; as `FusionSR.__call__`."""
        height, width = gbuffer.shape[1:3]
        check_channels(gbuffer, self.channels)
        scale = self.scale or max(1, height // color.shape[1])
        color, gbuffer = whole_levels(color, gbuffer, scale, 4)
        x = jnp.concatenate([zero_upsample(color, scale, offset), gbuffer], axis=-1)
        f1 = self.encoder[0](self.shallow(x))
        f2 = self.encoder[1](f1)
        f3 = self.encoder[2](f2)
        x = self.decoder1(self.decoder2(f3, f2), f1)
        return x[:, :height, :width].astype(jnp.float32)
