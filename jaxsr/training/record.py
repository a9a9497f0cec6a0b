"""What a training leaves to look at: `log.csv`, TensorBoard, pictures and the loss curve.

When a training resumes from a checkpoint, rows and events of later steps are dropped.
"""

import contextlib
import csv
import io
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, read_bytes, write_text
from jaxsr.io.images import write_png

LOG_BYTES = 256 << 20
"""Largest log that is read."""


class Log:
    """One row of numbers per step that is logged, in `log.csv` and in TensorBoard.

    A field of the CSV is empty where its row has no such number.

    Args:
        out: folder of the training.
        step: the step of the checkpoint from which the training resumes; 0 for a new one. Rows of later steps
            are dropped.

    Raises:
        JaxsrError: log.csv is not a log of a training.
    """

    def __init__(self, out: Path, step: int):
        self._out, self._file = out, out / "log.csv"
        self.rows = [row for row in _read(self._file) if row["step"] <= step and step]
        self._columns = list(dict.fromkeys(name for row in self.rows for name in row))
        self._rewrite()
        self._board = _Board(out / "tensorboard", step)

    def add(self, row: dict[str, float]) -> None:
        """Add a row; "step" must be among its numbers."""
        self.rows.append(row)
        new = [name for name in row if name not in self._columns]
        self._columns += new
        if new:
            self._rewrite()
        else:
            with _write_errors(self._file), self._file.open("a", encoding="utf-8", newline="") as file:
                self._writer(file).writerow(row)
        self._board.scalars({name: value for name, value in row.items() if name != "step"}, int(row["step"]))

    def picture(self, image: Float[np.ndarray, "h w 3"], step: int) -> None:
        """`pictures/step-000500.png`, and the same in TensorBoard."""
        write_png(self._out / "pictures" / f"step-{step:06d}.png", image)
        self._board.image("input, network, truth", image, step)

    def curve(self) -> None:
        """`loss.png`: the loss, and the PSNR of the evaluations, over the steps."""
        plot_curve(self._out / "loss.png", self.rows)

    def flush(self) -> None:
        """Write what was added so far to TensorBoard's file."""
        self._board.flush()

    def close(self) -> None:
        """Close TensorBoard's file."""
        self._board.close()

    def _writer(self, file: Any) -> csv.DictWriter:
        return csv.DictWriter(file, self._columns, restval="", lineterminator="\n")

    def _rewrite(self) -> None:
        text = io.StringIO()
        writer = self._writer(text)
        if self._columns:
            writer.writeheader()
        writer.writerows(self.rows)
        write_text(self._file, text.getvalue())


class _Board:
    """TensorBoard's file, written in this thread.

    tensorboardX has a writer with a thread of its own; a full disk ends that thread, and `close` then waits
    for it forever.
    """

    def __init__(self, folder: Path, step: int):
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2

        self._folder, self._event = folder, event_pb2.Event
        with _write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = EventsWriter(str(folder / "events"), f".{os.getpid()}-{step}")
        if step:  # TensorBoard drops what earlier files say of later steps
            self._add(step + 1, session_log=event_pb2.SessionLog(status=event_pb2.SessionLog.START))

    def _add(self, step: int, **content: Any) -> None:
        with _write_errors(self._folder):
            self._file.write_event(self._event(step=step, wall_time=time.time(), **content))

    def scalars(self, values: dict[str, float], step: int) -> None:
        from tensorboardX.summary import scalar

        for name, value in values.items():
            self._add(step, summary=scalar(name, value))

    def image(self, name: str, image: np.ndarray, step: int) -> None:
        from tensorboardX.summary import image as summary

        self._add(step, summary=summary(name, image, dataformats="HWC"))

    def flush(self) -> None:
        with _write_errors(self._folder):
            self._file.flush()

    def close(self) -> None:
        with contextlib.suppress(OSError):  # `flush` has reported it
            self._file.close()


@contextlib.contextmanager
def _write_errors(where: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        raise JaxsrError("cannot write", where=where, found=e.strerror or e, fix="check the folder") from e


def _read(file: Path) -> list[dict[str, float]]:
    if not file.is_file():
        return []
    try:
        # A writer that was killed may have left a part of the last line.
        whole = read_bytes(file, LOG_BYTES).decode().rpartition("\n")[0]
        rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(whole.splitlines())]
        return [row | {"step": int(row["step"])} for row in rows]
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, csv.Error) as e:
        raise JaxsrError("not the log of a training", where=file, found=e, fix="delete it") from e


def plot_curve(path: Path, rows: list[dict[str, float]]) -> None:
    """Loss (each row, and smoothed) on a logarithmic axis over PSNR and SSIM of the evaluations, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    losses = np.array([(row["step"], row["loss"]) for row in rows if "loss" in row], float).reshape(-1, 2)
    figure = Figure(figsize=(7, 7), layout="constrained")
    FigureCanvasAgg(figure)
    top, *below = figure.subplots(3, 1, sharex=True)
    top.plot(losses[:, 0], losses[:, 1], color="tab:blue", alpha=0.35, linewidth=0.8)
    top.plot(losses[:, 0], _smooth(losses[:, 1]), color="tab:blue")
    if (losses[:, 1] > 0).all():
        top.set_yscale("log")
        top.yaxis.set_major_formatter("{x:.3g}")
        top.yaxis.set_minor_formatter("{x:.3g}")
    top.set_ylabel("loss")
    for axes, key, label in zip(below, ("psnr", "ssim"), ("PSNR (dB)", "SSIM"), strict=True):
        scores = [(row["step"], row[f"eval/{key}"]) for row in rows if f"eval/{key}" in row]
        axes.plot(*np.array(scores, float).reshape(-1, 2).T, color="tab:green", marker=".")
        axes.set_ylabel(f"{label} of the evaluation")
    below[-1].set_xlabel("step")
    for axes in (top, *below):
        axes.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _smooth(values: np.ndarray) -> np.ndarray:
    """The mean over a twentieth of the values, centred; shorter at the ends."""
    n = len(values)
    half = n // 40
    total = np.concatenate([[0.0], np.cumsum(values)])
    low, high = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half + 1, n)
    return (total[high] - total[low]) / (high - low)
