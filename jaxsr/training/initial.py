"""Weights to start from: `--init FILE` for the whole network, `--init PART=FILE` for a part of it."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.files import file_digest
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.runtime.load import settings_of
from jaxsr.weights.file import into, load_weights

MISSING = "missing"
"""In place of the hash of a file that is no longer there."""


class Source(NamedTuple):
    """One `--init`."""

    part: str
    """Path of a sub-module, such as "frnet" or "frnet.encoder"; empty for the whole network."""
    file: Path

    def named(self, value: str) -> str:
        """`value`, with the part in front of it."""
        return f"{self.part}={value}" if self.part else value


def parse(text: str) -> Source:
    """`FILE` or `PART=FILE`. A text that is the path of a file is that file, whatever its name holds."""
    part, equals, file = text.partition("=")
    if not equals or not re.fullmatch(r"[A-Za-z_]\w*(\.\w+)*", part) or Path(text).is_file():
        return Source("", Path(text))
    return Source(part, Path(file))


def hashes(init: Iterable[str]) -> str | None:
    """What config.json keeps of the files: `PART=hash` for each, with a space between; None without any."""
    found = []
    for source in map(parse, init):
        there = source.file.is_file()
        found.append(source.named(file_digest(source.file)[:12] if there else MISSING))
    return " ".join(found) or None


def same_hashes(old: str | None, new: str | None) -> bool:
    """Whether a training may go on; a file that is no longer there counts as the one that it was."""
    before, now = (old or "").split(), (new or "").split()
    return len(before) == len(now) and all(
        a == b or (b.endswith(MISSING) and a.rpartition("=")[0] == b.rpartition("=")[0])
        for a, b in zip(before, now, strict=True)
    )


def initial_weights(
    method: Method, init: Iterable[str], scale: int | None = None
) -> tuple[Net | None, list[str]]:
    """State of the network to start from, of any scale; later files replace what earlier ones gave.

    Args:
        method: with a network.
        init: texts as `parse` takes them.
        scale: of the training, which the files of parts must have too; None does not compare it. A whole
            network may start from weights of another scale.

    Returns:
        What the files give of the network's state (None without files), and notes for the user: settings
        that are different from those that the weights were made with.

    Raises:
        JaxsrError: no such part or file, weights of another method, arrays that do not fit, or a part
            of another scale or other settings.
    """
    assert method.network is not None
    new = method.network.new
    whole = nnx.state(nnx.eval_shape(lambda: new(nnx.Rngs(0))), nnx.Not(nnx.RngState))
    flat: dict[tuple[Any, ...], Any] = {}
    notes: list[str] = []
    for source in map(parse, init):
        place = _place(whole, source, method.name)
        part = {path[len(place) :]: v for path, v in nnx.to_flat_state(whole) if path[: len(place)] == place}
        arrays, header = load_weights(source.file)
        if not source.part:
            notes += _changed_settings(method, header, source.file)
        else:
            _check_part(method, header, source, scale)
        filled = into(nnx.from_flat_state(list(part.items())), _of_part(arrays, part, source), source.file)
        flat |= {(*place, *path): variable for path, variable in nnx.to_flat_state(filled)}
    return nnx.from_flat_state(list(flat.items())) if flat else None, notes


def _place(whole: Net, source: Source, name: str) -> tuple[Any, ...]:
    """The part's path in the network's state."""
    if not source.part:
        return ()
    wanted = source.part.split(".")
    modules = {path[:n] for path, _ in nnx.to_flat_state(whole) for n in range(1, len(path))}
    for path in modules:
        if [str(x) for x in path] == wanted:
            return path
    outer = max((p for p in modules if [*map(str, p)] == wanted[: len(p)]), key=len, default=())
    known = sorted(".".join(map(str, p)) for p in modules if len(p) == len(outer) + 1 and p[:-1] == outer)
    raise JaxsrError(
        f"the network of {name!r} has no part {source.part!r}",
        where="--init",
        expected="one of " + ", ".join(known) if known else "the whole network: --init FILE",
    )


def _of_part(
    arrays: Mapping[str, np.ndarray], part: Mapping[tuple[Any, ...], Any], source: Source
) -> Mapping[str, np.ndarray]:
    """The arrays for a part: of a file of this part alone, or of one that holds a whole network with it."""
    if not source.part or any(".".join(map(str, path)) in arrays for path in part):
        return arrays
    prefix = source.part + "."
    inside = {name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)}
    return inside or arrays


def _changed_settings(method: Method, header: Mapping[str, Any], file: Path) -> list[str]:
    assert method.network is not None
    if header.get("method") != method.name:
        raise JaxsrError(
            "weights of another method", where=file, expected=method.name, found=header.get("method")
        )
    old, new = settings_of(dict(header), file), method.network.settings
    changed = [f"{name} {old[name]} -> {new[name]}" for name in _different(old, new)]
    return [f"{file.name} was made with other options: {', '.join(changed)}"] if changed else []


def _different(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the settings that both have, with other values."""
    return [name for name in new if name in old and old[name] != new[name]]


def _check_part(method: Method, header: Mapping[str, Any], source: Source, scale: int | None) -> None:
    """See that a part was made for this training: it may be frozen, and would then never adapt.

    Raises:
        JaxsrError: it has another scale or other settings; names both values.
    """
    assert method.network is not None
    old: dict[str, Any] = settings_of(dict(header), source.file)
    new: dict[str, Any] = dict(method.network.settings)
    if scale is not None and "scale" in header:
        old, new = old | {"scale": header["scale"]}, new | {"scale": scale}
    if changed := _different(old, new):
        raise JaxsrError(
            f"the weights for part {source.part!r} were made with other settings",
            where=source.file,
            expected=", ".join(f"{name} {new[name]}" for name in changed),
            found=", ".join(f"{name} {old[name]}" for name in changed),
            fix="train with the settings of the file, or choose another file",
        )
