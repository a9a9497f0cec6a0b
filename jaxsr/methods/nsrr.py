"""NSRR: super-resolution from the current and previous LR frames with depth (Xiao et al. 2020, METHODS 6).

    x_t         display-referred colour and normalised depth of the jittered LR frame t     `rgbd_input`
    F_t, F'_t   12 channels of x_t, LR, for the current frame and for a previous one        `jaxsr.nets.NSRR`
    Z           zero-upsampling: each LR sample in the HR pixel that it lies on
    D_t,k(p)    = MV_t(p) + D_{t-1,k-1}(p - MV_t(p)), D_t,0 = 0: the path of p over k frames
    I_t(p)      = reconstruct(Z F_t(p), Z F'_{t-1}(p - D_t,1(p)), .., Z F'_{t-4}(p - D_t,4(p)))

The samples are put where jitter has them, so that Z F is not jittered, as HR motion is not: nothing needs a
shift. Each Z F' is read once, bilinearly, 0 out of view: to warp such sparse maps again each frame would blur
them. The state keeps F' at LR and D, not Z F' or what was warped: to read a sample of F' takes one tap where
Z F' takes four (`jaxsr.ops.warp_zero_upsampled`), and the network of previous frames runs once a frame.

After a reset the missing history frames are all zeros. Training always has full windows, so the network never
learned this case. A frame that was not rendered is made from the last output by a plain backward warp; it
adds nothing to the history, but the paths lead through it.

The loss is that of the other networks here, `1 - SSIM + 0.2 LPIPS`. The paper's second term is 0.1 times a
distance of VGG-16's features; LPIPS is such a distance, over normalised and weighted features.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, Window
from jaxsr.methods.base import Method, Needs, Net, Network, Windows, last_frames, module_maker, one_image
from jaxsr.methods.history import History, plain_warp
from jaxsr.methods.image_loss import ImageLoss, check_loss, image_loss
from jaxsr.methods.options import check_options, to_json
from jaxsr.nets import NSRR
from jaxsr.nets.nsrr import CHANNELS
from jaxsr.ops import compose_motion, from_display, to_display, warp_zero_upsampled, zero_upsample
from jaxsr.ops.encoding import DEPTH_OCTAVES, normalized_depth, sample_offset


@dataclass(frozen=True)
class Options:
    """Settings of the network."""

    previous: int = 4
    """Rendered frames before the current one that the network sees."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions and of the history; parameters and losses are float32."""
    depth_octaves: float = DEPTH_OCTAVES
    """Ratio of depths, in octaves, that the network tells apart."""


class Previous(NamedTuple):
    """The last n rendered frames, the newest first; zeros where there were none."""

    features: Float[Array, "*b n h w 12"]
    """F', LR."""
    offset: Int[Array, "*b n 2"]
    """Where in its block of HR pixels each sample lies, (x, y)."""
    motion_px: Float[Array, "*b H W m"]
    """D: paths from the last frame, rendered or not, to each of them: n times (x, y), in HR pixels."""


class State(NamedTuple):
    """The previous frames, and the last output, from which frames that are not rendered are made."""

    previous: Previous
    last: History


def rgbd_input(frame: Frame, octaves: float = DEPTH_OCTAVES) -> Float[Array, "*b h w 4"]:
    """x: what the network sees of a frame; `octaves` is for `normalized_depth`."""
    depth = normalized_depth(frame.lr.depth_linear, octaves)
    return jnp.concatenate([to_display(frame.exposed), depth], -1)


def displayed(
    net: NSRR, frames: Frame, previous: Previous, octaves: float = DEPTH_OCTAVES
) -> Float[Array, "b H W 3"]:
    """A batch of frames through the network: HR colour, display-referred, not clipped.

    Args:
        net: the network.
        frames: the current frames.
        previous: the frames before, with motion that begins in the current ones.
        octaves: see `rgbd_input`.
    """
    scale, motion = frames.scale, previous.motion_px
    features = net.features(rgbd_input(frames, octaves))
    current = zero_upsample(features, scale, sample_offset(frames.jitter_px, scale))
    paths = jnp.moveaxis(motion.reshape(*motion.shape[:-1], -1, 2), -2, 1)
    warped = warp_zero_upsampled(previous.features, paths, scale, previous.offset)
    return net.reconstruct(current, warped)


def with_own_path(motion_px: Float[Array, "*b H W c"]) -> Float[Array, "*b H W c+2"]:
    """The paths after a frame has joined the previous ones: its own path has no length yet."""
    return jnp.concatenate([jnp.zeros_like(motion_px, shape=(*motion_px.shape[:-1], 2)), motion_px], -1)


def previous_of(net: NSRR, frames: Frame, octaves: float = DEPTH_OCTAVES) -> Previous:
    """What the last frame of each window, [B, T], sees of the others; no reset follows the first frame."""
    before = jax.tree.map(lambda x: x[:, -2::-1], frames)
    rgbd = rgbd_input(before, octaves)
    features = net.previous_features(rgbd.reshape(-1, *rgbd.shape[2:]))
    motion = frames.hr.motion_px
    paths = motion[:, 0, :, :, :0]
    for t in range(1, motion.shape[1]):
        paths = compose_motion(motion[:, t], with_own_path(paths))
    return Previous(
        features.reshape(*rgbd.shape[:-1], CHANNELS), sample_offset(before.jitter_px, frames.scale), paths
    )


def method(options: Options | None = None, loss: ImageLoss | None = None) -> Method:
    """The network of these settings as a method.

    Args:
        options: of the network.
        loss: weights of the training's loss, `1 - SSIM + 0.2 LPIPS` by default.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o, weights = options or Options(), loss or ImageLoss()
    check_options(o)
    check_loss(weights)
    if o.previous < 1:
        raise JaxsrError("bad previous", where="previous", expected="a whole number from 1", found=o.previous)
    if not o.depth_octaves > 0:
        raise JaxsrError("bad depth_octaves", where="depth_octaves", expected="a number above 0", found=0)
    dtype, octaves = jnp.dtype(o.dtype), o.depth_octaves

    def new(rngs: nnx.Rngs) -> NSRR:
        return NSRR(previous=o.previous, dtype=dtype, rngs=rngs)

    def loss_of(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        assert isinstance(net, NSRR)
        now, truth = last_frames(window)
        shown = displayed(net, now, previous_of(net, window.frames, octaves), octaves)
        return image_loss(shown, to_display(truth * now.exposure[..., None, None, None]), weights)

    module, warp = module_maker(new), plain_warp()

    def init(frame: Frame) -> State:
        count = 0 if frame.scale == 1 else o.previous  # full-size frames pass unchanged
        previous = Previous(
            jnp.zeros((count, *frame.color_linear.shape[:2], CHANNELS), dtype),
            jnp.zeros((count, 2), jnp.int32),
            jnp.zeros((*frame.size, 2 * count), frame.color_linear.dtype),
        )
        return State(previous, warp.init(frame))

    def seen_from(frame: Frame, previous: Previous) -> Previous:
        return previous._replace(motion_px=compose_motion(frame.hr.motion_px, previous.motion_px))

    def upscale(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        if frame.scale == 1:
            return State(state.previous, warp.keep(frame.color_linear, frame)), frame.color_linear
        model, before = module(net), seen_from(frame, state.previous)
        one, past = one_image((frame, before))
        shown = displayed(model, one, past, octaves)[0].astype(frame.color_linear.dtype)
        image = from_display(jnp.clip(shown, 0, 1)) / frame.exposure
        features = model.previous_features(rgbd_input(one, octaves))
        offset = sample_offset(one.jitter_px, frame.scale)
        previous = Previous(
            jnp.concatenate([features, before.features[:-1]]),
            jnp.concatenate([offset, before.offset[:-1]]),
            with_own_path(before.motion_px)[..., :-2],
        )
        return State(previous, warp.keep(image, frame)), image

    def extrapolate(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        last, image = warp.extrapolate(net, state.last, frame)
        return State(seen_from(frame, state.previous), last), image

    windows = Windows(o.previous + 1)
    return Method(
        "nsrr",
        "network: the current and previous frames with depth; plain warp where nothing was rendered",
        Needs(frozenset({"lr.color", "lr.depth", "hr.motion"}), warp.needs),
        init,
        upscale,
        extrapolate,
        Network(new, loss_of, windows, to_json(o), to_json(weights)),
    )
