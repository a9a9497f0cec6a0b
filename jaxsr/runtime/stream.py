"""A method over frames, one by one in constant memory, with the compilation timed apart."""

import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
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
    """Time spent compiling before this step; zero for all but the first frame of its kind."""
    cost: Cost
    """Of the step for rendered frames: the same for all frames."""


class _Compiled(NamedTuple):
    shapes: Any
    step: Any


def stream(method: Method, frames: Iterable[Frame], net: Net = None) -> Iterator[Output]:
    """Run a method over frames.

    Rendered frames go through `method.upscale`, the others through `method.extrapolate`; each of the two is
    compiled once. The state begins anew at the first frame and at each reset.

    Args:
        method: its steps.
        frames: NumPy or JAX arrays, all of one size.
        net: state of its network, None where it has none.

    Raises:
        JaxsrError: a frame has another size or other buffers than those before it of its kind, or a frame
            that is not rendered is the first of all or follows a reset.
    """
    compiled: dict[bool, _Compiled] = {}
    init, state, cost = jax.jit(method.init), None, Cost(0, 0.0)
    net = jax.device_put(net)
    for number, host_frame in enumerate(frames):
        rendered, compile_seconds = bool(host_frame.rendered), 0.0
        if not rendered and (number == 0 or bool(host_frame.reset)):
            what = "the first frame" if number == 0 else f"frame {number}, which begins anew,"
            raise JaxsrError(f"{what} is not rendered", fix="start at a rendered frame")
        frame = jax.device_put(host_frame)
        shapes = (frame.size, jax.tree.structure(frame), jax.tree.map(np.shape, frame))
        if state is None or bool(host_frame.reset):
            state = init(frame)
        if rendered not in compiled:
            start = time.perf_counter()
            traced = jax.jit(method.upscale if rendered else method.extrapolate).trace(net, state, frame)
            compiled[rendered] = _Compiled(shapes, traced.lower().compile())
            compile_seconds = time.perf_counter() - start
            if rendered:
                multiply_adds = multiply_adds_of(traced.jaxpr.jaxpr)
                cost = Cost(count_parameters(net), multiply_adds / float(np.prod(frame.size)))
        elif compiled[rendered].shapes != shapes:
            raise JaxsrError("the size or the buffers change within the sequence", where=f"frame {number}")
        jax.block_until_ready((state, frame))
        start = time.perf_counter()
        state, image = jax.block_until_ready(compiled[rendered].step(net, state, frame))
        seconds = time.perf_counter() - start
        yield Output(np.asarray(image), seconds, compile_seconds, cost)
