"""Progress on stderr: bars with rate and remaining time, and the types of the callbacks that drive them.

Where stderr is no terminal, a line says now and then how far each bar is. What takes time accepts a
`Progress`; commands hand in `Bars`, and library callers may hand in a function of their own.
"""

import math
import time
from collections.abc import Callable

Advance = Callable[[], object]
"""Called after each step."""
Progress = Callable[[str, int], Advance]
"""Called with a title and the number of steps; returns what is called after each step."""


def silent(title: str, total: int) -> Advance:
    """The `Progress` that shows nothing."""
    return lambda: None


class Bars:
    """Bars on stderr; a `Progress`. Use it in a `with` block.

    Args:
        quiet: show nothing.
    """

    LINE_SECONDS = 30.0
    """Between two lines where stderr is no terminal."""

    def __init__(self, *, quiet: bool = False):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True, quiet=quiet, soft_wrap=True, highlight=False)
        columns = (
            TextColumn("{task.description:>9}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[count]}", style="green"),
            TextColumn("{task.fields[note]}", style="bold", markup=False),
            TextColumn("{task.fields[rate]}", style="cyan"),
            TimeElapsedColumn(),
            TextColumn("left {task.fields[left]}"),
        )
        self._progress = Progress(*columns, console=self._console)
        self._printed = time.monotonic()

    def __enter__(self) -> "Bars":
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._console.is_terminal:
            self._progress.stop()

    def __call__(self, title: str, total: int) -> Advance:
        return self.start(title, total).advance

    def start(self, title: str, total: float | None, done: float = 0, unit: str = "step") -> "Bar":
        """One more bar.

        Args:
            title: what is done; one word where possible.
            total: how many units there are; None where `Bar.update` will tell.
            done: how many of them were done before.
            unit: one of them, for the rate: "frame" gives "2.1 frames/s" or "3.4 s/frame".
        """
        return Bar(self, title, total, done, unit)

    def say(self, text: str) -> None:
        """A line above the bars."""
        self._printed = time.monotonic()
        self._console.print(text, markup=False)


class Bar:
    """One bar of `Bars`, which starts it.

    Attributes:
        done: units that are done.
        rate: as text; "-" until it is known.
    """

    def __init__(self, bars: Bars, title: str, total: float | None, done: float, unit: str):
        self.done, self.rate, self._note = done, "-", ""
        self._bars, self._title, self._total, self._unit = bars, title, total, unit
        self._times: list[tuple[float, float]] = []
        self._task = bars._progress.add_task(
            title, total=total, completed=int(done), count=self._count(), note="", rate="-", left="-"
        )

    def advance(self) -> None:
        """One more unit is done."""
        self.update(self.done + 1)

    def update(self, done: float, note: str | None = None, total: float | None = None) -> None:
        """So many units are done.

        Args:
            done: of all, those of earlier runs included.
            note: a few words beside the bar; None keeps the last ones.
            total: where it is known only now.
        """
        now, self.done = time.monotonic(), done
        self._note = self._note if note is None else note
        self._total = self._total if total is None else total
        self._times = [*self._times[-29:], (now, done)]
        then, first = self._times[0]
        speed = (done - first) / (now - then) if now > then else 0.0
        left = "-"
        if speed > 0:
            one = speed >= 1
            self.rate = f"{speed:.2f} {self._unit}s/s" if one else f"{1 / speed:.2f} s/{self._unit}"
            left = "-" if self._total is None else _clock((self._total - done) / speed)
        self._bars._progress.update(
            self._task,
            total=self._total,
            completed=done,
            count=self._count(),
            note=self._note,
            rate=self.rate,
            left=left,
        )
        bars = self._bars
        if not bars._console.is_terminal and now - bars._printed > bars.LINE_SECONDS:
            words = [self._note, self.rate, f"{left} left"]
            bars.say(f"{self._title} {self._count()}: {', '.join(filter(None, words))}")

    def pause(self) -> None:
        """What comes now does not count towards the rate."""
        self._times = []

    def say(self, text: str) -> None:
        """A line above the bars."""
        self._bars.say(text)

    def _count(self) -> str:
        done = f"{math.floor(self.done * 10) / 10:.1f}".removesuffix(".0")
        return done if self._total is None else f"{done}/{self._total:g}"


def _clock(seconds: float) -> str:
    minutes, s = divmod(round(max(seconds, 0)), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}"
