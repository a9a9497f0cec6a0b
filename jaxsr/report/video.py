"""Labelled frames side by side as an H.264 video that any player shows.

Pixels are repeated, never filtered, so that the video shows the exact output of a method. yuv420p halves the
resolution of chroma and the encoder is lossy (CRF 16): a video is for looking at motion, not for measuring.
"""

import contextlib
import math
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import imageio_ffmpeg
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path
from jaxsr.progress import Advance
from jaxsr.report.embedding import ImageOrPath, to_bytes

TARGET_WIDTH = 1920
"""Width that an automatic scale stays below."""
_GAP = 4
_PAPER, _INK = (18, 20, 23), (235, 238, 242)


def _font(size: int) -> ImageFont.FreeTypeFont:
    # matplotlib brings DejaVu with it: the same glyphs on every machine.
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def _label(text: str, width: int, height: int) -> np.ndarray:
    """A strip [height, width, 3] with the text, cut with an ellipsis where it does not fit."""
    strip = Image.new("RGB", (width, height), _PAPER)
    draw, font = ImageDraw.Draw(strip), _font(round(height * 0.58))
    room = width - height // 2
    if draw.textlength(text, font=font) > room:
        while text and draw.textlength(text + "…", font=font) > room:
            text = text[:-1]
        text += "…"
    draw.text((height // 4, height / 2), text, fill=_INK, font=font, anchor="lm")
    return np.asarray(strip)


def _sheet(
    images: Sequence[np.ndarray], labels: Sequence[str], caption: str, scale: int, columns: int, strip: int
) -> np.ndarray:
    """One frame of the video: a grid of labelled images, even in both sizes."""
    h, w = images[0].shape[0] * scale, images[0].shape[1] * scale
    rows = math.ceil(len(images) / columns)
    height = rows * (h + strip) + (rows - 1) * _GAP
    width = columns * w + (columns - 1) * _GAP
    sheet = np.empty((height + height % 2, width + width % 2, 3), np.uint8)
    sheet[:] = _PAPER
    for i, (image, label) in enumerate(zip(images, labels, strict=True)):
        y, x = (i // columns) * (h + strip + _GAP), (i % columns) * (w + _GAP)
        text = f"{label}  {caption}" if caption and i == 0 else label
        sheet[y : y + strip, x : x + w] = _label(text, w, strip)
        sheet[y + strip : y + strip + h, x : x + w] = image.repeat(scale, 0).repeat(scale, 1)
    return sheet


def _shape(columns: Mapping[str, Sequence[ImageOrPath]]) -> tuple[int, tuple[int, ...]]:
    """Number of frames and common shape of the first frames."""
    counts = {label: len(images) for label, images in columns.items()}
    if not counts or 0 in counts.values():
        raise JaxsrError("no frames for the video", found=counts)
    if len(set(counts.values())) != 1:
        raise JaxsrError("unequal numbers of frames", found=counts)
    shapes = {label: to_bytes(images[0], label).shape for label, images in columns.items()}
    if len(set(shapes.values())) != 1:
        raise JaxsrError("columns differ in size", found=shapes, fix="enlarge the inputs first")
    return next(iter(counts.values())), next(iter(shapes.values()))


def write_video(
    path: Path | str,
    columns: Mapping[str, Sequence[ImageOrPath]],
    fps: float,
    scale: int | None = None,
    *,
    per_row: int | None = None,
    captions: Sequence[str] | None = None,
    advance: Advance = lambda: None,
) -> Path:
    """Write labelled columns of frames as one .mp4 (H.264, yuv420p, BT.709), atomically.

    Args:
        path: the file, ending in ".mp4".
        columns: label -> display-referred frames [H, W, 3] in [0, 1] or PNG files, equal in size and number.
        fps: frames per second.
        scale: how often each pixel is repeated in x and y; by default as often as fits into a width of 1920.
        per_row: images in a row; by default all.
        captions: one text per frame, shown beside the first label, for instance "frame 12, extrapolated".
        advance: called after each frame, for a progress bar.

    Returns:
        The path.

    Raises:
        JaxsrError: no frames, unequal numbers or sizes, bad arguments; ffmpeg failed (with its last line).
    """
    path = Path(path)
    count, (height, width, _) = _shape(columns)
    if not (math.isfinite(fps) and fps > 0):
        raise JaxsrError("bad frame rate", where="fps", expected="a number above 0", found=fps)
    if path.suffix != ".mp4":
        raise JaxsrError("unknown kind of video", where=path, expected=".mp4")
    if captions is not None and len(captions) != count:
        raise JaxsrError("wrong number of captions", expected=count, found=len(captions))
    per_row = len(columns) if per_row is None else per_row
    if per_row < 1 or (scale is not None and scale < 1):
        raise JaxsrError("scale and per_row must be at least 1", found=f"scale {scale}, per_row {per_row}")
    per_row = min(per_row, len(columns))
    if scale is None:
        scale = max(1, (TARGET_WIDTH - (per_row - 1) * _GAP) // (per_row * width))
    strip = int(np.clip(height * scale // 14, 16, 40))
    labels = list(columns)

    def sheet(i: int) -> np.ndarray:
        images = [to_bytes(columns[label][i], f"{label}, frame {i}") for label in labels]
        for label, image in zip(labels, images, strict=True):
            if image.shape != (height, width, 3):
                raise JaxsrError(
                    "frames differ in size",
                    where=f"{label}, frame {i}",
                    expected=(height, width, 3),
                    found=image.shape,
                )
        return _sheet(images, labels, captions[i] if captions else "", scale, per_row, strip)

    first = sheet(0)
    with atomic_path(path) as temporary, tempfile.TemporaryFile() as log:
        command = [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-loglevel", "error", "-y"),
            *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.shape[1]}x{first.shape[0]}"),
            *("-r", f"{fps:g}", "-i", "-", "-an", "-c:v", "libx264", "-crf", "16", "-preset", "veryfast"),
            *("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p"),
            *("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"),
            *("-movflags", "+faststart", "-f", "mp4", str(temporary)),
        ]
        # Not imageio_ffmpeg.write_frames: it ignores ffmpeg's status, so that a full disk looks like success,
        # and ffmpeg's messages go to the terminal.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)
        assert process.stdin is not None
        try:
            process.stdin.write(first.tobytes())
            advance()
            for i in range(1, count):
                process.stdin.write(sheet(i).tobytes())
                advance()
            process.stdin.close()
        except BrokenPipeError:  # ffmpeg gave up; its status and its message say why
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        except BaseException:
            process.kill()
            process.stdin.close()
            raise
        finally:
            status = process.wait()
        if status != 0:
            log.seek(0)
            lines = log.read().decode(errors="replace").strip().splitlines()
            raise JaxsrError(
                "ffmpeg could not write the video",
                where=path,
                found=lines[-1] if lines else f"status {status}",
            )
    return path
