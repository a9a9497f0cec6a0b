"""Weights as safetensors with a header: nothing in them is executed when they are loaded.

A file holds one array per parameter or batch statistic, named by its place in the network
("decoder1.up.kernel"), and one metadata entry, `jaxsr`: a JSON object (`new_header`) with at least `method`,
`settings` and `scale`, from which `jaxsr.methods.build` makes the method again. Arrays are float32, or
float16 at half the size; loaded, they are float32 either way. `jaxsr.weights.torch` reads those of other
programs.
"""

import itertools
import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, open_file, parse_json
from jaxsr.weights.archives import Budget, check_file
from jaxsr.weights.pickles import shortened

State: TypeAlias = Any
"""An `nnx.State`; not annotated as one, for its own annotations are of a kind that beartype rejects."""
FORMAT = 2
"""Of the header. Files without a number are of version 1: `jaxsr.methods.legacy` reads their settings."""
KEY = "jaxsr"
"""The name of the metadata entry that holds the header."""
HEADER_BYTES = 16 << 20
"""Of all that a safetensors file says about its arrays, which takes about 100 bytes per array."""


def flatten(state: State) -> dict[str, np.ndarray]:
    """The arrays of a state by name, "a.b.c" for `state["a"]["b"]["c"]`."""
    return {
        ".".join(map(str, path)): np.asarray(variable.get_value())
        for path, variable in nnx.to_flat_state(state)
    }


def new_header(method: str, settings: Mapping[str, Any], scale: int, **more: Any) -> dict[str, Any]:
    """The header of a file of weights.

    Args:
        method: its name.
        settings: all that its output depends on besides the arrays (`Network.settings`).
        scale: HR size over LR size that the weights are made for.
        **more: whatever else should be known of them, as JSON values.
    """
    return {
        "format": FORMAT,
        "method": method,
        "settings": dict(settings),
        "scale": scale,
        "jaxsr": jaxsr.__version__,
        **more,
    }


def save_weights(
    path: str | Path,
    state: State | Mapping[str, np.ndarray],
    header: Mapping[str, Any],
    half: bool = False,
) -> None:
    """Write a file of weights, atomically; the same weights and header give the same bytes.

    Args:
        path: of the file.
        state: parameters and batch statistics, as a state or already by name.
        header: see `new_header`.
        half: store float16, rounded to nearest.

    Raises:
        JaxsrError: a value that is not finite, or beyond float16; a header that is no JSON; no permission.
    """
    dtype = np.float16 if half else np.float32
    arrays = {}
    for name, array in (flatten(state) if isinstance(state, nnx.State) else state).items():
        with np.errstate(over="ignore"):  # the error below names the array
            arrays[name] = np.ascontiguousarray(array, dtype)
        if not np.isfinite(arrays[name]).all():
            raise JaxsrError(
                f"{name} is not finite",
                where=path,
                expected=f"values within {dtype.__name__}",
                found=_extreme(array),
                fix="store float32"
                if np.isfinite(array).all()
                else "the training diverged: use earlier weights",
            )
    try:
        text = json.dumps(dict(header), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as e:
        raise JaxsrError("the header is no JSON", where=path, found=e) from e
    blob = save(arrays, {KEY: text})
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(blob)


def load_weights(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a file of weights.

    Returns:
        Arrays by name, float32, and the header.

    Raises:
        JaxsrError: missing, truncated, not safetensors, without jaxsr's header, or with a value that is not
            finite; it names the first array that has one.
    """
    path = Path(path)
    arrays, metadata = read_safetensors(path)
    header = None
    if KEY in metadata:
        try:
            header = parse_json(metadata[KEY], path, limit=HEADER_BYTES)
        except JaxsrError as e:
            found = e.what if e.found is None else f"{e.what}: {e.found}"
            raise JaxsrError("the header of the weights is damaged", where=path, found=found) from e
    if not isinstance(header, dict) or not isinstance(header.get("method"), str):
        raise JaxsrError(
            "the file does not say which method its weights are for",
            where=path,
            expected=f"a metadata entry {KEY!r} that names the method",
            found=few(sorted(metadata)) or "no metadata",
            fix="convert published weights with `jaxsr convert-weights`",
        )
    check_finite(arrays, path)
    return arrays, header


def read_safetensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Any safetensors file of floating-point arrays: those by name, as float32, and its metadata.

    Raises:
        JaxsrError: missing, truncated, not safetensors, or with arrays of types that NumPy does not know.
    """
    budget = Budget(check_file(path))
    try:
        with open_file(path) as opened:
            if (size := int.from_bytes(opened.read(8), "little")) > HEADER_BYTES:
                raise ValueError(f"a header of {size} bytes, more than {HEADER_BYTES}")
        arrays = {}
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            for name in file.keys():  # noqa: SIM118 (not a dict)
                budget.spend(4 * math.prod(file.get_slice(name).get_shape()))
                arrays[name] = float32(file.get_tensor(name))
    except (SafetensorError, OSError, ValueError) as e:
        raise JaxsrError(
            "cannot read the weights", where=path, expected="a whole safetensors file", found=_words(e)
        ) from e
    except (TypeError, AttributeError) as e:  # bfloat16 and float8, which NumPy lacks
        raise JaxsrError(
            "cannot read the weights", where=path, expected="float16, float32 or float64", found=e
        ) from e
    return arrays, metadata


def float32(array: np.ndarray) -> np.ndarray:
    """The array as float32; what is too large becomes infinite, for `check_finite` to find."""
    with np.errstate(over="ignore"):
        return np.asarray(array, np.float32)


def check_finite(arrays: Mapping[str, np.ndarray], where: object) -> None:
    """Raise JaxsrError, which names the first bad array, unless all values are finite."""
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise JaxsrError(
                f"{shortened(name)} is not finite",
                where=where,
                expected="finite float32 values",
                found="NaN or infinity",
                fix="use weights from before the training diverged",
            )


def into(state: State, arrays: Mapping[str, np.ndarray], where: object = "weights") -> State:
    """A state like `state`, with these arrays as its values.

    Args:
        state: of the network that the arrays are for; abstract (`nnx.eval_shape`) or concrete.
        arrays: by name, as `load_weights` gives them.
        where: what an error names: the file, perhaps, or the network.

    Raises:
        JaxsrError: arrays that are missing, too many, or of another shape; it names the first of them.
    """
    flat = {".".join(map(str, path)): (path, variable) for path, variable in nnx.to_flat_state(state)}
    missing = [name for name in flat if name not in arrays]
    extra = [name for name in arrays if name not in flat]
    if missing or extra:
        what = [f"{kind} {few(names)}" for kind, names in (("lacks", missing), ("has", extra)) if names]
        raise JaxsrError(
            "the weights do not fit the network",
            where=where,
            expected=f"its {len(flat)} arrays",
            found=f"a file of {len(arrays)} that " + " and ".join(what),
            fix="choose weights, or arguments of the method, that belong together",
        )
    filled = []
    for name, (path, variable) in flat.items():
        old = variable.get_value()
        if arrays[name].shape != old.shape:
            raise JaxsrError(
                f"{name} has another shape than in the network",
                where=where,
                expected=list(old.shape),
                found=list(arrays[name].shape),
                fix="choose weights, or arguments of the method, that belong together",
            )
        filled.append((path, variable.replace(jnp.asarray(arrays[name], old.dtype))))
    return nnx.from_flat_state(filled)


def few(names: Collection[str]) -> str:
    """The first names out of a file, and how many more there are, for a message."""
    first = ", ".join(shortened(name) for name in itertools.islice(names, 3))
    return first + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _extreme(array: np.ndarray) -> object:
    return np.max(np.abs(array)) if np.isfinite(array).all() else "NaN or infinity"


def _words(error: Exception) -> str:
    return str(error).removeprefix("Error while deserializing header: ") or type(error).__name__
