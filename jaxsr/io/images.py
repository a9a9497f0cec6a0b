"""Single pictures: 8-bit PNG in and out, and any picture as linear colour.

Display-referred images are float in [0, 1] (sRGB encoded), linear ones are scene-linear and unbounded. No
tone mapping happens here: apply `jaxsr.ops.to_display` before writing a PNG.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, JpegImagePlugin, PngImagePlugin

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, open_file
from jaxsr.io.exr import read_exr
from jaxsr.io.exr_header import MAX_PIXELS
from jaxsr.srgb import linear_from_srgb

_READERS = {b"\x89PNG": PngImagePlugin.PngImageFile, b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile}


def write_png(
    path: str | Path, image: Float[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w c"] | np.ndarray
) -> None:
    """Write an 8-bit PNG, atomically.

    Args:
        path: the file; its folder is made.
        image: `[h, w]` or `[h, w, 1 | 3 | 4]`; floats are display-referred, clipped to [0, 1] and rounded
            to the nearest of 256 levels; uint8 is written as it is.

    Raises:
        JaxsrError: wrong shape or type; NaN.
    """
    path, image = Path(path), np.asarray(image)
    if image.ndim == 3 and image.shape[-1] == 1:
        image = image[..., 0]
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[-1] not in (3, 4)) or 0 in image.shape:
        raise JaxsrError("not a picture", where=path, expected="[h, w, 1 | 3 | 4]", found=image.shape)
    if np.issubdtype(image.dtype, np.floating):
        if np.isnan(image).any():
            raise JaxsrError(
                "the picture holds NaN", where=path, found=f"{int(np.isnan(image).sum())} values"
            )
        image = np.rint(image.clip(0, 1).astype(np.float32) * 255).astype(np.uint8)
    if image.dtype != np.uint8:
        raise JaxsrError("wrong type of picture", where=path, expected="float or uint8", found=image.dtype)
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def read_png(path: str | Path, size: tuple[int, int] | None = None) -> Float[np.ndarray, "h w 3"]:
    """Read a PNG (or JPEG) as display-referred float32 RGB in [0, 1]; grey is repeated, alpha is dropped.

    Args:
        path: the file.
        size: the height and width that it must have; compared before any pixel is decoded.

    Raises:
        JaxsrError: no regular file, another size, too large, or not a picture that can be decoded.
    """
    path = Path(path)
    with open_file(path) as file:
        start = file.read(4)
        file.seek(0)
        reader = next((reader for magic, reader in _READERS.items() if start.startswith(magic)), None)
        if reader is None:  # PIL knows further formats, some of which start other programs
            found = f"the bytes {start.hex(' ')}" if start else "an empty file"
            raise JaxsrError("cannot be read as a picture", where=path, expected="PNG or JPEG", found=found)
        try:
            with reader(file) as image:
                _check_size(path, (image.height, image.width), size)
                deep = image.mode.startswith("I")  # 16-bit grey: convert("RGB") would clip it
                pixels = np.asarray(image if deep else image.convert("RGB"), np.float32)
        except JaxsrError:
            raise
        except (OSError, SyntaxError, ValueError) as e:
            raise JaxsrError("cannot be read as a picture", where=path, found=e, fix="write it again") from e
    if deep:
        return np.repeat(pixels[..., None] / np.float32(65535), 3, -1)
    return pixels / np.float32(255)


def _check_size(path: Path, found: tuple[int, int], expected: tuple[int, int] | None) -> None:
    (h, w), limit = found, f"at most {MAX_PIXELS} pixels"
    if expected is not None and found != expected:
        raise JaxsrError("wrong size", where=path, expected=f"{expected[1]}x{expected[0]}", found=f"{w}x{h}")
    if h * w > MAX_PIXELS:
        raise JaxsrError("the picture is too large", where=path, expected=limit, found=f"{w}x{h}")


def read_color(
    path: str | Path, size: tuple[int, int] | None = None, layer: str = "color"
) -> Float[np.ndarray, "h w 3"]:
    """Read a picture as scene-linear float32 RGB: OpenEXR as it is, PNG and JPEG through the sRGB curve.

    Of an OpenEXR file the layer of that name is taken, or `R, G, B`, or Blender's `*.Combined`, or the only
    layer with R, G and B.

    Args:
        path: the file.
        size: the height and width that it must have; compared before any pixel is decoded.
        layer: the first choice of an OpenEXR file.

    Raises:
        JaxsrError: unknown extension, unreadable file, another size, no colour layer or several that could be
            meant.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind in (".png", ".jpg", ".jpeg"):
        return linear_from_srgb(read_png(path, size))
    if kind != ".exr":
        raise JaxsrError("unknown kind of picture", where=path, expected=".exr, .png or .jpg", found=kind)
    channels, _ = read_exr(path, size=size)
    prefixes = [n[:-1] for n in channels if n.endswith("R") and n[-2:-1] in ("", ".")]
    whole = [p for p in prefixes if f"{p}G" in channels and f"{p}B" in channels]
    named = [p for p in whole if p in ("color.", "") or p.endswith("Combined.")]
    chosen = f"{layer}." if f"{layer}." in whole else (named or whole)
    if not isinstance(chosen, str):
        if len(chosen) != 1:
            raise JaxsrError(
                "no colour layer" if not chosen else "several layers could be the colour",
                where=path,
                expected="color.R, color.G, color.B or R, G, B",
                found=", ".join(sorted(channels)),
            )
        chosen = chosen[0]
    return np.stack([channels[f"{chosen}{c}"].astype(np.float32) for c in "RGB"], -1)
