"""One image of a sequence in few bytes: quantisation, then lossless coding of integer planes.

The output of `decode_frame` differs from the input of `encode_frame` by at most this:

| layer | stored as | error |
|---|---|---|
| color, reference | half float, mantissa of `color_bits` | relative 2^-(color_bits + 1); negatives become 0 |
| depth | 16-bit logarithm between the image's extremes, 65535 for sky | relative (log range) / 131068 |
| motion | difference from the camera's motion at that depth, in steps of 1/64 pixel | 1/128 pixel |
| normal | octahedral, 8 bits per coordinate | 0.95 degrees |
| base_color | 8 bits, sRGB curve, clipped to [0, 1] | half a step |
| roughness, metallic | 8 bits, linear | 1/510 |
| object_id | exact | 0 |

World position is not stored: it is rebuilt from depth. The integer planes are coded without loss: green is
subtracted from red and blue, the best of four linear predictors leaves residuals, their bytes are sorted by
significance, and LZMA compresses them.
"""

import io
import json
import lzma
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.files import parse_json
from jaxsr.io.writing import FrameInfo
from jaxsr.ops.pinhole import pixels_from_view, unjittered_positions, view_from_world, world_from_depth
from jaxsr.srgb import linear_from_srgb, srgb_from_linear

MOTION_STEP = 64.0
SKY_CODE = 65535
CODES = {
    "depth": (1, "<u2"),
    "motion": (2, "<u4"),
    "color": (3, "<u2"),
    "reference": (3, "<u2"),
    "normal": (2, "|u1"),
    "base_color": (3, "|u1"),
    "roughness": (1, "|u1"),
    "metallic": (1, "|u1"),
    "object_id": (1, "<u2"),
}
"""Layer -> the number and the type of the planes that store it."""
_DAMAGES = (
    ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, struct.error, lzma.LZMAError,
)  # fmt: skip
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 4, "lp": 0, "pb": 0}]


# --- quantisation ----------------------------------------------------------------------------------------


def quantise_color(color: np.ndarray, bits: int) -> np.ndarray:
    """Half floats as 16-bit integers, with the low `10 - bits` bits of the mantissa rounded off."""
    half = np.clip(color, 0, 65504 * (1 - 2.0**-9)).astype(np.float16).view(np.uint16).astype(np.uint32)
    drop = 10 - bits
    return ((half + ((1 << drop) >> 1)) >> drop).astype(np.uint16)


def restore_color(code: np.ndarray, bits: int) -> np.ndarray:
    return (code.astype(np.uint16) << (10 - bits)).view(np.float16).astype(np.float32)


def quantise_depth(depth: np.ndarray) -> tuple[np.ndarray, list[float]]:
    sky = ~np.isfinite(depth)
    if sky.all():
        return np.full(depth.shape, SKY_CODE, np.uint16), [0.0, 1.0]
    logs = np.log2(np.maximum(np.where(sky, depth[~sky].min(), depth), 1e-6).astype(np.float64))
    low, high = float(logs.min()), max(float(logs.max()), float(logs.min()) + 1e-6)
    code = np.rint((logs - low) / (high - low) * (SKY_CODE - 1))
    return np.where(sky, SKY_CODE, code).astype(np.uint16), [low, high]


def restore_depth(code: np.ndarray, limits: list[float]) -> np.ndarray:
    low, high = limits
    depth = np.exp2(low + code.astype(np.float64) / (SKY_CODE - 1) * (high - low))
    return np.where(code == SKY_CODE, np.inf, depth).astype(np.float32)


def quantise_normal(normal: np.ndarray) -> np.ndarray:
    """Octahedral map (Meyer et al. 2010, "On floating-point normal vectors"), 8 bits per coordinate."""
    n = normal / np.maximum(np.abs(normal).sum(-1, keepdims=True), 1e-9)
    folded = (1 - np.abs(n[..., 1::-1])) * np.where(n[..., :2] >= 0, 1, -1)
    return np.rint((np.where(n[..., 2:] < 0, folded, n[..., :2]) * 0.5 + 0.5) * 254).astype(np.uint8)


def restore_normal(code: np.ndarray, sky: np.ndarray) -> np.ndarray:
    xy = code.astype(np.float32) / 127 - 1
    z = 1 - np.abs(xy).sum(-1, keepdims=True)
    folded = (1 - np.abs(xy[..., ::-1])) * np.where(xy >= 0, 1, -1)
    n = np.concatenate([np.where(z < 0, folded, xy), z], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return np.where(sky[..., None], 0, n).astype(np.float32)


def predicted_motion(
    depth: np.ndarray, info: FrameInfo, before: FrameInfo, jitter: tuple[float, float]
) -> np.ndarray:
    """Motion of static points under the motion of the camera, from depth `[h, w]`.

    Only differences from it are stored, so every step is part of the format: sky lies at 1e7, positions are
    rounded to float32, depth before the previous camera is at least 1e-3, and motion at most 4096 pixels.
    """
    size = depth.shape[0], depth.shape[1]
    near = np.where(np.isfinite(depth), depth, 1e7)[..., None]
    world = world_from_depth(near, info, jitter, np).astype(np.float32)
    view = view_from_world(world, before, np)
    view = np.concatenate([view[..., :2], np.maximum(view[..., 2:], 1e-3)], -1)
    here = unjittered_positions(size, jitter, np.float64, np)
    return np.clip(here - pixels_from_view(view, before, size, np), -4096, 4096)


# --- lossless coding of integer planes -------------------------------------------------------------------


def _predict(plane: np.ndarray, kind: int) -> np.ndarray:
    """Residuals modulo the integer range: 0 none, 1 left, 2 above, 3 left + above - above left."""
    out = plane.copy()
    if kind & 1:
        out[:, 1:] -= out[:, :-1].copy()
    if kind & 2:
        out[1:] -= out[:-1].copy()
    return out


def _unpredict(residual: np.ndarray, kind: int) -> np.ndarray:
    out = residual
    if kind & 2:
        out = np.cumsum(out, axis=0, dtype=out.dtype)
    if kind & 1:
        out = np.cumsum(out, axis=1, dtype=out.dtype)
    return out


def encode_plane(plane: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """The bytes of one unsigned integer plane, and the notes that decoding needs."""
    signed = np.dtype(f"i{plane.dtype.itemsize}")

    def zigzag(x: np.ndarray) -> np.ndarray:
        s = x.view(signed)
        return ((s << 1) ^ (s >> (8 * plane.dtype.itemsize - 1))).view(plane.dtype)

    best = None
    for kind in range(4):
        folded = zigzag(_predict(plane, kind))
        raw = b"".join((folded >> (8 * k)).astype(np.uint8).tobytes() for k in range(plane.dtype.itemsize))
        packed = lzma.compress(raw, lzma.FORMAT_RAW, filters=_FILTERS)
        if best is None or len(packed) < len(best[1]):
            best = ({"kind": kind, "dtype": plane.dtype.str, "bytes": len(packed)}, packed)
    assert best is not None
    return best


def decode_plane(note: Mapping[str, Any], packed: bytes, shape: tuple[int, int]) -> np.ndarray:
    """The inverse of `encode_plane`; never decompresses more bytes than a plane of this shape has."""
    dtype, kind = np.dtype(note["dtype"]), note["kind"]
    if kind not in range(4):
        raise ValueError(f"predictor {kind!r}")
    size = dtype.itemsize * shape[0] * shape[1]
    data = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS).decompress(packed, max_length=size + 1)
    if len(data) != size:
        raise ValueError(f"a plane of {'more' if len(data) > size else len(data)} bytes for {size}")
    raw = np.frombuffer(data, np.uint8)
    parts = raw.reshape(dtype.itemsize, *shape).astype(dtype)
    folded = sum((parts[k] << (8 * k) for k in range(1, dtype.itemsize)), parts[0]).astype(dtype)
    residual = (folded >> 1) ^ (0 - (folded & 1)).astype(dtype)
    return _unpredict(residual.astype(dtype), kind)


def _planes_of(code: np.ndarray) -> list[np.ndarray]:
    """Channels as planes; of colours, red and blue are stored as differences from green."""
    planes = [np.ascontiguousarray(code[..., k]) for k in range(code.shape[-1])]
    return planes if len(planes) != 3 else [planes[0] - planes[1], planes[1], planes[2] - planes[1]]


def _code_of(planes: list[np.ndarray]) -> np.ndarray:
    if len(planes) == 3:
        planes = [planes[0] + planes[1], planes[1], planes[2] + planes[1]]
    return np.stack(planes, -1)


def encode_frame(
    layers: Mapping[str, np.ndarray],
    info: FrameInfo,
    before: FrameInfo,
    jitter: tuple[float, float],
    color_bits: int,
) -> bytes:
    """All layers of one image; `before` is the previous frame (`info` itself if there is none)."""
    depth, limits = quantise_depth(layers["depth"][..., 0])
    codes: dict[str, np.ndarray] = {"depth": depth[..., None]}
    still = predicted_motion(restore_depth(depth, limits), info, before, jitter)
    codes["motion"] = np.rint((layers["motion"] - still) * MOTION_STEP).astype(np.int32).view(np.uint32)
    for name in ("color", "reference"):
        if name in layers:
            codes[name] = quantise_color(layers[name], color_bits)
    if "normal" in layers:
        codes["normal"] = quantise_normal(layers["normal"])
    if "base_color" in layers:
        display = srgb_from_linear(np.clip(layers["base_color"], 0, 1))
        codes["base_color"] = np.rint(display * 255).astype(np.uint8)
    for name in ("roughness", "metallic"):
        if name in layers:
            codes[name] = np.rint(np.clip(layers[name], 0, 1) * 255).astype(np.uint8)
    notes: dict[str, Any] = {"shape": depth.shape, "depth": limits, "color_bits": color_bits, "planes": {}}
    if "object_id" in layers:
        values, index = np.unique(layers["object_id"], return_inverse=True)
        notes["ids"] = [int(v) for v in values]
        codes["object_id"] = index.reshape(layers["object_id"].shape).astype(np.uint16)
    body = io.BytesIO()
    for name, code in codes.items():
        notes["planes"][name] = []
        for plane in _planes_of(code):
            note, packed = encode_plane(plane)
            notes["planes"][name].append(note)
            body.write(packed)
    head = json.dumps(notes, separators=(",", ":")).encode()
    return struct.pack("<I", len(head)) + head + body.getvalue()


def largest_blob(shape: tuple[int, int]) -> int:
    """The largest number of bytes of an image `(h, w)`: the notes, and planes that do not compress."""
    per_pixel = sum(channels * np.dtype(dtype).itemsize for channels, dtype in CODES.values())
    return (1 << 20) + 2 * per_pixel * shape[0] * shape[1]


def decode_frame(
    blob: bytes,
    shape: tuple[int, int],
    info: FrameInfo,
    before: FrameInfo,
    jitter: tuple[float, float],
    *,
    where: object = None,
) -> dict[str, np.ndarray]:
    """The inverse of `encode_frame`, float32 layers `[h, w, c]`.

    Args:
        blob: what `encode_frame` returned, or anything else.
        shape: the height and width that the image must have.
        info, before, jitter: those that `encode_frame` was given.
        where: the place that errors name.

    Raises:
        JaxsrError: the bytes are not an image of this shape.
    """
    try:
        codes, notes = _decode_codes(blob, shape)
        return _restore(codes, notes, info, before, jitter)
    except _DAMAGES as e:
        found = f"no {e}" if isinstance(e, KeyError) else e
        raise JaxsrError("cannot be decoded", where=where, found=found, fix="fetch the archive again") from e


def _decode_codes(blob: bytes, shape: tuple[int, int]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The integer arrays of the layers, and the notes about them, checked."""
    (length,) = struct.unpack_from("<I", blob)
    notes, at = parse_json(blob[4 : 4 + length], "notes", dict), 4 + length
    if notes["shape"] != list(shape):
        raise ValueError(f"shape {notes['shape']!r} for {list(shape)}")
    low, high = notes["depth"]
    if not -64 <= low <= high <= 64:  # logarithms
        raise ValueError(f"limits of depth {notes['depth']!r}")
    if notes["color_bits"] not in range(1, 11):
        raise ValueError(f"color_bits {notes['color_bits']!r}")
    codes = {}
    for name, planes in notes["planes"].items():
        channels, dtype = CODES[name]
        if [note["dtype"] for note in planes] != [dtype] * channels:
            raise ValueError(f"other planes of {name!r} than {channels} of {dtype}")
        decoded = []
        for note in planes:
            if not 0 <= note["bytes"] <= len(blob) - at:
                raise ValueError(f"a plane of {note['bytes']} bytes, where {len(blob) - at} are left")
            decoded.append(decode_plane(note, blob[at : at + note["bytes"]], shape))
            at += note["bytes"]
        codes[name] = _code_of(decoded)
    if "object_id" in codes and codes["object_id"].max() >= len(notes["ids"]):
        raise ValueError("an object without an id")
    return codes, notes


def _restore(
    codes: Mapping[str, np.ndarray],
    notes: Mapping[str, Any],
    info: FrameInfo,
    before: FrameInfo,
    jitter: tuple[float, float],
) -> dict[str, np.ndarray]:
    depth = restore_depth(codes["depth"][..., 0], notes["depth"])
    layers = {"depth": depth[..., None]}
    rest = np.ascontiguousarray(codes["motion"]).view(np.int32) / MOTION_STEP
    layers["motion"] = predicted_motion(depth, info, before, jitter) + rest
    for name in ("color", "reference"):
        if name in codes:
            layers[name] = restore_color(codes[name], notes["color_bits"])
    if "normal" in codes:
        layers["normal"] = restore_normal(codes["normal"], ~np.isfinite(depth))
    if "base_color" in codes:
        layers["base_color"] = linear_from_srgb(codes["base_color"] / 255)
    for name in ("roughness", "metallic"):
        if name in codes:
            layers[name] = codes[name] / 255
    if "object_id" in codes:
        layers["object_id"] = np.asarray(notes["ids"], np.float64)[codes["object_id"]]
    return {name: np.asarray(x, np.float32) for name, x in layers.items()}
