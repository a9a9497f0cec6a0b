"""A method over a sequence, frame by frame in constant memory, with the compilation timed apart.

`stream` feeds any iterable of frames to a method's step. What a frame holds is decided here: `observed` reads
a sequence so that the truth, and the colour of frames that are to be extrapolated, are never handed over.
"""

import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.io.sequence import Sequence, prefetch
from jaxsr.methods import METHODS, Method


class Output(NamedTuple):
    """One frame that a method made."""

    image: np.ndarray
    """HR linear colour, float32 `[H, W, 3]`."""
    seconds: float
    """Time of the step alone: inputs on the device, compiled."""
    compile_seconds: float
    """Time spent compiling before this step; zero for all but the first frame of a size."""


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
        JaxsrError: there is none.
    """
    if name not in METHODS:
        raise JaxsrError(f"unknown method {name!r}", expected="one of " + ", ".join(METHODS))
    return METHODS[name]


def rendered_schedule(sequence: Sequence, every: int) -> list[bool]:
    """Which frames were rendered if only every n-th is, counted from each cut; the rest is extrapolated.

    Raises:
        JaxsrError: `every` is below 1.
    """
    if every < 1:
        raise JaxsrError("bad interval", where="every", expected="a whole number from 1", found=every)
    rendered, since_cut = [], 0
    for info in sequence.infos:
        since_cut = 0 if info.cut else since_cut
        rendered.append(since_cut % every == 0)
        since_cut += 1
    return rendered


def observed(sequence: Sequence, scale: int, every: int = 1) -> Iterator[Frame]:
    """The frames as a method may see them, read ahead in a thread."""
    schedule = rendered_schedule(sequence, every)
    return prefetch(sequence.frame(i, scale, rendered=rendered) for i, rendered in enumerate(schedule))


def check_needs(method: Method, sequence: Sequence, scale: int) -> None:
    """Say at once what a sequence lacks for a method.

    Raises:
        JaxsrError: the first frame has not all the buffers.
    """
    frame = sequence.frame(0, scale)
    buffers = {"lr": frame.lr._asdict(), "hr": frame.hr._asdict()}
    have = {"lr.color"}
    for place, layers in buffers.items():
        have |= {f"{place}.{_layer(name)}" for name, value in layers.items() if value is not None}
    missing = sorted(method.needs - have)
    if missing:
        raise JaxsrError(
            f"method {method.name!r} needs {', '.join(missing)}",
            where=sequence.path,
            found=", ".join(sorted(have)),
            fix="export these buffers, or choose a method that does without (jaxsr inspect lists them)",
        )
    if "hr.motion" in method.needs and len(sequence) > 1 and not sequence.infos[1].cut:
        before, after = (np.asarray(info.world_from_view) for info in sequence.infos[:2])
        motion = np.asarray(sequence.frame(1, scale, rendered=False).hr.motion_px)
        if not motion.any() and not np.allclose(before, after, atol=1e-6):
            raise JaxsrError(
                "motion is zero everywhere, yet the camera moves",
                where=f"{sequence.path}, frame {sequence.infos[1].index}",
                expected="backward motion in pixels",
                fix="export motion vectors (see jaxsr inspect), or choose a method that does without",
            )


def _layer(field: str) -> str:
    return field.removesuffix("_linear").removesuffix("_px")


def stream(method: Method, frames: Iterable[Frame], net: Any = None) -> Iterator[Output]:
    """Run a method over frames.

    Raises:
        JaxsrError: a frame has another size than the first, or the first is not rendered.
    """
    step, state, shape, compile_seconds = None, None, None, 0.0
    for number, host_frame in enumerate(frames):
        if number == 0:
            if not bool(host_frame.rendered):
                raise JaxsrError("the first frame is not rendered", fix="start at a rendered frame")
            # Nothing came before the first frame, wherever the clip was cut from.
            host_frame = host_frame._replace(cut=jnp.asarray(True))
        frame = jax.device_put(host_frame)
        if step is None:
            shape = jax.tree.map(np.shape, frame)
            state = jax.jit(method.init)(frame)
            start = time.perf_counter()
            step = jax.jit(method.step).lower(net, state, frame).compile()
            compile_seconds = time.perf_counter() - start
        elif jax.tree.map(np.shape, frame) != shape:
            raise JaxsrError("the size or the buffers change within the sequence", where=f"frame {number}")
        jax.block_until_ready((state, frame))
        start = time.perf_counter()
        state, image = jax.block_until_ready(step(net, state, frame))
        seconds = time.perf_counter() - start
        yield Output(np.asarray(image), seconds, compile_seconds)
        compile_seconds = 0.0
