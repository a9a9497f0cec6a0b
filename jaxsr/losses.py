"""Training losses: scalars that are means over the batch, of images or of features.

Arrays are `[H, W, C]` or `[B, H, W, C]`. Losses whose constants have a scale (Charbonnier, census, SSIM,
LPIPS, VGG) want display-referred images in [0, 1], though a prediction may leave that range; the others
take any. Gradients are finite everywhere, also where both images are identical or constant: every root and
division has a constant in it that keeps it from zero. A loss has the wider type of its images; `lpips` and
`vgg_l1` are float32.

`lpips` is that of `jaxsr.nets.vgg`; it and `vgg_l1` need the extra `perceptual`.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.nets.vgg import Params, features, lpips

__all__ = [
    "SSIM_SIGMA",
    "SSIM_WINDOW",
    "census",
    "charbonnier",
    "feature_census",
    "gaussian_window",
    "hard_l1",
    "hole_l1",
    "lpips",
    "ssim_loss",
    "temporal_l1",
    "vgg_l1",
]

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


def _of_one_type(*arrays: Array) -> tuple[Array, ...]:
    """The arrays in the widest of their types: networks make float32 where the truth may be float64."""
    with jax.numpy_dtype_promotion("standard"):
        dtype = functools.reduce(jnp.promote_types, (a.dtype for a in arrays))
    return tuple(a.astype(dtype) for a in arrays)


def charbonnier(pred: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"]) -> Float[Array, ""]:
    """Mean of sqrt(d^2 + 1e-6) (Lai et al. 2017; the constant is IFRNet's): L1, but smooth within 1e-3 of 0.

    Identical images give 1e-3.
    """
    pred, target = _of_one_type(pred, target)
    return jnp.mean(jnp.sqrt(jnp.square(pred - target) + 1e-6))


def _census(a: Array, b: Array, size: int) -> Array:
    """Soft Hamming distance of the census transforms of each channel, size x size."""
    a, b = (x.reshape(-1, *x.shape[-3:]) for x in _of_one_type(a, b))
    radius = size // 2
    batch, height, width, channels = a.shape
    h, w = height - 2 * radius, width - 2 * radius
    if min(h, w) < 1:
        raise JaxsrError(
            "image is smaller than the census patch",
            expected=f"at least {size}x{size}",
            found=f"{height}x{width}",
        )

    def transformed(image: Array, y: Array | int, x: Array | int) -> Array:
        """d / sqrt(0.81 + d^2), d the neighbour at (y, x) of the patch less its centre."""
        centre = image[:, radius : radius + h, radius : radius + w]
        d = jax.lax.dynamic_slice(image, (0, y, x, 0), (batch, h, w, channels)) - centre
        return d * jax.lax.rsqrt(0.81 + d * d)

    # A loop in the program: unrolled, 48 neighbours take 3 times as long, and 8 times as long to compile.
    # Recomputing in the backward pass is cheaper than keeping 48 images.
    @jax.checkpoint
    def add(total: Array, offset: Array) -> tuple[Array, None]:
        y, x = offset // size, offset % size
        square = jnp.square(transformed(a, y, x) - transformed(b, y, x))
        return total + square / (0.1 + square), None

    total, _ = jax.lax.scan(add, jnp.zeros((batch, h, w, channels), a.dtype), jnp.arange(size * size))
    return jnp.sum(total) / (size * size * a.size)


def census(pred: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"]) -> Float[Array, ""]:
    """Ternary census loss, 7x7, of the channel means (Meister et al. 2018, with IFRNet's constants).

    n = d / sqrt(0.81 + d^2) for the difference d to each neighbour, D the difference of both images' n: the
    mean of D^2 / (0.1 + D^2). A shift in brightness costs nothing. As in the published code the mean runs
    over all 49 places (the centre gives 0) and all pixels, of which the outer 3 rows and columns give 0.

    Raises:
        JaxsrError: smaller than 7x7.
    """
    return _census(jnp.mean(pred, -1, keepdims=True), jnp.mean(target, -1, keepdims=True), 7)


def feature_census(a: Float[Array, "*b h w c"], b: Float[Array, "*b h w c"]) -> Float[Array, ""]:
    """`census`, 3x3, of each channel by itself: IFRNet's feature geometry loss. The outer pixels give 0.

    Both get gradients; stop those of the truth's features where they must not move.

    Raises:
        JaxsrError: smaller than 3x3.
    """
    return _census(a, b, 3)


def hole_l1(
    pred: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"], mask: Float[Array, "*b h w 1"]
) -> Float[Array, ""]:
    """L1 over the holes divided by their area in the whole batch; 0 where there are none.

    Args:
        pred, target: of any range.
        mask: 1 valid, 0 hole, as `jaxsr.ops.masks` makes them.
    """
    pred, target, mask = _of_one_type(pred, target, mask)
    hole = 1 - jax.lax.stop_gradient(mask)
    area = jnp.sum(hole) * pred.shape[-1]
    # The area is a whole number: the guard acts where it is 0, and then so is the sum.
    return jnp.sum(jnp.abs(pred - target) * hole) / jnp.maximum(area, 1.0)


def hard_l1(
    pred: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"], fraction: float = 0.1
) -> Float[Array, ""]:
    """Mean of the largest absolute errors of each image and channel (ExtraNet's hard loss).

    Args:
        pred, target: of any range.
        fraction: share of the pixels; floor(fraction h w) of them, at least one.

    Raises:
        JaxsrError: the fraction is not in (0, 1].
    """
    if not 0 < fraction <= 1:
        raise JaxsrError("bad fraction", where="hard_l1", expected="in (0, 1]", found=fraction)
    pred, target = _of_one_type(pred, target)
    height, width, channels = pred.shape[-3:]
    error = jnp.abs(pred - target).reshape(-1, height * width, channels)
    count = max(math.floor(fraction * height * width + 1e-6), 1)  # 0.29 * 100 is 28.999...
    return jnp.mean(jax.lax.top_k(error.swapaxes(1, 2), count)[0])


def _taps() -> list[float]:
    weights = np.exp(-0.5 * ((np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2) / SSIM_SIGMA) ** 2)
    return [float(w) for w in weights / weights.sum()]


@jax.custom_vjp
def gaussian_window(image: Float[Array, "*b h w c"]) -> Float[Array, "*b h-10 w-10 c"]:
    """Mean under SSIM's Gaussian window, 11x11 and sigma 1.5, for the windows that lie inside the image."""
    h, w = (n - SSIM_WINDOW + 1 for n in image.shape[-3:-1])
    rows = functools.reduce(jnp.add, [t * image[..., k : k + h, :, :] for k, t in enumerate(_taps())])
    # Sums of shifted images take a third of the time of convolutions on a CPU. The barrier keeps XLA from
    # fusing both passes into 121 taps per pixel.
    rows = jax.lax.optimization_barrier(rows)
    return functools.reduce(jnp.add, [t * rows[..., k : k + w, :] for k, t in enumerate(_taps())])


def _window_forward(image: Array) -> tuple[Array, None]:
    return gaussian_window(image), None


def _window_backward(_: None, gradient: Array) -> tuple[Array]:
    # The window is symmetric, so its transpose is itself on the padded gradient: no slower than forward.
    edge = (SSIM_WINDOW - 1, SSIM_WINDOW - 1)
    return (gaussian_window(jnp.pad(gradient, [(0, 0)] * (gradient.ndim - 3) + [edge, edge, (0, 0)])),)


gaussian_window.defvjp(_window_forward, _window_backward)


def ssim_loss(pred: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"]) -> Float[Array, ""]:
    """1 - SSIM (Wang et al. 2004), the SSIM of `jaxsr.metrics.ssim`: per channel, windows inside the image.

    Raises:
        JaxsrError: smaller than the window, 11x11.
    """
    if min(pred.shape[-3:-1]) < SSIM_WINDOW:
        raise JaxsrError(
            "image is smaller than the SSIM window",
            expected=f"at least {SSIM_WINDOW}x{SSIM_WINDOW}",
            found=f"{pred.shape[-3]}x{pred.shape[-2]}",
        )
    pred, target = _of_one_type(pred, target)
    c1, c2 = 0.01**2, 0.03**2  # they also keep both denominators, and so the gradients, away from 0
    mean_p, mean_t = gaussian_window(pred), gaussian_window(target)
    # Only the sum of the two variances is needed: four windows, not five.
    squares, product = gaussian_window(pred * pred + target * target), gaussian_window(pred * target)
    mean_squares, mean_product = mean_p * mean_p + mean_t * mean_t, mean_p * mean_t
    luminance = (2 * mean_product + c1) / (mean_squares + c1)
    structure = (2 * (product - mean_product) + c2) / (squares - mean_squares + c2)
    return 1 - jnp.mean(luminance * structure)


def vgg_l1(
    pred: Float[Array, "*b h w 3"], target: Float[Array, "*b h w 3"], params: Params | None = None
) -> Float[Array, ""]:
    """Mean absolute difference of VGG-16's features, averaged over relu 1_2, 2_2, 3_3, 4_3 and 5_3.

    Features are as the network makes them, not normalised. No gradient reaches the target.

    Raises:
        JaxsrError: as for `jaxsr.nets.vgg.lpips`.
    """
    of_target = jax.lax.stop_gradient(features(target, "vgg", params))
    of_pred = features(pred, "vgg", params)
    differences = [jnp.mean(jnp.abs(a - b)) for a, b in zip(of_pred, of_target, strict=True)]
    return functools.reduce(jnp.add, differences) / len(differences)


def temporal_l1(
    image: Float[Array, "*b h w c"], warped_previous: Float[Array, "*b h w c"]
) -> Float[Array, ""]:
    """|I_t - f_r(I_{t-1})|_1 (ExtraSS): L1 between an output and the previous output warped to it.

    Args:
        image: I_t.
        warped_previous: the previous output after `jaxsr.ops.backward_warp`; gradients reach it too.
    """
    image, warped_previous = _of_one_type(image, warped_previous)
    return jnp.mean(jnp.abs(image - warped_previous))
