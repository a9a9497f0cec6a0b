"""Files and folders that appear whole or not at all, bounded reading of small files, digests.

Whatever lies at a path that a user names may be a folder, a named pipe, or something far too large. The
readers here answer each of these with one `JaxsrError`, never with a hang or with all of the memory.
"""

import contextlib
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import Any

from jaxsr.errors import JaxsrError

JSON_BYTES = 32 << 20
"""Largest JSON text that is read: ten thousand frames of a sequence need about half of it."""
JSON_DEPTH = 64
"""Deepest nesting of JSON that is read; the deepest that jaxsr writes is about 8."""
_INTEGER_DIGITS = 40  # 128 bits, as the states of random generators have
ABANDONED_SECONDS = 24 * 3600.0
"""A temporary file that nobody has touched for so long has no writer any more."""
_TEMPORARY = re.compile(r"\..+\.((?P<host>[0-9a-f]{8})-)?(?P<process>\d+)-\d+\.tmp")
_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


# --- reading ---------------------------------------------------------------------------------------------


def open_file(path: str | Path) -> BufferedReader:
    """Open a regular file for reading bytes; never waits, as opening a named pipe would.

    Raises:
        JaxsrError: nothing there, a folder, a pipe or a device, or no permission.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except IsADirectoryError:  # Windows: it opens no folders
        raise JaxsrError("is a folder", where=path, expected="a file") from None
    except FileNotFoundError:
        raise JaxsrError("no such file", where=path) from None
    except (OSError, ValueError) as e:
        if Path(path).is_dir():
            raise JaxsrError("is a folder", where=path, expected="a file") from None
        raise JaxsrError("cannot be read", where=path, found=getattr(e, "strerror", None) or e) from e
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise JaxsrError("is a folder", where=path, expected="a file")
    found = next((name for test, name in _KINDS if test(mode)), "something else")
    raise JaxsrError("is not a regular file", where=path, expected="a file", found=found)


def read_bytes(path: str | Path, limit: int = JSON_BYTES) -> bytes:
    """All bytes of a regular file that has at most `limit` of them.

    Raises:
        JaxsrError: as `open_file`; too large; a failing disk.
    """
    with open_file(path) as file:
        try:
            data = file.read(limit + 1)
            size = os.fstat(file.fileno()).st_size
        except OSError as e:
            raise JaxsrError("cannot be read", where=path, found=e.strerror or e) from e
    if len(data) > limit:
        raise JaxsrError(
            "the file is too large", where=path, expected=f"at most {limit} bytes", found=max(size, len(data))
        )
    return data


def read_json(path: str | Path, kind: type | None = None, limit: int = JSON_BYTES) -> Any:
    """The value in a JSON file: `parse_json` of `read_bytes`.

    Args:
        path: a regular file of UTF-8 text.
        kind: `dict` or `list`, where only that is right.
        limit: bytes of the file at most.

    Raises:
        JaxsrError: as `read_bytes` and `parse_json`.
    """
    return parse_json(read_bytes(path, limit), path, kind, limit)


def parse_json(text: str | bytes, where: object, kind: type | None = None, limit: int = JSON_BYTES) -> Any:
    """The value of a JSON text, in bounded time and memory.

    NaN, Infinity, numbers that overflow to them (1e999) and integers of more than 40 digits are refused, so
    that callers only have to check ranges.

    Args:
        text: the text, or its bytes in UTF-8 (with or without a byte order mark).
        where: file or place that errors name.
        kind: `dict` or `list`, where only that is right.
        limit: length of the text at most.

    Raises:
        JaxsrError: not UTF-8, not JSON, nested deeper than `JSON_DEPTH`, too long, a number that is refused,
            or another kind of value.
    """
    if len(text) > limit:
        raise JaxsrError("the JSON is too long", where=where, expected=f"at most {limit}", found=len(text))
    try:
        decoded = text.decode("utf-8-sig") if isinstance(text, bytes) else text.removeprefix("\ufeff")
        value = json.loads(
            decoded, parse_constant=_refuse_constant, parse_float=_finite_float, parse_int=_short_int
        )
    except RecursionError:
        raise _too_deep(where) from None
    except UnicodeDecodeError as e:
        raise JaxsrError("the text is not UTF-8", where=where, found=e.reason) from e
    except ValueError as e:  # JSONDecodeError, and the refusals below
        raise JaxsrError("bad JSON", where=where, found=e) from e
    _check_depth(value, where)
    if "\\u" in decoded:
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except UnicodeEncodeError as e:  # half of a pair, which no file or terminal can show
            raise JaxsrError("bad JSON", where=where, found="an incomplete \\u escape") from e
    if kind is not None and not isinstance(value, kind):
        names: dict[type, str] = {dict: "an object {...}", list: "a list [...]"}
        found = type(value).__name__
        raise JaxsrError("bad JSON", where=where, expected=names.get(kind, kind.__name__), found=found)
    return value


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text}, where a finite number is needed")


def _finite_float(text: str) -> float:
    value = float(text)
    if value - value != 0:
        raise ValueError(f"{text[:40]}, which is too large")
    return value


def _short_int(text: str) -> int:
    if len(text) > _INTEGER_DIGITS:
        raise ValueError(f"an integer of {len(text)} digits")
    return int(text)


def _check_depth(value: Any, where: object) -> None:
    level: list[Any] = [value]
    for _ in range(JSON_DEPTH + 1):
        inner = (x for x in level if isinstance(x, dict | list))
        level = [y for x in inner for y in (x.values() if isinstance(x, dict) else x)]
        if not level:
            return
    raise _too_deep(where)


def _too_deep(where: object) -> JaxsrError:
    return JaxsrError("the JSON is nested too deep", where=where, expected=f"at most {JSON_DEPTH} levels")


# --- digests ---------------------------------------------------------------------------------------------


def file_digest(path: str | Path) -> str:
    """SHA-256 of a regular file, in hexadecimal digits; the file is never whole in memory."""
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(parts: Iterable[bytes]) -> str:
    """SHA-256 over the SHA-256 of each part, so that bytes cannot move from one part to the next."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()


# --- writing ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path` that replaces `path` when the block ends without an error.

    Raises:
        JaxsrError: an OSError of the block, such as a full disk.
    """
    path = Path(path)
    temporary = _temporary_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as e:
        raise _cannot_write(path, temporary, e, "check the folder") from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(path: Path, fix: str = "check the folder") -> Iterator[Path]:
    """A new temporary folder that becomes `path` when the block ends without an error.

    If `path` is a folder with content by then, because another process made the same one, it stays as it is
    and the temporary folder is deleted.

    Raises:
        JaxsrError: an OSError of the block, such as a full disk; it tells the user to `fix`.
    """
    path = Path(path)
    temporary = _temporary_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        yield temporary
        try:
            temporary.rename(path)
        except OSError:
            if not path.is_dir():
                raise
    except OSError as e:
        raise _cannot_write(path, temporary, e, fix) from e
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _cannot_write(path: Path, temporary: Path, error: OSError, fix: str) -> JaxsrError:
    found = str(error.strerror or error)
    other = Path(error.filename) if isinstance(error.filename, str) else path
    if other not in (path, path.parent, temporary) and temporary not in other.parents:
        found = f"{found} ({other})"  # the block reads or writes something else, too
    return JaxsrError("cannot write", where=path, found=found, fix=fix)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically.

    Raises:
        JaxsrError: it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# --- what killed writers leave behind --------------------------------------------------------------------


def remove_leftovers(folder: Path) -> int:
    """Delete the temporary files and folders in `folder` whose writers are dead; returns how many.

    Only names that `atomic_path` and `atomic_folder` give count. A writer is dead if its process ran on this
    machine and is gone, or, where that cannot be told, if nothing was written for `ABANDONED_SECONDS`.
    """
    count = 0
    for path in Path(folder).glob(".*.tmp"):
        named = _TEMPORARY.fullmatch(path.name)
        if named is None or not _is_abandoned(path, named["host"], int(named["process"])):
            continue
        with contextlib.suppress(OSError):  # another process deletes it at the same time
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            count += 1
    return count


def _temporary_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{threading.get_ident()}.tmp")


@cache
def _host() -> str:
    """A short name of this machine or, inside a container, of its own table of processes."""
    try:
        processes = str(Path("/proc/self/ns/pid").readlink())
    except OSError:  # not Linux
        processes = ""
    return hashlib.sha256(f"{platform.node()} {processes}".encode()).hexdigest()[:8]


def _is_abandoned(path: Path, host: str | None, process: int) -> bool:
    if host in (None, _host()) and not _is_alive(process):  # versions up to 0.1 named no host
        return True
    try:
        inside = path.rglob("*") if path.is_dir() else ()
        touched = max(p.lstat().st_mtime for p in (path, *inside))
    except OSError:  # it was renamed in this moment: its writer is alive
        return False
    return time.time() - touched > ABANDONED_SECONDS


def _is_alive(process: int) -> bool:
    if os.name == "nt":
        return True  # there, signal 0 would end the process
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it belongs to someone else
        pass
    return True
