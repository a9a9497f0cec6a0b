"""Results as small values: a `SequenceResult` is one sequence and task, a `MethodResult` one method in it.

Images are display-referred, in [0, 1], `[H, W, 3]`, or the path of a PNG that holds them. Metrics are lists
with one value per frame, named as in `jaxsr.metrics.METRICS`; None where a value is not defined and `inf` for
the PSNR of identical images. They are over all pixels, and again over the pixels of each region.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from jaxsr.errors import JaxsrError
from jaxsr.metrics import METRICS
from jaxsr.report.embedding import ImageOrPath
from jaxsr.runtime.cost import Cost, Timing

Values: TypeAlias = Sequence[float | None]

ALL = "all"
"""The name of the region that is the whole image."""
BEND = 0.1

REGIONS = {
    "edges": "The pixels on both sides of an outline: along a row or column of the HR depth, the inverse of "
    f"the depth is off the straight line of its two neighbours by more than {BEND:.0%} of the largest of the "
    "three. Neither a slanted plane nor a texture, a shadow or a crease is one.",
    "disocclusions": "What was hidden in the frame before: holes of "
    "jaxsr.ops.masks.disocclusion_mask between the two HR G-buffers. There are none at a reset or a start.",
}
"""Definitions of the regions that results are measured on (`jaxsr.evaluation.regions`), by name."""


@dataclass(frozen=True)
class MethodResult:
    """One method on one sequence and task."""

    name: str
    images: Sequence[ImageOrPath]
    metrics: Mapping[str, Values]
    """Over all pixels."""
    timing: Timing | None = None
    note: str = ""
    flip_maps: Sequence[bytes] = ()
    """FLIP error maps of the page as grey JPEG (`flip_jpeg`), one per frame; empty if not wanted."""
    regions: Mapping[str, Mapping[str, Values]] = field(default_factory=dict)
    """The metrics again, over the pixels of a region alone: region -> metric -> values."""
    cost: Cost | None = None

    def over(self, region: str) -> Mapping[str, Values]:
        """The metrics over the pixels of a region, "all" or one of `regions`; empty if not measured."""
        return self.metrics if region == ALL else self.regions.get(region, {})


@dataclass(frozen=True)
class SequenceResult:
    """One sequence and task, for instance "bunker, x4, every second frame extrapolated"."""

    title: str
    frames: Sequence[int]
    """Numbers of the frames, as in the file names."""
    truths: Sequence[ImageOrPath]
    methods: Sequence[MethodResult]
    inputs: Sequence[ImageOrPath | None] = ()
    """The input of the methods at render size; None for a frame that was not rendered."""
    extrapolated: Sequence[bool] = ()
    """True for frames that every method had to extrapolate; empty if there are none."""
    exposures: Sequence[float] = (1.0,)
    """Of the frames; linear colour was multiplied by it before the tone map. One for all will do."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    task: str = ""
    """Sections with the same task are also averaged; an empty task is not."""

    def __post_init__(self) -> None:
        n = len(self.frames)
        if n == 0:
            raise JaxsrError("no frames", where=self.title)
        if not self.methods:
            raise JaxsrError("no methods", where=self.title)
        names = [t.name for t in self.methods]
        if len(set(names)) != len(names):
            raise JaxsrError("two methods have the same name", where=self.title, found=names)
        counts = {"truths": len(self.truths)}
        counts |= {"inputs": len(self.inputs)} if self.inputs else {}
        counts |= {"extrapolated": len(self.extrapolated)} if self.extrapolated else {}
        for result in self.methods:
            counts[f"images of {result.name}"] = len(result.images)
            counts |= {f"FLIP maps of {result.name}": len(result.flip_maps)} if result.flip_maps else {}
            for region in (ALL, *result.regions):
                for key, values in result.over(region).items():
                    counts[f"{key} of {result.name}{'' if region == ALL else ', ' + region}"] = len(values)
                    if key not in METRICS:
                        raise JaxsrError(
                            f"unknown metric '{key}'",
                            where=f"{self.title}, {result.name}",
                            expected=sorted(METRICS),
                        )
        for what, count in counts.items():
            if count != n:
                raise JaxsrError(
                    f"{what}: wrong number", where=self.title, expected=f"{n} (frames)", found=count
                )

    def metric_keys(self) -> list[str]:
        """Keys of the metrics that any method has, in the order of `METRICS`."""
        return [key for key in METRICS if any(key in result.metrics for result in self.methods)]

    def regions(self) -> list[str]:
        """ "all", and the regions that any method was measured on."""
        return list(dict.fromkeys([ALL, *(region for result in self.methods for region in result.regions)]))

    def subsets(self) -> dict[str, list[int]]:
        """Positions of the frames to average over: "all", and "extrapolated" and "rendered" if both exist."""
        everything = list(range(len(self.frames)))
        if not any(self.extrapolated) or all(self.extrapolated):
            return {"all": everything}
        return {
            "extrapolated": [i for i in everything if self.extrapolated[i]],
            "rendered": [i for i in everything if not self.extrapolated[i]],
            "all": everything,
        }
