"""Super-resolution from one LR frame and HR G-buffers, with two encoders fused at three levels.

"G-buffer fusion super-resolution", section 3.2, its Figures 3 and 4. The names below are the paper's:
`F_LR,i` and `F_G,i` are the colour and G-buffer features of level i, `F^A_G,i` the excited ones, `F_FU,i` the
fused ones, `F_HR,i` the decoded ones; level 1 has the output's size, level 2 half, level 3 a quarter.

Contract: colour `[B, h, w, 3]` and G-buffer `[B, s h, s w, c]` in, colour `[B, s h, s w, 3]` out, float32,
for any h, w and s; inside, the last rows and columns are repeated up to a multiple of 4. Colour and G-buffer
are expected in about [0, 1] (normals in [-1, 1]); the output is at least 0: the last layer is a ReLU. What
the numbers mean (tone map, depth map, order of G-buffer channels) is up to the method. Current frame only: no
history, no motion. Squeeze-and-excitation sees means over the whole image, so a crop of the inputs does not
quite make a crop of the output. `train()` and `eval()` switch the batch norm.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.nets.blocks import (
    BatchNorm,
    ShallowFeatures,
    SqueezeExcite,
    UpConcat,
    check_channels,
    check_shape,
    conv,
    conv_beside,
    count_channels,
    encoder,
    whole_levels,
)
from jaxsr.ops import zero_upsample

FUSIONS = ("se-residual", "concat", "add")
SHALLOW = 18  # channels that each branch has after the shallow features
WIDTHS = ((32, 16), (32, 32), (64, 64))  # channels of the two convolutions of each level


class Fusion(nnx.Module):
    """Figure 4b: the G-buffer helps the colour, and not the other way round.

    `F^A_G = SE(F_G)`, `F_FU = [F_LR + residual([F_LR, F^A_G]), F^A_G]`: n and n channels in, 2n out.
    """

    def __init__(self, channels: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        n = channels
        self.se = SqueezeExcite(n, rngs=rngs)
        self.conv1 = conv(2 * n, n, 1, bias=False, dtype=dtype, rngs=rngs)
        self.norm1 = BatchNorm(n, rngs=rngs)
        self.conv2 = conv(n, n, bias=False, dtype=dtype, rngs=rngs)
        self.norm2 = BatchNorm(n, rngs=rngs)

    def __call__(
        self, color: Float[Array, "b h w n"], gbuffer: Float[Array, "b h w n"]
    ) -> Float[Array, "b h w m"]:
        excited = self.se(gbuffer)
        x = conv_beside(self.conv1, color, excited)
        x = nnx.relu(self.norm1(x)).astype(color.dtype)
        residual = self.norm2(self.conv2(x)).astype(color.dtype)
        return jnp.concatenate([color + residual, excited], axis=-1)


class FusionSR(nnx.Module):
    """The network of Figure 3; 418,619 trainable parameters with the defaults.

    Args:
        scale: s, HR size over LR size; None takes that of the inputs. The parameters do not depend on it.
        buffers: parts of the G-buffer (`blocks.CHANNELS`); the network needs only their number of channels.
        fusion: "se-residual" is the paper's; of Table 3, "concat" puts the features of both branches side by
            side, "add" adds them (the decoder's inputs shrink to n channels per level, its outputs stay).
        down_kernel: size of the stride-2 kernels: 3 as published, 2 as drawn in Figure 3.
        dtype: what convolutions compute in; parameters and output stay float32.

    Raises:
        JaxsrError: an unknown fusion or buffer, or a kernel or scale that is not available.
    """

    def __init__(
        self,
        *,
        scale: int | None = None,
        buffers: Sequence[str] = ("depth", "base_color", "normal", "roughness", "metallic"),
        fusion: str = "se-residual",
        down_kernel: int = 3,
        dtype: DTypeLike = jnp.float32,
        rngs: nnx.Rngs,
    ):
        if fusion not in FUSIONS:
            raise JaxsrError("unknown fusion", where="fusion", expected=" | ".join(FUSIONS), found=fusion)
        channels = count_channels(buffers)
        check_shape(scale, down_kernel)
        self.scale, self.fusion, self.channels = scale, fusion, channels
        self.color_shallow = ShallowFeatures(3, SHALLOW - 3, dtype=dtype, rngs=rngs)
        self.gbuffer_shallow = ShallowFeatures(channels, SHALLOW - channels, dtype=dtype, rngs=rngs)
        self.color_encoder = nnx.List(encoder(SHALLOW, WIDTHS, down_kernel, dtype=dtype, rngs=rngs))
        self.gbuffer_encoder = nnx.List(encoder(SHALLOW, WIDTHS, down_kernel, dtype=dtype, rngs=rngs))
        if fusion == "se-residual":
            self.fusions = nnx.List([Fusion(n, dtype=dtype, rngs=rngs) for _, n in WIDTHS])
        fused = [n if fusion == "add" else 2 * n for _, n in WIDTHS]
        self.decoder2 = UpConcat(fused[2], fused[1], 64, 64, dtype=dtype, rngs=rngs)
        self.decoder1 = UpConcat(64, fused[0], 32, 3, dtype=dtype, rngs=rngs)

    def __call__(
        self,
        color: Float[Array, "b h w 3"],
        gbuffer: Float[Array, "b H W c"],
        offset: Int[Array, "b 2"] | None = None,
    ) -> Float[Array, "b H W 3"]:
        """Make the HR colour.

        Args:
            color: LR.
            gbuffer: HR, the chosen buffers side by side.
            offset: (x, y) in [0, s): where in its s x s block of HR pixels each LR sample sits, one per
                image. The paper's top left by default.

        Raises:
            JaxsrError: sizes or channels that do not fit together.
        """
        height, width = gbuffer.shape[1:3]
        check_channels(gbuffer, self.channels)
        scale = self.scale or max(1, height // color.shape[1])
        color, gbuffer = whole_levels(color, gbuffer, scale, 4)
        # Section 3.2.1: F_LR,0 = H_UP(H^LR_SF(I_LR)), F_G,0 = H^G_SF(I_G).
        f_lr = zero_upsample(self.color_shallow(color), scale, offset)
        f_g = self.gbuffer_shallow(gbuffer)
        fused = []
        for i in range(3):
            # F_LR,i = H^LR_EN,i(F_LR,i-1), F_G,i = H^G_EN,i(F_G,i-1), F_FU,i = H_FU,i(F_LR,i, F_G,i)
            f_lr, f_g = self.color_encoder[i](f_lr), self.gbuffer_encoder[i](f_g)
            fused.append(self._fuse(i, f_lr, f_g))
        # Section 3.2.3: F_HR,3 = F_FU,3, F_HR,i = Convs_i([ConvTrans_i(F_HR,i+1), F_FU,i]), I_HR = F_HR,1.
        f_hr = self.decoder2(fused[2], fused[1])
        f_hr = self.decoder1(f_hr, fused[0])
        return f_hr[:, :height, :width].astype(jnp.float32)

    def _fuse(self, level: int, f_lr: Array, f_g: Array) -> Array:
        if self.fusion == "se-residual":
            return self.fusions[level](f_lr, f_g)
        return f_lr + f_g if self.fusion == "add" else jnp.concatenate([f_lr, f_g], axis=-1)
