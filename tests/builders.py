"""Tiny sequences for tests, from the analytic scene; every layer can be spoilt on the way to the disk."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from flax import nnx

from jaxsr.data import analytic
from jaxsr.io.sequence import Sequence
from jaxsr.io.writing import FrameInfo, SequenceWriter
from jaxsr.layers import LAYERS
from jaxsr.methods import variant
from jaxsr.weights.file import new_header, save_weights
from tests.networks import SMALL

Layers = dict[str, np.ndarray]


def halton_jitter(index: int) -> tuple[float, float]:
    """Halton(2, 3), length 32, minus 0.5, in float64."""

    def radical_inverse(n: int, base: int) -> float:
        value, factor = 0.0, 1.0 / base
        while n:
            value, n, factor = value + (n % base) * factor, n // base, factor / base
        return value

    return tuple(radical_inverse(index % 32 + 1, base) - 0.5 for base in (2, 3))


def frame_info(index: int, size: tuple[int, int], *, reset: bool = False, **camera: Any) -> FrameInfo:
    view = analytic.camera(index, size, **camera)
    return FrameInfo(index, halton_jitter(index), reset, view.world_from_view, view.tan_half_fov)


def reference_of(color: np.ndarray) -> np.ndarray:
    """A stand-in for the anti-aliased colour: half as bright, and mirrored."""
    return color[:, ::-1] * 0.5


def make_sequence(
    path: Path,
    *,
    frames: int = 3,
    size: tuple[int, int] = (64, 40),
    scales: tuple[int, ...] = (2,),
    spoil: Callable[[str, int, Layers], None] | None = None,
    jitter: Callable[[tuple[float, float]], tuple[float, float]] | None = None,
    still: bool = False,
    frozen: bool = False,
    reference: bool = False,
    **writer: Any,
) -> Sequence:
    """Write a sequence of the analytic scene and open it.

    Args:
        spoil: called with "hr", "x2", ..., the frame's number and the layers, which it may change.
        jitter: what the metadata says of a jitter that was rendered; the sequence is then opened unchecked.
        still, frozen: the camera, the objects do not move.
        reference: also write this layer, which is another image than the colour.
        **writer: more arguments of `SequenceWriter`.
    """
    head: dict[str, Any] = {"name": path.name, "size": size, "scales": scales, "license": "CC0-1.0"} | writer
    with SequenceWriter(path, **head) as out:
        for index in range(1, frames + 1):
            info = frame_info(index, size, reset=index == 1, still=still)
            images = {"hr": analytic.render(index, size, still=still, frozen=frozen)}
            for s in scales:
                small = (size[0] // s, size[1] // s)
                images[f"x{s}"] = analytic.render(
                    index, small, jitter_px=info.jitter_px, still=still, frozen=frozen
                )
            if reference:
                images["hr"]["reference"] = reference_of(images["hr"]["color"])
            for name, layers in images.items():
                for extra in set(layers) - set(LAYERS):
                    del layers[extra]
                if spoil is not None:
                    spoil(name, index, layers)
            out.write_frame(info, images["hr"] if out.hr else None, {s: images[f"x{s}"] for s in scales})
    if jitter is not None:  # the writer would refuse some
        edit_frames(path, lambda frame: frame.update(jitter_px=jitter(frame["jitter_px"])))
    return Sequence.open(path, check=jitter is None)


def edit_frames(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change every entry of `frames` in sequence.json."""
    head = json.loads((path / "sequence.json").read_text())
    for frame in head["frames"]:
        change(frame)
    (path / "sequence.json").write_text(json.dumps(head))


def random_weights(path: Path, *, scale: int, method: str = "fusion-sr", seed: int = 0) -> Path:
    """A file of weights as training writes it, but of a network that has learned nothing."""
    network = variant(method, SMALL[method] | {"scale": scale} if method in SMALL else {}).network
    assert network is not None
    rng = np.random.default_rng(seed)
    # Not what `network.new` begins with: that may be made to change nothing, and takes long to make.
    state = nnx.state(nnx.eval_shape(lambda: network.new(nnx.Rngs(0))), nnx.Not(nnx.RngState))
    arrays = {}
    for place, variable in nnx.to_flat_state(state):
        shape = variable.get_value().shape
        if place[-1] == "kernel":
            arrays[".".join(map(str, place))] = rng.normal(size=shape) / np.sqrt(np.prod(shape[:-1]))
        else:
            arrays[".".join(map(str, place))] = np.full(shape, float(place[-1] in ("scale", "var")))
    save_weights(path, arrays, new_header(method, network.settings, scale))
    return path
