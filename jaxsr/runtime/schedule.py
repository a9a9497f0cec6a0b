"""Which frames of a sequence count as rendered, and the frames as a method may see them.

The truth, and the colour of frames that are to be extrapolated, are never handed over.
"""

from collections.abc import Iterator

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.io.sequence import Sequence, prefetch
from jaxsr.methods import Method


def rendered_schedule(sequence: Sequence, every: int) -> list[bool]:
    """Which frames were rendered if only every n-th is, counted from each cut; the rest is extrapolated.

    Raises:
        JaxsrError: `every` is below 1.
    """
    if every < 1:
        raise JaxsrError("bad interval", where="every", expected="a whole number from 1", found=every)
    rendered, since_reset = [], 0
    for info in sequence.infos:
        since_reset = 0 if info.reset else since_reset
        rendered.append(since_reset % every == 0)
        since_reset += 1
    return rendered


def observed(sequence: Sequence, scale: int, every: int = 1) -> Iterator[Frame]:
    """The frames as a method may see them, read ahead in a thread."""
    schedule = rendered_schedule(sequence, every)
    return prefetch(sequence.frame(i, scale, rendered=rendered) for i, rendered in enumerate(schedule))


def check_needs(method: Method, sequence: Sequence, scale: int) -> None:
    """Say at once what a sequence lacks for a method.

    Raises:
        JaxsrError: the first frame has not all the buffers.
    """
    frame = sequence.frame(0, scale)
    buffers = {"lr": frame.lr._asdict(), "hr": frame.hr._asdict()}
    have = {"lr.color"}
    for place, layers in buffers.items():
        have |= {f"{place}.{_layer(name)}" for name, value in layers.items() if value is not None}
    missing = sorted(method.needs - have)
    if missing:
        raise JaxsrError(
            f"method {method.name!r} needs {', '.join(missing)}",
            where=sequence.path,
            found=", ".join(sorted(have)),
            fix="export these buffers, or choose a method that does without (jaxsr inspect lists them)",
        )
    cameras = all(info.has_camera for info in sequence.infos[:2])
    if cameras and "hr.motion" in method.needs and len(sequence) > 1 and not sequence.infos[1].reset:
        before, after = (np.asarray(info.world_from_view) for info in sequence.infos[:2])
        motion = np.asarray(sequence.frame(1, scale, rendered=False).hr.motion_px)
        if not motion.any() and not np.allclose(before, after, atol=1e-6):
            raise JaxsrError(
                "motion is zero everywhere, yet the camera moves",
                where=f"{sequence.path}, frame {sequence.infos[1].index}",
                expected="backward motion in pixels",
                fix="export motion vectors (see jaxsr inspect), or choose a method that does without",
            )


def _layer(field: str) -> str:
    return field.removesuffix("_linear").removesuffix("_px")
