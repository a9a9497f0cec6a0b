"""Which HR colour of a sequence is the truth: the anti-aliased reference, or the aliased colour.

`reference` has many samples per pixel under a wide filter, as people want to see images. `color` is sampled
at the centre of each pixel, as the papers with HR G-buffers use it (docs/conventions.md).
"""

from collections.abc import Iterable
from typing import Literal, get_args

from jaxsr.errors import JaxsrError
from jaxsr.io.sequence import Sequence

Truth = Literal["reference", "color"]
"""A layer of the HR images that methods are measured against or trained on."""
TRUTHS: tuple[Truth, ...] = get_args(Truth)
"""The best one first."""


def lacking(sequence: Sequence, truth: Truth) -> int | None:
    """The first position whose frame has no such layer; None if all have it."""
    if not sequence.hr:
        return 0
    return next((i for i in range(len(sequence)) if truth not in sequence.layers("hr", i)), None)


def choose_truth(sequences: Iterable[Sequence], wanted: Truth | None = None) -> Truth:
    """The truth that all frames of all sequences have: the one that is asked for, else the best one.

    Raises:
        JaxsrError: `wanted` is not the name of a truth, or a frame lacks it; or a frame has none at all.
    """
    if wanted is not None and wanted not in TRUTHS:
        raise JaxsrError("bad truth", where="--truth", expected=" or ".join(TRUTHS), found=wanted)
    opened = list(sequences)
    missing: tuple[Sequence, int] | None = None
    for truth in TRUTHS if wanted is None else (wanted,):
        places = ((sequence, lacking(sequence, truth)) for sequence in opened)
        missing = next(((sequence, i) for sequence, i in places if i is not None), None)
        if missing is None:
            return truth
    assert missing is not None
    sequence, i = missing
    raise JaxsrError(
        f"frame {sequence.infos[i].index} has no truth",
        where=sequence.path,
        expected=f"layer {wanted or 'reference or color'} in hr/",
        fix="render it"
        + (" (jaxsr render --reference-samples)" if wanted == "reference" else "")
        + ", or use `jaxsr upscale`, which needs none",
    )
