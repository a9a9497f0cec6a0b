"""The smallest method that learns: two convolutions, batch norm and dropout, all that training can carry.

Run as a program it trains, and can kill itself at a given moment:

    python -m tests.tiny_method DATA OUT [--step N | --save N | --picture N]
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import nnx

from jaxsr.methods import Method, Needs, Network, Windows
from jaxsr.methods.base import module_maker
from jaxsr.ops import from_display, to_display, upsample


class Net(nnx.Module):
    def __init__(self, rngs: nnx.Rngs):
        self.conv1 = nnx.Conv(6, 8, (3, 3), use_bias=False, rngs=rngs)
        self.norm = nnx.BatchNorm(8, rngs=rngs)
        self.dropout = nnx.Dropout(0.1, rngs=rngs)
        self.conv2 = nnx.Conv(8, 3, (3, 3), rngs=rngs)

    def __call__(self, color, base_color):
        color = upsample(color, base_color.shape[1] // color.shape[1])
        x = self.norm(self.conv1(jnp.concatenate([color, base_color], -1)))
        return color + self.conv2(self.dropout(nnx.relu(x)))


def loss(net, window):
    frames = jax.tree.map(lambda x: x[:, -1], window.frames)
    made = net(to_display(frames.color_linear), frames.hr.base_color)
    error = jnp.mean(jnp.abs(made - to_display(window.truth_linear[:, -1])))
    return error, {"l1": error}


module = module_maker(Net)


def upscale(net, state, frame):
    made = module(net)(to_display(frame.color_linear)[None], frame.hr.base_color[None])[0]
    return state, from_display(jnp.clip(made, 0, 1))


def method(loss=loss, window: int = 1) -> Method:
    needs = Needs(frozenset({"lr.color", "hr.base_color"}))
    network = Network(Net, loss, Windows(window))
    return Method("tiny", "for tests", needs, lambda frame: (), upscale, upscale, network)


def train(data: Path, out: Path, **options):
    """Twelve steps with evaluations and checkpoints on the way."""
    from jaxsr.training import TrainConfig
    from jaxsr.training import train as train_method

    shorter = {"steps": 12, "batch": 2, "crop": 32, "scale": 2, "eval_every": 4, "save_every": 3, "ema": 0.9}
    config = TrainConfig(data=(data,), out=out, cache=data.parent / "cache", **shorter | options)
    return train_method(method(), config, quiet=True)


def main() -> None:
    from jaxsr.progress import Bar
    from jaxsr.training import loop

    data, out, *when = sys.argv[1:]
    moment, number = when[0] if when else "", int(when[1]) if when else 0

    def kill() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def before(owner, name: str, step_of) -> None:
        original = getattr(owner, name)

        def wrapped(*arguments):
            if step_of(arguments) == number:
                kill()
            return original(*arguments)

        setattr(owner, name, wrapped)

    if moment == "--step":
        before(Bar, "update", lambda arguments: arguments[1] if arguments[0]._title == "steps" else None)
    if moment == "--picture":  # the weights are released, the checkpoint of the same step is not written
        before(loop.Log, "picture", lambda arguments: arguments[2])
    if moment == "--save":

        def watch() -> None:
            while not list((Path(out) / "checkpoints").glob(f"{number}.*tmp*/**/manifest*")):
                time.sleep(1e-4)  # or it keeps the others from running
            kill()

        threading.Thread(target=watch, daemon=True).start()
    train(Path(data), Path(out))


if __name__ == "__main__":
    main()
