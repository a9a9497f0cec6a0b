"""One file a method: which buffers it needs, its step over a sequence, and its loss if it learns."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxsr.errors import JaxsrError
from jaxsr.methods import fusion_sr, guided, guided_taau, interpolation, nsrr, rcan, rrn, taau
from jaxsr.methods.base import Method


class Learned(NamedTuple):
    """How a method with a network is made: its options, and the method of them."""

    options: type
    method: Callable[[Any], Method]


LEARNED: dict[str, Learned] = {
    "fusion-sr": Learned(fusion_sr.Options, fusion_sr.method),
    "rcan": Learned(rcan.Options, rcan.method),
    "rrn": Learned(rrn.Options, rrn.method),
    "nsrr": Learned(nsrr.Options, nsrr.method),
}

METHODS: dict[str, Method] = {
    made.name: made
    for made in (
        interpolation.method("nearest"),
        interpolation.method("bilinear"),
        interpolation.method("bicubic"),
        taau.method(),
        guided.method(),
        guided_taau.method(),
        *(learned.method(learned.options()) for learned in LEARNED.values()),
    )
}


def build(name: str, arguments: Mapping[str, Any]) -> Method:
    """The learned method of that name with the arguments that a file of weights records.

    Raises:
        JaxsrError: no such method, or it has no such argument.
    """
    if name not in LEARNED:
        raise JaxsrError(f"no method {name!r} that learns", expected="one of " + ", ".join(LEARNED))
    learned = LEARNED[name]
    known = {field.name for field in dataclasses.fields(learned.options)}
    if unknown := sorted(set(arguments) - known):
        raise JaxsrError(
            f"method {name!r} has no argument {unknown[0]!r}",
            expected=", ".join(sorted(known)),
            fix="update jaxsr, or train again",
        )
    # JSON knows no tuples.
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in arguments.items()}
    return learned.method(learned.options(**values))


__all__ = ["LEARNED", "METHODS", "Learned", "Method", "build"]
