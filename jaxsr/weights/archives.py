"""Bounded reading of files of weights: regular files, and ZIP archives (`.pth`, `.npz`) by their members."""

import contextlib
import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

from jaxsr.errors import JaxsrError
from jaxsr.files import open_file

FILE_BYTES = 2 << 30
"""Of a file of weights. The networks here take at most 60 MB; a checkpoint of PyTorch has several copies."""
EXPANSION = 6
"""What is read and its arrays as float32 take at most so many times the bytes of the file: float32 takes
twice, float16 three times, int8 five times. More only comes of a file that is made to fill the memory."""
SMALL_BYTES = 64 << 20
"""Arrays of so many bytes are read whatever the size of the file: zeros compress well."""
DIRECTORY_BYTES = 4 << 20
"""Of the directory of a ZIP archive, which is read as a whole: enough for 40,000 tensors."""


def check_file(path: Path) -> int:
    """The size of a file of weights, in bytes.

    Raises:
        JaxsrError: no such file, a folder, a pipe, no permission, or too large.
    """
    if not os.path.lexists(path):
        raise JaxsrError("no such file of weights", where=path)
    if path.is_dir():
        raise JaxsrError("a folder, not a file of weights", where=path)
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
    if size > FILE_BYTES:
        raise JaxsrError(
            "too large for a file of weights", where=path, expected=f"at most {FILE_BYTES} bytes", found=size
        )
    return size


class Budget:
    """What the arrays of one file may still take, in bytes."""

    def __init__(self, file_bytes: int):
        self.left = self.limit = max(SMALL_BYTES, EXPANSION * file_bytes)

    def spend(self, size: int) -> None:
        """Raise ValueError where the arrays so far and `size` more bytes are too much."""
        self.left -= size
        if self.left < 0:
            raise ValueError(f"arrays of more than {self.limit} bytes, which a file of this size cannot hold")


@contextlib.contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """The ZIP archive at `path`.

    Raises:
        JaxsrError: as `check_file`.
        zipfile.BadZipFile: no archive, or a damaged one.
        ValueError: a directory that is too large.
    """
    check_file(path)
    with _Reader(open_file(path).detach()) as file:
        file.limit = DIRECTORY_BYTES
        with zipfile.ZipFile(file) as archive:
            file.limit = FILE_BYTES
            yield archive


class _Reader(io.BufferedReader):
    """A file with a limit for one read: `zipfile` reads the directory in one piece, whatever its size."""

    limit = FILE_BYTES

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size > self.limit:
            raise ValueError(f"a directory of {size} bytes, more than {self.limit}")
        return super().read(size)


def read_member(archive: zipfile.ZipFile, name: str, budget: Budget) -> bytes:
    """The bytes of a member, at most as many as the directory says.

    Raises:
        KeyError: no such member.
        ValueError: beyond the budget.
        zipfile.BadZipFile: damaged, or of another size.
    """
    size = archive.getinfo(name).file_size
    budget.spend(size)
    with archive.open(name) as member:  # `read` without a size would inflate everything before it looks
        content = member.read(size)
        member.read(1)
    if len(content) != size:
        raise zipfile.BadZipFile(f"{name} has {len(content)} bytes, not {size}")
    return content
