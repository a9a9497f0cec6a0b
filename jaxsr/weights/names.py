"""Published weights under our names and in our layouts, and the arguments of the network that they are for.

PyTorch's layouts become JAX's: convolutions OIHW -> HWIO, transposed ones IOHW -> HWIO and mirrored, matrices
transposed. Everything about one published network is one row of `PUBLISHED`: how to recognise it, the
method's arguments, and which published layer is which of ours. Another network is another row and its two
functions.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.nets.blocks import count_channels
from jaxsr.nets.rcan import MEAN

_ALL = ("depth", "base_color", "normal", "roughness", "metallic")
Names: TypeAlias = str | list[str] | list[list[str]]
"""Of a published layer, or of those that are one `stacked` layer here."""
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
        published: as `jaxsr.weights.torch.read_published` gives them.
        buffers: the parts of the G-buffer, in the order of the channels that the network was trained with;
            not needed where it has all nine channels, in the paper's order.
        where: what an error names, perhaps the file.

    Raises:
        JaxsrError: weights of another network, or buffers that do not have its number of channels.
    """
    is_unet = "cur_extract.f_e_net.0.weight" in published
    names = (
        "cur_extract.f_e_net.0.weight" if is_unet else "cur_gbuffer_extract.f_e_net.0.weight",
        f"fusion_reconstruct.{'' if is_unet else 'rgb_'}conv2.conv.0.weight",
        "fusion_reconstruct.up1.up.weight",
    )
    shallow, down, up = _kernels("fusion-sr", published, names, where)
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
        "demodulated": False,
        "base": "none",
        "unjitter": False,
    }
    if not is_unet:
        has_modules = any(name.startswith("fusion_reconstruct.fuse") for name in published)
        arguments["fusion"] = "se-residual" if has_modules else "concat" if up.shape[0] == 128 else "add"
    return arguments


def _fusion_sr(net: nnx.Module) -> Iterator[tuple[str, Names]]:
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


def rcan_arguments(
    published: Mapping[str, np.ndarray], buffers: Sequence[str] | None = None, where: object = "weights"
) -> dict[str, Any]:
    """What the shapes say about an RCAN: arguments of the method "rcan". Arguments as `fusion_sr_arguments`.

    Raises:
        JaxsrError: weights of another network, or buffers, of which it sees none.
    """
    _check_no_buffers(buffers)
    names = ("head.0.weight", "body.0.body.0.body.3.conv_du.0.weight")
    features, squeezed = (len(kernel) for kernel in _kernels("rcan", published, names, where))
    ups = [len(a) / features for name, a in published.items() if re.fullmatch(r"tail\.0\.\d+\.weight", name)]
    return {
        "scale": math.isqrt(round(math.prod(ups))),
        "groups": _count(published, r"body\.\d+\.body\.0\.body\.0\.weight"),
        "blocks": _count(published, r"body\.0\.body\.\d+\.body\.0\.weight"),
        "features": features,
        "reduction": features // squeezed,
    }


def rrn_arguments(
    published: Mapping[str, np.ndarray], buffers: Sequence[str] | None = None, where: object = "weights"
) -> dict[str, Any]:
    """What the shapes say about an RRN: arguments of the method "rrn". Arguments as `fusion_sr_arguments`.

    Raises:
        JaxsrError: weights of another network, or buffers, of which it sees none.
    """
    _check_no_buffers(buffers)
    first, last = _kernels("rrn", published, ("neuro.conv_1.weight", "neuro.conv_o.weight"), where)
    return {
        "scale": math.isqrt(len(last) // 3),
        "blocks": _count(published, r"neuro\.recon_trunk\.\d+\.conv1\.weight"),
        "features": len(first),
    }


def _count(published: Mapping[str, np.ndarray], pattern: str) -> int:
    return sum(re.fullmatch(pattern, name) is not None for name in published)


def _check_no_buffers(buffers: Sequence[str] | None) -> None:
    if buffers is not None:
        raise JaxsrError("the network sees no G-buffer", where="--buffers", expected="none", found=buffers)


def _kernels(
    method: str, published: Mapping[str, np.ndarray], names: Sequence[str], where: object
) -> list[np.ndarray]:
    """The kernels, OIHW, whose shapes tell about the network."""
    for name in names:
        if name not in published or published[name].ndim != 4 or not published[name].size:
            raise JaxsrError(
                f"not weights of a published {method} network",
                where=where,
                expected=f"a kernel {name!r}",
                found=", ".join(list(published)[:3]),
            )
    return [published[name] for name in names]


def _without_mean_shifts(published: Mapping[str, np.ndarray], where: object) -> dict[str, np.ndarray]:
    """RCAN for colours in [0, 1], whatever the range R of the published one: `rgb_range`, 255 or 1.

    `sub_mean` and `add_mean`, which are our constants, tell R: head(R x) is a head with R times the kernel,
    tail(y) / R a tail with 1 / R of kernel and bias.
    """
    rest = dict(published)
    for name, sign, inside in (
        ("sub_mean", -1, {"head.0.weight"}),
        ("add_mean", 1, {"tail.1.weight", "tail.1.bias"}),
    ):
        matrix, shift = (rest.pop(f"{name}.{leaf}", np.zeros(0)) for leaf in ("weight", "bias"))
        is_identity = matrix.shape == (3, 3, 1, 1) and np.allclose(matrix[:, :, 0, 0], np.eye(3))
        # Half floats are a ten-thousandth off.
        spans = [
            r for r in (1, 255) if shift.shape == (3,) and np.allclose(sign * shift / r, MEAN, atol=1e-3)
        ]
        if not is_identity or not spans:
            raise JaxsrError(
                f"{name} is not RCAN's",
                where=where,
                expected=f"the identity, and a shift by {MEAN} times 1 or 255",
                found=shift.tolist() if shift.size else "no such array",
            )
        for scaled in inside & rest.keys():
            rest[scaled] = rest[scaled] * np.float32(spans[0]) ** -sign
    return rest


def _rcan(net: Any) -> Iterator[tuple[str, Names]]:
    """Our layers and their published names, of RCAN."""
    groups, blocks = net.groups.blocks.conv1.bias.shape[:2]
    yield "head", "head.0"
    for ours, theirs in (
        ("conv1", "0"),
        ("conv2", "2"),
        ("attention.squeeze", "3.conv_du.0"),
        ("attention.excite", "3.conv_du.2"),
    ):
        named = [[f"body.{g}.body.{b}.body.{theirs}" for b in range(blocks)] for g in range(groups)]
        yield f"groups.blocks.{ours}", named
    yield "groups.last", [f"body.{g}.body.{blocks}" for g in range(groups)]
    yield "last", f"body.{groups}"
    for k in range(len(net.ups)):
        yield f"ups.{k}", f"tail.0.{2 * k}"
    yield "tail", "tail.1"


def _rrn(net: Any) -> Iterator[tuple[str, Names]]:
    """Our layers and their published names, of RRN."""
    yield "first", "neuro.conv_1"
    for k in range(len(net.blocks)):
        for conv in ("conv1", "conv2"):
            yield f"blocks.{k}.{conv}", f"neuro.recon_trunk.{k}.{conv}"
    yield "hidden", "neuro.conv_h"
    yield "output", "neuro.conv_o"


class Published(NamedTuple):
    """What is known of the published networks of a method."""

    key: str
    """A beginning that names of their arrays have and those of no other network."""
    arguments: Callable[..., dict[str, Any]]
    """The method's arguments: `arguments(published, buffers, where)`."""
    layers: Callable[[nnx.Module], Iterator[tuple[str, Names]]]
    """Our layers and their published names: `layers(net)`."""
    adapt: Callable[..., dict[str, np.ndarray]] | None = None
    """Changes the arrays before the layers take them: `adapt(published, where)`."""
    scale: int = 4
    """What the networks were trained for, where neither their shapes nor the caller tell."""


PUBLISHED: dict[str, Published] = {
    "fusion-sr": Published("fusion_reconstruct.", fusion_sr_arguments, _fusion_sr),
    "rcan": Published("body.0.body.0.body.3.conv_du.", rcan_arguments, _rcan, _without_mean_shifts),
    "rrn": Published("neuro.", rrn_arguments, _rrn),
}


def method_of(published: Mapping[str, np.ndarray], where: object = "weights") -> str:
    """The method whose network these weights are for, by their names.

    Raises:
        JaxsrError: none that is known.
    """
    for method, known in PUBLISHED.items():
        if any(name.startswith(known.key) for name in published):
            return method
    raise JaxsrError(
        "not weights of a published network that is known",
        where=where,
        expected="those of " + ", ".join(PUBLISHED),
        found=", ".join(list(published)[:3]),
    )


def translate(
    method: str, net: nnx.Module, published: Mapping[str, np.ndarray], where: object = "weights"
) -> dict[str, np.ndarray]:
    """Published weights by our names and in our layouts.

    Args:
        method: name in `PUBLISHED`.
        net: the network that they are for; abstract (`nnx.eval_shape`) will do.
        published: by their names; PyTorch's counts of batches are ignored.
        where: what an error names, perhaps the file.

    Raises:
        JaxsrError: arrays that are missing or that no layer takes.
    """
    layers = {".".join(map(str, path)): module for path, module in nnx.iter_modules(net)}
    known = PUBLISHED[method]
    rest = {name: array for name, array in published.items() if not name.endswith("num_batches_tracked")}
    if known.adapt is not None:
        rest = known.adapt(rest, where)
    result = {}

    def take(theirs: Names, ours: str, leaf: str) -> np.ndarray:
        if not isinstance(theirs, str):
            return _stack([take(part, ours, leaf) for part in theirs], f"{ours}.{leaf}", where)
        name = f"{theirs}.{_LEAVES[leaf]}"
        if name not in rest:
            raise JaxsrError(f"array {name} is missing", where=where, expected=f"it, for {ours}.{leaf}")
        return _layout(rest.pop(name), layers[ours])

    for ours, theirs in known.layers(net):
        for (leaf,), _ in nnx.to_flat_state(nnx.state(layers[ours])):
            result[f"{ours}.{leaf}"] = take(theirs, ours, str(leaf))
    if rest:
        raise JaxsrError(
            "arrays that the network does not have",
            where=where,
            expected=f"{len(result)} arrays",
            found=f"{len(rest)} more: {', '.join(list(rest)[:3])}",
        )
    return result


def _stack(arrays: list[np.ndarray], name: str, where: object) -> np.ndarray:
    if len(shapes := {array.shape for array in arrays}) > 1:
        raise JaxsrError(f"arrays of several shapes for {name}", where=where, found=sorted(shapes))
    return np.stack(arrays)


def _layout(array: np.ndarray, layer: nnx.Module) -> np.ndarray:
    if isinstance(layer, nnx.ConvTranspose) and array.ndim == 4:
        return array.transpose(2, 3, 0, 1)[::-1, ::-1]
    if isinstance(layer, nnx.Linear) and array.shape[2:] == (1, 1):  # published as a 1x1 convolution
        array = array[:, :, 0, 0]
    return array.transpose(2, 3, 1, 0) if array.ndim == 4 else array.T
