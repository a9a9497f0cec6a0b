"""What a training asks of its process: to be the only one in its folder, and to end after a whole step."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxsr.errors import JaxsrError


@contextlib.contextmanager
def only_one(out: Path) -> Iterator[None]:
    """A lock on the folder, which the system releases when the process ends, however it ends.

    Raises:
        JaxsrError: another process trains in this folder.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with (out / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            raise JaxsrError(
                "another process trains in this folder", where=out, fix="wait for it, or choose another --out"
            ) from e
        yield


@contextlib.contextmanager
def first_interrupt() -> Iterator[list[int]]:
    """A list that is empty until the first Ctrl-C or SIGTERM; the second raises KeyboardInterrupt at once."""
    stop: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handle(number: int, frame: Any) -> None:
        if stop:
            raise KeyboardInterrupt
        stop.append(number)
        # Not through rich: the interrupt may have come while rich holds its lock.
        os.write(2, b"\nstopping after this step; once more stops at once\n")

    old = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
