"""Sequences in one small file, and back, with checksums.

The archive is a ZIP file (stored, readable by any tool) of `manifest.json` and one member per frame and
resolution. `manifest.json` holds each sequence's `sequence.json` word for word and the SHA-256 of every
member; `ARCHIVE.sha256` beside the archive holds that of the whole. The layers are quantised: the table in
`archive_coding.py` says how much. An archive takes 5 to 6 bytes per pixel (all layers) and decodes faster
than OpenEXR. The same sequences give the same bytes.

An archive may come from anywhere: nothing in it is compressed by ZIP, members are bounded by the sizes in the
manifest, planes are decompressed to exactly what these sizes need, and names cannot lead out of the folder.
"""

import contextlib
import hashlib
import json
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import (
    JSON_BYTES,
    atomic_path,
    file_digest,
    open_file,
    parse_json,
    read_bytes,
    read_json,
    remove_leftovers,
    write_text,
)
from jaxsr.io.archive_coding import CODES, decode_frame, encode_frame, largest_blob
from jaxsr.io.description import check_head, frame_info, has_hr
from jaxsr.io.exr import read_exr
from jaxsr.io.exr_header import MAX_PIXELS
from jaxsr.io.sequence import Sequence
from jaxsr.io.writing import FrameInfo, SequenceWriter, frame_file
from jaxsr.layers import LAYERS

FORMAT, VERSION = "jaxsr-archive", 1
_EPOCH = (1980, 1, 1, 0, 0, 0)
_ZIP_ERRORS = (OSError, ValueError, EOFError, RuntimeError, OverflowError, struct.error, zipfile.BadZipFile)
"""What zipfile raises for damaged, encrypted or foreign files."""


def _raw_layers(path: Path) -> dict[str, np.ndarray]:
    """The layers of a file that an archive keeps: all but position, which depth and camera give."""
    channels, _ = read_exr(path, pad=False)
    layers = {
        name: np.stack([channels[f"{name}.{c}"].astype(np.float32) for c in layer.letters], -1)
        for name, layer in LAYERS.items()
        if name != "position" and f"{name}.{layer.letters[0]}" in channels
    }
    for layer in ("depth", "motion"):
        if layer not in layers:
            raise JaxsrError(f"an archive needs the layer {layer!r}", where=path, found=", ".join(layers))
    for layer in layers:
        if layer not in CODES:
            raise JaxsrError(
                f"an archive cannot hold the layer {layer!r}", where=path, expected=", ".join(CODES)
            )
    return layers


def _images(
    infos: list[FrameInfo], resolutions: Iterable[str]
) -> Iterator[tuple[FrameInfo, FrameInfo, str, tuple[float, float]]]:
    """(frame, the one before, resolution, jitter) of every image, in the order of the archive."""
    for k, info in enumerate(infos):
        before = infos[k - 1] if k and not info.reset else info
        for resolution in resolutions:
            yield info, before, resolution, info.hr_jitter_px if resolution == "hr" else info.jitter_px


def pack(
    sequences: Mapping[str, Path],
    archive: Path,
    color_bits: int = 5,
    max_megabytes: float = 200.0,
    progress: Callable[[str, int], None] = lambda name, size: None,
) -> str:
    """Write the archive and its checksum file; returns the SHA-256 of the whole.

    Args:
        sequences: name in the archive ("train/bunker-train-0") -> folder.
        archive: the file to write.
        color_bits: mantissa bits kept of the colour, 1 to 10.
        max_megabytes: refuse to grow beyond.
        progress: called with the name and size of each member.

    Raises:
        JaxsrError: too large; a sequence that cannot be read, or that has what an archive does not hold.
    """
    manifest: dict[str, Any] = {
        "format": FORMAT, "version": VERSION, "color_bits": color_bits, "sequences": {}, "members": {},
    }  # fmt: skip
    total = 0
    remove_leftovers(archive.parent)
    with atomic_path(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as file:
        for name, folder in sequences.items():
            seq = Sequence.open(folder)
            manifest["sequences"][name] = read_json(folder / "sequence.json", dict)
            for info, before, resolution, jitter in _images(seq.infos, seq.resolutions):
                if info.world_from_view is None:
                    raise JaxsrError(f"an archive needs a camera for frame {info.index}", where=folder)
                layers = _raw_layers(frame_file(folder, resolution, info.index))
                blob = encode_frame(layers, info, before, jitter, color_bits)
                member = f"{name}/{resolution}/{info.index:04d}"
                file.writestr(zipfile.ZipInfo(member, _EPOCH), blob)
                manifest["members"][member] = hashlib.sha256(blob).hexdigest()
                total += len(blob)
                progress(member, len(blob))
                if total > max_megabytes * 1e6:
                    raise JaxsrError(
                        "the archive grows too large",
                        where=archive,
                        expected=f"at most {max_megabytes:g} MB",
                        found=f"{total / 1e6:.0f} MB with {name} unfinished",
                        fix="keep fewer bits of colour (--color-bits) or pack fewer sequences",
                    )
        file.writestr(zipfile.ZipInfo("manifest.json", _EPOCH), json.dumps(manifest, indent=1))
    digest = file_digest(archive)
    write_text(archive.with_name(archive.name + ".sha256"), f"{digest}  {archive.name}\n")
    return digest


def read_manifest(archive: Path) -> dict[str, Any]:
    """The manifest of an archive.

    Raises:
        JaxsrError: missing, not an archive of ours, another version, names that lead out of a folder.
    """
    with _opened(archive) as file:
        text = _read_member(file, archive, "manifest.json", JSON_BYTES)
    manifest = parse_json(text, f"{archive}, manifest.json", dict)
    if manifest.get("format") != FORMAT or manifest.get("version") != VERSION:
        found = f"{manifest.get('format')} {manifest.get('version')}"
        raise JaxsrError(
            "another kind of archive", where=archive, expected=f"{FORMAT} {VERSION}", found=found
        )
    for key in ("sequences", "members"):
        if not isinstance(manifest.get(key), dict):
            raise JaxsrError("damaged manifest", where=archive, expected=f'"{key}": {{...}}')
    for name, head in manifest["sequences"].items():
        check_head(head, f"{archive}, {name}")
        if not _stays_inside(name):
            raise JaxsrError(
                "unsafe name of a sequence", where=archive, expected="a relative path", found=repr(name)
            )
        width, height = head["size"]
        if width * height > MAX_PIXELS:
            raise JaxsrError(
                "the images are too large",
                where=f"{archive}, {name}",
                expected=f"at most {MAX_PIXELS} pixels",
                found=f"{width}x{height}",
            )
    return manifest


@contextlib.contextmanager
def _opened(archive: Path) -> Iterator[zipfile.ZipFile]:
    with open_file(archive) as stream:
        try:
            file = zipfile.ZipFile(stream)
        except (*_ZIP_ERRORS, KeyError) as e:
            raise JaxsrError("not an archive of a data set", where=archive, found=e) from e
        with file:
            yield file


def _read_member(file: zipfile.ZipFile, archive: Path, member: str, limit: int) -> bytes:
    """The bytes of a member that is stored as it is, and has at most `limit` of them."""
    try:
        info = file.getinfo(member)
    except KeyError as e:
        raise JaxsrError(f"no member {member!r}", where=archive, fix="fetch the archive again") from e
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > limit:
        stored = "stored" if info.compress_type == zipfile.ZIP_STORED else "compressed"
        raise JaxsrError(
            f"member {member!r} is not as jaxsr writes it",
            where=archive,
            expected=f"at most {limit} bytes, stored without compression",
            found=f"{info.file_size} bytes, {stored}",
        )
    try:
        return file.read(info)
    except _ZIP_ERRORS as e:
        raise JaxsrError(
            f"member {member!r} cannot be read", where=archive, found=e, fix="fetch the archive again"
        ) from e


def _stays_inside(name: str) -> bool:
    """Whether a name is a path below the folder that it is joined to, on every system, and can be shown."""
    if not name.isprintable():
        return False
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if path.anchor or not path.parts or ".." in path.parts:
            return False
    return True


def verify(archive: Path) -> None:
    """Compare the whole with ARCHIVE.sha256, where that exists.

    Raises:
        JaxsrError: they differ, or one cannot be read.
    """
    beside = archive.with_name(archive.name + ".sha256")
    if not beside.exists():
        return
    if read_bytes(beside, 4096).split()[:1] != [file_digest(archive).encode()]:
        raise JaxsrError("the checksum does not match", where=archive, expected=f"that of {beside.name}")


def unpack_sequence(
    archive: Path,
    manifest: Mapping[str, Any],
    name: str,
    folder: Path,
    more: Callable[[int], Mapping[str, np.ndarray]] | None = None,
) -> Path:
    """Write one sequence of the archive to a folder; resumes.

    Args:
        archive: the file.
        manifest: of it (`read_manifest`).
        name: of the sequence in the archive.
        folder: to write.
        more: index of a frame -> further HR layers, which lie beside the archive.

    Raises:
        JaxsrError: a member is missing or damaged.
    """
    head = manifest["sequences"][name]
    infos = [frame_info(entry, k, f"{archive}, {name}") for k, entry in enumerate(head["frames"])]
    writer = SequenceWriter(
        folder,
        name=head.get("name", Path(name).name),
        size=tuple(head["size"]),
        scales=head["scales"],
        hr=has_hr(head),
        fps=head.get("fps", 24.0),
        exposure=head.get("exposure", 1.0),
        license=head.get("license", ""),
        generator=head.get("generator", {})
        | {"quantised": f"{FORMAT} {VERSION}, {manifest.get('color_bits')} bits of colour"},
        precision={"motion": "float"},
    )
    images: dict[int, dict[str, dict[str, np.ndarray]]] = {}
    with _opened(archive) as file:
        for info, before, resolution, jitter in _images(infos, writer.resolutions):
            if writer.has(info.index):
                continue
            member = f"{name}/{resolution}/{info.index:04d}"
            scale = 1 if resolution == "hr" else int(resolution[1:])
            shape = (head["size"][1] // scale, head["size"][0] // scale)
            blob = _read_member(file, archive, member, largest_blob(shape))
            if hashlib.sha256(blob).hexdigest() != manifest["members"].get(member):
                raise JaxsrError(
                    f"member {member!r} is damaged", where=archive, fix="fetch the archive again"
                )
            images.setdefault(info.index, {})[resolution] = decode_frame(
                blob, shape, info, before, jitter, where=f"{archive}, member {member!r}"
            )
            if len(images[info.index]) == len(writer.resolutions):
                done = images.pop(info.index)
                if more is not None and "hr" in done:
                    done["hr"] |= more(info.index)
                writer.write_frame(info, done.pop("hr", None), {int(r[1:]): x for r, x in done.items()})
    writer.close()
    return folder
