"""Guided temporal upsampling, corrected by a small U-Net.

    E     the image that `jaxsr.methods.guided_taau` makes of this frame and its history, display-referred
    C     what it makes of this frame before it is anti-aliased: sharp, and sampled at the pixel's centre
    I     the LR colour, interpolated
    n     what the history of the image is worth
    G     the HR G-buffer
    O     = clip(E + net(E, C - E, I - E, n, G), 0, 1)

The histories are those of guided-taau, which the network does not touch: it cannot feed on its own errors,
and training needs no gradient through time. Its first output is E itself. All of it is at full size, so one
network serves every scale; which one it has seen in training is in its file.

The output is display-referred before it is made linear again: nothing in it is brighter than white.

A frame that was not rendered is that of guided-taau: the network corrects only what was rendered.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, Window
from jaxsr.methods import guided, guided_taau
from jaxsr.methods.base import Method, Needs, Net, Network, Windows, module_maker
from jaxsr.methods.image_loss import ImageLoss, check_loss, image_loss
from jaxsr.methods.options import check_options, to_json
from jaxsr.nets.guided_unet import WIDTHS, GuidedUNet
from jaxsr.ops import from_display, to_display
from jaxsr.ops.encoding import DEPTH_OCTAVES, normalized_depth
from jaxsr.ops.resampling import sample

CHANNELS = 3 + 3 + 3 + 1 + 1 + 3 + 3 + 1 + 1
"""E, C - E, I - E, n, depth, base colour, normal, roughness, metallic."""
LENGTH = 4
"""Frames of a window. The loss compares all of them, so that the network learns the first ones as well."""


@dataclass(frozen=True)
class Options:
    """Settings of the network and of what is around it; a file of weights records all of them."""

    widths: tuple[int, ...] = WIDTHS
    """Features at half the size, a quarter, and so on."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions; parameters and losses are float32."""
    depth_octaves: float = DEPTH_OCTAVES
    """Ratio of depths, in octaves, that the network tells apart."""
    base: guided_taau.Options = guided_taau.Options()  # noqa: RUF009 (frozen)
    """Of the image that is corrected."""
    reprojection: guided.Options = guided.Options()  # noqa: RUF009 (frozen)
    """For frames that were not rendered."""

    def check(self) -> None:
        """Raise JaxsrError for an option that has no such value."""
        check_options(self)
        self.base.check()
        self.reprojection.check()
        if not self.depth_octaves > 0:
            raise JaxsrError("bad depth_octaves", where="depth_octaves", expected="a number above 0", found=0)


@dataclass(frozen=True)
class Loss(ImageLoss):
    """Weights of the loss."""

    ssim_weight: float = 0.1
    """Of 1 - SSIM."""
    l1_weight: float = 1.0
    """Of the mean absolute error."""
    perceptual_weight: float = 0.0
    """Of LPIPS; 0 needs no LPIPS weights."""


def interpolated(frame: Frame) -> Float[Array, "H W 3"]:
    """I of one frame, display-referred: bilinear, at the places of the jittered samples."""
    shown, scale = to_display(frame.exposed), frame.scale
    y, x = (
        (jnp.arange(size, dtype=shown.dtype) + 0.5) / scale - 0.5 - frame.jitter_px[axis]
        for size, axis in zip(frame.size, (1, 0), strict=True)
    )
    positions = jnp.stack(jnp.meshgrid(x, y), -1)
    return sample(shown, positions, mode="bilinear")


def inputs(
    state: guided_taau.State, image: Float[Array, "H W 3"], frame: Frame, options: Options
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W c"]]:
    """E, and all that the network sees, of one frame after the step of guided-taau."""
    shown = to_display(image * frame.exposure)
    sharp = to_display(state.last.image * frame.exposure)
    base_color, normal = guided.surface_of(frame.hr)
    assert frame.hr.roughness is not None
    assert frame.hr.metallic is not None
    parts = [
        shown,
        sharp - shown,
        interpolated(frame) - shown,
        state.worth / options.base.antialiasing.memory,
        normalized_depth(frame.hr.depth_linear, options.depth_octaves),
        base_color,
        normal,
        frame.hr.roughness,
        frame.hr.metallic,
    ]
    return shown, jnp.concatenate(parts, -1)


def method(options: Options | None = None, loss: Loss | None = None) -> Method:
    """The network of these settings as a method.

    Args:
        options: of the network.
        loss: weights of the training's loss.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o, weights = options or Options(), loss or Loss()
    o.check()
    check_loss(weights)
    base = guided_taau.method(o.base, o.reprojection)
    dtype = jnp.dtype(o.dtype)

    def new(rngs: nnx.Rngs) -> GuidedUNet:
        return GuidedUNet(CHANNELS, o.widths, dtype=dtype, rngs=rngs)

    def seen(frames: Frame) -> tuple[Array, Array]:
        """E and the inputs of each frame of one window."""

        def step(state: guided_taau.State, frame: Frame) -> tuple[guided_taau.State, tuple[Array, Array]]:
            fresh = base.init(frame)
            state = jax.tree.map(lambda a, b: jnp.where(frame.reset, a, b), fresh, state)
            state, image = base.upscale(None, state, frame)
            return state, inputs(state, image, frame, o)

        first = jax.tree.map(lambda x: x[0], frames)
        return jax.lax.scan(step, base.init(first), frames)[1]

    def loss_of(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        assert isinstance(net, GuidedUNet)
        shown, given = jax.lax.stop_gradient(jax.vmap(seen)(window.frames))
        exposure = window.frames.exposure[..., None, None, None]
        truth = to_display(window.truth_linear * exposure)
        flat = [x.reshape(-1, *x.shape[2:]) for x in (shown, given, truth)]
        return image_loss(flat[0] + net(flat[1]), flat[2], weights)

    module = module_maker(new)

    def upscale(net: Net, state: guided_taau.State, frame: Frame) -> tuple[guided_taau.State, Array]:
        state, image = base.upscale(None, state, frame)
        if frame.scale == 1:
            return state, image
        shown, given = inputs(state, image, frame, o)
        corrected = jnp.clip(shown + module(net)(given[None])[0].astype(shown.dtype), 0, 1)
        return state, from_display(corrected) / frame.exposure

    needs = base.needs.rendered | {"hr.roughness", "hr.metallic"}
    return Method(
        "guided-unet",
        "network: corrects the image of guided-taau; guided reprojection where nothing was rendered",
        Needs(needs, base.needs.extrapolated, hr_jitter=True),
        base.init,
        upscale,
        lambda net, state, frame: base.extrapolate(None, state, frame),
        Network(new, loss_of, Windows(LENGTH, made=None), to_json(o), to_json(weights)),
    )
