"""What methods with a network share: their loss, the check of options, frames that were not rendered."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.losses import lpips, ssim_loss
from jaxsr.methods import guided, taau
from jaxsr.methods.base import Net
from jaxsr.nets.vgg import MIN_SIZE
from jaxsr.ops import backward_warp


@dataclass(frozen=True)
class ImageLoss:
    """Weights of a loss on display-referred images; base of the options of methods that use it."""

    ssim_weight: float = 1.0
    """Of 1 - SSIM."""
    l1_weight: float = 0.0
    """Of the mean absolute error."""
    perceptual_weight: float = 0.2
    """Of LPIPS; 0 needs no LPIPS weights."""
    perceptual_crop: int = 64
    """LPIPS sees the middle of each crop, so many pixels square: its VGG is as slow as the networks."""


def image_loss(
    shown: Float[Array, "b H W 3"], truth: Float[Array, "b H W 3"], weights: ImageLoss
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The weighted sum, and its parts. SSIM and L1 are always among the parts, for the log."""
    parts = {"ssim": ssim_loss(shown, truth), "l1": jnp.mean(jnp.abs(shown - truth))}
    total = weights.ssim_weight * parts["ssim"] + weights.l1_weight * parts["l1"]
    if weights.perceptual_weight:
        seen, true = (middle(x, weights.perceptual_crop) for x in (shown, truth))
        parts["lpips"] = lpips(seen, true)
        total = total + weights.perceptual_weight * parts["lpips"]
    return total, parts


def middle(image: Float[Array, "b H W c"], size: int) -> Float[Array, "b h w c"]:
    """The middle of images, at most `size` pixels square. Crops are random, hence so is this."""
    y, x = (max(n - size, 0) // 2 for n in image.shape[1:3])
    return image[:, y : y + size, x : x + size]


def check_options(options: ImageLoss) -> None:
    """Files of weights and command lines bring any value: a wrong one must not count as another one.

    Raises:
        JaxsrError: an option that is not of its type, or a loss that cannot be computed.
    """
    for name, kind in get_type_hints(type(options)).items():
        value = getattr(options, name)
        good, expected = {
            bool: (isinstance(value, bool), "true or false"),
            int: (type(value) is int, "a whole number"),
            float: (type(value) in (int, float) and 0 <= value < math.inf, "a number from 0"),
            tuple: (isinstance(value, tuple) and all(isinstance(v, str) for v in value), "a list of names"),
            Literal: (value in get_args(kind), " | ".join(map(str, get_args(kind)))),
        }[get_origin(kind) or kind]
        if not good:
            raise JaxsrError(f"bad {name}", where=name, expected=expected, found=value)
    if options.perceptual_weight and options.perceptual_crop < MIN_SIZE["vgg"]:
        found, expected = options.perceptual_crop, f"at least {MIN_SIZE['vgg']}, which LPIPS needs"
        raise JaxsrError("bad perceptual_crop", where="perceptual_crop", expected=expected, found=found)
    if not (options.ssim_weight or options.l1_weight or options.perceptual_weight):
        raise JaxsrError("a loss of nothing", where="the weights of the loss", expected="one that is not 0")


class LastOutput(NamedTuple):
    """How a network that sees only rendered frames makes the others: from its last output."""

    init: Callable[[Frame], Any]
    """The empty history."""
    keep: Callable[[Array, Frame], Any]
    """The history after this output."""
    extrapolate: Callable[[Net, Any, Frame], tuple[Any, Array]]
    """A method's step where nothing was rendered."""


def last_output(is_guided: bool) -> LastOutput:
    """By guided reprojection (`jaxsr.methods.guided`), which needs base colour and normal, or a warp."""

    def init(frame: Frame) -> guided.State | taau.State:
        return guided.init(frame) if is_guided else taau.init(frame)

    def keep(image: Array, frame: Frame) -> guided.State | taau.State:
        depth = frame.hr.depth_linear
        history = taau.State(image, jnp.ones_like(depth), depth)
        return guided.State(history, *guided.surface(frame.hr)) if is_guided else history

    def extrapolate(net: Net, state: guided.State | taau.State, frame: Frame) -> tuple[object, Array]:
        if isinstance(state, guided.State):
            return guided.extrapolate(guided.Options(), state, frame)
        image = backward_warp(state.image, frame.hr.motion_px)
        return keep(image, frame), image

    return LastOutput(init, keep, extrapolate)
