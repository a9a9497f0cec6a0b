"""Super-resolution by multi-scale fusion with HR G-buffers (Zhang et al., METHODS 2): one frame, no history.

    I_LR    colour of the jittered LR frame, in [0, 1]              `color_input`
    I_G     HR G-buffer, every channel about [0, 1] or [-1, 1]      `gbuffer_input`
    I_HR    = net(I_LR, I_G)                                        `jaxsr.nets.FusionSR` or `UNetSR`

Normalisation, the same in training and inference:

    colour  "display": display-referred colour, sRGB(ACES(exposure I)); the output is shown as it is.
            "lighting": l = sqrt(L / (1 + L)) of the lighting L = exposure I / a, a the base colour; the
            output is turned back into L and multiplied by the HR base colour: texture is given, not learned.
            L ends at 499, white on any screen: linear output has no brighter lights than 499 a / exposure.
    depth   0.5 + log2(d / m) / 16, clipped to [0, 1], m the geometric mean of what is not sky; sky is 1.
            Free of exposure and of the scene's scale: another unit changes nothing, a crop shifts all by a
            constant, and the contrast between two surfaces is the ratio of their depths wherever they are.
    normal  world space, unit; 0 for sky.  base colour, roughness, metallic  as they are.

The paper's network makes the picture from nothing (`start="nothing"`). With `start="guided"` it corrects what
`jaxsr.methods.guided_taau` makes of the frame alone, a joint bilateral upsampling E of the lighting: E is
three more channels of I_G, and the output is E + r - 1/2, r the network's (not negative). With few training
frames and steps this is worth much: what a filter can do need not be learned.

Zero-upsampling puts each LR sample into one HR pixel of its block. The paper takes the top left one; jittered
samples lie at `s (x + J + 1/2) - 1/2` (equation 1 of `jaxsr.ops.jitter`), so here it is the nearest to that.

A frame that was not rendered is made from the last output: by guided reprojection (`jaxsr.methods.guided`)
where base colour and normal are there, else by a plain backward warp.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer, Window
from jaxsr.methods import guided, guided_taau, taau
from jaxsr.methods._network import ImageLoss, check_options, image_loss, last_output
from jaxsr.methods.base import Loss, Method, Net, by_rendered
from jaxsr.nets import FusionSR, UNetSR
from jaxsr.nets.blocks import count_channels
from jaxsr.ops import demodulate, from_display, modulate, to_display

BUFFERS = ("depth", "base_color", "normal", "roughness", "metallic")
"""In the order of the network's channels."""


@dataclass(frozen=True)
class Options(ImageLoss):
    """What is fixed when a network is made; recorded in its file of weights."""

    architecture: Literal["fusion", "unet"] = "fusion"
    """Two encoders with fusion modules, or the single-branch U-Net of the paper's Figure 11."""
    fusion: Literal["se-residual", "concat", "add"] = "se-residual"
    """How features meet (Table 3)."""
    residual: Literal["published", "zero"] = "published"
    """How the residuals of "se-residual" begin: with the unit variance of their batch norm, or at 0."""
    buffers: tuple[str, ...] = BUFFERS
    """HR buffers that the network sees (Tables 4 and 5)."""
    down_kernel: Literal[2, 3] = 3
    """Of the stride-2 convolutions: the published network has 3, the paper draws 2."""
    color: Literal["display", "lighting"] = "lighting"
    """What the network sees of the colour and makes."""
    start: Literal["nothing", "guided"] = "guided"
    """"guided": correct an upsampling of the lighting; it needs LR base colour, normal and depth as well."""
    follow_jitter: bool = True
    """Put LR samples where they lie; else at the top left of their block."""
    compute: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions; parameters and losses are float32."""


def normalized_depth(depth_linear: Float[Array, "*b H W 1"]) -> Float[Array, "*b H W 1"]:
    """Linear depth to [0, 1]: logarithmic, relative to the image's geometric mean; sky is 1."""
    solid = jnp.isfinite(depth_linear) & (depth_linear > 0)
    octaves = jnp.log2(jnp.where(solid, depth_linear, 1.0))
    count = jnp.maximum(jnp.sum(solid, (-3, -2), keepdims=True), 1).astype(octaves.dtype)
    mean = jnp.sum(octaves, (-3, -2), keepdims=True) / count
    return jnp.where(solid, jnp.clip(0.5 + (octaves - mean) / 16, 0, 1), 1.0)


def gbuffer_input(gbuffer: GBuffer, buffers: tuple[str, ...]) -> Float[Array, "*b H W c"]:
    """I_G: the buffers of these names, normalised, as channels."""
    channels = []
    for name in buffers:
        if name == "depth":
            channels.append(normalized_depth(gbuffer.depth_linear))
        else:
            value = getattr(gbuffer, name)
            assert value is not None  # `needs` promised it
            channels.append(value)
    return jnp.concatenate(channels, -1)


def compress_lighting(lighting: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """l = sqrt(L / (1 + L)) in [0, 1): about as many steps in the dark as the display has."""
    lighting = jnp.minimum(lighting, 1e6)  # infinite light is white, not NaN
    # The guard keeps the slope of the root finite at black.
    return jnp.sqrt(jnp.maximum(lighting / (1 + lighting), 1e-8))


def expand_lighting(compressed: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The inverse of `compress_lighting`; 0.999 and above is L = 499."""
    squared = jnp.minimum(compressed, 0.999) ** 2
    return squared / (1 - squared)


def color_input(frame: Frame, options: Options) -> Float[Array, "*b h w 3"]:
    """I_LR."""
    exposure = frame.exposure[..., None, None, None]
    if options.color == "display":
        return to_display(frame.color_linear * exposure)
    assert frame.lr.base_color is not None
    surface = jnp.isfinite(frame.lr.depth_linear)
    lighting = demodulate(frame.color_linear * exposure, frame.lr.base_color, surface=surface)
    return compress_lighting(jnp.maximum(lighting, 0))


def starting_point(frame: Frame, options: Options) -> Float[Array, "H W 3"]:
    """E of one frame, as the network sees colour: the lighting of the alike samples around each HR pixel."""
    made = guided_taau.estimate(frame, guided_taau.Options())
    lighting = taau.from_working(made.color, frame.exposure)
    if options.color == "lighting":
        return compress_lighting(lighting * frame.exposure)
    surface = jnp.isfinite(frame.hr.depth_linear)
    return to_display(modulate(lighting, guided.surface(frame.hr)[0], surface=surface), frame.exposure)


def sample_offset(jitter_px: Float[Array, "*b 2"], scale: int) -> Int[Array, "*b 2"]:
    """Which pixel (x, y) of its s x s block an LR sample falls on: `s J + (s - 1) / 2`, rounded."""
    offset = jnp.floor(scale * jitter_px + scale / 2)
    return jnp.clip(offset, 0, scale - 1).astype(jnp.int32)


def displayed(
    net: Callable[..., Array], frames: Frame, options: Options
) -> tuple[Float[Array, "b H W 3"], Float[Array, "b H W 3"]]:
    """A batch of frames through the network.

    Returns:
        The HR colour, display-referred and for "display" not clipped; and scene-linear.
    """
    offset = sample_offset(frames.jitter_px, frames.scale) if options.follow_jitter else None
    gbuffer = gbuffer_input(frames.hr, options.buffers)
    if options.start == "guided":
        start = jax.lax.stop_gradient(jax.vmap(lambda frame: starting_point(frame, options))(frames))
        made = net(color_input(frames, options), jnp.concatenate([gbuffer, start], -1), offset)
        made = jnp.maximum(start + made - 0.5, 0)
    else:
        made = net(color_input(frames, options), gbuffer, offset)
    exposure = frames.exposure[..., None, None, None]
    if options.color == "display":
        return made, from_display(jnp.clip(made, 0, 1)) / exposure
    assert frames.hr.base_color is not None
    exposed = modulate(
        expand_lighting(made), frames.hr.base_color, surface=jnp.isfinite(frames.hr.depth_linear)
    )
    return to_display(exposed), exposed / exposure


def loss_of(options: Options) -> Loss:
    """`1 - SSIM + 0.2 LPIPS` on display-referred colour (section 3.3), and L1 where it is asked for."""

    def loss(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames = jax.tree.map(lambda x: x[:, -1], window.frames)
        shown, _ = displayed(net, frames, options)
        truth = to_display(window.truth_linear[:, -1] * frames.exposure[..., None, None, None])
        return image_loss(shown, truth, options)

    return loss


def _check(options: Options) -> None:
    check_options(options)
    if unknown := [name for name in options.buffers if name not in BUFFERS]:
        raise JaxsrError(f"unknown buffer {unknown[0]!r}", where="buffers", expected=", ".join(BUFFERS))
    count_channels(options.buffers)


def method(options: Options | None = None) -> Method:
    """The network of these options as a method.

    Raises:
        JaxsrError: an option that has no such value.
    """
    o = options or Options()
    _check(o)
    init, keep, extrapolate = last_output({"base_color", "normal"} <= set(o.buffers))

    def new_net(rngs: nnx.Rngs) -> nnx.Module:
        parts = (*o.buffers, "estimate") if o.start == "guided" else o.buffers
        common = {"buffers": parts, "down_kernel": o.down_kernel, "dtype": jnp.dtype(o.compute)}
        net: FusionSR | UNetSR
        if o.architecture == "unet":
            net = UNetSR(**common, rngs=rngs)  # type: ignore[arg-type]
        else:
            net = FusionSR(**common, fusion=o.fusion, rngs=rngs)  # type: ignore[arg-type]
            if o.fusion == "se-residual" and o.residual == "zero":
                for module in net.fusions:
                    assert module.norm2.scale is not None
                    module.norm2.scale[...] = jnp.zeros_like(module.norm2.scale[...])
        if o.start == "guided":  # begin at E: steps away from a random picture kill the ReLUs before it
            last = net.decoder1.convs.conv2
            assert last.bias is not None
            last.kernel[...] = jnp.zeros_like(last.kernel[...])
            last.bias[...] = jnp.full_like(last.bias[...], 0.5)
        return net

    def upscale(net: Net, state: object, frame: Frame) -> tuple[object, Array]:
        if frame.scale == 1:
            return keep(frame.color_linear, frame), frame.color_linear
        model = nnx.merge(nnx.graphdef(nnx.eval_shape(lambda: new_net(nnx.Rngs(0)))), net)
        model.eval()
        one = jax.tree.map(lambda x: jnp.asarray(x)[None], frame)
        image = displayed(model, one, o)[1][0]
        return keep(image, frame), image

    lr, hr = {"lr.color"}, {f"hr.{name}" for name in o.buffers} | {"hr.motion"}
    if o.color == "lighting" or o.start == "guided":
        lr, hr = lr | {"lr.base_color", "lr.depth"}, hr | {"hr.base_color", "hr.depth"}
    if o.start == "guided":
        lr, hr = lr | {"lr.normal"}, hr | {"hr.normal"}
    return Method(
        "fusion-sr",
        "network: the current frame fused with HR G-buffers; reprojection where nothing was rendered",
        init,
        by_rendered(init, upscale, extrapolate),
        frozenset(lr | hr),
        new_net=new_net,
        loss=loss_of(o),
        arguments=asdict(o),
    )
