"""How good the network is while it trains: the method's own steps on frames that it is not trained on.

Of each window the last rendered frame is measured and, where the cadence has such frames, the last one that
was not rendered. The frames before it, those of the warm-up included, fill the history. No frame of the
warm-up is measured.
"""

from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxsr.data.windows import WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import Frame
from jaxsr.methods import Method, Windows
from jaxsr.metrics import psnr, ssim
from jaxsr.ops import to_display

FRAMES = 8
"""Windows that are measured, at most, evenly over all."""
SHOWN = 4
"""Rows of a picture, at most."""
TILE = (216, 384)
"""Height and width of what the picture shows of a frame, at most: its middle, pixel by pixel."""
Kind = Literal["rendered", "extrapolated"]


class Evaluation(NamedTuple):
    """What an evaluation found."""

    metrics: dict[str, float]
    """"psnr" in dB and "ssim" of display-referred colour, means over all measured frames. Where windows have
    both kinds of frames, also "psnr_rendered", "psnr_extrapolated", "ssim_rendered", "ssim_extrapolated"."""
    picture: Float[np.ndarray, "h w 3"]
    """One row per frame: the last LR colour that was rendered, enlarged; the network's frame; the truth."""


def evaluation_windows(windows: Windows) -> Windows:
    """Windows like these, whose frames to be made are those that an evaluation measures.

    Raises:
        JaxsrError: all frames belong to the warm-up.
    """
    made = []
    for rendered in (True, False):
        kind = [t for t, r in enumerate(windows.cadence) if r == rendered and t >= windows.warmup]
        made += kind[-1:]
    if not made:
        raise JaxsrError("no frame of a window is left to evaluate", found=f"a warm-up of {windows.warmup}")
    return windows._replace(made=tuple(sorted(made)), lr_truth=False)


def held_back_frames(windows: Windows) -> int:
    """Frames at the end of a sequence that training must leave out, so that they can be measured."""
    return windows.length - evaluation_windows(windows).targets[0]


def score_names(windows: Windows) -> tuple[str, ...]:
    """The numbers that an evaluation of these windows gives."""
    targets = evaluation_windows(windows).targets
    kinds = ("", "_rendered", "_extrapolated") if len(targets) > 1 else ("",)
    return tuple(f"{name}{kind}" for name in ("psnr", "ssim") for kind in kinds)


class Evaluator:
    """Measures a network on a few windows.

    Args:
        method: its steps run over each window, as the cadence says.
        source: of windows as `evaluation_windows` gives them; its truth is that of the measured frames.
        last_only: measure only the last window of each sequence, whose measured frames are held back from
            training.

    Attributes:
        sequences: the folders.
        frames: what is measured, in words.

    Raises:
        JaxsrError: there is no such window.
    """

    def __init__(self, method: Method, source: WindowSource, *, last_only: bool = False):
        self._source, length = source, source.windows.length
        possible = []
        for i in range(len(source)):
            k, start = source.place(i)
            if not last_only or start + length == len(source.sequences[k]):
                possible.append(i)
        if not possible:
            raise JaxsrError("no frames to evaluate on", where="--eval-data", fix="name other sequences")
        chosen = np.linspace(0, len(possible) - 1, min(FRAMES, len(possible))).round().astype(int)
        self._chosen = [possible[i] for i in chosen]
        names = []
        for i in self._chosen:
            k, start = source.place(i)
            clip = source.sequences[k]
            names += [f"{clip.name} {clip.infos[start + t].index}" for t in source.windows.targets]
        self.frames = ", ".join(names) + (", held back from training" if last_only else "")
        self.sequences = [clip.path for clip in source.sequences]
        self._init = jax.jit(method.init)
        self._steps = {True: jax.jit(method.upscale), False: jax.jit(method.extrapolate)}

    def __call__(self, net: Any) -> Evaluation:
        """Run the steps with the net (an `nnx.State`), and measure.

        Raises:
            JaxsrError: the network makes NaN.
        """
        net = jax.device_put(net, jax.local_devices()[0])
        scores: dict[Kind, list[tuple[float, float]]] = {"rendered": [], "extrapolated": []}
        rows: list[np.ndarray] = []
        for i in self._chosen:
            window = jax.tree.map(lambda x: x[0], stack([self._source[i]]))
            images = self._run(net, window.frames)
            for t, truth in zip(self._source.windows.targets, window.truth_linear, strict=True):
                exposure = window.frames.exposure[t]
                pair = [np.asarray(to_display(x, exposure)) for x in (images[t], truth)]
                kind: Kind = "rendered" if self._source.windows.cadence[t] else "extrapolated"
                scores[kind].append((psnr(*pair), ssim(*pair)))
                if len(rows) < SHOWN:
                    rows.append(self._row(window.frames, t, pair))
        width = max(row.shape[1] for row in rows)
        rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
        return Evaluation(_means(scores), np.concatenate(rows).clip(0, 1))

    def _run(self, net: Any, frames: Frame) -> list[np.ndarray]:
        """The frames of a window as the steps make them, HR linear."""
        state, images = None, []
        for t, rendered in enumerate(self._source.windows.cadence):
            frame = jax.tree.map(lambda x, t=t: x[t], frames)
            if state is None:  # a window may begin in the middle of a shot, whose past it lacks
                frame = frame._replace(reset=np.asarray(True))
                state = self._init(frame)
            state, image = self._steps[rendered](net, state, frame)
            images.append(np.asarray(image))
        return images

    def _row(self, frames: Frame, t: int, pair: list[np.ndarray]) -> np.ndarray:
        last = max(k for k in range(t + 1) if self._source.windows.cadence[k])
        given = np.asarray(to_display(frames.color_linear[last], frames.exposure[last]))
        enlarged = given.repeat(frames.scale, 0).repeat(frames.scale, 1)
        return np.concatenate([_middle(x) for x in (enlarged, *pair)], axis=1)


def _means(scores: dict[Kind, list[tuple[float, float]]]) -> dict[str, float]:
    kinds = {f"_{kind}": values for kind, values in scores.items() if values}
    groups = {"": [pair for values in kinds.values() for pair in values]}
    if len(kinds) > 1:
        groups |= kinds
    means = {suffix: np.mean(values, axis=0) for suffix, values in groups.items()}
    psnrs = {f"psnr{suffix}": float(mean[0]) for suffix, mean in means.items()}
    return psnrs | {f"ssim{suffix}": float(mean[1]) for suffix, mean in means.items()}


def _middle(image: np.ndarray) -> np.ndarray:
    (h, w), (most_h, most_w) = image.shape[:2], TILE
    y, x = max(h - most_h, 0) // 2, max(w - most_w, 0) // 2
    return image[y : y + most_h, x : x + most_w]
