"""Published weights under our names and in our layouts, and the arguments of the network that they are for.

PyTorch's layouts become JAX's: convolutions OIHW -> HWIO, transposed ones IOHW -> HWIO and mirrored, matrices
transposed. Which published layer is which of ours is written once, in `_fusion_sr`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.nets.layers import count_channels

_ALL = ("depth", "base_color", "normal", "roughness", "metallic")
_LEAVES = {
    "kernel": "weight",
    "scale": "weight",
    "bias": "bias",
    "mean": "running_mean",
    "var": "running_var",
}


def fusion_sr_arguments(
    published: Mapping[str, np.ndarray], buffers: Sequence[str] | None = None, where: object = "weights"
) -> dict[str, Any]:
    """What the shapes of published weights say about their network: arguments of the method "fusion-sr".

    The published networks see display-referred colour, with samples at the top left of their blocks.

    Args:
        published: as `jaxsr.io.published.read_published` gives them.
        buffers: the parts of the G-buffer, in the order of the channels that the network was trained with;
            not needed where it has all nine channels, in the paper's order.
        where: what an error names, perhaps the file.

    Raises:
        JaxsrError: weights of another network, or buffers that do not have its number of channels.
    """
    is_unet = "cur_extract.f_e_net.0.weight" in published
    try:
        shallow = published[
            "cur_extract.f_e_net.0.weight" if is_unet else "cur_gbuffer_extract.f_e_net.0.weight"
        ]
        down = published[f"fusion_reconstruct.{'' if is_unet else 'rgb_'}conv2.conv.0.weight"]
        up = published["fusion_reconstruct.up1.up.weight"]
    except KeyError as e:
        raise JaxsrError(
            "not weights of a published fusion-sr network",
            where=where,
            expected=f"an array {e}",
            found=", ".join(list(published)[:3]),
        ) from None
    channels = shallow.shape[1] - (3 if is_unet else 0)
    if buffers is None and channels != count_channels(_ALL):
        raise JaxsrError(
            f"the network has a G-buffer of {channels} channels",
            where=where,
            fix=f"say which, in order, with --buffers: {', '.join(_ALL)}",
        )
    chosen = _ALL if buffers is None else tuple(buffers)
    if count_channels(chosen) != channels:
        raise JaxsrError(
            "the network has another number of G-buffer channels",
            where=where,
            expected=channels,
            found=f"{count_channels(chosen)} ({', '.join(chosen)})",
        )
    arguments: dict[str, Any] = {
        "architecture": "unet" if is_unet else "fusion",
        "buffers": list(chosen),
        "down_kernel": int(down.shape[2]),
        "color": "display",
        "start": "nothing",
        "follow_jitter": False,
    }
    if not is_unet:
        has_modules = any(name.startswith("fusion_reconstruct.fuse") for name in published)
        arguments["fusion"] = "se-residual" if has_modules else "concat" if up.shape[0] == 128 else "add"
    return arguments


def _fusion_sr(net: nnx.Module) -> Iterator[tuple[str, str]]:
    """Our layers and their published names, of FusionSR and UNetSR."""

    def shallow(ours: str, theirs: str) -> Iterator[tuple[str, str]]:
        for k in range(3):
            yield f"{ours}.conv{k + 1}", f"{theirs}.f_e_net.{2 * k}"

    def pair(ours: str, theirs: str) -> Iterator[tuple[str, str]]:
        for k in range(2):
            yield f"{ours}.conv{k + 1}", f"{theirs}.conv.{2 * k}"

    top = "fusion_reconstruct"
    branches = {"": ""} if hasattr(net, "encoder") else {"color_": "rgb_", "gbuffer_": "gbuffer_"}
    for ours, theirs in branches.items():
        yield from shallow(f"{ours}shallow", f"cur_{theirs}extract")
        for k in range(3):
            yield from pair(f"{ours}encoder.{k}", f"{top}.{theirs}conv{k + 1}")
    for k in range(3 if hasattr(net, "fusions") else 0):
        fuse = f"{top}.fuse{k + 1}"
        yield f"fusions.{k}.se.squeeze", f"{fuse}.SE.fc.0"
        yield f"fusions.{k}.se.excite", f"{fuse}.SE.fc.2"
        for j, (layer, number) in enumerate((("conv", 0), ("norm", 1), ("conv", 3), ("norm", 4))):
            yield f"fusions.{k}.{layer}{j // 2 + 1}", f"{fuse}.residual.{number}"
    for ours, theirs in (("decoder2", "up1"), ("decoder1", "up2")):
        yield f"{ours}.up", f"{top}.{theirs}.up"
        yield from pair(f"{ours}.convs", f"{top}.{theirs}.conv")


class Published(NamedTuple):
    """What is known of the published networks of a method."""

    arguments: Callable[..., dict[str, Any]]
    """The method's arguments: `arguments(published, buffers, where)`."""
    layers: Callable[[nnx.Module], Iterator[tuple[str, str]]]
    """Our layers and their published names: `layers(net)`."""


PUBLISHED: dict[str, Published] = {"fusion-sr": Published(fusion_sr_arguments, _fusion_sr)}


def translate(
    method: str, net: nnx.Module, published: Mapping[str, np.ndarray], where: object = "weights"
) -> dict[str, np.ndarray]:
    """Published weights by our names and in our layouts.

    Args:
        method: name in `PUBLISHED`.
        net: the network that they are for; abstract (`nnx.eval_shape`) will do.
        published: by their names; PyTorch's count of batches is ignored.
        where: what an error names, perhaps the file.

    Raises:
        JaxsrError: arrays that are missing or that no layer takes.
    """
    layers = {".".join(map(str, path)): module for path, module in nnx.iter_modules(net)}
    rest = {name: array for name, array in published.items() if not name.endswith("num_batches_tracked")}
    result = {}
    for ours, theirs in PUBLISHED[method].layers(net):
        for leaf, _ in nnx.to_flat_state(nnx.state(layers[ours])):
            name = f"{theirs}.{_LEAVES[str(leaf[0])]}"
            if name not in rest:
                raise JaxsrError(
                    f"array {name} is missing", where=where, expected=f"it, for {ours}.{leaf[0]}"
                )
            result[f"{ours}.{leaf[0]}"] = _layout(rest.pop(name), layers[ours])
    if rest:
        raise JaxsrError(
            "arrays that the network does not have",
            where=where,
            expected=f"{len(result)} arrays",
            found=f"{len(rest)} more: {', '.join(list(rest)[:3])}",
        )
    return result


def _layout(array: np.ndarray, layer: nnx.Module) -> np.ndarray:
    if isinstance(layer, nnx.ConvTranspose) and array.ndim == 4:
        return array.transpose(2, 3, 0, 1)[::-1, ::-1]
    return array.transpose(2, 3, 1, 0) if array.ndim == 4 else array.T
