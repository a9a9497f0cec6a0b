"""Image quality on display-referred images: PSNR, SSIM, LPIPS, FLIP, and the PSNR of frame differences.

All take images `[H, W, 3]` in [0, 1], sRGB-encoded after the tone map (`jaxsr.ops.color.to_display`). `psnr`,
`ssim`, `lpips` and `flip` return a Python float, `flip_map` an array `[H, W]`; `temporal_psnr` and `measure`
take frames in order and return lists of one float or None per frame. No metric crops, converts to luma, or
quantises. Values outside [0, 1], NaN and unequal shapes are errors, never a number. They compute on the host
and are no losses (those are in `jaxsr.losses`).

A mask `[H, W]` (True: counts) restricts the average to its pixels; nothing is cut out before filtering, so
SSIM, LPIPS and FLIP there still see the neighbours of masked pixels. An empty mask is an error.
`measure_frame` has every metric of a frame over all pixels and over any regions, and makes each map once.

LPIPS needs the extra `perceptual`; without it `available` has no "lpips", and `measure` leaves it out. It
costs several times as much as all the others together. "lpips_alex", the same over AlexNet, judges networks
whose training has seen LPIPS over VGG-16; it is measured only where `keys` asks for it.

PSNR of identical images is `inf`; `jaxsr.report.tables` writes that as the string "inf" in JSON, for JSON has
no number for it. A value that is not defined (the temporal PSNR of the first frame) is None, `null` in JSON.
"""

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import dm_pix
import flip_evaluator
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsr.errors import JaxsrError
from jaxsr.losses import SSIM_WINDOW, gaussian_window
from jaxsr.nets import vgg as perceptual

Image: TypeAlias = Float[Array | np.ndarray, "h w 3"]
Mask: TypeAlias = Bool[Array | np.ndarray, "h w"]

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
    "lpips": Metric(
        "LPIPS",
        "",
        False,
        4,
        "Zhang et al. 2018, LPIPS v0.1 over VGG-16, of the whole display-referred image at its own size. "
        "Over a region: the mean there of the layers' maps, enlarged bilinearly.",
    ),
    "lpips_alex": Metric(
        "LPIPS-Alex",
        "",
        False,
        4,
        "LPIPS v0.1 over AlexNet, otherwise as LPIPS. Networks that are trained with LPIPS see VGG-16 and "
        "never AlexNet.",
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
        "flicker lowers it, a constant error does not. Not defined for the first frame or across a reset.",
    ),
}

OPTIONAL = ("lpips_alex",)
"""Metrics that are measured only where they are asked for."""
_LPIPS: dict[str, perceptual.Net] = {"lpips": "vgg", "lpips_alex": "alex"}


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


def _sized_mask(mask: Array | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if mask.shape != shape:
        raise JaxsrError("mask has the wrong size", expected=shape, found=mask.shape)
    return np.asarray(mask)


def _checked_mask(mask: Array | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    array = _sized_mask(mask, shape)
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


@jax.jit
def _ssim_map(image: Array, truth: Array) -> Array:
    return dm_pix.ssim(image, truth, k1=0.01, k2=0.03, return_map=True, filter_fn=gaussian_window)


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
    return _average(_channel_mean(_ssim_map(image_, truth_)), mask, SSIM_WINDOW // 2)


def _channel_mean(ssim_map: Array) -> np.ndarray:
    return np.asarray(ssim_map).mean(axis=-1, dtype=np.float64)


def _average(values: np.ndarray, mask: Mask | None, edge: int = 0) -> float:
    """Mean of a map, `edge` pixels smaller than the image on each side, over a mask of the image."""
    if mask is not None:
        shape = (values.shape[0] + 2 * edge, values.shape[1] + 2 * edge)
        inner = _checked_mask(mask, shape)[edge : shape[0] - edge, edge : shape[1] - edge]
        values = values[_checked_mask(inner, values.shape)]
    return float(values.mean(dtype=np.float64))


@functools.partial(jax.jit, static_argnames="net")
def _lpips_value(image: Array, truth: Array, params: perceptual.Params, net: perceptual.Net) -> Array:
    return perceptual.lpips(image, truth, net, params)


@functools.partial(jax.jit, static_argnames="net")
def _lpips_both(
    image: Array, truth: Array, params: perceptual.Params, net: perceptual.Net
) -> tuple[Array, Array]:
    """The value and the map. The networks run once: the compiler sees that both need the same features."""
    found = perceptual.lpips_map(image, truth, net, params)
    return perceptual.lpips(image, truth, net, params), found


def _lpips_over(
    image: np.ndarray, truth: np.ndarray, net: perceptual.Net, needs_map: bool
) -> Callable[[np.ndarray | None], float]:
    """LPIPS over a mask, or over all pixels for None, which is not the mean of the map."""
    params = perceptual.load_params(net)
    if not needs_map:
        value = float(_lpips_value(image, truth, params, net))
        return lambda mask: value
    whole, values = (np.asarray(x) for x in _lpips_both(image, truth, params, net))
    return lambda mask: float(whole) if mask is None else _average(values, mask)


def lpips(image: Image, truth: Image, mask: Mask | None = None, net: perceptual.Net = "vgg") -> float:
    """LPIPS v0.1 (Zhang et al. 2018) over VGG-16 or AlexNet: 0 for identical images, lower is better.

    Over a mask it is the mean of `jaxsr.nets.vgg.lpips_map`. Compiled once per size.

    Raises:
        JaxsrError: as for `psnr`, images below 16x16 (AlexNet: 31x31), and where the extra `perceptual` is
            not installed.
    """
    image_, truth_ = _checked(image, truth)
    if mask is not None:
        mask = _checked_mask(mask, truth_.shape[:2])
    return _lpips_over(image_, truth_, net, mask is not None)(mask)


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
    return _average(flip_map(image, truth, ppd), mask)


def temporal_psnr(
    images: Sequence[Image],
    truths: Sequence[Image],
    mask: Mask | None = None,
    starts: Sequence[bool] | None = None,
) -> list[float | None]:
    """PSNR of `image_t - image_{t-1}` against `truth_t - truth_{t-1}`, peak 1, one value per frame.

    Differences lie in [-1, 1], but the peak stays 1 so that the scale is that of `psnr`. An error that
    stays the same from frame to frame costs nothing; flicker does.

    Args:
        images, truths: display-referred frames in order.
        mask: pixels that count, the same in all frames.
        starts: True where a frame does not follow the one before it (a reset, a gap in the numbers).

    Returns:
        One value per frame; None for frame 0 and for every start.

    Raises:
        JaxsrError: unequal lengths, and as for `psnr`.
    """
    _check_lengths(images, truths, starts)
    values: list[float | None] = []
    previous: np.ndarray | None = None
    for t, (image, truth) in enumerate(zip(images, truths, strict=True)):
        image_, truth_ = _checked(image, truth)
        error = image_ - truth_  # (o_t - o_{t-1}) - (g_t - g_{t-1}) is the change of the error
        if previous is None or (starts is not None and starts[t]):
            values.append(None)
        else:
            values.append(_psnr_of(_change(error, previous), mask))
        previous = error
    return values


def _check_lengths(images: Sequence[Image], truths: Sequence[Image], starts: Sequence[bool] | None) -> None:
    if len(images) != len(truths):
        raise JaxsrError("unequal number of frames", expected=f"{len(truths)} (truth)", found=len(images))
    if starts is not None and len(starts) != len(truths):
        raise JaxsrError("starts has the wrong length", expected=len(truths), found=len(starts))


def _change(error: np.ndarray, previous: np.ndarray) -> np.ndarray:
    if previous.shape != error.shape:
        raise JaxsrError("frames differ in size", expected=previous.shape, found=error.shape)
    return error - previous


def available() -> tuple[str, ...]:
    """Keys of the metrics that are measured unless others are asked for.

    Those of `METRICS` without the `OPTIONAL` ones, and without "lpips" where its extra is not installed.
    """
    left_out = {*OPTIONAL, *(() if perceptual.installed() else _LPIPS)}
    return tuple(key for key in METRICS if key not in left_out)


def measure_frame(
    image: Image,
    truth: Image,
    *,
    before: tuple[Image, Image] | None = None,
    regions: Mapping[str, Mask] | None = None,
    flip_error: Float[np.ndarray, "h w"] | None = None,
    keys: Collection[str] | None = None,
) -> dict[str, dict[str, float | None]]:
    """Every metric of one frame: over "all" pixels, and over each region.

    Args:
        image, truth: of the frame, display-referred.
        before: image and truth of the frame before it; None at a start, where the temporal PSNR is None.
        regions: masks by name. Where one has no pixels (for SSIM: none 5 pixels from the border) it has None.
        flip_error: `flip_map` of the frame at its default distance, if it was made already.
        keys: which metrics; all of `available` by default.

    Returns:
        region -> metric -> value. Images too small for SSIM or LPIPS have None there.

    Raises:
        JaxsrError: as for `psnr`; an unknown metric; a region named "all"; LPIPS asked for without its extra.
    """
    keys = available() if keys is None else keys
    regions = regions or {}
    if unknown := sorted(set(keys) - set(METRICS)):
        raise JaxsrError(f"unknown metric {unknown[0]!r}", expected=", ".join(METRICS))
    if "all" in regions:
        raise JaxsrError("a region is named 'all'", fix="choose another name: it is that of the whole image")
    image_, truth_ = _checked(image, truth)
    masks = {name: _sized_mask(mask, truth_.shape[:2]) for name, mask in regions.items()}
    size = min(truth_.shape[:2])
    found: dict[str, dict[str, float | None]] = {name: dict.fromkeys(keys) for name in ("all", *masks)}

    def note(key: str, over: Callable[[np.ndarray | None], float], edge: int = 0) -> None:
        found["all"][key] = over(None)
        for name, mask in masks.items():
            if mask[edge : mask.shape[0] - edge, edge : mask.shape[1] - edge].any():
                found[name][key] = over(mask)

    error = image_ - truth_
    if "psnr" in keys:
        note("psnr", lambda mask: _psnr_of(error, mask))
    if "ssim" in keys and size >= SSIM_WINDOW:
        ssim_map, edge = _channel_mean(_ssim_map(image_, truth_)), SSIM_WINDOW // 2
        note("ssim", lambda mask: _average(ssim_map, mask, edge), edge)
    for key, net in _LPIPS.items():
        if key in keys and size >= perceptual.MIN_SIZE[net]:
            note(key, _lpips_over(image_, truth_, net, bool(masks)))
    if "flip" in keys:
        errors = flip_map(image_, truth_) if flip_error is None else flip_error
        note("flip", lambda mask: _average(errors, mask))
    if "tpsnr" in keys and before is not None:
        image_before, truth_before = _checked(*before)
        change = _change(error, image_before - truth_before)
        note("tpsnr", lambda mask: _psnr_of(change, mask))
    return found


def measure(
    images: Sequence[Image],
    truths: Sequence[Image],
    starts: Sequence[bool] | None = None,
    flip_maps: Sequence[Float[np.ndarray, "h w"]] | None = None,
    keys: Collection[str] | None = None,
) -> dict[str, list[float | None]]:
    """Every metric of `available`, by its key, for every frame.

    Images too small for SSIM or LPIPS have None there. `starts` is that of `temporal_psnr`; `flip_maps` are
    those of `flip_map` at its default distance, if they were made already; `keys` are those of the metrics
    that are wanted, if not those of `available`.
    """
    _check_lengths(images, truths, starts)
    pairs = list(zip(images, truths, strict=True))
    found: dict[str, list[float | None]] = {key: [] for key in (available() if keys is None else keys)}
    for t, (image, truth) in enumerate(pairs):
        is_start = t == 0 or (starts is not None and starts[t])
        values = measure_frame(
            image,
            truth,
            before=None if is_start else pairs[t - 1],
            flip_error=None if flip_maps is None else flip_maps[t],
            keys=keys,
        )["all"]
        for key, value in values.items():
            found[key].append(value)
    return found
