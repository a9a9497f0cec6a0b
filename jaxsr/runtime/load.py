"""Methods ready to run: by name, by the name of released weights, or from a file of weights."""

import importlib.resources
import re
from pathlib import Path
from typing import Any, NamedTuple

from flax import nnx

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.methods import METHODS, Method, build
from jaxsr.methods.base import Net
from jaxsr.methods.legacy import upgrade
from jaxsr.weights.file import FORMAT, into, load_weights


class LoadedMethod(NamedTuple):
    """A method with all it needs to run."""

    method: Method
    """Named as it was asked for; a file of weights gives its name, or that of its folder (`weights_name`)."""
    net: Net = None
    """State of the network; None where nothing is learned."""
    weights: Path | None = None
    """The file that the state was read from."""


def weights_folder() -> Path:
    """The folder of the weights that ship with the package."""
    return Path(str(importlib.resources.files(jaxsr) / "weights" / "released"))


def shipped_scales(name: str) -> list[int]:
    """Scales for which weights of that name ship with the package."""
    matches = (
        re.fullmatch(rf"{re.escape(name)}-x(\d+)", path.stem)
        for path in weights_folder().glob("*.safetensors")
    )
    return sorted(int(match[1]) for match in matches if match)


def shipped_names() -> list[str]:
    """Names of the weights that ship with the package, without their scales."""
    return sorted({re.sub(r"-x\d+$", "", path.stem) for path in weights_folder().glob("*.safetensors")})


def weights_name(path: Path) -> str:
    """What a file of weights is called: those that `jaxsr train` writes go by the name of their folder."""
    if path.stem not in ("weights", "best"):
        return path.stem
    folder = path.resolve().parent.name
    return folder if path.stem == "weights" else f"{folder}-{path.stem}"


def find_method(name: str, scale: int) -> LoadedMethod:
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
        return load_method(path, scale, weights_name(path))
    if (card := weights_folder() / f"{name}.safetensors").is_file():
        return load_method(card, scale, name)
    scales = shipped_scales(name)
    if scale in scales:
        return load_method(weights_folder() / f"{name}-x{scale}.safetensors", scale, name)
    if name not in METHODS and not scales:
        raise JaxsrError(
            f"unknown method {name!r}",
            expected="one of " + ", ".join(dict.fromkeys([*METHODS, *shipped_names()])),
            fix="or the path of a file of weights, *.safetensors",
        )
    if scales or METHODS[name].network is not None:
        raise JaxsrError(
            f"no weights of {name!r} for scale {scale}",
            expected=f"scale {' or '.join(map(str, scales))}" if scales else None,
            found=None if scales else "no weights of it in the package",
            fix="train some (jaxsr train) and give the path of the file as the method",
        )
    return LoadedMethod(METHODS[name])


def settings_of(header: dict[str, Any], path: Path) -> dict[str, Any]:
    """The settings that the header of a file of weights records, also of files of earlier versions.

    Raises:
        JaxsrError: the header is damaged, or of a later version.
    """
    version = header.get("format", 1)
    if version not in (1, FORMAT):
        raise JaxsrError(
            "weights of another version", where=path, expected=FORMAT, found=version, fix="update jaxsr"
        )
    settings = header.get("arguments" if version == 1 else "settings", {})
    if not isinstance(settings, dict):
        raise JaxsrError(
            "the header of the weights is damaged",
            where=path,
            expected="settings as an object",
            found=settings,
        )
    return upgrade(str(header["method"]), settings) if version == 1 else settings


def method_of_header(header: dict[str, Any], path: Path) -> Method:
    """The method that the header of a file of weights describes.

    Raises:
        JaxsrError: the header is damaged, or names settings that the method does not have.
    """
    return build(str(header["method"]), settings_of(header, path), path)


def load_method(path: Path, scale: int, name: str) -> LoadedMethod:
    """The method of a file of weights, under a name.

    Raises:
        JaxsrError: the file is damaged, of another scale, or does not fit the method.
    """
    arrays, header = load_weights(path)
    trained = header.get("scale")
    if not isinstance(trained, int):
        raise JaxsrError(
            "the header of the weights is damaged",
            where=path,
            expected="a whole number as scale",
            found=f"scale {trained}",
        )
    if trained != scale:
        raise JaxsrError(
            "the weights are made for another scale",
            where=path,
            expected=f"scale {scale}",
            found=f"scale {trained}",
            fix=f"choose --scale {trained}, or other weights",
        )
    method = method_of_header(header, path)
    network = method.network
    assert network is not None  # `build` knows only methods that learn
    empty = nnx.state(nnx.eval_shape(lambda: network.new(nnx.Rngs(0))), nnx.Not(nnx.RngState))
    return LoadedMethod(method._replace(name=name), into(empty, arrays, path), path)
