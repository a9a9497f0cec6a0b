"""Display-referred images as bytes that fit into a page: 8 bits, each once, the best quality in a budget.

Encodings go from lossless to small: lossless WebP, the same after rounding values to 7 or 6 bits (an error of
at most 1 or 2 of 255), then JPEG without chroma subsampling. If even the smallest is too large, only every
n-th frame is embedded.
"""

import hashlib
import io
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

from jaxsr.errors import JaxsrError
from jaxsr.io.images import read_png

ImageOrPath: TypeAlias = np.ndarray | Path
"""Display-referred [H, W, 3] in [0, 1] (or uint8), or the path of a PNG that holds it."""


def to_bytes(image: ImageOrPath, where: str = "image") -> np.ndarray:
    """A display-referred image or the file that holds one as uint8 [H, W, 3].

    Raises:
        JaxsrError: unreadable file, wrong shape, NaN, values outside [0, 1].
    """
    if isinstance(image, Path):
        image, where = read_png(image), str(image)
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[-1] != 3 or 0 in array.shape:
        raise JaxsrError("not an RGB image", where=where, expected="[H, W, 3]", found=array.shape)
    if array.dtype == np.uint8:
        return array
    low, high = float(array.min()), float(array.max())
    if not (low >= 0.0 and high <= 1.0):  # false for NaN too
        found = f"[{low:.4g}, {high:.4g}]"
        raise JaxsrError(
            "image is not display-referred", where=where, expected="values in [0, 1]", found=found
        )
    return np.rint(array.astype(np.float32) * 255.0).astype(np.uint8)


def _save(array: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, **options)
    return buffer.getvalue()


def flip_jpeg(error: np.ndarray) -> bytes:
    """A FLIP map [H, W] in [0, 1] as a small grey JPEG; it is only displayed, never measured."""
    grey = np.rint(np.clip(error, 0.0, 1.0) * 255.0).astype(np.uint8)
    return _save(grey, format="JPEG", quality=70, optimize=True)


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


def decoded_error(image: np.ndarray, file: bytes) -> np.ndarray:
    """Difference, in levels of 255, between an encoded image and what was encoded."""
    with Image.open(io.BytesIO(file)) as decoded:
        return np.asarray(decoded.convert("RGB")).astype(np.int32) - image


class Images:
    """The images of a page, each stored once: tasks share the truth, methods share the input.

    Only what was given is kept: of a path the path, so that memory does not grow with the number of frames.
    """

    def __init__(self) -> None:
        self._sources: list[ImageOrPath] = []
        self._index: dict[tuple[tuple[int, ...], bytes], int] = {}
        self.shapes: list[tuple[int, ...]] = []

    def __len__(self) -> int:
        return len(self._sources)

    def add(self, image: ImageOrPath, where: str) -> int:
        """The number of the image, which is new if no equal one was added before."""
        array = to_bytes(image, where)
        key = (array.shape, hashlib.sha256(array.tobytes()).digest())
        if key not in self._index:
            self._index[key] = len(self._sources)
            self._sources.append(image if isinstance(image, Path) else array)
            self.shapes.append(array.shape)
        return self._index[key]

    def choose(self, budget: float) -> tuple[str, float]:
        """The best encoding expected to fit `budget` bytes of base64, and the bytes it is expected to take.

        Judged from every n-th image. If none fits, it is the smallest one.
        """
        positions = range(0, len(self), math.ceil(len(self) / 10))
        sample = [to_bytes(self._sources[i]) for i in positions]
        more = sum(math.prod(s) for s in self.shapes) / sum(i.size for i in sample)
        for name, (_, encode) in ENCODINGS.items():
            chosen, size = name, sum(len(encode(i)) for i in sample) * more * 4 / 3
            if size <= budget:
                break
        return chosen, size

    def encode(self, name: str, wanted: set[int]) -> tuple[dict[int, bytes], str]:
        """The wanted images as files, and a sentence about the error of the encoding."""
        _, encode = ENCODINGS[name]

        def one(i: int) -> bytes:
            return encode(to_bytes(self._sources[i]))

        order = sorted(wanted)
        with ThreadPoolExecutor(4) as pool:
            files = dict(zip(order, pool.map(one, order), strict=True))
        sample = order[:: math.ceil(len(order) / 10)]
        errors = [decoded_error(to_bytes(self._sources[i]), files[i]) for i in sample]
        worst = max(int(abs(e).max()) for e in errors)
        rms = math.sqrt(sum(float((e**2).sum()) for e in errors) / sum(e.size for e in errors))
        about = "no error beyond 8 bits"
        if worst:
            about = f"error of the encoding rms {rms:.2f}, at most {worst} of 255 (in {len(sample)} images)"
        return files, f"{name}; {about}"


def thinned(flags: Sequence[bool], every: int) -> list[bool]:
    """Which frames to embed if only about every n-th fits, extrapolated and rendered ones in turn."""
    if every <= 1:
        return [True] * len(flags)
    # An odd step meets both kinds where every second frame is extrapolated.
    step = every if every % 2 or not any(flags) else every + 1
    return [i % step == 0 for i in range(len(flags))]
