"""Weights that others published, as arrays by name: `.pth`, `.npz` and `.safetensors`. No code in them runs.

A `.pth` file of PyTorch 1.6 or later is a ZIP archive of one pickle, `data.pkl`, and the raw bytes of each
storage. A pickle may call whatever it names. `jaxsr.weights.pickles` lets it name ordered dictionaries,
tensors and storages only, and refuses every other name. Arrays take no more memory than a file of that size
can hold (`jaxsr.weights.archives`). Names and layouts stay the publisher's: `jaxsr.weights.names` translates.
"""

import io
import math
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.weights.archives import Budget, check_file, open_archive, read_member
from jaxsr.weights.file import KEY, check_finite, few, float32, read_safetensors
from jaxsr.weights.pickles import Known, Name, shortened, unpickle

_STORAGES = {
    Name("torch", "FloatStorage"): np.float32,
    Name("torch", "DoubleStorage"): np.float64,
    Name("torch", "HalfStorage"): np.float16,
    Name("torch", "BFloat16Storage"): jnp.bfloat16,
    Name("torch", "LongStorage"): np.int64,
    Name("torch", "IntStorage"): np.int32,
    Name("torch", "ShortStorage"): np.int16,
    Name("torch", "CharStorage"): np.int8,
    Name("torch", "ByteStorage"): np.uint8,
    Name("torch", "BoolStorage"): np.bool_,
}
_WRAPPERS = ("state_dict", "model_state_dict", "model", "net", "params")
"""Entries under which checkpoints keep the weights among other things."""
_MOST_WRAPPERS = 4
"""Entries inside of entries."""
_MOST_AXES = 32
"""Of a tensor; a network has at most 4."""


def read_published(path: str | Path) -> dict[str, np.ndarray]:
    """Read a published file of weights.

    Args:
        path: `.pth` or `.pt` (a state dictionary, or a dictionary that holds one), `.npz` (entries `sd/NAME`
            where there are any, else all), or `.safetensors`.

    Returns:
        Arrays by their published names, without a leading "module.", float32, in the layout of the file.

    Raises:
        JaxsrError: missing, damaged, of another kind, without arrays, with a value that is not finite, or a
            pickle with a forbidden name.
    """
    path = Path(path)
    check_file(path)
    readers = {".pth": _read_pth, ".pt": _read_pth, ".npz": _read_npz, ".safetensors": _read_safetensors}
    if path.suffix not in readers:
        raise JaxsrError(
            "unknown kind of weights",
            where=path,
            expected=", ".join(readers),
            found=path.suffix or "no ending",
        )
    arrays = readers[path.suffix](path)
    if not arrays:
        raise JaxsrError("no weights in the file", where=path)
    # torch.nn.DataParallel wraps a network in an attribute of this name.
    prefix = "module." if all(name.startswith("module.") for name in arrays) else ""
    arrays = {name.removeprefix(prefix): float32(array) for name, array in arrays.items()}
    check_finite(arrays, path)
    return arrays


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    arrays, metadata = read_safetensors(path)
    if KEY in metadata:
        raise JaxsrError("these are weights of jaxsr already", where=path, fix="use the file as it is")
    return arrays


# --- .npz ------------------------------------------------------------------------------------------------


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    budget = Budget(check_file(path))
    try:
        with open_archive(path) as archive:
            members = [name for name in archive.namelist() if name.endswith(".npy")]
            arrays = {
                name.removesuffix(".npy"): _npy(read_member(archive, name, budget), budget)
                for name in members
            }
    except JaxsrError:
        raise
    except Exception as e:  # a damaged archive can fail in any way
        raise JaxsrError(
            "cannot read the weights",
            where=path,
            expected="a whole .npz file of plain arrays",
            found=_told(e),
        ) from e
    chosen = {name.removeprefix("sd/"): a for name, a in arrays.items() if name.startswith("sd/")}
    return chosen or arrays


def _npy(content: bytes, budget: Budget) -> np.ndarray:
    """The array in a .npy file, whose header says no more than what follows it."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _NPY_HEADERS:
        raise ValueError(f"version {version} of the .npy format")
    shape, is_fortran, dtype = _NPY_HEADERS[version](file)
    if dtype.kind not in "fiub":
        raise ValueError(f"an array of {dtype}, which are not plain numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"an array of shape {shape} whose file is of another size")
    budget.spend(max(0, 4 - dtype.itemsize) * math.prod(shape))  # what it grows as float32
    flat = np.frombuffer(content, dtype, offset=file.tell())
    return flat.reshape(shape, order="F" if is_fortran else "C")


_NPY_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


# --- .pth ------------------------------------------------------------------------------------------------


class _Tensor(NamedTuple):
    """What `torch._utils._rebuild_tensor_v2` is called with; the layout in elements of the storage."""

    dtype: np.dtype
    key: str
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def _tensor(arguments: tuple[Any, ...]) -> _Tensor:
    """A record of a tensor. The storage is ("storage", type, key, device, length)."""
    storage, offset, size, stride, *_ = arguments
    _, kind, key, *_ = storage
    layout = (offset, *size, *stride)
    if len(size) != len(stride) or len(size) > _MOST_AXES:
        raise ValueError("a tensor of impossible layout")
    if not all(type(n) is int and n >= 0 for n in layout):
        raise ValueError("a tensor of impossible layout")
    if kind not in _STORAGES or not isinstance(key, str):
        raise ValueError("a tensor without a storage")
    return _Tensor(np.dtype(_STORAGES[kind]), key, offset, tuple(size), tuple(stride))


def _dictionary(arguments: tuple[Any, ...]) -> dict[str, Any]:
    if arguments:
        raise ValueError("a dictionary that is made of something")
    return {}


_KNOWN: Known = {
    Name("collections", "OrderedDict"): _dictionary,
    Name("torch._utils", "_rebuild_tensor_v2"): _tensor,
    **dict.fromkeys(_STORAGES),
}


def _read_pth(path: Path) -> dict[str, np.ndarray]:
    budget = Budget(check_file(path))
    if not zipfile.is_zipfile(path):
        raise JaxsrError(
            "cannot read the weights",
            where=path,
            expected="a whole .pth file of PyTorch 1.6 or later (a ZIP archive)",
            found="an older or a damaged one",
            fix="load it in PyTorch and save its state dictionary again",
        )
    try:
        with open_archive(path) as archive:
            return _tensors(archive, path, budget)
    except JaxsrError:
        raise
    except Exception as e:  # a damaged archive can fail in any way
        raise JaxsrError(
            "cannot read the weights",
            where=path,
            expected="a whole .pth file, as torch.save writes it",
            found=_told(e),
        ) from e


def _tensors(archive: zipfile.ZipFile, path: Path, budget: Budget) -> dict[str, np.ndarray]:
    pickles = [name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl"]
    if len(pickles) != 1:
        raise ValueError(f"{len(pickles)} members data.pkl")
    folder = pickles[0].removesuffix("data.pkl")
    order = f"{folder}byteorder"
    if order in archive.namelist() and _stored(archive, order, budget) == b"big":
        raise ValueError("big-endian numbers")
    content = unpickle(_stored(archive, pickles[0], budget), _KNOWN, path)
    storages: dict[str, np.ndarray] = {}
    arrays = {}
    for name, tensor in _state_dict(content, path).items():
        where = f"{folder}data/{tensor.key}"
        if where not in storages:
            storages[where] = np.frombuffer(_stored(archive, where, budget), np.uint8)
        arrays[name] = _array(tensor, storages[where].view(tensor.dtype), budget)
    return arrays


def _state_dict(content: Any, path: Path) -> dict[str, _Tensor]:
    """The dictionary of tensors in a checkpoint, which may be an entry of an entry."""
    inner = content
    for _ in range(_MOST_WRAPPERS):
        if not isinstance(inner, dict):
            break
        if tensors := {k: v for k, v in inner.items() if isinstance(k, str) and isinstance(v, _Tensor)}:
            return tensors
        inner = next((inner[name] for name in _WRAPPERS if isinstance(inner.get(name), dict)), None)
    raise JaxsrError(
        "no state dictionary in the file",
        where=path,
        expected="tensors by name, or an entry " + " | ".join(_WRAPPERS),
        found=few([str(k) for k in content]) if isinstance(content, dict) else type(content).__name__,
    )


def _stored(archive: zipfile.ZipFile, name: str, budget: Budget) -> bytes:
    if archive.getinfo(name).compress_type != zipfile.ZIP_STORED:  # PyTorch compresses nothing
        raise ValueError(f"{name} is compressed")
    return read_member(archive, name, budget)


def _array(tensor: _Tensor, flat: np.ndarray, budget: Budget) -> np.ndarray:
    size, stride, step = tensor.size, tensor.stride, tensor.dtype.itemsize
    count = math.prod(size)
    last = tensor.offset + sum((n - 1) * k for n, k in zip(size, stride, strict=True))
    if count and max(last + 1, count) > flat.size:  # a stride of 0 repeats without end
        raise ValueError("a tensor that is larger than its storage")
    budget.spend(4 * count)
    window = flat[tensor.offset :] if count else flat[:0]
    return np.lib.stride_tricks.as_strided(window, size, [k * step for k in stride]).astype(np.float32)


def _told(error: Exception) -> str:
    return shortened(f"{type(error).__name__}: {error}", 200)
