"""The stream of training batches: seeded, endless, and resumable to the bit.

Grain draws it: all windows in a new order each epoch, a new crop and flip for each, by the position in the
stream alone, so that a position is all there is to save. Batches run on over the ends of epochs: none is
short, however few windows there are. Processes take turns at the windows of the same stream. Batches are
read in threads, a few ahead.
"""

import functools
import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import grain

from jaxsr.data.augment import random_crop
from jaxsr.data.cache import source_key
from jaxsr.data.windows import WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import Window
from jaxsr.io.find import find_sequences
from jaxsr.progress import Progress, silent

_THREADS, _AHEAD = 2, 4


class Loader(Iterator[Window]):
    """Endless batches of windows, leaves NumPy `[B, T, ...]`. Made by `make_loader`.

    Attributes:
        windows: how many different windows there are: one epoch, over all processes.
        sequences: the folders that they come from.
    """

    def __init__(self, source: WindowSource, dataset: grain.MapDataset, stream: str):
        self.sequences = [clip.path for clip in source.sequences]
        self.windows = len(source)
        self._stream = stream
        options = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=_AHEAD)
        self._batches = iter(dataset.to_iter_dataset(options))

    def __next__(self) -> Window:
        return next(self._batches)

    def get_state(self) -> dict[str, Any]:
        """The position, to be kept as JSON: the next batch after `set_state` of it is the one due now."""
        return {"position": self._batches.get_state(), "stream": self._stream}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on where `get_state` was called.

        Raises:
            JaxsrError: the position belongs to other data or other arguments.
        """
        if state.get("stream") != self._stream:
            raise JaxsrError(
                "the position in the training data belongs to other data or other options",
                expected=self._stream,
                found=state.get("stream"),
                fix="resume with the same sequences, scale, crop, batch, seed and processes, or start anew",
            )
        self._batches.set_state(state["position"])

    def close(self) -> None:
        """End the threads."""
        self._batches.close()


def make_loader(
    sequences: Iterable[str | Path],
    *,
    scale: int,
    needs: frozenset[str],
    window: int = 1,
    batch: int = 8,
    crop: int = 128,
    flips: bool = True,
    vertical_flips: bool = False,
    held_back: int = 0,
    seed: int = 0,
    cache: Path | None = None,
    process_index: int = 0,
    process_count: int = 1,
    progress: Progress = silent,
) -> Loader:
    """Batches of random crops of windows of consecutive frames; the first call converts the sequences.

    Args:
        sequences: as in `find_sequences`.
        scale: HR size divided by LR size.
        needs: buffers that the method wants, such as "lr.color"; others are left out (see `WindowSource`).
        window: consecutive frames in a window (T).
        batch: windows in a batch of this process (B).
        crop: side of the square crops in HR pixels, a multiple of the scale.
        flips: mirror every second window left to right.
        vertical_flips: mirror every second window top to bottom.
        held_back: frames at the end of each sequence that are left out, to be evaluated on.
        seed: of the order, the crops and the flips; 0 to 2**32 - 1.
        cache: folder for the converted arrays, by default `cache.default_cache()`.
        process_index, process_count: this process takes every `process_count`-th window of the stream.
        progress: told of each frame that is converted.

    Raises:
        JaxsrError: arguments out of range, a crop that does not fit, and what `WindowSource` raises.
    """
    for name, value in (("batch", batch), ("crop", crop), ("scale", scale)):
        if value < 1:
            raise JaxsrError(f"bad {name}", expected="1 or more", found=value)
    if not 0 <= seed < 2**32:
        raise JaxsrError("bad seed", expected="0 to 2**32 - 1", found=seed)
    if crop % scale:
        raise JaxsrError("bad crop", expected=f"a multiple of the scale {scale}", found=crop)
    if not 0 <= process_index < process_count:
        raise JaxsrError("bad process", expected=f"0 to {process_count - 1}", found=process_index)
    source = WindowSource(
        find_sequences(sequences),
        scale=scale,
        needs=needs,
        length=window,
        held_back=held_back,
        cache=cache,
        progress=progress,
    )
    for clip in source.sequences:
        if crop > min(clip.size):
            raise JaxsrError(
                "the crop is larger than the frames",
                where=clip.path,
                expected=f"at most {min(clip.size) // scale * scale}",
                found=crop,
            )
    augment = functools.partial(random_crop, crop_px=crop, flips=flips, vertical_flips=vertical_flips)
    # Crops are drawn before the processes part, or all would draw the same; batches come after `repeat`, or
    # each epoch would lose its last windows, and a small data set all of them.
    dataset = grain.MapDataset.source(source).seed(seed).shuffle().random_map(augment).repeat()
    dataset = dataset[process_index::process_count].batch(batch, drop_remainder=True, batch_fn=stack)
    data = [source_key(clip, r, times=False) for clip in source.sequences for r in source.resolutions]
    options = [
        scale,
        window,
        batch,
        crop,
        flips,
        vertical_flips,
        held_back,
        seed,
        process_index,
        process_count,
    ]
    stream = hashlib.sha256(json.dumps([data, options]).encode()).hexdigest()[:16]
    return Loader(source, dataset, stream)
