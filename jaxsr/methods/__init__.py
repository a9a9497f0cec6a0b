"""One file a method: which buffers it needs, and its step over a sequence."""

from jaxsr.methods import guided, guided_taau, interpolation, taau
from jaxsr.methods._method import Method

METHODS: dict[str, Method] = {
    made.name: made
    for made in (
        interpolation.method("nearest"),
        interpolation.method("bilinear"),
        interpolation.method("bicubic"),
        taau.method(),
        guided.method(),
        guided_taau.method(),
    )
}

__all__ = ["METHODS", "Method"]
