"""Frames against the truth, a few at a time: whatever the length of a sequence, no more stay in memory."""

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxsr.evaluation.regions import regions
from jaxsr.io.sequence import Sequence as FrameSequence
from jaxsr.io.truth import Truth as TruthLayer
from jaxsr.io.truth import choose_truth
from jaxsr.metrics import METRICS, available, flip_map, measure_frame
from jaxsr.report.embedding import ImageOrPath, flip_jpeg
from jaxsr.report.results import ALL, MethodResult
from jaxsr.runtime.cost import Cost, Timing
from jaxsr.runtime.upscale import display

CACHE_BYTES = 256e6
"""How much of the truth a `Reference` keeps."""


def metrics_with(lpips: bool, lpips_alex: bool = False) -> tuple[str, ...]:
    """The metrics to measure, in the order of `jaxsr.metrics.METRICS`.

    Args:
        lpips: LPIPS over VGG-16 too, if its extra is installed.
        lpips_alex: LPIPS over AlexNet too; `measure_frame` raises an error where its extra is not installed.
    """
    wanted = {*available(), *(("lpips_alex",) if lpips_alex else ())}
    return tuple(key for key in METRICS if key in wanted and (lpips or key != "lpips"))


class Truth(NamedTuple):
    """What a frame is measured against."""

    image: np.ndarray
    """Display-referred."""
    regions: Mapping[str, np.ndarray]
    """Masks `[H, W]` by name."""


class Reference:
    """The truth of a sequence, and the regions that are measured apart from all pixels.

    Args:
        sequence: with HR colour, and for regions with an HR G-buffer.
        in_regions: whether edges and disocclusions are measured apart.
        truth: "reference" or "color"; by default the best that all frames have.

    Attributes:
        truth: the name of the layer.
    """

    def __init__(
        self, sequence: FrameSequence, in_regions: bool = False, truth: TruthLayer | None = None
    ) -> None:
        self.in_regions, self.truth = in_regions, choose_truth([sequence], truth)
        self._sequence = sequence
        width, height = sequence.size
        frames = int(CACHE_BYTES / (width * height * (3 * 4 + 2)))
        self._of: Callable[[int], Truth] = functools.lru_cache(max(frames, 2))(self._read)
        self._frame = functools.lru_cache(2)(lambda i: sequence.frame(i, 1, rendered=False))

    def __call__(self, i: int) -> Truth:
        """Of the frame at position `i`; kept for the next method while there is room."""
        return self._of(i)

    def _read(self, i: int) -> Truth:
        sequence = self._sequence
        masks = regions(self._frame(i), self._frame(i - 1) if i else None) if self.in_regions else {}
        return Truth(display(sequence.truth(i, self.truth), sequence.exposure_at(i)), masks)


class Meter:
    """Every metric of a method, frame after frame.

    Args:
        keys: the metrics; all there are by default.
    """

    def __init__(self, keys: Collection[str] | None = None) -> None:
        self._keys = keys
        self._values: dict[str, dict[str, list[float | None]]] = {}
        self._flip_maps: list[bytes] = []
        self._before: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, images: Sequence[np.ndarray], truths: Sequence[Truth], starts: Sequence[bool]) -> None:
        """Measure the next frames.

        Args:
            images: display-referred, float [H, W, 3].
            truths: of the same frames; all of them with the same regions.
            starts: True where a frame does not follow the one before it.
        """
        with ThreadPoolExecutor() as pool:  # FLIP is slow, and runs outside the interpreter's lock
            maps = list(pool.map(flip_map, images, (truth.image for truth in truths)))
            self._flip_maps += pool.map(flip_jpeg, maps)
        for image, truth, start, error in zip(images, truths, starts, maps, strict=True):
            measured = measure_frame(
                image,
                truth.image,
                before=None if start else self._before,
                regions=truth.regions,
                flip_error=error,
                keys=self._keys,
            )
            for region, values in measured.items():
                for key, value in values.items():
                    self._values.setdefault(region, {}).setdefault(key, []).append(value)
            self._before = image, truth.image

    def result(
        self,
        name: str,
        images: Sequence[ImageOrPath],
        timing: Timing | None = None,
        note: str = "",
        cost: Cost | None = None,
    ) -> MethodResult:
        """What was measured, as that of these images."""
        regions = {region: values for region, values in self._values.items() if region != ALL}
        return MethodResult(
            name, images, self._values.get(ALL, {}), timing, note, self._flip_maps, regions, cost
        )


def measured(
    name: str,
    images: Sequence[np.ndarray],
    truths: Sequence[np.ndarray],
    *,
    starts: Sequence[bool] | None = None,
    timing: Timing | None = None,
    note: str = "",
) -> MethodResult:
    """A result with every metric, of images that are in memory.

    Args:
        images, truths: display-referred float images [H, W, 3], one pair per frame.
        starts: True where a frame does not follow the one before it.
    """
    meter = Meter()
    meter.add(images, [Truth(truth, {}) for truth in truths], starts or [False] * len(truths))
    return meter.result(name, images, timing, note)
