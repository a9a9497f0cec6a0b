"""Blocks that several networks share.

Features are `[B, H, W, C]`. Kernels start Xavier-uniform (Glorot and Bengio 2010) unless a network begins
otherwise, biases at zero. Parameters are float32; convolutions compute in the dtype of the block, batch norm
and squeeze-and-excitation in float32, because means over an image need the digits. Padding is explicit: a
stride-2 convolution with 3x3 kernel pads one pixel on every side, as PyTorch's does, and not only at the
bottom and right, as "SAME" would.

Some blocks are not computed in their textbook form, which is slow on a CPU: `conv_beside`, `convolve` and
`UpConv` say why.
"""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError

CHANNELS = {"depth": 1, "base_color": 3, "normal": 3, "roughness": 1, "metallic": 1, "estimate": 3}
"""Parts of a G-buffer and their numbers of channels; "estimate" is a first guess of the colour."""
XAVIER = nnx.initializers.xavier_uniform()
Module = TypeVar("Module", bound=nnx.Module)


def conv(
    inputs: int,
    outputs: int,
    kernel: int = 3,
    *,
    stride: int = 1,
    bias: bool = True,
    dtype: DTypeLike,
    rngs: nnx.Rngs,
) -> nnx.Conv:
    """A convolution that keeps the size at odd kernels, or divides it by `stride`; 2x2 kernels do not pad."""
    pad = (kernel - 1) // 2
    return nnx.Conv(
        inputs,
        outputs,
        (kernel, kernel),
        strides=(stride, stride),
        padding=((pad, pad), (pad, pad)),
        use_bias=bias,
        dtype=dtype,
        kernel_init=XAVIER,
        rngs=rngs,
    )


def conv_beside(layer: nnx.Conv, *parts: Float[Array, "b h w _"]) -> Float[Array, "b h2 w2 d"]:
    """`layer(concatenate(parts))` as the sum of one convolution per part.

    Materialising the concatenation takes half as long as the convolution itself, and memory besides.
    """
    total, first = None, 0
    for part in parts:
        last = first + part.shape[-1]
        product = jax.lax.conv_general_dilated(
            part.astype(layer.dtype),
            layer.kernel[:, :, first:last].astype(layer.dtype),
            layer.strides,  # type: ignore[arg-type]
            layer.padding,  # type: ignore[arg-type]
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )
        total, first = product if total is None else total + product, last
    assert total is not None
    if layer.bias is None:
        return total
    return total + layer.bias[...].astype(total.dtype).reshape(1, 1, 1, -1)


def count_channels(buffers: Sequence[str]) -> int:
    """How many channels these parts of a G-buffer have.

    Raises:
        JaxsrError: an unknown part, one twice, or none.
    """
    if not buffers or len(set(buffers)) < len(buffers) or not set(buffers) <= set(CHANNELS):
        raise JaxsrError(
            "bad parts of the G-buffer",
            where="buffers",
            expected=f"some of {', '.join(CHANNELS)}",
            found=buffers,
        )
    return sum(CHANNELS[name] for name in buffers)


MOST = {"scale": 16, "groups": 64, "blocks": 64, "features": 1024, "previous": 16, "frames": 64}
"""The largest sizes of networks. Files of weights bring any number, and even the plan of a network with ten
million blocks takes hours; the largest published network here has 10 groups of 20 blocks and 128 features."""


def check_shape(scale: int | None, down_kernel: int) -> None:
    """Raise JaxsrError unless networks of this scale and stride-2 kernel exist."""
    if scale is not None:
        check_counts(scale=scale)
    if down_kernel not in (2, 3):
        raise JaxsrError("bad kernel", where="down_kernel", expected="2 | 3", found=down_kernel)


def check_counts(least: int = 1, **counts: int) -> None:
    """Raise JaxsrError, which names the first bad one, unless all are whole, from `least` to `MOST`."""
    for name, count in counts.items():
        most = MOST.get(name, max(MOST.values()))
        if type(count) is not int or not least <= count <= most:
            bound = f"at most {most}" if type(count) is int and count > most else f"at least {least}"
            raise JaxsrError(f"bad {name}", where=name, expected=f"a whole number of {bound}", found=count)


def check_channels(gbuffer: Float[Array, "b h w c"], channels: int) -> None:
    """Raise JaxsrError unless the G-buffer has this number of channels."""
    if gbuffer.shape[-1] != channels:
        raise JaxsrError(
            "wrong number of channels", where="gbuffer", expected=channels, found=gbuffer.shape[-1]
        )


def _convolution(x: Array, kernel: Array, pad: int) -> Array:
    numbers = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), ((pad, pad), (pad, pad)), dimension_numbers=numbers
    )


@jax.custom_vjp
def convolve(x: Float[Array, "b h w c"], kernel: Float[Array, "k k c d"]) -> Float[Array, "b h w d"]:
    """A convolution of odd size that keeps the size of the image."""
    return _convolution(x, kernel, kernel.shape[0] // 2)


def _convolve_forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return convolve(x, kernel), (x, kernel)


def _convolve_backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    pad = saved[1].shape[0] // 2

    def usual(x: Array, kernel: Array, gradient: Array) -> tuple[Array, Array]:
        return jax.vjp(lambda x, kernel: _convolution(x, kernel, pad), x, kernel)[1](gradient)

    def in_forward_layout(x: Array, kernel: Array, gradient: Array) -> tuple[Array, Array]:
        of_x = _convolution(gradient, kernel[::-1, ::-1].swapaxes(2, 3), pad)
        of_kernel = _convolution(x.transpose(3, 1, 2, 0), gradient.transpose(1, 2, 0, 3), pad)
        return of_x, of_kernel.transpose(1, 2, 0, 3)

    # On CPUs, XLA's convolutions of other layouts are slow inside a loop: training would be 20 times slower.
    return jax.lax.platform_dependent(*saved, gradient, cpu=in_forward_layout, default=usual)


convolve.defvjp(_convolve_forward, _convolve_backward)


class LoopConv(nnx.Conv):
    """A 3x3 convolution with stride 1 whose gradient is fast in a loop, too: `jax.lax.scan`, `through`."""

    def __init__(self, inputs: int, outputs: int, *, init: nnx.Initializer, dtype: DTypeLike, rngs: nnx.Rngs):
        super().__init__(inputs, outputs, (3, 3), dtype=dtype, kernel_init=init, rngs=rngs)

    def __call__(  # type: ignore[override]  # nothing about sharding
        self, inputs: Float[Array, "b h w c"]
    ) -> Float[Array, "b h w d"]:
        assert self.bias is not None
        bias = self.bias[...].astype(self.dtype).reshape(1, 1, 1, -1)
        return convolve(inputs.astype(self.dtype), self.kernel[...].astype(self.dtype)) + bias


def stacked(count: int, make: Callable[[nnx.Rngs], Module], rngs: nnx.Rngs) -> Module:
    """`count` modules as one module whose arrays have a leading axis; `through` runs them in a loop."""
    return nnx.split_rngs(splits=count)(nnx.vmap(make, in_axes=0, out_axes=0))(rngs)


@nnx.scan(in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)
def through(x: Float[Array, "b h w c"], modules: Callable[[Array], Array]) -> Float[Array, "b h w c"]:
    """Features through `stacked` modules, one after the other."""
    return modules(x)


class ConvPair(nnx.Module):
    """Two convolutions with ReLU, of features side by side: a level of an encoder or of a decoder.

    Args:
        inputs, middle, outputs: channels; `inputs` counts those of all parts.
        kernel: size of the first kernel; the second is 3x3.
        stride: of the first one.
    """

    def __init__(
        self,
        inputs: int,
        middle: int,
        outputs: int,
        *,
        kernel: int = 3,
        stride: int = 1,
        dtype: DTypeLike,
        rngs: nnx.Rngs,
    ):
        self.conv1 = conv(inputs, middle, kernel, stride=stride, dtype=dtype, rngs=rngs)
        self.conv2 = conv(middle, outputs, dtype=dtype, rngs=rngs)

    def __call__(self, *parts: Float[Array, "b h w _"]) -> Float[Array, "b h2 w2 d"]:
        return nnx.relu(self.conv2(nnx.relu(conv_beside(self.conv1, *parts))))


def encoder(
    inputs: int, widths: Sequence[tuple[int, int]], down_kernel: int, *, dtype: DTypeLike, rngs: nnx.Rngs
) -> list[ConvPair]:
    """Levels of a U-Net: the first keeps the size, every other one halves it."""
    levels = []
    for i, (middle, outputs) in enumerate(widths):
        kernel, stride = (3, 1) if i == 0 else (down_kernel, 2)
        levels.append(ConvPair(inputs, middle, outputs, kernel=kernel, stride=stride, dtype=dtype, rngs=rngs))
        inputs = outputs
    return levels


class ShallowFeatures(nnx.Module):
    """Three 3x3 convolutions with ReLU (32, 32, `features`), and the input beside their result."""

    def __init__(self, inputs: int, features: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        self.conv1 = conv(inputs, 32, dtype=dtype, rngs=rngs)
        self.conv2 = conv(32, 32, dtype=dtype, rngs=rngs)
        self.conv3 = conv(32, features, dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w d"]:
        features = nnx.relu(self.conv3(nnx.relu(self.conv2(nnx.relu(self.conv1(x))))))
        return jnp.concatenate([x.astype(features.dtype), features], axis=-1)


class BatchNorm(nnx.BatchNorm):
    """Batch norm with PyTorch's constants, computed in float32.

    Training mode normalises by the batch and lets a tenth of its statistics into the running ones; the
    running variance is that of the batch, where PyTorch multiplies by n / (n - 1).
    """

    def __init__(self, channels: int, *, rngs: nnx.Rngs):
        super().__init__(channels, momentum=0.9, epsilon=1e-5, dtype=jnp.float32, rngs=rngs)


class SqueezeExcite(nnx.Module):
    """Channels scaled by a gate in (0, 1) that sees all of their means (Hu et al. 2018)."""

    def __init__(self, channels: int, reduction: int = 16, *, bias: bool = False, rngs: nnx.Rngs):
        middle = channels // reduction
        self.squeeze = nnx.Linear(channels, middle, use_bias=bias, kernel_init=XAVIER, rngs=rngs)
        self.excite = nnx.Linear(middle, channels, use_bias=bias, kernel_init=XAVIER, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        mean = jnp.mean(x, axis=(1, 2), keepdims=True, dtype=jnp.float32)
        gate = nnx.sigmoid(self.excite(nnx.relu(self.squeeze(mean))))
        return x * gate.astype(x.dtype)


def whole_levels(
    color: Float[Array, "b h w 3"], gbuffer: Float[Array, "b H W c"], scale: int, multiple: int
) -> tuple[Float[Array, "b h2 w2 3"], Float[Array, "b H2 W2 c"]]:
    """Both inputs with their last rows and columns repeated, until the HR size is a multiple of `multiple`.

    Raises:
        JaxsrError: the G-buffer is not `scale` times the size of the colour.
    """
    (height, width), found = color.shape[1:3], gbuffer.shape[1:3]
    if found != (height * scale, width * scale):
        raise JaxsrError(
            "colour and G-buffer do not fit together",
            where="gbuffer",
            expected=f"{width * scale} x {height * scale}, {scale} times {width} x {height}",
            found=f"{found[1]} x {found[0]}",
        )
    step = multiple // math.gcd(multiple, scale)
    rows, columns = -height % step, -width % step
    if not rows and not columns:
        return color, gbuffer

    def pad(image: Array, times: int) -> Array:
        return jnp.pad(image, ((0, 0), (0, rows * times), (0, columns * times), (0, 0)), mode="edge")

    return pad(color, 1), pad(gbuffer, scale)


class UpConv(nnx.ConvTranspose):
    """A transposed convolution with a 2x2 kernel and stride 2: every pixel becomes a block of 2x2.

    Blocks do not overlap, so one matrix product computes it. Computed as a dilated convolution, its gradient
    alone takes as long as that of the rest of the network.
    """

    def __init__(self, inputs: int, outputs: int, *, dtype: DTypeLike, rngs: nnx.Rngs):
        super().__init__(
            inputs, outputs, (2, 2), (2, 2), padding="VALID", dtype=dtype, kernel_init=XAVIER, rngs=rngs
        )

    def __call__(self, inputs: Float[Array, "b h w c"]) -> Float[Array, "b h2 w2 d"]:
        batch, height, width, _ = inputs.shape
        kernel = self.kernel[::-1, ::-1]  # flax's kernels are mirrored: those of the equal convolution
        blocks = jnp.einsum(
            "bhwc,yxcd->bhywxd",
            inputs.astype(self.dtype),
            kernel.astype(self.dtype),
            preferred_element_type=jnp.float32,  # bfloat16 products must not be summed in bfloat16
        )
        image = blocks.reshape(batch, 2 * height, 2 * width, self.out_features).astype(self.dtype)
        assert self.bias is not None
        return image + self.bias[...].astype(self.dtype).reshape(1, 1, 1, -1)


class UpConcat(nnx.Module):
    """A level of a U-Net's decoder: transposed 2x2 convolution with stride 2, skip, two 3x3 convolutions.

    Args:
        inputs: channels of the coarse features.
        skip: channels of the features beside which the upsampled ones are put.
        middle: channels of the upsampled features and of the first convolution.
        outputs: channels of the result, after a ReLU.
    """

    def __init__(
        self, inputs: int, skip: int, middle: int, outputs: int, *, dtype: DTypeLike, rngs: nnx.Rngs
    ):
        self.up = UpConv(inputs, middle, dtype=dtype, rngs=rngs)
        self.convs = ConvPair(middle + skip, middle, outputs, dtype=dtype, rngs=rngs)

    def __call__(
        self, coarse: Float[Array, "b h w c"], skip: Float[Array, "b h2 w2 d"]
    ) -> Float[Array, "b h2 w2 e"]:
        return self.convs(skip, self.up(coarse))
