"""The command line: `jaxsr demo | inspect | compare | upscale | render`.

A mistake in the input is one line on stderr and exit status 2. Heavy imports wait until a command runs, so
that `jaxsr --help` answers at once.
"""

import json as json_module
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxsr.errors import JaxsrError

Positional = tyro.conf.Positional

app = tyro.extras.SubcommandApp()


@contextmanager
def _progress() -> Iterator[Callable[[str, int], Callable[[], Any]]]:
    """A bar with rate and remaining time; gives a function that starts a bar and returns its `advance`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class RateColumn(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.1f}/s", style="cyan")

    columns = (
        TextColumn("{task.description:>9}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:

        def start(title: str, total: int) -> Callable[[], Any]:
            task = bar.add_task(title, total=total)
            return lambda: bar.advance(task)

        yield start


@app.command
def demo(
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-demo"),
    scale: int = 2,
    scenes: tuple[str, ...] = (),
) -> None:
    """Upscale and extrapolate the sample that ships with jaxsr; write frames, videos, metrics and a page.

    Args:
        out: folder for everything that is made.
        scale: of the low-resolution frames to start from, 2 or 4.
        scenes: only these of the sample's scenes, by name.
    """
    from rich.console import Console

    from jaxsr.evaluation.demo import run_demo, sample_sequences
    from jaxsr.evaluation.tables import rich_tables

    sequences = sample_sequences()
    names = [path.name.split("-")[0] for path in sequences]
    unknown = sorted(set(scenes) - set(names))
    if unknown:
        raise JaxsrError(f"no scene {unknown[0]!r} in the sample", expected=", ".join(names))
    chosen = [path for path, name in zip(sequences, names, strict=True) if not scenes or name in scenes]
    with _progress() as progress:
        sections = run_demo(out, chosen, scale=scale, progress=progress)
    console = Console()
    for table in rich_tables(sections):
        console.print(table)
    print(f"Open {out / 'report.html'}; frames, videos and metrics.json are beside it.")


@app.command
def inspect(
    sequence: Positional[Path],
    json: bool = False,
) -> None:
    """Look through a sequence: buffers, motion convention, jitter, and what each method lacks.

    Args:
        sequence: folder of the sequence.
        json: print the findings for machines instead of people.
    """
    from jaxsr.evaluation.inspect import inspect as inspect_sequence
    from jaxsr.evaluation.inspect import print_report
    from jaxsr.io.sequence import Sequence
    from jaxsr.methods import METHODS

    report = inspect_sequence(
        Sequence.open(sequence, check=False), {name: method.needs for name, method in METHODS.items()}
    )
    if json:
        print(json_module.dumps(report.to_json(), indent=1))
    else:
        print_report(report)


@app.command
def compare(
    folders: Positional[tuple[Path, ...]],
    truth: Path,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-compare"),
    exposure: float = 1.0,
    fps: float = 24.0,
) -> None:
    """Measure folders of frames against the truth and write the comparison page.

    Args:
        folders: frames of each method, PNG (as shown) or EXR (linear colour), matched by number.
        truth: the true frames.
        out: folder for the page and the metrics.
        exposure: factor on linear colour before the tone map.
        fps: playing speed on the page.
    """
    raise NotImplementedError


@app.command
def upscale(
    sequence: Positional[Path],
    method: str = "guided",
    scale: int = 0,
    every: int = 1,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-upscaled"),
) -> None:
    """Upscale a sequence, and make the frames that were not rendered.

    Args:
        sequence: folder of the sequence.
        method: one of the methods that README lists.
        scale: of the low-resolution frames to start from; 0 takes the largest there is, 1 takes the
            high-resolution frames and makes only those between.
        every: every n-th frame counts as rendered; the others are extrapolated.
        out: folder for `exr/` (linear) and `png/` (as shown).
    """
    from jaxsr.evaluation.run import find_method
    from jaxsr.evaluation.upscale import upscale as upscale_sequence
    from jaxsr.io.sequence import Sequence

    opened = Sequence.open(sequence)
    with _progress() as progress:
        _, timing = upscale_sequence(
            opened,
            find_method(method),
            out,
            scale=scale or max(opened.scales, default=1),
            every=every,
            advance=progress("frames", len(opened)),
        )
    print(
        f"{len(opened)} frames in {out}: {timing.median_ms:.1f} ms a frame, "
        f"compiled in {timing.compile_s:.1f} s"
    )


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 and one line on bad input."""
    try:
        app.cli(prog="jaxsr", args=arguments, description="Cheap renders in, expensive-looking frames out.")
    except JaxsrError as error:
        print(f"jaxsr: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("jaxsr: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
