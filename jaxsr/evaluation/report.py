"""The comparison page: one HTML file with everything in it, which opens from disk and asks for nothing else.

Images are embedded at the best quality that keeps the page below a size: lossless WebP, then lossless WebP
of values rounded to 7 or 6 bits, then JPEG without chroma subsampling. The page says which, and how large
the error of the encoding is. Metrics on the page were measured before encoding; error maps are computed in
the browser from the embedded images.

The numbers of a section are also in plain HTML tables, readable without JavaScript.
"""

import base64
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.tables import ImageOrPath, Section, json_value, rows, write_text
from jaxsr.metrics import METRICS

MAX_MEGABYTES = 18.0
"""Default aim for the size of the page."""


def to_bytes(image: ImageOrPath, where: str = "image") -> np.ndarray:
    """A display-referred image [H, W, 3] in [0, 1], or the file that holds one, as uint8 [H, W, 3].

    Raises:
        JaxsrError: unreadable file, wrong shape, NaN, values outside [0, 1].
    """
    if isinstance(image, Path):
        try:
            with Image.open(image) as file:
                return np.asarray(file.convert("RGB"))
        except (OSError, SyntaxError) as error:
            raise JaxsrError("cannot read the image", where=image, found=error) from error
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[-1] != 3:
        raise JaxsrError("not an RGB image", where=where, expected="[H, W, 3]", found=array.shape)
    if array.dtype == np.uint8:
        return array
    array = array.astype(np.float32)
    if not (float(array.min()) >= 0.0 and float(array.max()) <= 1.0):  # false for NaN too
        raise JaxsrError(
            "image is not display-referred",
            where=where,
            expected="values in [0, 1]",
            found=f"[{array.min():.4g}, {array.max():.4g}]",
        )
    return np.rint(array * 255.0).astype(np.uint8)


def _save(array: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, **options)
    return buffer.getvalue()


def _lossless(step: int) -> Callable[[np.ndarray], bytes]:
    def encode(image: np.ndarray) -> bytes:
        kept = (
            np.minimum(np.rint(image / np.float32(step)) * step, 255).astype(np.uint8) if step > 1 else image
        )
        return _save(kept, format="WEBP", lossless=True, method=2, quality=50, exact=True)

    return encode


def _jpeg(quality: int) -> Callable[[np.ndarray], bytes]:
    return lambda image: _save(image, format="JPEG", quality=quality, subsampling=0, optimize=True)


ENCODINGS: dict[str, tuple[str, Callable[[np.ndarray], bytes]]] = {
    "WebP, lossless (8 bits a channel)": ("webp", _lossless(1)),
    "WebP, lossless after rounding to 7 bits a channel": ("webp", _lossless(2)),
    "WebP, lossless after rounding to 6 bits a channel": ("webp", _lossless(4)),
    **{f"JPEG, quality {q}, 4:4:4": ("jpeg", _jpeg(q)) for q in (98, 95, 91, 85, 75)},
}
"""From best to smallest: name -> (image subtype, encoder of uint8 [H, W, 3])."""


def _flip_bytes(error: np.ndarray) -> bytes:
    """A FLIP map, uint8 [H, W], as a small grey JPEG; it is looked at, never measured."""
    return _save(error, format="JPEG", quality=70, optimize=True)


def _choose(images: Sequence[np.ndarray], budget: float) -> str:
    """The best encoding that is expected to stay within `budget` bytes of base64, from every n-th image."""
    sample = images[:: math.ceil(len(images) / 10)]
    area = sum(i.size for i in images) / sum(i.size for i in sample)
    for name, (_, encode) in ENCODINGS.items():
        if sum(len(encode(i)) for i in sample) * area * 4 / 3 <= budget:
            return name
    return name


class _Images:
    """Images of the page, each once: the truth is shared by tasks, inputs by methods."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.flips: list[np.ndarray] = []
        self._index: dict[tuple[tuple[int, ...], bytes], int] = {}

    def add(self, image: ImageOrPath | None, where: str) -> int | None:
        if image is None:
            return None
        array = to_bytes(image, where)
        key = (array.shape, hashlib.sha256(array.tobytes()).digest())
        if key not in self._index:
            self._index[key] = len(self.arrays)
            self.arrays.append(array)
        return self._index[key]

    def add_flip(self, error: np.ndarray) -> int:
        """FLIP maps are numbered from -1 downwards until the number of images is known."""
        self.flips.append(error)
        return -len(self.flips)


def _keys(names: Iterable[str]) -> list[str]:
    """Short unique names for addresses: "Joint SR+FE" -> "joint-sr-fe"."""
    taken = {"truth", "input"}
    keys = []
    for name in names:
        base = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "track"
        key = next(k for n in range(1, 10_000) if (k := base if n == 1 else f"{base}-{n}") not in taken)
        taken.add(key)
        keys.append(key)
    return keys


def _section_data(section: Section, images: _Images) -> dict[str, Any]:
    """What the viewer needs of one section."""

    def place(what: str, i: int) -> str:
        return f"{section.title}, {what}, frame {section.frames[i]}"

    truth = [images.add(image, place("truth", i)) for i, image in enumerate(section.truths)]
    shapes = {images.arrays[i].shape for i in truth if i is not None}
    if len(shapes) != 1:
        raise JaxsrError("truth frames differ in size", where=section.title, found=sorted(shapes))
    (shape,) = shapes
    tracks = []
    for key, track in zip(_keys(t.name for t in section.tracks), section.tracks, strict=True):
        indices = [images.add(image, place(track.name, i)) for i, image in enumerate(track.images)]
        for i, index in enumerate(indices):
            if index is None or images.arrays[index].shape != shape:
                found = None if index is None else images.arrays[index].shape
                raise JaxsrError("wrong size", where=place(track.name, i), expected=shape, found=found)
        flip = [images.add_flip(error) for error in track.flip_maps] or None
        tracks.append(
            {
                "key": key,
                "name": track.name,
                "note": track.note,
                "images": indices,
                "flip": flip,
                "metrics": track.metrics,
            }
        )
    inputs = [images.add(image, place("input", i)) for i, image in enumerate(section.inputs)] or None
    sizes = {images.arrays[i].shape for i in inputs or [] if i is not None}
    if len(sizes) > 1:
        raise JaxsrError("input frames differ in size", where=section.title, found=sorted(sizes))
    note = "".join(f"{w}×{h}, pixels enlarged" for h, w, _ in sizes if (h, w, 3) != shape)
    return {
        "title": section.title,
        "frames": section.frames,
        "extrapolated": [bool(x) for x in section.extrapolated] or [False] * len(section.frames),
        "size": [shape[1], shape[0]],
        "truth": truth,
        "input": inputs if sizes else None,
        "input_note": note,
        "tracks": tracks,
        "subsets": [[name, len(where)] for name, where in section.subsets().items()],
    }


def _tables(sections: Sequence[Section]) -> str:
    """Every section and subset as an HTML table; the viewer shows one of them at a time."""
    out = []
    for index, section in enumerate(sections):
        for subset, positions in section.subsets().items():
            columns, cells, marks = rows(section, subset)
            timing = len(columns) - 2 if any(t.timing for t in section.tracks) else len(columns)
            head = "".join(
                f'<th scope="col"{" class=time" if i == timing else ""}>{html.escape(c)}</th>'
                for i, c in enumerate(columns)
            )
            body = []
            for track, line, mark in zip(section.tracks, cells, marks, strict=True):
                note = f"<small>{html.escape(track.note)}</small>" if track.note else ""
                row = [f'<th scope="row">{html.escape(track.name)}{note}</th>']
                for i, (text, best) in enumerate(zip(line[1:], mark[1:], strict=True), 1):
                    value, _, rest = html.escape(text).partition(" ")
                    value = f'<b class="best">{value}<span class="vh"> (best)</span></b>' if best else value
                    rest = f" <span>{rest}</span>" if rest else ""
                    row.append(f"<td{' class=time' if i == timing else ''}>{value}{rest}</td>")
                body.append("<tr>" + "".join(row) + "</tr>")
            count = f"{len(positions)} frame{'s' if len(positions) != 1 else ''}"
            out.append(
                f'<div class="result scroll" data-section="{index}" data-subset="{html.escape(subset)}">'
                f'<table class="data"><caption>{html.escape(section.title)} · {subset}: {count}</caption>'
                f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
            )
    return "\n".join(out)


def _list(pairs: Iterable[tuple[str, object]]) -> str:
    items = (f"<dt>{html.escape(str(k))}</dt><dd>{html.escape(str(v))}</dd>" for k, v in pairs)
    return "<dl>" + "".join(items) + "</dl>"


def _flat(meta: Mapping[str, Any], prefix: str = "") -> list[tuple[str, object]]:
    out: list[tuple[str, object]] = []
    for key, value in meta.items():
        if isinstance(value, Mapping):
            out += _flat(value, f"{prefix}{key} · ")
        elif isinstance(value, list | tuple):
            out.append((f"{prefix}{key}", ", ".join(str(v) for v in value)))
        else:
            out.append((f"{prefix}{key}", value))
    return out


def _encode(images: _Images, budget: float) -> tuple[list[str], str]:
    """Data URIs of all images and then all FLIP maps, and a sentence about the encoding."""
    with ThreadPoolExecutor(4) as pool:
        flips = list(pool.map(_flip_bytes, images.flips))
        name = _choose(images.arrays, budget - sum(map(len, flips)) * 4 / 3)
        subtype, encode = ENCODINGS[name]
        files = list(pool.map(encode, images.arrays))
    worst, squares, count = 0, 0.0, 0
    for array, file in list(zip(images.arrays, files, strict=True))[:: math.ceil(len(files) / 10)]:
        with Image.open(io.BytesIO(file)) as decoded:
            error = np.asarray(decoded.convert("RGB")).astype(np.int32) - array
        worst, squares, count = (
            max(worst, int(abs(error).max())),
            squares + float((error**2).sum()),
            count + error.size,
        )
    rms = math.sqrt(squares / count)
    about = f"{name}; error of the encoding: "
    about += (
        "none beyond 8 bits" if worst == 0 else f"rms {rms:.2f}, at most {worst} of 255 (sample of frames)"
    )
    uris = [f"data:image/{subtype};base64,{base64.b64encode(f).decode()}" for f in files]
    uris += [f"data:image/jpeg;base64,{base64.b64encode(f).decode()}" for f in flips]
    return uris, about


def write_report(
    path: Path | str,
    sections: Sequence[Section],
    *,
    title: str,
    meta: Mapping[str, Any] | None = None,
    max_megabytes: float = MAX_MEGABYTES,
) -> Path:
    """Write the comparison page of some sections as one self-contained HTML file.

    Args:
        path: the file to write; replaced atomically.
        sections: what to show; images display-referred in [0, 1], truth and tracks of one size a section.
        title: heading and window title.
        meta: device, versions, commit, date, settings; shown as given, nested mappings flattened.
        max_megabytes: aim for the size (10^6 bytes) of the embedded images.

    Returns:
        The path.

    Raises:
        JaxsrError: no sections, sizes that differ, images that are not display-referred, an unwritable path.
    """
    if not sections:
        raise JaxsrError("no sections to report", where=path)
    images = _Images()
    payload = [_section_data(section, images) for section in sections]
    uris, about = _encode(images, max_megabytes * 1e6)
    for section_data in payload:
        for track in section_data["tracks"]:
            track["flip"] = [len(images.arrays) - 1 - i for i in track["flip"]] if track["flip"] else None
    keys = [k for k in METRICS if any(k in s.metric_keys() for s in sections)]
    fields = ("label", "unit", "higher_is_better", "digits")
    magma = colormaps["magma"](np.arange(256), bytes=True)[:, :3]
    data = {
        "sections": payload,
        "metrics": {k: {f: getattr(METRICS[k], f) for f in fields} for k in keys},
        "colormap": magma.tobytes().hex(),
        "images": uris,
    }
    exposures = sorted({s.exposure for s in sections})
    definitions = [
        (
            "Images",
            "display-referred: sRGB(clip(ACES(colour × exposure))), colour linear with Rec. 709 primaries",
        ),
        ("Exposure", ", ".join(f"{e:g}" for e in exposures)),
        ("Crop", "none: all pixels count, borders included"),
        *((METRICS[k].label, METRICS[k].definition) for k in keys),
        ("Embedded as", about),
        (
            "Error maps",
            "|difference|: from the embedded images; FLIP: from the originals, stored as grey JPEG",
        ),
    ]
    section_meta = [(f"{s.title} · {k}", v) for s in sections for k, v in _flat(s.meta)]
    package = resources.files("jaxsr.evaluation")
    parts = {
        "TITLE": html.escape(title),
        "CSS": package.joinpath("report.css").read_text("utf-8").strip(),
        "JS": package.joinpath("report.js").read_text("utf-8").strip(),
        "TABLES": _tables(sections),
        "META": _list([*_flat(meta or {}), *section_meta]),
        "DEFINITIONS": _list(definitions),
        # "</script>" or "<!--" inside a string would end or change the script element.
        "DATA": json.dumps(json_value(data), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
    }
    template = package.joinpath("report.html").read_text("utf-8")
    page = re.sub(r"@([A-Z]+)@", lambda m: parts[m[1]], template)
    write_text(Path(path), page)
    return Path(path)
