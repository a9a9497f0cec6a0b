"""One file per method: which buffers it needs, its two steps, and its loss if it learns."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxsr.errors import JaxsrError
from jaxsr.methods import fusion_sr, guided, guided_taau, guided_unet, interpolation, nsrr, rcan, rrn, taau
from jaxsr.methods.base import Method, Needs, Network, Windows, last_frames, module_maker
from jaxsr.methods.image_loss import ImageLoss, L1Loss
from jaxsr.methods.options import NoOptions, from_json, to_json


class Learned(NamedTuple):
    """How a method with a network is made: from its settings and the weights of its loss."""

    options: type
    """A frozen dataclass; a file of weights records its fields."""
    loss: type
    """A frozen dataclass; a training records its fields."""
    method: Callable[[Any, Any], Method]
    """`method(options, loss)`."""


LEARNED: dict[str, Learned] = {
    "fusion-sr": Learned(fusion_sr.Options, ImageLoss, fusion_sr.method),
    "guided-unet": Learned(guided_unet.Options, guided_unet.Loss, guided_unet.method),
    "rcan": Learned(rcan.Options, L1Loss, rcan.method),
    "rrn": Learned(rrn.Options, rrn.Loss, rrn.method),
    "nsrr": Learned(nsrr.Options, ImageLoss, nsrr.method),
}

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        interpolation.method("nearest"),
        interpolation.method("bilinear"),
        interpolation.method("bicubic"),
        taau.method(),
        guided.method(),
        guided_taau.method(),
        *(learned.method(learned.options(), learned.loss()) for learned in LEARNED.values()),
    )
}


def build(name: str, settings: Mapping[str, Any], where: object = None) -> Method:
    """The method with a network of that name, with the settings that a file of weights records.

    Args:
        name: one of `LEARNED`.
        settings: all of them, as `Network.settings` gives them.
        where: what an error names, such as the file.

    Raises:
        JaxsrError: there is no such method, or a setting is missing, unknown or wrong.
    """
    if name not in LEARNED:
        raise JaxsrError(
            f"no method {name!r} that learns", where=where, expected="one of " + ", ".join(LEARNED)
        )
    learned = LEARNED[name]
    options: Any = from_json(learned.options, settings, where)
    try:
        return learned.method(options, learned.loss())
    except JaxsrError as e:
        if where is None:
            raise
        raise JaxsrError(e.what, where=where, expected=e.expected, found=e.found, fix=e.fix) from e


def variant(name: str, changes: Mapping[str, Any]) -> Method:
    """The method with a network of that name, with some settings other than their defaults.

    Args:
        name: one of `LEARNED`.
        changes: as JSON values.

    Raises:
        JaxsrError: there is no such method, or a setting is unknown or wrong.
    """
    defaults = to_json(LEARNED[name].options()) if name in LEARNED else {}
    return build(name, defaults | dict(changes))


__all__ = [
    "LEARNED",
    "METHODS",
    "Learned",
    "Method",
    "Needs",
    "Network",
    "NoOptions",
    "Windows",
    "build",
    "from_json",
    "last_frames",
    "module_maker",
    "to_json",
    "variant",
]
