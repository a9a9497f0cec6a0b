"""A method of two networks, of which one extrapolates: all that windows with a cadence ask of training.

Frames are rendered, not rendered, rendered; the middle one is to be made. `upscaler` makes rendered frames
and may be frozen; `filler` corrects the last output where nothing was rendered.
"""

import jax.numpy as jnp
from flax import nnx

from jaxsr.methods import Method, Needs, Network, Windows
from jaxsr.methods.base import module_maker
from jaxsr.ops import from_display, to_display, upsample

WINDOWS = Windows(3, (True, False, True), made=(1,), warmup=1, lr_truth=True)


class Part(nnx.Module):
    """A convolution with batch norm and dropout: parameters, statistics and random streams."""

    def __init__(self, channels: int, rngs: nnx.Rngs):
        self.conv = nnx.Conv(channels, 3, (3, 3), rngs=rngs)
        self.norm = nnx.BatchNorm(3, rngs=rngs)
        self.dropout = nnx.Dropout(0.1, rngs=rngs)

    def __call__(self, x):
        return self.dropout(self.norm(self.conv(x)))


class Net(nnx.Module):
    def __init__(self, rngs: nnx.Rngs):
        self.upscaler = Part(3, rngs)
        self.filler = Part(6, rngs)

    def upscale(self, shown, scale):
        shown = upsample(shown, scale)
        return shown + self.upscaler(shown)

    def fill(self, last, base_color):
        return last + self.filler(jnp.concatenate([last, base_color], -1))


def loss(net, window):
    frames = window.frames
    first = net.upscale(to_display(frames.color_linear[:, 0]), frames.scale)
    made = net.fill(first, frames.hr.base_color[:, 1])
    hr = jnp.mean(jnp.abs(made - to_display(window.truth_linear[:, 0])))
    small = made.reshape(*window.lr_truth_linear.shape[:1], -1, frames.scale, made.shape[2] // frames.scale,
                         frames.scale, 3).mean((2, 4))  # fmt: skip
    lr = jnp.mean(jnp.abs(small - to_display(window.lr_truth_linear[:, 0])))
    return hr + 0.1 * lr, {"hr": hr, "lr": lr}


module = module_maker(Net)


def upscale(net, state, frame):
    shown = module(net).upscale(to_display(frame.color_linear)[None], frame.scale)[0]
    return shown, from_display(jnp.clip(shown, 0, 1))


def extrapolate(net, state, frame):
    shown = module(net).fill(state[None], frame.hr.base_color[None])[0]
    return shown, from_display(jnp.clip(shown, 0, 1))


def method(frozen=False, windows: Windows = WINDOWS) -> Method:
    needs = Needs(frozenset({"lr.color"}), frozenset({"hr.base_color"}))
    network = Network(Net, loss, windows, frozen=frozen)
    return Method(
        "two", "for tests", needs, lambda frame: jnp.zeros((*frame.size, 3)), upscale, extrapolate, network
    )
