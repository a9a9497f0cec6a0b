"""The rendered sample that ships with the package: three scenes, a test and a training clip of each.

It is stored as one archive per scene and split (`jaxsr.io.archive`), since OpenEXR would take several times
the space, and is unpacked to ordinary sequences where it is used. docs/data_card.md describes it.
"""

import hashlib
import importlib.resources
from pathlib import Path
from typing import Any

import jaxsr
from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_folder, remove_leftovers
from jaxsr.io.archive import read_manifest, unpack_sequence
from jaxsr.io.sequence import Sequence
from jaxsr.progress import Progress, silent

SPLITS = ("test", "train")


def sample_folder() -> Path:
    """The folder of the archives inside the package."""
    return Path(str(importlib.resources.files(jaxsr) / "sample"))


def sample_scenes() -> list[str]:
    """Names of the scenes.

    Raises:
        JaxsrError: the package was installed without its sample.
    """
    scenes = sorted({path.stem.rpartition("-")[0] for path in sample_folder().glob("*.jsrz")})
    if not scenes:
        raise JaxsrError("the sample is missing", where=sample_folder(), fix="reinstall jaxsr")
    return scenes


def unpack_sample(
    out: Path,
    split: str,
    scenes: tuple[str, ...] = (),
    scale: int | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Unpack the sequences of a split to `out/<name>`; what is there already is kept.

    A sequence appears under its name when it is whole, so that processes may unpack to the same folder at
    the same time.

    Args:
        split: "test" or "train".
        scenes: names; all by default.
        scale: one that the sequences must have.
        progress: told of each sequence.

    Returns:
        The folders, one per sequence.

    Raises:
        JaxsrError: no such scene, split or scale, no sample, a damaged archive, or no room.
    """
    known = sample_scenes()
    unknown = sorted(set(scenes) - set(known))
    if unknown:
        raise JaxsrError(f"no scene {unknown[0]!r} in the sample", expected=", ".join(known))
    found = []
    for scene in dict.fromkeys(scenes or known):
        archive = sample_folder() / f"{scene}-{split}.jsrz"
        if not archive.is_file():
            raise JaxsrError(
                "no such part of the sample", where="split", expected=" or ".join(SPLITS), found=split
            )
        manifest = read_manifest(archive)
        found += [(archive, manifest, name) for name in manifest["sequences"]]
    for archive, manifest, name in found:
        scales = manifest["sequences"][name]["scales"]
        if scale is not None and scale not in scales:
            raise JaxsrError(f"scale {scale} is not available", where=archive, expected=f"one of {scales}")
    advance = progress("unpack", len(found))
    folders = []
    for archive, manifest, name in found:
        folders.append(out / Path(name).name)
        _unpack(archive, manifest, name, folders[-1])
        advance()
    remove_leftovers(out)
    return folders


def _unpack(archive: Path, manifest: dict[str, Any], name: str, folder: Path) -> None:
    if _is_whole(folder, manifest["sequences"][name]):
        return
    if folder.exists():  # a part of it, as versions up to 0.1 left it when they were killed
        unpack_sequence(archive, manifest, name, folder)
        return
    with atomic_folder(folder) as temporary:
        unpack_sequence(archive, manifest, name, temporary)


def _is_whole(folder: Path, head: dict[str, Any]) -> bool:
    """Whether the folder holds a sequence of these frames and sizes; its pixels are not looked at."""
    try:
        found = Sequence.open(folder)
    except JaxsrError:
        return False
    indices = [info.index for info in found.infos]
    expected = [frame["index"] for frame in head["frames"]]
    return (indices, list(found.size), list(found.scales)) == (expected, head["size"], head["scales"])


def unpack_to_cache(
    cache: Path, split: str, scale: int | None = None, progress: Progress = silent
) -> list[Path]:
    """Unpack a split of the sample below the folder `cache`, once for each release of the sample.

    Returns:
        The folders, one per sequence.

    Raises:
        JaxsrError: as `unpack_sample`.
    """
    archives = (path.read_bytes() for path in sorted(sample_folder().glob("*.jsrz.sha256")))
    folder = cache / f"sample-{hashlib.sha256(b''.join(archives)).hexdigest()[:12]}"
    return unpack_sample(folder, split, scale=scale, progress=progress)
