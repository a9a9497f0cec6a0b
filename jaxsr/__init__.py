"""jaxsr: super-resolution and frame extrapolation for rendered images, guided by G-buffers, in JAX.

    up = jaxsr.load("guided-taau", scale=4)
    frame = jaxsr.Frame.of(color=color, depth=depth, motion=motion, jitter=(0.25, -0.1), hr={...})
    state = up.init(frame)
    image, state = up(frame, state)

`jaxsr.ops` holds the functions that the methods are made of. JAX is imported when one of these names is first
used: parts of jaxsr run in a renderer's own Python, which has no JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxsr.errors import JaxsrError

if TYPE_CHECKING:
    from jaxsr.frames import Camera, Frame, GBuffer
    from jaxsr.runtime.upscaler import load

__version__ = "0.1.0"

__all__ = ["Camera", "Frame", "GBuffer", "JaxsrError", "__version__", "load"]

_HOMES = {
    "Camera": "jaxsr.frames",
    "Frame": "jaxsr.frames",
    "GBuffer": "jaxsr.frames",
    "load": "jaxsr.runtime.upscaler",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxsr' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
