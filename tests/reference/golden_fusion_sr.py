"""Writes golden_fusion_sr.npz: what the fusion network, written in PyTorch, makes of weights drawn here.

    pip install torch==2.13.0
    python -m tests.reference.golden_fusion_sr

The tests need only the .npz, which holds the outputs: weights and inputs follow from names and shapes.
"""

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

SIZE, SCALE, CHANNELS = (5, 6), 4, 9


def array(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Weights or statistics of a published name: uniform, the variances positive."""
    unit = np.random.default_rng(zlib.crc32(name.encode())).random(shape, np.float32)
    if len(shape) > 1:
        return (2 * unit - 1) * np.float32(np.sqrt(6 / (np.prod(shape[1:]) + shape[0])))
    return unit / 2 + np.float32(0.5) if "running_var" in name else unit / 2 - np.float32(0.25)


def weights(shapes: Mapping[str, Sequence[int]]) -> dict[str, np.ndarray]:
    return {name: array(name, tuple(shape)) for name, shape in shapes.items()}


def inputs() -> tuple[np.ndarray, np.ndarray]:
    """LR colour `[1, h, w, 3]` and HR G-buffer `[1, 4 h, 4 w, 9]`."""
    rng, (h, w) = np.random.default_rng(0), SIZE
    return rng.random((1, h, w, 3), np.float32), rng.random((1, h * SCALE, w * SCALE, CHANNELS), np.float32)


def main() -> None:
    import torch

    from benchmarks.networks import torch_network

    net = torch_network().eval()
    drawn = weights({name: tuple(x.shape) for name, x in net.state_dict().items() if x.ndim})
    net.load_state_dict({name: torch.from_numpy(x) for name, x in drawn.items()}, strict=False)
    with torch.inference_mode():
        made = net(*(torch.from_numpy(x).permute(0, 3, 1, 2) for x in inputs()))
    shapes = {name: np.array(x.shape) for name, x in drawn.items()}
    np.savez_compressed(Path(__file__).with_suffix(".npz"), output=made.permute(0, 2, 3, 1).numpy(), **shapes)


if __name__ == "__main__":
    main()
