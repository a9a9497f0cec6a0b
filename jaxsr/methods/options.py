"""Settings of methods: frozen dataclasses, checked, and as JSON in files of weights.

A file of weights records every setting that its output depends on. Names that an earlier version of jaxsr
used are understood for ever (`upgrade`).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from jaxsr.errors import JaxsrError

Options = TypeVar("Options")

MAX_COUNT = 4096
"""No number of channels, blocks or frames is larger: a file could else ask for a network without end."""


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """The settings of a method, or of its loss, that has none."""


def check_options(options: Any) -> None:
    """See that each field of a dataclass of options has a value of its type.

    Files of weights and command lines can bring any value. Whole numbers are at most `MAX_COUNT`, other
    numbers are from 0 and finite.

    Raises:
        JaxsrError: it names the option, what was expected, and what was found.
    """
    for name, kind in get_type_hints(type(options)).items():
        value = getattr(options, name)
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, kind):  # type: ignore[arg-type]
                raise JaxsrError(f"bad {name}", where=name, expected="a group of settings", found=value)
            check_options(value)
            continue
        good, expected = _fits(value, kind)
        if not good:
            raise JaxsrError(f"bad {name}", where=name, expected=expected, found=value)


def _fits(value: Any, kind: Any) -> tuple[bool, str]:
    """Whether a value is of a type, and that type in words."""
    origin = get_origin(kind) or kind
    if origin is bool:
        return isinstance(value, bool), "true or false"
    if origin is int:
        return type(value) is int and 0 <= value <= MAX_COUNT, f"a whole number from 0 to {MAX_COUNT}"
    if origin is float:
        return type(value) in (int, float) and 0 <= value < math.inf, "a number from 0"
    if origin is str:
        return isinstance(value, str), "a name"
    if origin is Literal:
        choices = get_args(kind)
        return type(value) in map(type, choices) and value in choices, " | ".join(map(str, choices))
    if origin is tuple:
        item = get_args(kind)[0]
        good = isinstance(value, tuple) and all(_fits(v, item)[0] for v in value)
        return good, "a list of names" if item is str else "a list of whole numbers"
    raise TypeError(f"options of type {kind} are not supported")


def to_json(options: Any) -> dict[str, Any]:
    """A dataclass of options as JSON values, groups as nested objects."""
    return {field.name: _json(getattr(options, field.name)) for field in dataclasses.fields(options)}


def _json(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_json(value)
    return list(value) if isinstance(value, tuple) else value


def from_json(kind: type[Options], settings: Mapping[str, Any], where: object = None) -> Options:
    """The dataclass of these settings, all of which must be there.

    Args:
        kind: the dataclass.
        settings: as `to_json` gives them.
        where: what an error names.

    Raises:
        JaxsrError: settings that are unknown, missing, or of the wrong type.
    """
    hints = get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    unknown, missing = sorted(set(settings) - set(names)), [n for n in names if n not in settings]
    if unknown or missing:
        what = f"no setting {unknown[0]!r} is known" if unknown else f"the setting {missing[0]!r} is missing"
        raise JaxsrError(what, where=where, expected=", ".join(names), fix="update jaxsr, or train again")
    values: dict[str, Any] = {}
    for name in names:
        value = settings[name]
        if dataclasses.is_dataclass(hints[name]):
            if not isinstance(value, Mapping):
                raise JaxsrError(f"bad {name}", where=where, expected="an object", found=value)
            value = from_json(hints[name], value, where)
        values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)
