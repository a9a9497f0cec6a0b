"""What a training trains on, and what it is evaluated on: never the same frames."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import NamedSharding

from jaxsr.data.cache import default_cache
from jaxsr.data.loader import Loader, Stream
from jaxsr.data.sample import unpack_to_cache
from jaxsr.data.windows import WindowSource
from jaxsr.errors import JaxsrError
from jaxsr.frames import Window
from jaxsr.io.find import find_sequences
from jaxsr.io.sequence import Sequence
from jaxsr.io.truth import Truth, choose_truth
from jaxsr.methods import Method
from jaxsr.progress import Bars
from jaxsr.training.config import TrainConfig, identity
from jaxsr.training.evaluate import Evaluator, evaluation_windows, held_back_frames


class Data(NamedTuple):
    """Of one training."""

    loader: Loader
    evaluate: Evaluator
    truth: Truth
    """The layer that both have as their truth."""


def open_data(method: Method, config: TrainConfig, *, quiet: bool = False) -> Data:
    """Open the sequences; new ones are converted. Without `--data` they are the sample's training frames.

    Without `--eval-data`, frames at the end of each training sequence are held back: as many as it takes for
    all measured frames of the last window.

    Raises:
        JaxsrError: a sequence is in both sets, is too short, cannot be read or lacks something.
    """
    assert method.network is not None
    windows = method.network.windows
    with Bars(quiet=quiet) as progress:
        if config.data:
            trained = find_sequences(config.data)
        else:
            home = config.cache or default_cache().parent
            trained = unpack_to_cache(home, "train", config.scale, progress)
        if config.eval_data:
            evaluated, held_back = find_sequences(config.eval_data), 0
            _check_apart(trained, evaluated)
        else:
            evaluated, held_back = trained, held_back_frames(windows)
            _check_lengths(trained, windows.length, held_back)
        wanted = None if config.truth == "best" else config.truth
        truth = choose_truth([Sequence.open(path) for path in (*trained, *evaluated)], wanted)
        shared: Any = {"scale": config.scale, "truth": truth, "cache": config.cache, "progress": progress}
        measured = WindowSource(evaluated, method.needs, evaluation_windows(windows), **shared)
        source = WindowSource(trained, method.needs, windows, held_back=held_back, **shared)
    evaluate = Evaluator(method, measured, last_only=not config.eval_data)
    stream = Stream(batch=config.batch, crop=config.crop, flips=config.flips, seed=config.seed)
    return Data(Loader(source, stream), evaluate, truth)


def batches(loader: Loader, sharding: NamedSharding) -> Iterator[tuple[Window, dict[str, Any]]]:
    """Batches on the devices, each with the position in the data after it."""
    for window in loader:
        yield jax.device_put(window, sharding), loader.get_state()


def _check_apart(trained: list[Path], evaluated: list[Path]) -> None:
    seen = {identity(path) for path in evaluated}
    for path in trained:
        if identity(path) in seen:
            raise JaxsrError("is in --data and in --eval-data", where=path, fix="evaluate on other sequences")


def _check_lengths(trained: list[Path], length: int, held_back: int) -> None:
    frames = "a frame" if held_back == 1 else f"{held_back} frames"
    for path in trained:
        if (count := len(Sequence.open(path))) < length + held_back:
            raise JaxsrError(
                f"too short to hold back {frames} for evaluation",
                where=path,
                expected=f"at least {length + held_back} frames",
                found=count,
                fix="name sequences to evaluate on with --eval-data"
                if count >= length
                else "bring longer ones with --data",
            )
