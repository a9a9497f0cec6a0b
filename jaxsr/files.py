"""Files that appear whole or not at all, and what killed writers leave behind."""

import contextlib
import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path

from jaxsr.errors import JaxsrError

_TEMPORARY = re.compile(r"\..+\.\d+-\d+\.tmp")


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path` that replaces `path` when the block ends without an error."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as e:
        raise JaxsrError("cannot write", where=path, found=e.strerror or e, fix="check the folder") from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> int:
    """Delete what killed writers left in `folder` (names that `atomic_path` gives); returns how many."""
    leftovers = [p for p in Path(folder).glob(".*.tmp") if _TEMPORARY.fullmatch(p.name)]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return len(leftovers)
