"""A method of your own, trained and compared: `python experiments/examples/add_a_method.py --steps 150`."""

from pathlib import Path

import jax
import jax.numpy as jnp
import tyro
from flax import nnx

from jaxsr.data.sample import unpack_sample
from jaxsr.evaluation.evaluate import evaluate
from jaxsr.evaluation.running import Settings
from jaxsr.methods import LEARNED, Learned, Method, Needs, Network, NoOptions, last_frames, module_maker
from jaxsr.methods.history import no_image
from jaxsr.ops import from_display, sample_jittered, to_display
from jaxsr.progress import Bars
from jaxsr.training import TrainConfig, train


class Net(nnx.Module):
    def __init__(self, rngs: nnx.Rngs):
        self.conv1 = nnx.Conv(9, 16, (3, 3), rngs=rngs)
        self.conv2 = nnx.Conv(16, 3, (3, 3), rngs=rngs)

    def __call__(self, frame):  # a `jaxsr.frames.Frame`; makes display-referred colour
        hr, color = frame.hr, to_display(frame.color_linear, frame.exposure)
        color = sample_jittered(color, frame.jitter_px, hr.normal.shape[:2], "bicubic")
        x = nnx.relu(self.conv1(jnp.concatenate([color, hr.base_color, hr.normal], -1)))
        return color + self.conv2(x)


def loss(net, window):  # of a batch of windows; here their last frames are all there is
    frames, truth = last_frames(window)
    return jnp.mean(jnp.abs(jax.vmap(net)(frames) - jax.vmap(to_display)(truth, frames.exposure))), {}


def upscale(net, state, frame):  # a rendered frame; `state` goes from frame to frame
    image = from_display(jnp.clip(module(net)(frame), 0, 1)) / frame.exposure
    return image, image


module = module_maker(Net)
NEEDS = Needs(frozenset({"lr.color", "hr.base_color", "hr.normal"}))
HOLD = lambda net, state, frame: (state, state)  # noqa: E731 (a frame that was not rendered)
MINE = Method("mine", "a network", NEEDS, no_image, upscale, HOLD, Network(Net, loss))
LEARNED["mine"] = Learned(NoOptions, NoOptions, lambda *_: MINE)  # how its weights find it


def main(steps: int = 150, out: Path = Path("example")) -> None:
    weights = train(MINE, TrainConfig(steps=steps, out=out / "mine"))
    clips, names = unpack_sample(out / "sample", "test"), ("taau", "fusion-sr", str(weights))
    with Bars() as bar:
        evaluate(clips, names, out / "compared", Settings(4), progress=bar)
    print((out / "compared" / "metrics.md").read_text())


if __name__ == "__main__":
    tyro.cli(main)
