"""Which sequences lie at the places that a command line names."""

from collections.abc import Iterable
from pathlib import Path

from jaxsr.errors import JaxsrError

DEPTH = 3
"""How far below a folder sequences are looked for."""


def find_sequences(places: Iterable[str | Path]) -> list[Path]:
    """Folders of sequences, each once, in the order given.

    Args:
        places: sequences, or folders that hold some, at one depth; these come in the order of their names.

    Raises:
        JaxsrError: no such folder; none in it; none at all.
    """
    found: list[Path] = []
    for place in map(Path, places):
        folder = place.parent if place.name == "sequence.json" else place
        if not folder.is_dir():
            raise JaxsrError("no such folder", where=folder, expected="a sequence, or a folder of sequences")
        levels = (sorted(folder.glob("*/" * depth + "sequence.json")) for depth in range(DEPTH + 1))
        inside = next(filter(None, levels), [])
        if not inside:
            raise JaxsrError(
                "no sequence in the folder",
                where=folder,
                expected="a file sequence.json in it, or in folders in it",
                fix="docs/data.md says how to make one",
            )
        found += [file.parent for file in inside]
    if not found:
        raise JaxsrError("no sequences", fix="name at least one folder")
    once: dict[Path, Path] = {}
    for path in found:
        once.setdefault(path.resolve(), path)
    return list(once.values())
