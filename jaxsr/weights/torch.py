"""Weights that others published, as arrays by name: `.pth`, `.npz` and `.safetensors`. No code in them runs.

A `.pth` file of PyTorch 1.6 or later is a ZIP archive of one pickle, `data.pkl`, and the raw bytes of each
storage. A pickle may call whatever it names. The reader here lets it name ordered dictionaries, tensors and
storages only, puts inert records in the place of the last two, and refuses every other name before it is
looked up. Names and layouts stay the publisher's: `jaxsr.weights.names` translates.
"""

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.weights.file import KEY, check_file, read_safetensors

_STORAGES = {
    "FloatStorage": np.float32,
    "DoubleStorage": np.float64,
    "HalfStorage": np.float16,
    "BFloat16Storage": jnp.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}
_WRAPPERS = ("state_dict", "model_state_dict", "model", "net", "params")
"""Entries under which checkpoints keep the weights among other things."""


def read_published(path: str | Path) -> dict[str, np.ndarray]:
    """Read a published file of weights.

    Args:
        path: `.pth` or `.pt` (a state dictionary, or a dictionary that holds one), `.npz` (entries `sd/NAME`
            where there are any, else all), or `.safetensors`.

    Returns:
        Arrays by their published names, without a leading "module.", float32, in the layout of the file.

    Raises:
        JaxsrError: missing, damaged, of another kind, without arrays, or a pickle with a forbidden name.
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
    return {name.removeprefix(prefix): np.asarray(array, np.float32) for name, array in arrays.items()}


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    arrays, metadata = read_safetensors(path)
    if KEY in metadata:
        raise JaxsrError("these are weights of jaxsr already", where=path, fix="use the file as it is")
    return arrays


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as e:
        raise JaxsrError(
            "cannot read the weights", where=path, expected="a whole .npz file of plain arrays", found=e
        ) from e
    chosen = {name.removeprefix("sd/"): a for name, a in arrays.items() if name.startswith("sd/")}
    return chosen or arrays


class _Storage(NamedTuple):
    dtype: Any


class _Tensor(NamedTuple):
    """What `torch._utils._rebuild_tensor_v2` is called with; the layout in elements of the storage."""

    storage: Any
    offset: Any
    size: Any
    stride: Any
    requires_grad: Any = None
    hooks: Any = None
    metadata: Any = None


def _tensor(*arguments: Any) -> _Tensor:
    """Not the class itself: a pickle may set attributes of what it names."""
    return _Tensor(*arguments)


_ALLOWED = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    **{("torch", name): _Storage(np.dtype(dtype)) for name, dtype in _STORAGES.items()},
}


class _Unpickler(pickle.Unpickler):
    """Knows three kinds of names; `persistent_load` keeps the record of a storage as it is."""

    def __init__(self, file: Any, path: Path):
        super().__init__(file)
        self.path = path

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise JaxsrError(
                f"the pickle names {module}.{name}, which could run code",
                where=self.path,
                expected="tensors, dictionaries, numbers and text",
                fix="save the state dictionary alone: torch.save(model.state_dict(), path)",
            )
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _read_pth(path: Path) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise JaxsrError(
            "cannot read the weights",
            where=path,
            expected="a whole .pth file of PyTorch 1.6 or later (a ZIP archive)",
            found="an older or a damaged one",
            fix="load it in PyTorch and save its state dictionary again",
        )
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl"]
            if len(pickles) != 1:
                raise ValueError(f"{len(pickles)} members data.pkl")
            folder = pickles[0].removesuffix("data.pkl")
            if (
                f"{folder}byteorder" in archive.namelist()
                and _member(archive, f"{folder}byteorder") == b"big"
            ):
                raise ValueError("big-endian numbers")
            content = _Unpickler(io.BytesIO(_member(archive, pickles[0])), path).load()
            state = _state_dict(content, path)
            storages: dict[str, np.ndarray] = {}
            return {name: _array(tensor, archive, folder, storages) for name, tensor in state.items()}
    except JaxsrError:
        raise
    except Exception as e:  # a damaged pickle can fail in any way
        raise JaxsrError(
            "cannot read the weights",
            where=path,
            expected="a whole .pth file, as torch.save writes it",
            found=f"{type(e).__name__}: {e}",
        ) from e


def _state_dict(content: Any, path: Path) -> dict[str, _Tensor]:
    """The dictionary of tensors in a checkpoint."""
    if isinstance(content, Mapping):
        tensors = {k: v for k, v in content.items() if isinstance(k, str) and isinstance(v, _Tensor)}
        if tensors:
            return tensors
        for name in _WRAPPERS:
            if isinstance(content.get(name), Mapping):
                return _state_dict(content[name], path)
    raise JaxsrError(
        "no state dictionary in the file",
        where=path,
        expected="tensors by name, or an entry " + " | ".join(_WRAPPERS),
        found=", ".join(map(str, list(content)[:5]))
        if isinstance(content, Mapping)
        else type(content).__name__,
    )


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).compress_type != zipfile.ZIP_STORED:  # a small file must not become a huge one
        raise ValueError(f"{name} is compressed")
    return archive.read(name)


def _array(
    tensor: _Tensor, archive: zipfile.ZipFile, folder: str, storages: dict[str, np.ndarray]
) -> np.ndarray:
    _, (dtype,), key, *_ = tensor.storage
    if key not in storages:
        storages[key] = np.frombuffer(_member(archive, f"{folder}data/{key}"), dtype)
    flat = storages[key]
    size, stride = tuple(tensor.size), tuple(tensor.stride)
    if len(size) != len(stride) or min((tensor.offset, *size, *stride), default=0) < 0:
        raise ValueError("a tensor of impossible layout")
    last = tensor.offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and max(last + 1, math.prod(size)) > flat.size:  # a step of 0 repeats without end
        raise ValueError("a tensor that is larger than its storage")
    window = flat[tensor.offset :] if 0 not in size else flat[:0]
    view = np.lib.stride_tricks.as_strided(window, size, [step * dtype.itemsize for step in stride])
    return view.astype(np.float32)
