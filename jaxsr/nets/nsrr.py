"""Super-resolution from several LR frames with depth: NSRR.

Xiao et al., "Neural supersampling for real-time rendering", SIGGRAPH 2020 (METHODS 6). The caller upsamples
and warps between the networks, because the features of a frame also serve as history for the next frames:

    features, previous_features    RGB-D -> 12 channels, LR; one net for the current frame, one for all others
    (the caller)                   zero-upsampling of both; backward warp of the previous frames' to this one
    reconstruct                    reweighting, then a U-Net -> the HR colour

Contract: RGB-D `[B, h, w, 4]` in, 12 channels `[B, h, w, 12]` out, the RGB-D first; of those, at HR, one map
of the current frame and `previous` of the others, the newest first, make colour `[B, H, W, 3]`. Any h, w, H
and W. What the numbers mean (tone map, depth map) is up to the method; missing history is all zeros.
Features have the dtype of the network, the colour is float32 and not clipped. No batch norm.

Colour stays RGB (METHODS 6); public re-implementations convert it to YCbCr. Left open, and chosen here: a
ReLU after the last of the feature convolutions, none after that of the reconstruction, so that black does not
stop gradients; max pooling of 2x2 blocks; bilinear upsampling with pixel centres aligned, before the skip is
put beside; decoder levels of 64, 64 and 32, 3 channels. At sizes that are no multiples of 4 the maps are
padded with zeros, which is how "no sample" looks. No weights were published.
"""

import functools

import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.nets.blocks import ConvPair, ShallowFeatures, check_counts, conv, conv_beside
from jaxsr.ops import upsample

RGBD = 4
CHANNELS = RGBD + 8
"""Of one frame: RGB-D, and the features that the network adds."""
MOST = 10.0
"""The largest weight of a previous frame."""
WIDTHS = ((64, 32), (64, 64), (128, 128))  # channels of the two convolutions of each level


class NSRR(nnx.Module):
    """Features, reweighting and reconstruction; 547,767 trainable parameters with the defaults.

    Args:
        previous: frames before the current one that are seen.
        dtype: what convolutions compute in; parameters and output stay float32.

    Raises:
        JaxsrError: no previous frame, or more than 16.
    """

    def __init__(self, *, previous: int = 4, dtype: DTypeLike = jnp.float32, rngs: nnx.Rngs):
        check_counts(previous=previous)
        self.previous, self.dtype = previous, dtype
        frames = 1 + previous
        self.features = ShallowFeatures(RGBD, CHANNELS - RGBD, dtype=dtype, rngs=rngs)
        self.previous_features = ShallowFeatures(RGBD, CHANNELS - RGBD, dtype=dtype, rngs=rngs)
        self.reweighting = ConvPair(RGBD * frames, 32, 32, dtype=dtype, rngs=rngs)
        self.weights = conv(32, previous, dtype=dtype, rngs=rngs)
        inputs = (CHANNELS * frames, WIDTHS[0][1], WIDTHS[1][1])
        self.encoder = nnx.List(
            [ConvPair(n, *widths, dtype=dtype, rngs=rngs) for n, widths in zip(inputs, WIDTHS, strict=True)]
        )
        self.decoder2 = ConvPair(64 + 128, 64, 64, dtype=dtype, rngs=rngs)
        self.decoder1 = conv(32 + 64, 32, dtype=dtype, rngs=rngs)
        self.color = conv(32, 3, dtype=dtype, rngs=rngs)

    def reconstruct(
        self, current: Float[Array, "b H W c"], previous: Float[Array, "b n H W c"]
    ) -> Float[Array, "b H W 3"]:
        """Make the HR colour.

        Args:
            current: `features` of the current frame, zero-upsampled.
            previous: `previous_features` of the others, zero-upsampled and warped to it, the newest first.

        Raises:
            JaxsrError: sizes, channels or a number of frames that do not fit.
        """
        batch, height, width, _ = current.shape
        expected = (batch, self.previous, height, width, CHANNELS)
        if previous.shape != expected or current.shape[-1] != CHANNELS:
            raise JaxsrError(
                "maps of the frames do not fit together",
                where="previous",
                expected=expected,
                found=f"{previous.shape}, beside a current frame of {current.shape[-1]} channels",
            )
        frames = [_whole_levels(x.astype(self.dtype)) for x in (current, *jnp.unstack(previous, axis=1))]
        # Reweighting: from the RGB-D of all frames, one weight per pixel and previous frame.
        x = self.weights(self.reweighting(jnp.concatenate([x[..., :RGBD] for x in frames], -1)))
        weights = MOST / 2 * (1 + jnp.tanh(x))
        weighted = [x * weights[..., k : k + 1] for k, x in enumerate(frames[1:])]
        f1 = self.encoder[0](jnp.concatenate([frames[0], *weighted], -1))
        f2 = self.encoder[1](_max_pool(f1))
        f3 = self.encoder[2](_max_pool(f2))
        x = self.decoder2(f2, upsample(f3, 2))
        x = nnx.relu(conv_beside(self.decoder1, f1, upsample(x, 2)))
        return self.color(x)[:, :height, :width].astype(jnp.float32)


def _whole_levels(image: Float[Array, "b h w c"]) -> Float[Array, "b h2 w2 c"]:
    """Padded at the bottom and right until both poolings meet whole blocks."""
    rows, columns = (-n % 4 for n in image.shape[1:3])
    return jnp.pad(image, ((0, 0), (0, rows), (0, columns), (0, 0))) if rows or columns else image


def _max_pool(x: Float[Array, "b h w c"]) -> Float[Array, "b h2 w2 c"]:
    # Slices, since the gradient of XLA's own pooling is slow on a CPU.
    x = functools.reduce(jnp.maximum, [x[:, k::2] for k in (0, 1)])
    return functools.reduce(jnp.maximum, [x[:, :, k::2] for k in (0, 1)])
