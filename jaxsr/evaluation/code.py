"""A digest of the code of a method, wherever that code lies: in jaxsr, in a script, or in a notebook.

jaxsr's own files are hashed as a whole elsewhere (`kept.py`). Of a method itself this walks everything that
its functions hold: closures, defaults, options. Of a function that is not of jaxsr or of an installed package
it also takes the compiled code and the values of the globals that it names; and where there is such a
function, the files of all modules that are neither jaxsr's, installed nor of Python.
"""

import functools
import hashlib
import importlib.util
import re
import site
import sys
import sysconfig
import types
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxsr
from jaxsr.files import digest

_PACKAGE = Path(jaxsr.__file__).resolve().parent
_NAMED = (
    types.ModuleType, types.BuiltinFunctionType, np.ufunc, types.MethodDescriptorType,
    types.WrapperDescriptorType, types.GetSetDescriptorType, types.MemberDescriptorType,
)  # fmt: skip
"""What is told by its name alone."""
_PLAIN = (
    type(None),
    type(...),
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    range,
    slice,
    Path,
    np.dtype,
    re.Pattern,
)
"""What is told by its `repr`."""
_INSIDE = ("func", "args", "keywords", "__func__", "__self__", "__wrapped__", "fget", "fun")
"""What partial functions, bound methods, jitted functions, properties and custom gradients are made of."""


class UnknownCodeError(ValueError):
    """A method holds a value whose content cannot be told, such as an open file."""


def method_digest(method: Any) -> str:
    """SHA-256 of the code of a method and of the values that its functions hold.

    Args:
        method: a `jaxsr.methods.Method`, or anything made of functions, containers and arrays.

    Raises:
        UnknownCodeError: a closure holds a value that cannot be told from another one.
    """
    walk = _Walk()
    try:
        content = walk.digest(method)
    except RecursionError:
        raise UnknownCodeError("values nested too deep") from None
    return digest([content, *(_modules_of_the_user() if walk.foreign else [])])


def _modules_of_the_user() -> list[bytes]:
    """The digests of the source files of modules that are not jaxsr's, installed or Python's own."""
    files = {
        Path(file).resolve()
        for module in list(sys.modules.values())
        if isinstance(file := getattr(module, "__file__", None), str)
    }
    parts = []
    for file in sorted(files):
        if file.suffix == ".py" and file.is_file() and not _is_installed(file):
            parts += [file.name.encode(), hashlib.sha256(file.read_bytes()).digest()]
    return parts


@functools.cache
def _installed_folders() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    folders = [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    folders += [*site.getsitepackages(), site.getusersitepackages(), sys.base_prefix + "/lib"]
    return (_PACKAGE, *{Path(folder).resolve() for folder in folders})


def _is_installed(file: Path) -> bool:
    return any(file.is_relative_to(folder) for folder in _installed_folders())


@functools.cache
def _is_foreign(module: str) -> bool:
    """Whether a module is the user's: neither jaxsr's, nor installed, nor Python's own."""
    if module.split(".")[0] in ("jaxsr", "builtins", *sys.stdlib_module_names):
        return False
    if module == "__main__":  # in a notebook its file is that of the notebook's program
        return True
    loaded = sys.modules.get(module)
    file = getattr(loaded, "__file__", None)
    if loaded is None:
        try:
            spec = importlib.util.find_spec(module)
        except (ImportError, ValueError):
            spec = None
        file = spec.origin if spec else None
    return file is None or not _is_installed(Path(file).resolve())


class _Walk:
    """Digests of values; what was met before counts by the order in which it was met."""

    def __init__(self) -> None:
        self.foreign = False
        """Whether a function or class was met that is the user's."""
        self._met: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no `id` is given to two values

    def digest(self, value: Any, strict: bool = True) -> bytes:
        """Of one value; where it is not `strict`, of an unknown value the type alone counts."""
        return digest(self._parts(value, strict)).encode()

    def _parts(self, value: Any, strict: bool) -> Iterator[bytes]:
        kind = type(value)
        yield f"{kind.__module__}.{kind.__qualname__}".encode()
        if isinstance(value, _PLAIN):
            yield repr(value).encode()
            return
        if id(value) in self._met:
            yield str(self._met[id(value)]).encode()
            return
        self._met[id(value)] = len(self._met)
        self._kept.append(value)
        if isinstance(value, types.FunctionType):
            yield from self._function(value, strict)
        elif isinstance(value, _NAMED) or kind.__module__ == "typing":
            yield f"{getattr(value, '__module__', '')}.{getattr(value, '__name__', value)}".encode()
        elif isinstance(value, type):
            yield from self._class(value)
        elif isinstance(value, weakref.ReferenceType):
            yield self.digest(value(), strict)
        elif isinstance(value, types.CodeType):
            yield from self._code(value)
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            yield from self._array(value)
        elif isinstance(value, Mapping):
            for key, item in value.items():
                yield self.digest(key, strict)
                yield self.digest(item, strict)
        elif isinstance(value, tuple | list):
            for item in value:
                yield self.digest(item, strict)
        elif isinstance(value, set | frozenset):
            yield from sorted(_Walk().digest(item, strict) for item in value)
        else:
            yield from self._object(value, strict)

    def _function(self, function: types.FunctionType, strict: bool) -> Iterator[bytes]:
        yield f"{function.__module__}.{function.__qualname__}".encode()
        for value in (function.__defaults__, function.__kwdefaults__):
            yield self.digest(value, strict)
        for closed in function.__closure__ or ():
            try:
                content = closed.cell_contents
            except ValueError:  # not set yet
                continue
            yield self.digest(content, strict)
        if _is_foreign(function.__module__ or "__main__"):
            self.foreign = True
            yield self.digest(function.__code__)
            for name in sorted(_names(function.__code__)):
                if name in function.__globals__:
                    yield name.encode()
                    yield self.digest(function.__globals__[name], strict=False)
        elif wrapped := getattr(function, "__wrapped__", None):
            yield self.digest(wrapped, strict)

    def _class(self, value: type) -> Iterator[bytes]:
        yield f"{value.__module__}.{value.__qualname__}".encode()
        if not _is_foreign(value.__module__):
            return
        self.foreign = True
        for base in value.__bases__:
            yield self.digest(base)
        for name, item in sorted(vars(value).items()):
            if name not in ("__dict__", "__weakref__", "__doc__", "__module__", "__firstlineno__"):
                yield name.encode()
                yield self.digest(item, strict=False)

    def _code(self, code: types.CodeType) -> Iterator[bytes]:
        yield code.co_code
        for names in (code.co_names, code.co_varnames, code.co_freevars):
            yield " ".join(names).encode()
        for constant in code.co_consts:
            yield self.digest(constant)

    def _array(self, value: Any) -> Iterator[bytes]:
        if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            value = jax.random.key_data(value)
        array = np.asarray(value)
        yield f"{array.dtype} {array.shape}".encode()
        yield np.ascontiguousarray(array).tobytes()

    def _object(self, value: Any, strict: bool) -> Iterator[bytes]:
        foreign = _is_foreign(type(value).__module__)
        inside = [getattr(value, name) for name in _INSIDE if getattr(value, name, None) is not None]
        fields = {} if inside else dict(getattr(value, "__dict__", {}))
        slots = (name for c in type(value).__mro__ for name in getattr(c, "__slots__", ()))
        fields |= {n: getattr(value, n) for n in slots if not n.startswith("__") and hasattr(value, n)}
        if strict and not inside and not fields and not hasattr(value, "__dict__"):
            raise UnknownCodeError(f"a value of type {type(value).__module__}.{type(value).__qualname__}")
        for part in inside:
            yield self.digest(part, strict)
        if strict or foreign:
            for name, item in sorted(fields.items()):
                yield name.encode()
                yield self.digest(item, strict and foreign)
        yield from self._class(type(value))


def _names(code: types.CodeType) -> set[str]:
    """The globals (and attributes) that a code object and those inside it name."""
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return set(code.co_names).union(*(_names(one) for one in inner))
