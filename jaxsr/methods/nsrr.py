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

After a cut the missing frames are zeros, RGB-D too: their network is not asked. Training never sees that. A
frame that was not rendered is made from the last output by a plain backward warp; it adds nothing to the
history, but the paths lead through it.

The loss is that of the other networks here, `1 - SSIM + 0.2 LPIPS`. The paper's second term is 0.1 times a
distance of VGG-16's features; LPIPS is such a distance, over normalised and weighted features.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, Window
from jaxsr.methods._network import ImageLoss, check_options, image_loss, last_output
from jaxsr.methods.base import Loss, Method, Net, by_rendered
from jaxsr.methods.fusion_sr import normalized_depth, sample_offset
from jaxsr.nets import NSRR
from jaxsr.nets.nsrr import CHANNELS
from jaxsr.ops import compose_motion, from_display, to_display, warp_zero_upsampled, zero_upsample


@dataclass(frozen=True)
class Options(ImageLoss):
    """What is fixed when a network is made; recorded in its file of weights."""

    previous: int = 4
    """Rendered frames before the current one that the network sees."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions and of the history; parameters and losses are float32."""


class History(NamedTuple):
    """The last n rendered frames, the newest first; zeros where there were none."""

    features: Float[Array, "*b n h w 12"]
    """F', LR."""
    offset: Int[Array, "*b n 2"]
    """Where in its block of HR pixels each sample lies, (x, y)."""
    motion_px: Float[Array, "*b H W m"]
    """D: paths from the last frame, rendered or not, to each of them: n times (x, y), in HR pixels."""


class State(NamedTuple):
    """The history, and the last output, from which frames that are not rendered are made."""

    history: History
    last: Any


def rgbd_input(frame: Frame) -> Float[Array, "*b h w 4"]:
    """x: what the network sees of a frame."""
    color = to_display(frame.color_linear * frame.exposure[..., None, None, None])
    return jnp.concatenate([color, normalized_depth(frame.lr.depth_linear)], -1)


def displayed(net: NSRR, frames: Frame, history: History) -> Float[Array, "b H W 3"]:
    """A batch of frames through the network: HR colour, display-referred, not clipped.

    Args:
        history: as these frames see it, with motion that begins in them.
    """
    scale, motion = frames.scale, history.motion_px
    current = zero_upsample(net.features(rgbd_input(frames)), scale, sample_offset(frames.jitter_px, scale))
    paths = jnp.moveaxis(motion.reshape(*motion.shape[:-1], -1, 2), -2, 1)
    previous = warp_zero_upsampled(history.features, paths, scale, history.offset)
    return net.reconstruct(current, previous)


def longer(motion_px: Float[Array, "*b H W c"]) -> Float[Array, "*b H W c+2"]:
    """The paths after a frame that joins the history: its own has no length yet."""
    return jnp.concatenate([jnp.zeros_like(motion_px, shape=(*motion_px.shape[:-1], 2)), motion_px], -1)


def history_of(net: NSRR, frames: Frame) -> History:
    """What the last of several frames, [B, T], sees of the others: all rendered, none but the first a cut."""
    before = jax.tree.map(lambda x: x[:, -2::-1], frames)
    rgbd = rgbd_input(before)
    features = net.previous_features(rgbd.reshape(-1, *rgbd.shape[2:]))
    motion = frames.hr.motion_px
    paths = motion[:, 0, :, :, :0]
    for t in range(1, motion.shape[1]):
        paths = compose_motion(motion[:, t], longer(paths))
    return History(
        features.reshape(*rgbd.shape[:-1], CHANNELS), sample_offset(before.jitter_px, frames.scale), paths
    )


def loss_of(options: Options) -> Loss:
    """`1 - SSIM + 0.2 LPIPS` of the last frame of each window, display-referred."""

    def loss(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        assert isinstance(net, NSRR)
        now = jax.tree.map(lambda x: x[:, -1], window.frames)
        shown = displayed(net, now, history_of(net, window.frames))
        truth = to_display(window.truth_linear[:, -1] * now.exposure[..., None, None, None])
        return image_loss(shown, truth, options)

    return loss


def method(options: Options | None = None) -> Method:
    """The network of these options as a method.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o = options or Options()
    check_options(o)
    if o.previous < 1:
        raise JaxsrError("bad previous", where="previous", expected="a whole number from 1", found=o.previous)
    dtype = jnp.dtype(o.compute)
    no_output, keep, extrapolate = last_output(False)

    def new_net(rngs: nnx.Rngs) -> NSRR:
        return NSRR(previous=o.previous, dtype=dtype, rngs=rngs)

    def init(frame: Frame) -> State:
        kept = 0 if frame.scale == 1 else o.previous  # full-size frames pass unchanged
        size, hr_size = frame.color_linear.shape[:2], frame.hr.depth_linear.shape[:2]
        history = History(
            jnp.zeros((kept, *size, CHANNELS), dtype),
            jnp.zeros((kept, 2), jnp.int32),
            jnp.zeros((*hr_size, 2 * kept), frame.hr.motion_px.dtype),
        )
        return State(history, no_output(frame))

    def seen_from(frame: Frame, history: History) -> History:
        return history._replace(motion_px=compose_motion(frame.hr.motion_px, history.motion_px))

    def upscale(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        if frame.scale == 1:
            return State(state.history, keep(frame.color_linear, frame)), frame.color_linear
        model = nnx.merge(nnx.graphdef(nnx.eval_shape(lambda: new_net(nnx.Rngs(0)))), net)
        history = seen_from(frame, state.history)
        one, past = jax.tree.map(lambda x: jnp.asarray(x)[None], (frame, history))
        shown = displayed(model, one, past)[0]
        image = from_display(jnp.clip(shown, 0, 1)) / frame.exposure
        features = model.previous_features(rgbd_input(one))
        offset = sample_offset(one.jitter_px, frame.scale)
        history = History(
            jnp.concatenate([features, history.features[:-1]]),
            jnp.concatenate([offset, history.offset[:-1]]),
            longer(history.motion_px)[..., :-2],
        )
        return State(history, keep(image, frame)), image

    def pass_over(net: Net, state: State, frame: Frame) -> tuple[State, Array]:
        last, image = extrapolate(net, state.last, frame)
        return State(seen_from(frame, state.history), last), image

    return Method(
        "nsrr",
        "network: the current and previous frames with depth; plain warp where nothing was rendered",
        init,
        by_rendered(init, upscale, pass_over),
        frozenset({"lr.color", "lr.depth", "hr.motion"}),
        new_net=new_net,
        loss=loss_of(o),
        window=o.previous + 1,
        arguments=asdict(o),
    )
