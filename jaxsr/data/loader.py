"""The stream of training batches: seeded, endless, and resumable to the bit.

Grain draws it: all windows in a new order in each epoch, and a new crop and flip for each window. All of it
follows from the position in the stream alone, so that nothing but the position must be saved. Batches
continue across the ends of epochs: each is full, however few windows there are. Processes take turns at the
windows of the same stream. Threads read a few batches ahead.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import grain

from jaxsr.data.augment import random_crop
from jaxsr.data.cache import source_key
from jaxsr.data.windows import WindowSource, stack
from jaxsr.errors import JaxsrError
from jaxsr.frames import Window

_THREADS, _AHEAD = 2, 4


@dataclass(frozen=True)
class Stream:
    """How batches are drawn from the windows of a `WindowSource`."""

    batch: int = 8
    """Windows in a batch of this process."""
    crop: int = 128
    """Side of the square crops in HR pixels, a multiple of the scale."""
    flips: bool = True
    """Mirror every second window left to right."""
    vertical_flips: bool = False
    """Mirror every second window top to bottom."""
    seed: int = 0
    """Of the order, the crops and the flips; 0 to 2**32 - 1."""
    process_index: int = 0
    """This process takes every `process_count`-th window of the stream, from this one on."""
    process_count: int = 1
    """Processes that share the stream."""

    def check(self) -> None:
        """Raise JaxsrError if a value is out of range."""
        for name in ("batch", "crop"):
            if getattr(self, name) < 1:
                raise JaxsrError(f"bad {name}", expected="1 or more", found=getattr(self, name))
        if not 0 <= self.seed < 2**32:
            raise JaxsrError("bad seed", expected="0 to 2**32 - 1", found=self.seed)
        if not 0 <= self.process_index < self.process_count:
            expected = f"0 to {self.process_count - 1}"
            raise JaxsrError("bad process", expected=expected, found=self.process_index)


def check_crop(crop: int, scale: int, multiple: int = 1, where: str | None = None) -> None:
    """See that crops lie on whole LR pixels, and that their LR sides are multiples of `multiple`.

    Raises:
        JaxsrError: they are not; it names sizes that are.
    """
    unit = scale * multiple
    if crop >= 1 and crop % unit == 0:
        return
    below = crop // unit * unit
    sizes = [str(n) for n in (below, below + unit) if n >= unit]
    why = f"the scale {scale}"
    if multiple > 1:
        why = f"{unit}: the network takes LR sides that are multiples of {multiple}, at scale {scale}"
    fix = f"choose {' or '.join(sizes)}"
    raise JaxsrError("bad crop", where=where, expected=f"a multiple of {why}", found=crop, fix=fix)


class Loader(Iterator[Window]):
    """Endless batches of random crops of windows; leaves are NumPy arrays `[B, T, ...]`.

    Args:
        source: of the windows.
        stream: size, order and crops of the batches.

    Attributes:
        windows: how many different windows there are: one epoch, over all processes.
        sequences: the folders that they come from.

    Raises:
        JaxsrError: values out of range, or a crop that does not fit the frames, the scale or the network.
    """

    def __init__(self, source: WindowSource, stream: Stream):
        stream.check()
        unit = source.scale * source.windows.multiple
        check_crop(stream.crop, source.scale, source.windows.multiple)
        for clip in source.sequences:
            if stream.crop > min(clip.size):
                raise JaxsrError(
                    "the crop is larger than the frames",
                    where=clip.path,
                    expected=f"at most {min(clip.size) // unit * unit}",
                    found=stream.crop,
                )
        self.sequences = [clip.path for clip in source.sequences]
        self.windows = len(source)
        self._stream = _stream_key(source, stream)
        options = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=_AHEAD)
        self._batches = iter(_dataset(source, stream).to_iter_dataset(options))

    def __next__(self) -> Window:
        return next(self._batches)

    def get_state(self) -> dict[str, Any]:
        """The position, as JSON types: after `set_state` of it, the batch that is due now comes next."""
        return {"position": self._batches.get_state(), "stream": self._stream}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue where `get_state` was called.

        Raises:
            JaxsrError: the position belongs to other data or other options.
        """
        if state.get("stream") != self._stream:
            raise JaxsrError(
                "the position in the training data belongs to other data or other options",
                expected=self._stream,
                found=state.get("stream"),
                fix="resume with the same sequences, windows, scale, crop, batch, seed and processes, or "
                "start anew",
            )
        self._batches.set_state(state["position"])

    def close(self) -> None:
        """End the threads."""
        self._batches.close()


def _dataset(source: WindowSource, stream: Stream) -> grain.MapDataset:
    augment = functools.partial(
        random_crop, crop_px=stream.crop, flips=stream.flips, vertical_flips=stream.vertical_flips
    )
    # Crops are drawn before the processes take their shares, or all processes would draw the same crops.
    # Batches are made after `repeat`, or each epoch would lose its last windows.
    dataset = grain.MapDataset.source(source).seed(stream.seed).shuffle().random_map(augment).repeat()
    dataset = dataset[stream.process_index :: stream.process_count]
    return dataset.batch(stream.batch, drop_remainder=True, batch_fn=stack)


def _stream_key(source: WindowSource, stream: Stream) -> str:
    """A hash of all that the batches depend on, but for the buffers that are read."""
    data = [source_key(clip, r, times=False) for clip in source.sequences for r in source.resolutions]
    windows = source.windows
    options = [
        source.scale,
        source.held_back,
        windows.cadence,
        windows.targets,
        windows.lr_truth,
        dataclasses.asdict(stream),
    ]
    return hashlib.sha256(json.dumps([data, options]).encode()).hexdigest()[:16]
