"""A method over frames, one by one in constant memory, with the compilation timed apart."""

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.runtime.cost import Cost, count_parameters, multiply_adds_of


class Output(NamedTuple):
    """One frame that a method made."""

    image: np.ndarray
    """HR linear colour, float32 `[H, W, 3]`."""
    seconds: float
    """Time of the step alone: inputs on the device, compiled."""
    compile_seconds: float
    """Time spent compiling before this step; zero for all but the first frame of a size."""
    cost: Cost
    """Of the step: the same for all frames."""


def stream(method: Method, frames: Iterable[Frame], net: Net = None) -> Iterator[Output]:
    """Run a method over frames.

    Args:
        net: state of its network, None where it has none.

    Raises:
        JaxsrError: a frame has another size than the first, or the first is not rendered.
    """
    step, state, shape, cost, compile_seconds = None, None, None, Cost(0, 0.0), 0.0
    net = jax.device_put(net)
    for number, host_frame in enumerate(frames):
        if number == 0:
            if not bool(host_frame.rendered):
                raise JaxsrError("the first frame is not rendered", fix="start at a rendered frame")
            # Nothing came before the first frame, wherever the clip was cut from.
            host_frame = host_frame._replace(reset=jnp.asarray(True))
        frame = jax.device_put(host_frame)
        if step is None:
            shape = jax.tree.map(np.shape, frame)
            state = jax.jit(method.init)(frame)
            start = time.perf_counter()
            traced = jax.jit(method.step).trace(net, state, frame)
            step = traced.lower().compile()
            compile_seconds = time.perf_counter() - start
            pixels = int(np.prod(frame.hr.depth_linear.shape))
            cost = Cost(count_parameters(net), multiply_adds_of(traced.jaxpr.jaxpr) / pixels)
        elif jax.tree.map(np.shape, frame) != shape:
            raise JaxsrError("the size or the buffers change within the sequence", where=f"frame {number}")
        jax.block_until_ready((state, frame))
        start = time.perf_counter()
        state, image = jax.block_until_ready(step(net, state, frame))
        seconds = time.perf_counter() - start
        yield Output(np.asarray(image), seconds, compile_seconds, cost)
        compile_seconds = 0.0
