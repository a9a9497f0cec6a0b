"""Which frames of a sequence count as rendered, and the frames as a method may see them.

The truth, and the colour of frames that are to be extrapolated, are never handed over.
"""

import functools
from collections.abc import Callable, Iterator

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.io.sequence import Sequence, prefetch
from jaxsr.layers import DERIVED
from jaxsr.methods import Method


def rendered_schedule(sequence: Sequence, every: int) -> list[bool]:
    """Which frames were rendered if only every n-th is, counted from each reset; the rest is extrapolated.

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


def readers(sequence: Sequence, method: Method, scale: int, every: int = 1) -> list[Callable[[], Frame]]:
    """One function per frame, which reads it as the method may see it: with the buffers that it needs.

    The camera is None unless that of all frames is known, so that all frames have the same structure.
    """
    schedule = rendered_schedule(sequence, every)
    needs = {rendered: method.needs.of(rendered, not all(schedule)) for rendered in (True, False)}
    cameras = all(info.has_camera for info in sequence.infos)

    def read(i: int, rendered: bool) -> Frame:
        frame = sequence.frame(i, scale, rendered=rendered, needs=needs[rendered])
        return frame if cameras else frame._replace(camera=None)

    return [functools.partial(read, i, rendered) for i, rendered in enumerate(schedule)]


def observed(sequence: Sequence, method: Method, scale: int, every: int = 1) -> Iterator[Frame]:
    """The frames as a method may see them, read ahead in a thread."""
    return prefetch(read() for read in readers(sequence, method, scale, every))


def available(sequence: Sequence, scale: int) -> frozenset[str]:
    """The buffers that frames can have, by place and layer, from the headers of the first frame's files."""
    have = {f"lr.{layer}" for layer in sequence.layers("hr" if scale == 1 else f"x{scale}")}
    if scale > 1 and have >= {f"lr.{layer}" for layer in DERIVED}:
        have |= {f"hr.{layer}" for layer in DERIVED}
    if sequence.hr:
        have |= {f"hr.{layer}" for layer in sequence.layers("hr")}
    return frozenset(have)


def check_needs(method: Method, sequence: Sequence, scale: int, every: int = 1) -> None:
    """Say at once what a sequence lacks for a method, from the headers of its first files.

    Raises:
        JaxsrError: the first frame does not have all the buffers, the HR ones are jittered and the method
            does not account for it, or motion is zero where the camera moves.
    """
    needs = method.needs.of(True, every > 1)
    have = available(sequence, scale)
    missing = sorted(needs - have)
    if missing:
        raise JaxsrError(
            f"method {method.name!r} needs {', '.join(missing)}",
            where=sequence.path,
            found=", ".join(sorted(have)),
            fix="export these buffers, or choose a method that does without (jaxsr inspect lists them)",
        )
    if method.needs.refuses_hr_jitter and any(any(info.hr_jitter_px) for info in sequence.infos):
        raise JaxsrError(
            f"method {method.name!r} does not account for jittered HR buffers",
            where=sequence.path,
            expected="hr_jitter_px 0 in all frames",
            fix="use guided-taau, or export HR buffers without jitter",
        )
    cameras = all(info.has_camera for info in sequence.infos[:2])
    if cameras and "hr.motion" in needs and len(sequence) > 1 and not sequence.infos[1].reset:
        before, after = (np.asarray(info.world_from_view) for info in sequence.infos[:2])
        frame = sequence.frame(1, scale, rendered=False, needs=frozenset({"hr.motion"}))
        still = np.allclose(before, after, atol=1e-6)
        if not np.asarray(frame.hr.motion_px).any() and not still:
            raise JaxsrError(
                "motion is zero everywhere, yet the camera moves",
                where=f"{sequence.path}, frame {sequence.infos[1].index}",
                expected="backward motion in pixels",
                fix="export motion vectors (see jaxsr inspect), or choose a method that does without",
            )
