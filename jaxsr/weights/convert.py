"""Published weights become a file of ours: `torch` reads them, `names` translates names and layouts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flax import nnx

from jaxsr.errors import JaxsrError
from jaxsr.files import file_digest
from jaxsr.methods import variant
from jaxsr.weights.file import into, new_header, save_weights
from jaxsr.weights.names import PUBLISHED, method_of, translate
from jaxsr.weights.torch import read_published


def convert_published(
    source: Path,
    out: Path,
    method: str | None = None,
    *,
    scale: int | None = None,
    buffers: Sequence[str] | None = None,
    half: bool = False,
) -> dict[str, Any]:
    """Write the weights that `source` holds under published names to `out`, a file that `jaxsr` can use.

    Args:
        source: `.pth`, `.npz` or `.safetensors`; nothing in it is executed.
        out: ends in `.safetensors`; replaced if it exists.
        method: that the weights are for; by default the names of the arrays decide. Their shapes decide the
            variant of its network.
        scale: that they were trained for; not needed where the shapes tell. By default that of `PUBLISHED`.
        buffers: the G-buffer channels in the order of training, where they are not all in the paper's order.
        half: store float16.

    Returns:
        The header of the file: "method", its "settings", and more.

    Raises:
        JaxsrError: no such method, a file that cannot be read, or weights that do not fit the method.
    """
    if method is not None and method not in PUBLISHED:
        raise JaxsrError(
            f"no published weights of {method!r} are known",
            where="--method",
            expected="one of " + ", ".join(PUBLISHED),
        )
    if out.suffix != ".safetensors":
        raise JaxsrError("bad name for a file of weights", where=out, expected="it to end in .safetensors")
    published = read_published(source)
    method = method or method_of(published, source)
    arguments = PUBLISHED[method].arguments(published, buffers, source)
    trained = arguments.get("scale", scale or PUBLISHED[method].scale)
    if scale not in (None, trained):
        raise JaxsrError("the weights are of another scale", where=source, expected=scale, found=trained)
    network = variant(method, arguments).network
    assert network is not None  # `variant` knows only methods that learn
    net = nnx.eval_shape(lambda: network.new(nnx.Rngs(0)))
    state = into(nnx.state(net), translate(method, net, published, source), source)
    origin = {"file": source.name, "sha256": file_digest(source)}
    header = new_header(method, network.settings, trained, source=origin)
    save_weights(out, state, header, half=half)
    return header
