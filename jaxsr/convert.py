"""Published weights to a file of ours: reading (`io`), names and layouts (`nets`), the method (`methods`)."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flax import nnx

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.io.published import read_published
from jaxsr.io.weights import into, save_weights
from jaxsr.methods import build
from jaxsr.nets.published import PUBLISHED, translate


def convert_published(
    source: Path,
    out: Path,
    method: str = "fusion-sr",
    *,
    scale: int = 4,
    buffers: Sequence[str] | None = None,
    half: bool = False,
) -> dict[str, Any]:
    """Write the weights that `source` holds under published names to `out`, a file that `jaxsr` can use.

    Args:
        source: `.pth`, `.npz` or `.safetensors`; nothing in it is executed.
        out: ends in `.safetensors`; replaced if it exists.
        method: that the weights are for; the variant of its network is read off their shapes.
        scale: that they were trained for; the shapes do not tell.
        buffers: the G-buffer channels in the order of training, where they are not all in the paper's order.
        half: store float16.

    Returns:
        The method's arguments, as the header records them.

    Raises:
        JaxsrError: no such method, a file that cannot be read, or weights that do not fit the method.
    """
    if method not in PUBLISHED:
        raise JaxsrError(
            f"no published weights of {method!r} are known",
            where="--method",
            expected="one of " + ", ".join(PUBLISHED),
        )
    if out.suffix != ".safetensors":
        raise JaxsrError("bad name for a file of weights", where=out, expected="it to end in .safetensors")
    published = read_published(source)
    arguments = PUBLISHED[method].arguments(published, buffers, source)
    new_net = build(method, arguments).new_net
    assert new_net is not None  # `build` knows only methods that learn
    net = nnx.eval_shape(lambda: new_net(nnx.Rngs(0)))
    state = into(nnx.state(net), translate(method, net, published, source), source)
    header = {
        "method": method,
        "arguments": arguments,
        "scale": scale,
        "jaxsr": jaxsr.__version__,
        "source": {"file": source.name, "sha256": hashlib.sha256(source.read_bytes()).hexdigest()},
    }
    save_weights(out, state, header, half=half)
    return arguments
