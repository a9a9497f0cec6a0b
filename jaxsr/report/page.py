"""The comparison page: one HTML file with everything in it, which opens from disk and loads nothing else.

Images are embedded at the best quality that keeps the page below a size (`embedding.py`), and the page says
which that is and how large the error of the encoding is. Metrics on the page were measured before encoding;
error maps are computed in the browser from the embedded images.

The numbers are also in plain HTML tables, readable without JavaScript.
"""

import base64
import html
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path
from jaxsr.metrics import METRICS
from jaxsr.report.documents import json_value
from jaxsr.report.embedding import Images, thinned
from jaxsr.report.results import REGIONS, SequenceResult
from jaxsr.report.scores import Scores, groups, mean_scores, scores
from jaxsr.report.tables import rows

MAX_MEGABYTES = 18.0
"""Default target for the size of the page."""


def _keys(names: Iterable[str]) -> list[str]:
    """Short unique names for addresses: "Joint SR+FE" -> "joint-sr-fe"."""
    taken = {"truth", "input"}
    keys = []
    for name in names:
        base = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "method"
        key = next(k for n in range(1, 10_000) if (k := base if n == 1 else f"{base}-{n}") not in taken)
        taken.add(key)
        keys.append(key)
    return keys


def _section_data(section: SequenceResult, images: Images) -> dict[str, Any]:
    """What the viewer needs of one section."""

    def place(what: str, i: int) -> str:
        return f"{section.title}, {what}, frame {section.frames[i]}"

    truth = [images.add(image, place("truth", i)) for i, image in enumerate(section.truths)]
    shapes = {images.shapes[i] for i in truth}
    if len(shapes) != 1:
        raise JaxsrError("truth frames differ in size", where=section.title, found=sorted(shapes))
    (shape,) = shapes
    results = []
    for key, result in zip(_keys(t.name for t in section.methods), section.methods, strict=True):
        indices = [images.add(image, place(result.name, i)) for i, image in enumerate(result.images)]
        for i, index in enumerate(indices):
            if images.shapes[index] != shape:
                found = images.shapes[index]
                raise JaxsrError("wrong size", where=place(result.name, i), expected=shape, found=found)
        results.append(
            {
                "key": key,
                "name": result.name,
                "note": result.note,
                "images": indices,
                "flip": list(result.flip_maps),
                "metrics": result.metrics,
                "regions": result.regions,
            }
        )
    inputs = [
        None if image is None else images.add(image, place("input", i))
        for i, image in enumerate(section.inputs)
    ]
    sizes = {images.shapes[i] for i in inputs if i is not None}
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
        "tracks": results,
        "subsets": [[name, len(where)] for name, where in section.subsets().items()],
        "regions": section.regions(),
        "task": section.task,
    }


def _tables(sections: Sequence[SequenceResult]) -> str:
    """Every section, subset and region as an HTML table; the viewer shows one of them at a time."""
    return "\n".join(
        _table(scores(section, subset, region), f'data-section="{index}"')
        for index, section in enumerate(sections)
        for subset in section.subsets()
        for region in section.regions()
    )


def _means(sections: Sequence[SequenceResult]) -> str:
    """The means over the sections of a task, for each subset and region."""
    return "\n".join(
        _table(mean_scores(task, same, subset, region), f'data-task="{html.escape(task)}"')
        for task, same in groups(sections).items()
        for subset in same[0].subsets()
        for region in same[0].regions()
    )


def _table(table: Scores, place: str) -> str:
    columns, cells, marks = rows(table)
    first = 1 + len(table.keys)  # of the columns that are no metrics
    head = "".join(
        f'<th scope="col"{" class=time" if i == first else ""}>{html.escape(c)}</th>'
        for i, c in enumerate(columns)
    )
    body = []
    for one, line, mark in zip(table.lines, cells, marks, strict=True):
        note = f"<small>{html.escape(one.note)}</small>" if one.note else ""
        row = [f'<th scope="row" data-name="{html.escape(one.name)}">{html.escape(one.name)}{note}</th>']
        for i, (text, best) in enumerate(zip(line[1:], mark[1:], strict=True), 1):
            value, _, rest = html.escape(text).partition(" ")
            value = f'<b class="best">{value}<span class="vh"> (best)</span></b>' if best else value
            rest = f" <span>{rest}</span>" if rest else ""
            row.append(f"<td{' class=time' if i == first else ''}>{value}{rest}</td>")
        body.append("<tr>" + "".join(row) + "</tr>")
    return (
        f'<div class="result scroll" {place} data-subset="{html.escape(table.subset)}" '
        f'data-region="{html.escape(table.region)}">'
        f'<table class="data"><caption>{html.escape(table.title)} · {html.escape(table.about)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


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


def _uri(subtype: str, file: bytes) -> str:
    return f"data:image/{subtype};base64,{base64.b64encode(file).decode()}"


def _embed(payload: list[dict[str, Any]], images: Images, budget: float) -> tuple[list[str], str]:
    """Replace image numbers and FLIP files in the payload by positions in the list of data URIs returned.

    Frames that do not fit get null. Also returns a sentence about the encoding.
    """
    flips = sum(len(file) for s in payload for t in s["tracks"] for file in t["flip"]) * 4 / 3
    name, size = images.choose(max(budget - flips, budget / 2))
    total = sum(len(s["frames"]) for s in payload)
    for every in range(1, total + 1):
        for s in payload:
            s["embedded"] = thinned(s["extrapolated"], every)
        shown = sum(sum(s["embedded"]) for s in payload)
        if shown * (size + flips) <= total * budget:
            break
    for s in payload:
        of_methods = [(result, key) for result in s["tracks"] for key in ("images", "flip")]
        for holder, key in [(s, "truth"), (s, "input"), *of_methods]:
            if holder[key]:
                pairs = zip(holder[key], s["embedded"], strict=True)
                holder[key] = [what if here else None for what, here in pairs]
            else:
                holder[key] = None
    lists = [s[k] or [] for s in payload for k in ("truth", "input")]
    lists += [t["images"] for s in payload for t in s["tracks"]]
    files, about = images.encode(name, {i for some in lists for i in some if i is not None})
    subtype = "webp" if name.startswith("WebP") else "jpeg"
    uris = [_uri(subtype, file) for file in files.values()]
    position = {number: p for p, number in enumerate(files)}
    for some in lists:
        some[:] = [None if i is None else position[i] for i in some]
    for s in payload:
        for result in s["tracks"]:
            for i, file in enumerate(result["flip"] or []):
                if file is not None:
                    result["flip"][i] = len(uris)
                    uris.append(_uri("jpeg", file))
    if shown < total:
        about += f"; {shown} of {total} frames have images here, all have numbers"
    return uris, about


def write_report(
    path: Path | str,
    sections: Sequence[SequenceResult],
    *,
    title: str,
    meta: Mapping[str, Any] | None = None,
    fps: float = 4.0,
    max_megabytes: float = MAX_MEGABYTES,
) -> Path:
    """Write the comparison page of some sections as one self-contained HTML file.

    Args:
        path: the file to write; replaced atomically.
        sections: what to show; images display-referred in [0, 1], of one size in each section.
        title: heading and window title.
        meta: device, versions, commit, date, settings; shown as given, nested mappings flattened.
        fps: speed at which the page plays at first.
        max_megabytes: target for the size (10^6 bytes) of the page. It decides how images are encoded; where
            even JPEG is too large, only every n-th frame gets images.

    Returns:
        The path.

    Raises:
        JaxsrError: no sections, sizes that differ, images that are not display-referred, an unwritable path.
    """
    if not sections:
        raise JaxsrError("no sections to report", where=path)
    for what, value in (("max_megabytes", max_megabytes), ("fps", fps)):
        if not (math.isfinite(value) and value > 0):
            raise JaxsrError("must be a number above 0", where=what, found=value)
    images = Images()
    payload = [_section_data(section, images) for section in sections]
    uris, about = _embed(payload, images, max_megabytes * 1e6)
    keys = [k for k in METRICS if any(k in s.metric_keys() for s in sections)]
    fields = ("label", "unit", "higher_is_better", "digits")
    magma = colormaps["magma"](np.arange(256), bytes=True)[:, :3]
    data = {
        "sections": payload,
        "metrics": {k: {f: getattr(METRICS[k], f) for f in fields} for k in keys},
        "colormap": magma.tobytes().hex(),
        "fps": fps,
        "images": uris,
    }
    exposures = sorted({exposure for s in sections for exposure in s.exposures})
    shown = ", ".join(f"{e:g}" for e in exposures)
    if len(exposures) > 4:
        shown = f"{exposures[0]:g} to {exposures[-1]:g}, each frame its own"
    definitions = [
        (
            "Images",
            "display-referred. Linear colour (Rec. 709) is shown as sRGB(clip(ACES(colour × exposure))); "
            "PNG and JPEG frames are taken as they are",
        ),
        ("Exposure", shown),
        ("Crop", "none: all pixels count, borders included"),
        *((METRICS[k].label, METRICS[k].definition) for k in keys),
        *((r.capitalize(), REGIONS[r]) for r in REGIONS if any(r in s.regions() for s in sections)),
        ("Embedded as", about),
        (
            "Error maps",
            "|difference|: from the embedded images; FLIP: from the originals, stored as grey JPEG",
        ),
    ]
    known = dict(_flat(meta or {}))
    section_meta = [
        (f"{s.title} · {k}", v) for s in sections for k, v in _flat(s.meta) if k not in known or known[k] != v
    ]
    package = resources.files("jaxsr.report")
    parts = {
        "TITLE": html.escape(title),
        "CSS": package.joinpath("page.css").read_text("utf-8").strip(),
        "JS": package.joinpath("page.js").read_text("utf-8").strip(),
        "TABLES": _tables(sections),
        "MEANS": _means(sections),
        "META": _list([*_flat(meta or {}), *section_meta]),
        "DEFINITIONS": _list(definitions),
        # "</script>" or "<!--" inside a string would end or change the script element.
        "DATA": json.dumps(json_value(data), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
    }
    template = package.joinpath("page.html").read_text("utf-8")
    page = re.sub(r"@([A-Z]+)@", lambda m: parts[m[1]], template)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)
