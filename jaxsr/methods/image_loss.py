"""The loss of networks on display-referred images: SSIM, L1 and LPIPS, weighted."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.losses import lpips, ssim_loss
from jaxsr.methods.options import check_options
from jaxsr.nets.vgg import MIN_SIZE


@dataclass(frozen=True)
class ImageLoss:
    """Weights of the loss; those of Zhang et al. by default."""

    ssim_weight: float = 1.0
    """Of 1 - SSIM."""
    l1_weight: float = 0.0
    """Of the mean absolute error."""
    perceptual_weight: float = 0.2
    """Of LPIPS; 0 needs no LPIPS weights."""
    perceptual_crop: int = 64
    """LPIPS sees only the middle of each crop, a square of this side: its VGG is as slow as the networks."""


@dataclass(frozen=True)
class L1Loss(ImageLoss):
    """L1 alone, as RCAN and RRN were published."""

    ssim_weight: float = 0.0
    """Of 1 - SSIM."""
    l1_weight: float = 1.0
    """Of the mean absolute error."""
    perceptual_weight: float = 0.0
    """Of LPIPS; 0 needs no LPIPS weights."""


def check_loss(weights: ImageLoss) -> None:
    """Raise JaxsrError for weights of the wrong type, or a loss that cannot be computed."""
    check_options(weights)
    if weights.perceptual_weight and weights.perceptual_crop < MIN_SIZE["vgg"]:
        found, expected = weights.perceptual_crop, f"at least {MIN_SIZE['vgg']}, which LPIPS needs"
        raise JaxsrError("bad perceptual_crop", where="perceptual_crop", expected=expected, found=found)
    if not (weights.ssim_weight or weights.l1_weight or weights.perceptual_weight):
        raise JaxsrError("a loss of nothing", where="the weights of the loss", expected="one that is not 0")


def image_loss(
    shown: Float[Array, "b H W 3"], truth: Float[Array, "b H W 3"], weights: ImageLoss
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The weighted sum, and its parts. SSIM and L1 are always among the parts, for the log.

    Args:
        shown: display-referred prediction; it need not be clipped.
        truth: display-referred truth.
        weights: of the parts.
    """
    parts = {"ssim": ssim_loss(shown, truth), "l1": jnp.mean(jnp.abs(shown - truth))}
    total = weights.ssim_weight * parts["ssim"] + weights.l1_weight * parts["l1"]
    if weights.perceptual_weight:
        middle_shown, middle_truth = (middle(x, weights.perceptual_crop) for x in (shown, truth))
        parts["lpips"] = lpips(middle_shown, middle_truth)
        total = total + weights.perceptual_weight * parts["lpips"]
    return total, parts


def middle(image: Float[Array, "b H W c"], size: int) -> Float[Array, "b h w c"]:
    """The middle of images, at most `size` pixels square. Crops are random, so their middle is random too."""
    y, x = (max(n - size, 0) // 2 for n in image.shape[1:3])
    return image[:, y : y + size, x : x + size]
