"""Image quality on display-referred images: PSNR, SSIM, FLIP, and the PSNR of frame differences.

All take images `[H, W, 3]` in [0, 1], sRGB-encoded after the tone map (`jaxsr.ops.color.to_display`). `psnr`,
`ssim` and `flip` return a Python float, `flip_map` an array `[H, W]`; `temporal_psnr` and `measure` take
frames in order and return lists of one float or None a frame. No metric crops, converts to luma, or
quantises. Values outside [0, 1], NaN and unequal shapes are errors, never a number. They compute on the host
and are no losses.

A mask `[H, W]` (True: counts) restricts the average to its pixels; nothing is cut out before filtering, so
SSIM and FLIP there still see the neighbours of masked pixels. An empty mask is an error.

PSNR of identical images is `inf`; tables.py writes that as the string "inf" in JSON, for JSON has no number
for it. A value that is not defined (the temporal PSNR of the first frame) is None, `null` in JSON.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import dm_pix
import flip_evaluator
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsr.errors import JaxsrError

Image: TypeAlias = Float[Array | np.ndarray, "h w 3"]
Mask: TypeAlias = Bool[Array | np.ndarray, "h w"]

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
FLIP_PPD = 3840 * math.pi / 180
"""67.02 pixels per degree: a 0.7 m wide display of 3840 pixels seen from 0.7 m, FLIP's own default."""


class Metric(NamedTuple):
    """How a metric is shown: its label, unit, direction, digits and definition."""

    label: str
    unit: str
    higher_is_better: bool
    digits: int
    definition: str


METRICS: dict[str, Metric] = {
    "psnr": Metric(
        "PSNR",
        "dB",
        True,
        2,
        "10 log10(1 / MSE) over all pixels and the three channels, peak 1. Identical images: infinite.",
    ),
    "ssim": Metric(
        "SSIM",
        "",
        True,
        4,
        "Wang et al. 2004: 11x11 Gaussian window, sigma 1.5, K1 0.01, K2 0.03, per channel and averaged, "
        "over the pixels whose window lies inside the image.",
    ),
    "flip": Metric(
        "FLIP",
        "",
        False,
        4,
        "Andersson et al. 2020, LDR-FLIP, mean of the error map, 67 pixels per degree "
        "(0.7 m from a 0.7 m wide display of 3840 pixels).",
    ),
    "tpsnr": Metric(
        "tPSNR",
        "dB",
        True,
        2,
        "PSNR, peak 1, of the frame difference (output t minus output t-1) against that of the truth: "
        "flicker lowers it, a constant error does not. Not defined for the first frame or across a cut.",
    ),
}


def _checked(image: Array | np.ndarray, truth: Array | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as float32 arrays, or the one error that says what is wrong with them."""
    if image.shape != truth.shape:
        raise JaxsrError("image and truth differ in size", expected=truth.shape, found=image.shape)
    if 0 in truth.shape:
        raise JaxsrError("image is empty", found=truth.shape)
    pair = []
    for name, x in (("image", image), ("truth", truth)):
        array = np.asarray(x, np.float32)
        low, high = float(array.min()), float(array.max())  # NaN propagates through min and max
        if not (math.isfinite(low) and math.isfinite(high)):
            bad = np.argwhere(~np.isfinite(array).all(axis=-1))
            raise JaxsrError(
                f"{name} has {len(bad)} pixels that are NaN or infinite",
                where=f"pixel x={bad[0][1]} y={bad[0][0]}",
                fix="look at the frame that made it",
            )
        if low < 0.0 or high > 1.0:
            raise JaxsrError(
                f"{name} is not display-referred",
                expected="values in [0, 1]",
                found=f"[{low:.4g}, {high:.4g}]",
                fix="apply jaxsr.ops.color.to_display to linear colour",
            )
        pair.append(array)
    return pair[0], pair[1]


def _checked_mask(mask: Array | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if mask.shape != shape:
        raise JaxsrError("mask has the wrong size", expected=shape, found=mask.shape)
    array = np.asarray(mask)
    if not array.any():
        raise JaxsrError("mask is empty: there is no pixel to measure on")
    return array


def _psnr_of(error: np.ndarray, mask: Mask | None) -> float:
    if mask is not None:
        error = error[_checked_mask(mask, error.shape[:2])]
    mse = float(np.mean(np.square(error, dtype=np.float64)))
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)


def psnr(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio in dB, peak 1, accumulated in float64; `inf` for identical images.

    Raises:
        JaxsrError: shapes differ, NaN or infinity, values outside [0, 1], empty mask.
    """
    image_, truth_ = _checked(image, truth)
    return _psnr_of(image_ - truth_, mask)


def _gaussian(image: Array) -> Array:
    """The window of SSIM over rows, then columns, where it lies inside the image."""
    weights = np.exp(-0.5 * ((np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2) / SSIM_SIGMA) ** 2)
    taps = [float(w) for w in weights / weights.sum()]
    h, w = (n - SSIM_WINDOW + 1 for n in image.shape[:2])
    # Sums of shifted images take a third of the time of dm-pix's own convolutions on a CPU. The barrier keeps
    # XLA from fusing both passes into 121 taps a pixel.
    rows = jax.lax.optimization_barrier(sum(t * image[k : k + h] for k, t in enumerate(taps)))
    return sum(t * rows[:, k : k + w] for k, t in enumerate(taps))


@jax.jit
def _ssim_map(image: Array, truth: Array) -> Array:
    return dm_pix.ssim(image, truth, k1=0.01, k2=0.03, return_map=True, filter_fn=_gaussian)


def ssim(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Structural similarity (Wang et al. 2004) with an 11x11 Gaussian window, sigma 1.5, averaged over RGB.

    Only windows inside the image count: the map is 5 pixels smaller on each side. Computed by dm-pix.

    Raises:
        JaxsrError: as for `psnr`, and images smaller than the window.
    """
    image_, truth_ = _checked(image, truth)
    if min(truth_.shape[:2]) < SSIM_WINDOW:
        raise JaxsrError(
            "image is smaller than the SSIM window",
            expected=f"at least {SSIM_WINDOW}x{SSIM_WINDOW}",
            found=truth_.shape[:2],
        )
    ssim_map = np.asarray(_ssim_map(image_, truth_)).mean(axis=-1, dtype=np.float64)
    if mask is not None:
        edge = SSIM_WINDOW // 2
        inner = _checked_mask(mask, truth_.shape[:2])[edge:-edge, edge:-edge]
        ssim_map = ssim_map[_checked_mask(inner, ssim_map.shape)]
    return float(ssim_map.mean())


def flip_map(image: Image, truth: Image, ppd: float = FLIP_PPD) -> Float[np.ndarray, "h w"]:
    """LDR-FLIP error map (Andersson et al. 2020) in [0, 1], at `ppd` pixels per degree; by flip-evaluator.

    Raises:
        JaxsrError: as for `psnr`, and `ppd` not positive.
    """
    image_, truth_ = _checked(image, truth)
    if not (math.isfinite(ppd) and ppd > 0.0):
        raise JaxsrError("pixels per degree must be positive", where="ppd", found=ppd)
    # The binding takes only writable arrays in C order; those that come from JAX are read-only.
    truth_, image_ = np.array(truth_, order="C"), np.array(image_, order="C")
    error, _, _ = flip_evaluator.evaluate(
        truth_, image_, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": ppd}
    )
    return np.asarray(error, np.float32).reshape(truth_.shape[:2])


def flip(image: Image, truth: Image, mask: Mask | None = None, ppd: float = FLIP_PPD) -> float:
    """Mean of `flip_map`: 0 for identical images, at most 1. Lower is better.

    Raises:
        JaxsrError: as for `flip_map`, and an empty mask.
    """
    error = flip_map(image, truth, ppd)
    if mask is not None:
        error = error[_checked_mask(mask, error.shape)]
    return float(error.mean(dtype=np.float64))


def temporal_psnr(
    images: Sequence[Image],
    truths: Sequence[Image],
    mask: Mask | None = None,
    starts: Sequence[bool] | None = None,
) -> list[float | None]:
    """PSNR of `image_t - image_{t-1}` against `truth_t - truth_{t-1}`, peak 1, one value a frame.

    Differences lie in [-1, 1], but the peak stays 1 so that the scale is that of `psnr`. An error that
    stays the same from frame to frame costs nothing; flicker does.

    Args:
        images, truths: display-referred frames in order.
        mask: pixels that count, the same in all frames.
        starts: True where a frame does not follow the one before it (a cut, a gap in the numbers).

    Returns:
        One value a frame; None for frame 0 and for every start.

    Raises:
        JaxsrError: unequal lengths, and as for `psnr`.
    """
    if len(images) != len(truths):
        raise JaxsrError("unequal number of frames", expected=f"{len(truths)} (truth)", found=len(images))
    if starts is not None and len(starts) != len(truths):
        raise JaxsrError("starts has the wrong length", expected=len(truths), found=len(starts))
    values: list[float | None] = []
    previous: np.ndarray | None = None
    for t, (image, truth) in enumerate(zip(images, truths, strict=True)):
        image_, truth_ = _checked(image, truth)
        error = image_ - truth_  # (o_t - o_{t-1}) - (g_t - g_{t-1}) is the change of the error
        if previous is None or (starts is not None and starts[t]):
            values.append(None)
        else:
            if previous.shape != error.shape:
                raise JaxsrError("frames differ in size", expected=previous.shape, found=error.shape)
            values.append(_psnr_of(error - previous, mask))
        previous = error
    return values


def measure(
    images: Sequence[Image],
    truths: Sequence[Image],
    starts: Sequence[bool] | None = None,
    flip_maps: Sequence[Float[np.ndarray, "h w"]] | None = None,
) -> dict[str, list[float | None]]:
    """Every metric of `METRICS`, by its key, for every frame.

    Images smaller than the SSIM window have None for SSIM. `starts` is that of `temporal_psnr`; `flip_maps`
    are those of `flip_map` at its default distance, if they were made already.
    """
    tpsnr = temporal_psnr(images, truths, starts=starts)  # checks the lengths
    pairs = list(zip(images, truths, strict=True))
    maps = [flip_map(a, b) for a, b in pairs] if flip_maps is None else flip_maps
    return {
        "psnr": [psnr(a, b) for a, b in pairs],
        "ssim": [ssim(a, b) if min(b.shape[:2]) >= SSIM_WINDOW else None for a, b in pairs],
        "flip": [float(m.mean(dtype=np.float64)) for m in maps],
        "tpsnr": tpsnr,
    }
