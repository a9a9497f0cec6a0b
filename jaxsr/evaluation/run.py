"""A method over a sequence, frame by frame in constant memory, with the compilation timed apart.

`find_method` gets a method ready, with the weights of its network where it has one. `stream` feeds any
iterable of frames to its step. What a frame holds is decided here: `observed` reads a sequence so that the
truth, and the colour of frames that are to be extrapolated, are never handed over.
"""

import importlib.resources
import re
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.evaluation.cost import Cost, count_parameters, multiply_adds_of
from jaxsr.frames import Frame
from jaxsr.io.sequence import Sequence, prefetch
from jaxsr.io.weights import into, load_weights
from jaxsr.methods import METHODS, Method, build
from jaxsr.methods._method import Net


class Ready(NamedTuple):
    """A method with all it needs to run."""

    method: Method
    """Named as it was asked for; a file of weights gives its name, or that of its folder (`weights_name`)."""
    net: Net = None
    """Of a network, its state; None where nothing is learned."""
    weights: Path | None = None
    """The file that the state was read from."""


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


def weights_folder() -> Path:
    """The folder of the weights that ship with the package."""
    return Path(str(importlib.resources.files(jaxsr) / "weights"))


def shipped_scales(name: str) -> list[int]:
    """Scales for which weights of that name ship with the package."""
    found = (
        re.fullmatch(rf"{re.escape(name)}-x(\d+)", path.stem)
        for path in weights_folder().glob("*.safetensors")
    )
    return sorted(int(match[1]) for match in found if match)


def shipped_names() -> list[str]:
    """Names of the weights that ship with the package, without their scales."""
    return sorted({re.sub(r"-x\d+$", "", path.stem) for path in weights_folder().glob("*.safetensors")})


def weights_name(path: Path) -> str:
    """What a file of weights is called: those that `jaxsr train` writes go by the name of their folder."""
    if path.stem not in ("weights", "best"):
        return path.stem
    folder = path.resolve().parent.name
    return folder if path.stem == "weights" else f"{folder}-{path.stem}"


def find_method(name: str, scale: int) -> Ready:
    """The method of that name, or of a file of weights.

    Args:
        name: of a method; or of weights that ship with the package, without their scale ("fusion-sr") or
            with it, as their cards call them ("fusion-sr-x4"); or the path of a file that ends in
            ".safetensors", whose header names the method.
        scale: HR size over LR size; weights must be made for it.

    Raises:
        JaxsrError: there is none, no weights of it ship for this scale, or the file is damaged, of another
            scale, or does not fit the method.
    """
    if name.endswith(".safetensors"):
        path = Path(name)
        return _with_weights(weights_name(path), path, scale)
    if (card := weights_folder() / f"{name}.safetensors").is_file():
        return _with_weights(name, card, scale)
    scales = shipped_scales(name)
    if scale in scales:
        return _with_weights(name, weights_folder() / f"{name}-x{scale}.safetensors", scale)
    if name not in METHODS and not scales:
        raise JaxsrError(
            f"unknown method {name!r}",
            expected="one of " + ", ".join(dict.fromkeys([*METHODS, *shipped_names()])),
            fix="or the path of a file of weights, *.safetensors",
        )
    if scales or METHODS[name].new_net is not None:
        raise JaxsrError(
            f"no weights of {name!r} for scale {scale}",
            expected=f"scale {' or '.join(map(str, scales))}" if scales else None,
            found=None if scales else "no weights of it in the package",
            fix="train some (jaxsr train) and give the path of the file as the method",
        )
    return Ready(METHODS[name])


def _with_weights(name: str, path: Path, scale: int) -> Ready:
    arrays, header = load_weights(path)
    trained, arguments = header.get("scale"), header.get("arguments", {})
    if not isinstance(trained, int) or not isinstance(arguments, dict):
        raise JaxsrError(
            "the header of the weights is damaged",
            where=path,
            expected="a whole number as scale, an object as arguments",
            found=f"scale {trained}, arguments {arguments}",
        )
    if trained != scale:
        raise JaxsrError(
            "the weights are made for another scale",
            where=path,
            expected=f"scale {scale}",
            found=f"scale {trained}",
            fix=f"choose --scale {trained}, or other weights",
        )
    method = build(str(header["method"]), arguments)
    assert method.new_net is not None  # `build` knows only methods that learn
    new_net = method.new_net
    empty = nnx.state(nnx.eval_shape(lambda: new_net(nnx.Rngs(0))))
    return Ready(method._replace(name=name), into(empty, arrays, path), path)


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
            host_frame = host_frame._replace(cut=jnp.asarray(True))
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
