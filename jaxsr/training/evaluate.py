"""How good the network is while it trains: the method's own step on frames that it is not trained on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxsr.data.windows import WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.methods import Method
from jaxsr.methods.base import step
from jaxsr.metrics import psnr, ssim
from jaxsr.ops import to_display
from jaxsr.progress import Progress, silent

FRAMES = 8
"""Frames that are measured, at most, evenly over all."""
SHOWN = 4
"""Frames in a picture, at most."""
TILE = (216, 384)
"""Height and width of what the picture shows of a frame, at most: its middle, pixel by pixel."""


class Evaluation(NamedTuple):
    """What an evaluation found."""

    metrics: dict[str, float]
    """"psnr" in dB and "ssim", means over the frames, of display-referred colour."""
    picture: Float[np.ndarray, "h w 3"]
    """A row a frame: the input enlarged, what the network made, the truth."""


class Evaluator:
    """Measures a network on a few frames.

    Args:
        method: its step is run over the `window` frames up to each that is measured.
        sequences: where the frames come from.
        scale, needs, window: as in `jaxsr.data.loader.make_loader`.
        held_back: only the last so many frames of each sequence; 0 takes any.
        cache, progress: as in `make_loader`.

    Attributes:
        sequences: the folders.
        frames: what is measured, in words.

    Raises:
        JaxsrError: the sequences cannot be read or lack what the method needs.
    """

    def __init__(
        self,
        method: Method,
        sequences: Sequence[Path],
        *,
        scale: int,
        needs: frozenset[str],
        window: int = 1,
        held_back: int = 0,
        cache: Path | None = None,
        progress: Progress = silent,
    ):
        self._source = WindowSource(
            sequences, scale=scale, needs=needs, length=window, cache=cache, progress=progress
        )
        possible = []
        for i in range(len(self._source)):
            k, start = self._source.place(i)
            if not held_back or start + window > len(self._source.sequences[k]) - held_back:
                possible.append(i)
        if not possible:
            raise JaxsrError("no frames to evaluate on", where="--eval-data", fix="name other sequences")
        chosen = np.linspace(0, len(possible) - 1, min(FRAMES, len(possible))).round().astype(int)
        self._windows = [possible[i] for i in chosen]
        names = []
        for i in self._windows:
            k, start = self._source.place(i)
            clip = self._source.sequences[k]
            names.append(f"{clip.name} {clip.infos[start + window - 1].index}")
        self.frames = ", ".join(names) + (", held back from training" if held_back else "")
        self.sequences = [clip.path for clip in self._source.sequences]
        self._init, self._step = jax.jit(method.init), jax.jit(step(method))

    def __call__(self, net: Any) -> Evaluation:
        """Run the step with the net (an `nnx.State`), and measure.

        Raises:
            JaxsrError: the network makes NaN.
        """
        net = jax.device_put(net, jax.local_devices()[0])
        values, rows = [], []
        for number, i in enumerate(self._windows):
            window = jax.tree.map(lambda x: x[0], stack([self._source[i]]))
            image, shown = self._run(net, window.frames)
            exposure = window.frames.exposure[-1]
            pair = [np.asarray(to_display(x, exposure)) for x in (image, window.truth_linear[-1])]
            values.append((psnr(*pair), ssim(*pair)))
            if number < SHOWN:
                given = np.asarray(to_display(shown, exposure))
                factor = pair[1].shape[0] // given.shape[0]
                enlarged = given.repeat(factor, 0).repeat(factor, 1)
                rows.append(np.concatenate([_middle(x) for x in (enlarged, *pair)], axis=1))
        width = max(row.shape[1] for row in rows)
        rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
        means = np.mean(values, axis=0)
        return Evaluation({"psnr": float(means[0]), "ssim": float(means[1])}, np.concatenate(rows).clip(0, 1))

    def _run(self, net: Any, frames: Any) -> tuple[np.ndarray, np.ndarray]:
        """The last frame as the step makes it, HR linear; and its LR colour."""
        state = None
        for t in range(frames.reset.shape[0]):
            frame = jax.tree.map(lambda x, t=t: x[t], frames)
            if state is None:
                # The window begins in the middle of a shot; the step must not miss what came before.
                frame = frame._replace(reset=np.asarray(True))
                state = self._init(frame)
            state, image = self._step(net, state, frame)
        return np.asarray(image), frame.color_linear


def _middle(image: np.ndarray) -> np.ndarray:
    (h, w), (most_h, most_w) = image.shape[:2], TILE
    y, x = max(h - most_h, 0) // 2, max(w - most_w, 0) // 2
    return image[y : y + most_h, x : x + most_w]
