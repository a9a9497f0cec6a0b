"""Super-resolution by multi-scale fusion with HR G-buffers (Zhang et al., METHODS 2): one frame, no history.

    I_LR    colour of the jittered LR frame, in [0, 1]              `color_input`
    I_G     HR G-buffer, every channel about [0, 1] or [-1, 1]      `gbuffer_input`
    I_HR    = net(I_LR, I_G)                                        `jaxsr.nets.FusionSR` or `UNetSR`

Normalisation is the same in training and inference (`jaxsr.ops.encoding`):

    colour  By default the network sees the lighting L = exposure I / a, a the base colour, as
            l = sqrt(L / (1 + L)). Its output is turned back into L and multiplied by the HR base colour:
            texture is given, not learned. L ends at 499, which is white on any screen: linear output has no
            brighter lights than 499 a / exposure. With `demodulated=False` the network sees display-referred
            colour, sRGB(ACES(exposure I)), and its output is shown as it is.
    depth   0.5 + log2(d / m) / 16, clipped to [0, 1], m the geometric mean of the surfaces; sky is 1.
    normal  world space, unit; 0 for sky.  base colour, roughness, metallic  as they are.

The paper's network makes the picture from nothing (`base="none"`). With `base="guided"` it corrects what
`jaxsr.methods.guided_taau` makes of the frame alone, a joint bilateral upsampling E of the lighting: E is
three more channels of I_G, and the output is E + r - 1/2, r the network's (not negative). With few training
frames and steps this is worth much: the network need not learn what a filter can do.

Zero-upsampling puts each LR sample into one HR pixel of its block. The paper takes the top left one; jittered
samples lie at `s (x + J + 1/2) - 1/2` (equation 1 of `jaxsr.ops.jitter`), so here it is the nearest to that.

A frame that was not rendered is made from the last output: by guided reprojection (`jaxsr.methods.guided`)
where base colour and normal are there, else by a plain backward warp.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame, GBuffer, Window
from jaxsr.methods import accumulation, guided, guided_taau
from jaxsr.methods.base import Method, Needs, Net, Network, last_frames, module_maker, one_image
from jaxsr.methods.history import plain_warp
from jaxsr.methods.image_loss import ImageLoss, check_loss, image_loss
from jaxsr.methods.options import check_options, to_json
from jaxsr.nets import FusionSR, UNetSR
from jaxsr.nets.blocks import count_channels
from jaxsr.ops import from_display, to_display
from jaxsr.ops.color import WHITE
from jaxsr.ops.encoding import (
    DEPTH_OCTAVES,
    compress_lighting,
    expand_lighting,
    normalized_depth,
    sample_offset,
)

BUFFERS = ("depth", "base_color", "normal", "roughness", "metallic")
"""In the order of the network's channels."""


@dataclass(frozen=True)
class Options:
    """Settings of the network and of what is around it; a file of weights records all of them."""

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
    demodulated: bool = True
    """Whether the network works on lighting (colour over base colour) or on display-referred colour."""
    base: Literal["none", "guided"] = "guided"
    """"guided": correct an upsampling of the lighting; it needs LR base colour, normal and depth as well."""
    unjitter: bool = True
    """Put LR samples where they lie; else at the top left of their block."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the convolutions; parameters and losses are float32."""
    eps: float = 0.02
    """Smallest base colour that the colour of a surface is divided by."""
    depth_octaves: float = DEPTH_OCTAVES
    """Ratio of depths, in octaves, that the network tells apart."""
    estimate: guided_taau.Upsampling = guided_taau.Upsampling()  # noqa: RUF009 (frozen)
    """Constants of the guided upsampling that `base="guided"` corrects."""
    reprojection: guided.Options = guided.Options()  # noqa: RUF009 (frozen)
    """Constants of guided reprojection, for frames that were not rendered."""

    def check(self) -> None:
        """Raise JaxsrError for an option that has no such value."""
        check_options(self)
        self.estimate.check()
        self.reprojection.check()
        if unknown := [name for name in self.buffers if name not in BUFFERS]:
            raise JaxsrError(f"unknown buffer {unknown[0]!r}", where="buffers", expected=", ".join(BUFFERS))
        for name in ("eps", "depth_octaves"):
            if not (value := getattr(self, name)) > 0:
                raise JaxsrError(f"bad {name}", where=name, expected="a number above 0", found=value)
        count_channels(self.buffers)

    def needs(self) -> frozenset[str]:
        """What the network reads of a rendered frame."""
        needs = {"lr.color"} | {f"hr.{name}" for name in self.buffers}
        if self.demodulated or self.base == "guided":  # depth says what is sky
            needs |= {f"{place}.{layer}" for place in ("lr", "hr") for layer in ("base_color", "depth")}
        if self.base == "guided":
            needs |= guided_taau.BUFFERS
        return frozenset(needs)


def gbuffer_input(
    gbuffer: GBuffer, buffers: tuple[str, ...], octaves: float = DEPTH_OCTAVES
) -> Float[Array, "*b H W c"]:
    """I_G: the buffers of these names, normalised, as channels; `octaves` is for `normalized_depth`."""
    channels = []
    for name in buffers:
        if name == "depth":
            channels.append(normalized_depth(gbuffer.depth_linear, octaves))
        else:
            value = getattr(gbuffer, name)
            assert value is not None  # the needs of the method promise it
            channels.append(value)
    return jnp.concatenate(channels, -1)


def color_input(frame: Frame, options: Options) -> Float[Array, "*b h w 3"]:
    """I_LR."""
    if not options.demodulated:
        return to_display(frame.exposed)
    return compress_lighting(guided.lighting_of(frame.exposed, frame.lr, options.eps))


def base_image(frame: Frame, options: Options) -> Float[Array, "H W 3"]:
    """E of one frame, as the network sees colour: the lighting of the alike samples around each HR pixel."""
    estimate = guided_taau.estimate(frame, options.estimate)
    lighting = accumulation.from_working(estimate.color, frame.exposure)
    if options.demodulated:
        return compress_lighting(lighting * frame.exposure)
    return to_display(guided.color_of(lighting, frame.hr, options.estimate.eps), frame.exposure)


def network_output(net: Callable[..., Array], frames: Frame, options: Options) -> Float[Array, "b H W 3"]:
    """A batch of frames through the network: lighting as `compress_lighting` makes it, or display colour."""
    offset = sample_offset(frames.jitter_px, frames.scale) if options.unjitter else None
    gbuffer = gbuffer_input(frames.hr, options.buffers, options.depth_octaves)
    if options.base == "none":
        return net(color_input(frames, options), gbuffer, offset)
    base = jax.lax.stop_gradient(jax.vmap(lambda frame: base_image(frame, options))(frames))
    residual = net(color_input(frames, options), jnp.concatenate([gbuffer, base], -1), offset)
    return jnp.maximum(base + residual - 0.5, 0)


def displayed(
    net: Callable[..., Array], frames: Frame, options: Options
) -> tuple[Float[Array, "b H W 3"], Float[Array, "b H W 3"]]:
    """A batch of frames through the network.

    Returns:
        The HR colour, display-referred (not clipped, unless it was demodulated); and scene-linear.
    """
    output = network_output(net, frames, options)
    exposure = frames.exposure[..., None, None, None]
    if not options.demodulated:
        return output, from_display(jnp.clip(output, 0, 1)) / exposure
    exposed = guided.color_of(expand_lighting(output), frames.hr, options.eps)
    shown = to_display(exposed)
    # Beyond white the display has no slope, and a prediction that is too bright could not come down. The
    # second term is zero, with a slope of 0.1.
    white = compress_lighting(WHITE / guided.color_of(jnp.ones_like(exposed), frames.hr, options.eps))
    excess = jnp.maximum(output - jax.lax.stop_gradient(white), 0)
    return shown + 0.1 * (excess - jax.lax.stop_gradient(excess)), exposed / exposure


def _new_net(o: Options, rngs: nnx.Rngs) -> nnx.Module:
    parts = (*o.buffers, "estimate") if o.base == "guided" else o.buffers
    common = {"buffers": parts, "down_kernel": o.down_kernel, "dtype": jnp.dtype(o.dtype)}
    net: FusionSR | UNetSR
    if o.architecture == "unet":
        net = UNetSR(**common, rngs=rngs)  # type: ignore[arg-type]
    else:
        net = FusionSR(**common, fusion=o.fusion, rngs=rngs)  # type: ignore[arg-type]
        if o.fusion == "se-residual" and o.residual == "zero":
            for module in net.fusions:
                assert module.norm2.scale is not None
                module.norm2.scale[...] = jnp.zeros_like(module.norm2.scale[...])
    if o.base == "guided":  # begin at E: steps away from a random picture kill the ReLUs before it
        last = net.decoder1.convs.conv2
        assert last.bias is not None
        last.kernel[...] = jnp.zeros_like(last.kernel[...])
        last.bias[...] = jnp.full_like(last.bias[...], 0.5)
    return net


def method(options: Options | None = None, loss: ImageLoss | None = None) -> Method:
    """The network of these settings as a method.

    Args:
        options: of the network.
        loss: weights of the training's loss, `1 - SSIM + 0.2 LPIPS` by default (section 3.3).

    Raises:
        JaxsrError: an option that has no such value.
    """
    o, weights = options or Options(), loss or ImageLoss()
    o.check()
    check_loss(weights)
    guides = {"base_color", "normal"} <= set(o.buffers)
    last = guided.reprojection(o.reprojection) if guides else plain_warp()

    def new(rngs: nnx.Rngs) -> nnx.Module:
        return _new_net(o, rngs)

    def loss_of(net: nnx.Module, window: Window) -> tuple[Array, dict[str, Array]]:
        frames, truth = last_frames(window)
        shown, _ = displayed(net, frames, o)
        return image_loss(shown, to_display(truth * frames.exposure[..., None, None, None]), weights)

    module = module_maker(new)

    def upscale(net: Net, state: object, frame: Frame) -> tuple[object, Array]:
        if frame.scale == 1:
            return last.keep(frame.color_linear, frame), frame.color_linear
        image = displayed(module(net), one_image(frame), o)[1][0].astype(frame.color_linear.dtype)
        return last.keep(image, frame), image

    return Method(
        "fusion-sr",
        "network: the current frame fused with HR G-buffers; reprojection where nothing was rendered",
        Needs(o.needs(), last.needs),
        last.init,
        upscale,
        last.extrapolate,
        Network(new, loss_of, settings=to_json(o), loss_settings=to_json(weights)),
    )
