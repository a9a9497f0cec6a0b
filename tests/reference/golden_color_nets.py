"""Writes golden_color_nets.npz: what RCAN and RRN, written in PyTorch, make of weights drawn here.

    pip install torch==2.13.0
    python -m tests.reference.golden_color_nets

The tests need only the .npz, which holds the outputs: weights follow from their names, inputs from a seed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from tests.reference.golden_fusion_sr import weights

FEATURES, GROUPS, BLOCKS, REDUCTION, SCALE, SIZE, STEPS = 8, 2, 2, 4, 4, (5, 6), 3
MEAN = (0.4488, 0.4371, 0.4040)


def rcan_shapes() -> dict[str, tuple[int, ...]]:
    """Published names, OIHW; without the fixed shifts of colour."""
    n = FEATURES
    sizes = {"head.0": (n, 3, 3, 3), "body.2": (n, n, 3, 3), "tail.1": (3, n, 3, 3)}
    for g in range(GROUPS):
        sizes[f"body.{g}.body.{BLOCKS}"] = (n, n, 3, 3)
        for b in range(BLOCKS):
            name = f"body.{g}.body.{b}.body"
            sizes |= {f"{name}.0": (n, n, 3, 3), f"{name}.2": (n, n, 3, 3)}
            sizes[f"{name}.3.conv_du.0"] = (n // REDUCTION, n, 1, 1)
            sizes[f"{name}.3.conv_du.2"] = (n, n // REDUCTION, 1, 1)
    sizes |= {f"tail.0.{k}": (4 * n, n, 3, 3) for k in (0, 2)}
    return with_biases(sizes)


def rrn_shapes() -> dict[str, tuple[int, ...]]:
    n = FEATURES
    sizes = {"conv_1": (n, 6 + n + 3 * SCALE**2, 3, 3), "conv_h": (n, n, 3, 3)}
    sizes["conv_o"] = (3 * SCALE**2, n, 3, 3)
    for b in range(BLOCKS):
        sizes |= {f"recon_trunk.{b}.conv{k}": (n, n, 3, 3) for k in (1, 2)}
    return with_biases({f"neuro.{name}": shape for name, shape in sizes.items()})


def with_biases(sizes: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    return {f"{k}.weight": v for k, v in sizes.items()} | {f"{k}.bias": v[:1] for k, v in sizes.items()}


def shifts() -> dict[str, np.ndarray]:
    """The fixed shifts of RCAN's colour, as published for images in [0, 1]."""
    eye, mean = np.eye(3, dtype=np.float32)[..., None, None], np.array(MEAN, np.float32)
    return {
        "sub_mean.weight": eye,
        "sub_mean.bias": -mean,
        "add_mean.weight": eye,
        "add_mean.bias": mean,
    }


def frames() -> np.ndarray:
    """LR colour `[T, 1, h, w, 3]`."""
    return np.random.default_rng(1).random((STEPS + 1, 1, *SIZE, 3), np.float32)


def rcan(w: dict[str, Any], x: Any) -> Any:
    """Zhang et al., ECCV 2018, with convolutions from a dictionary of weights."""
    import torch
    from torch.nn import functional

    def conv(name: str, x: Any) -> Any:
        weight = w[f"{name}.weight"]
        return functional.conv2d(x, weight, w[f"{name}.bias"], padding=weight.shape[-1] // 2)

    x = head = conv("head.0", conv("sub_mean", x))
    for g in range(GROUPS):
        group = x
        for b in range(BLOCKS):
            name, block = f"body.{g}.body.{b}.body", x
            x = conv(f"{name}.2", torch.relu(conv(f"{name}.0", x)))
            y = torch.relu(conv(f"{name}.3.conv_du.0", x.mean((2, 3), keepdim=True)))
            x = block + x * torch.sigmoid(conv(f"{name}.3.conv_du.2", y))
        x = group + conv(f"body.{g}.body.{BLOCKS}", x)
    x = head + conv(f"body.{GROUPS}", x)
    for k in (0, 2):
        x = functional.pixel_shuffle(conv(f"tail.0.{k}", x), 2)
    return conv("add_mean", conv("tail.1", x))


def rrn(w: dict[str, Any], previous: Any, now: Any, hidden: Any, output: Any) -> tuple[Any, Any]:
    """A step of Isobe et al., BMVC 2020."""
    import torch
    from torch.nn import functional

    def conv(name: str, x: Any) -> Any:
        return functional.conv2d(x, w[f"neuro.{name}.weight"], w[f"neuro.{name}.bias"], padding=1)

    x = torch.cat([previous, now, hidden, functional.pixel_unshuffle(output, SCALE)], 1)
    x = torch.relu(conv("conv_1", x))
    for b in range(BLOCKS):
        x = x + conv(f"recon_trunk.{b}.conv2", torch.relu(conv(f"recon_trunk.{b}.conv1", x)))
    enlarged = functional.interpolate(now, scale_factor=SCALE, mode="bilinear", align_corners=False)
    return functional.pixel_shuffle(conv("conv_o", x), SCALE) + enlarged, torch.relu(conv("conv_h", x))


def main() -> None:
    import torch

    def tensors(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
        return {name: torch.from_numpy(x) for name, x in arrays.items()}

    images = torch.from_numpy(frames()).permute(0, 1, 4, 2, 3)
    single = rcan(tensors(weights(rcan_shapes()) | shifts()), images[0])
    w, made = tensors(weights(rrn_shapes())), []
    hidden = torch.zeros((1, FEATURES, *SIZE))
    output = torch.zeros((1, 3, *(n * SCALE for n in SIZE)))
    for t in range(STEPS):
        output, hidden = rrn(w, images[t], images[t + 1], hidden, output)
        made.append(output)
    np.savez_compressed(
        Path(__file__).with_suffix(".npz"),
        rcan=single.permute(0, 2, 3, 1).numpy(),
        rrn=torch.stack(made).permute(0, 1, 3, 4, 2).numpy(),
        hidden=hidden.permute(0, 2, 3, 1).numpy(),
    )


if __name__ == "__main__":
    main()
