"""The command line: `jaxsr demo | inspect | compare | upscale | evaluate | render | train | convert-weights`.

A mistake in the input is one line on stderr and exit status 2. Heavy imports wait until a command runs, so
that `jaxsr --help` answers at once.
"""

import io
import json as json_module
import os
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from jaxsr.errors import JaxsrError
from jaxsr.progress import Bars

app = tyro.extras.SubcommandApp()


@app.command
def demo(
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-demo"),
    scale: int = 2,
    scenes: tuple[str, ...] = (),
    lpips: bool = False,
) -> None:
    """Upscale and extrapolate the sample that ships with jaxsr; write frames, videos, metrics and a page.

    Args:
        out: the folder for all results.
        scale: the scale of the low-resolution frames, 2 or 4.
        scenes: names of the scenes to use; the default is all scenes of the sample.
        lpips: also measure LPIPS, if the extra `perceptual` is installed; this takes most of the time.
    """
    from rich.console import Console

    from jaxsr.data.sample import unpack_sample
    from jaxsr.evaluation.demo import run_demo
    from jaxsr.report.tables import rich_tables

    with Bars() as progress:
        sequences = unpack_sample(out / "sample", "test", scenes, scale, progress)
        sections = run_demo(out, sequences, scale=scale, lpips=lpips, progress=progress)
    console = Console()
    for table in rich_tables(sections, brief=True):
        console.print(table)
    print(f"Open {out / 'report.html'}; frames, videos and metrics.json are beside it.")


@app.command
def inspect(
    sequence: Positional[Path],
    json: bool = False,
) -> None:
    """Check a sequence: buffers, motion convention, jitter, and the buffers that each method lacks.

    The exit status is 0 if methods can use the sequence, 1 if something in it is wrong (all faults are
    listed), and 2 if it cannot be read as a sequence.

    Args:
        sequence: the folder of the sequence.
        json: print the findings as JSON for a program.
    """
    from jaxsr.inspection.inspect import inspect as inspect_sequence
    from jaxsr.inspection.inspect import print_report
    from jaxsr.io.sequence import Sequence
    from jaxsr.methods import METHODS

    report = inspect_sequence(
        Sequence.open(sequence, check=False),
        {name: method.needs.rendered for name, method in METHODS.items()},
    )
    if json:
        print(json_module.dumps(report.to_json(), indent=1))
    else:
        print_report(report)
    if report.level == "bad":
        raise SystemExit(1)


@app.command
def compare(
    folders: Positional[tuple[Path, ...]],
    truth: Path,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-compare"),
    exposure: float | None = None,
    fps: float = 4.0,
    lpips: bool = True,
    lpips_alex: bool = False,
    layer: Literal["reference", "color"] | None = None,
) -> None:
    """Measure folders of frames against the truth and write the comparison page.

    Args:
        folders: one folder per method, with PNG (display colour) or EXR (linear colour) frames; frames are
            matched by their number.
        truth: a folder with the true frames, or a sequence.
        out: the folder for the page and the metrics.
        exposure: the factor on linear colour before the tone map; the default is the exposure of the truth,
            or 1 if the truth has none.
        fps: the speed at which the page plays at first, in frames per second.
        lpips: also measure LPIPS, if the extra `perceptual` is installed; this takes most of the time.
        lpips_alex: also measure LPIPS with AlexNet, which no training loss uses.
        layer: the layer of a truth that is a sequence: `reference`, which is anti-aliased, or `color`, which
            is not. The default is the reference if all frames have one.
    """
    from rich.console import Console

    from jaxsr.evaluation.compare import compare as compare_folders
    from jaxsr.evaluation.demo import description
    from jaxsr.evaluation.measuring import metrics_with
    from jaxsr.report.tables import rich_tables

    with Bars() as progress:
        section = compare_folders(
            folders,
            truth,
            out,
            exposure=exposure,
            fps=fps,
            layer=layer,
            meta=description(),
            keys=metrics_with(lpips, lpips_alex),
            progress=progress,
        )
    for table in rich_tables([section]):
        Console().print(table)
    print(f"Open {out / 'report.html'}; metrics.json, .csv and .md are beside it.")


@app.command
def upscale(
    sequence: Positional[Path],
    method: str = "guided-taau",
    scale: int = 0,
    every: int = 1,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-upscaled"),
) -> None:
    """Upscale a sequence, and make the frames that were not rendered.

    Args:
        sequence: the folder of the sequence.
        method: nearest, bilinear, bicubic, taau, guided, guided-taau or fusion-sr; or a file of weights.
        scale: the scale of the low-resolution frames. 0 takes the largest scale of the sequence. 1 takes the
            high-resolution frames and makes only the frames between them.
        every: every n-th frame counts as rendered; the others are extrapolated.
        out: the folder for `exr/` (linear colour), `png/` (display colour) and `run.json`. A folder
            that holds the frames of another run is refused.
    """
    from jaxsr.io.sequence import Sequence
    from jaxsr.runtime.load import find_method
    from jaxsr.runtime.upscale import upscale as upscale_sequence

    opened = Sequence.open(sequence)
    scale = scale or max(opened.scales, default=1)
    ready = find_method(method, scale)
    with Bars() as progress:
        timing = upscale_sequence(
            opened, ready, out, scale=scale, every=every, advance=progress("frames", len(opened))
        )
    print(
        f"{len(opened)} frames in {out}: {timing.median_ms:.1f} ms per frame, "
        f"compiled in {timing.compile_s:.1f} s"
    )


@app.command
def evaluate(
    sequences: Positional[tuple[Path, ...]],
    methods: tuple[str, ...] = ("bicubic", "taau", "guided-taau", "fusion-sr"),
    scale: int = 4,
    every: int = 1,
    frames: Annotated[str | None, tyro.conf.arg(metavar="A:B")] = None,
    warmup: int = 0,
    lpips: bool = True,
    lpips_alex: bool = False,
    truth: Literal["reference", "color"] | None = None,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("jaxsr-evaluation"),
) -> None:
    """Run methods over sequences and measure them: tables, the comparison page, metrics of every frame.

    Each metric is measured over all pixels, over edges, and over disocclusions. Finished results are kept:
    the same command continues an interrupted evaluation.

    Args:
        sequences: folders of sequences with truth, or folders that hold such folders.
        methods: names of methods, or files of weights (*.safetensors), separated by spaces.
        scale: the scale of the low-resolution frames.
        every: every n-th frame counts as rendered; the others are extrapolated.
        frames: the first and the last frame; the default is all frames.
        warmup: the number of frames at the start of each sequence that are made but not measured.
        lpips: also measure LPIPS, if the extra `perceptual` is installed; this takes most of the time.
        lpips_alex: also measure LPIPS with AlexNet, which no training loss uses.
        truth: the layer to measure against: `reference`, which is anti-aliased, or `color`, which is not. The
            default is the reference if all frames have one.
        out: the folder for all results.
    """
    from rich.console import Console

    from jaxsr.evaluation.demo import description
    from jaxsr.evaluation.evaluate import evaluate as evaluate_methods
    from jaxsr.evaluation.measuring import metrics_with
    from jaxsr.evaluation.running import Settings
    from jaxsr.report.tables import rich_tables

    settings = Settings(scale, every, warmup, metrics_with(lpips, lpips_alex))
    with Bars() as progress:
        sections = evaluate_methods(
            sequences,
            _split_commas(methods, "--methods"),
            out,
            settings,
            frames=_frame_range(frames),
            truth=truth,
            meta=description(**settings._asdict()),
            progress=progress,
        )
    for table in rich_tables(sections, brief=len(sections) > 1):
        Console().print(table)
    print(f"Open {out / 'report.html'}; metrics.json, .csv and .md, and the frames are beside it.")


@app.command
def render(
    scene: Positional[Path],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    frames: Annotated[str | None, tyro.conf.arg(metavar="A:B")] = None,
    scale: tuple[int, ...] = (4,),
    size: tuple[int, int] | None = None,
    samples: int | None = None,
    reference_samples: int | None = None,
    jitter_hr: bool = False,
    denoise: bool | None = None,
    position: bool = True,
    seed: int = 0,
    blender: Path | None = None,
    threads: int | None = None,
) -> None:
    """Render a .blend file to a sequence: colour and G-buffers, high-resolution and jittered low-resolution.

    The same command continues an interrupted render.

    Args:
        scene: a .blend file.
        out: the folder of the sequence.
        frames: the first and the last frame; the default is the range of the scene.
        scale: one or more factors between high and low resolution; 1 renders high resolution only.
        size: width and height of the high resolution; the default is the size in the scene.
        samples: samples per pixel of the colour; the default is the number in the scene.
        reference_samples: samples per pixel of the reference, an anti-aliased high-resolution colour. The
            default is the number of the colour; 0 renders none.
        jitter_hr: jitter the high-resolution G-buffers too; guided-taau makes smoother images with them.
        denoise: denoise the colour; the default is the setting of the scene.
        position: also store world positions; without them readers rebuild them from depth and camera.
        seed: the seed of the renderer's noise.
        blender: a Blender program, or a Python that has the bpy module. The default is the program in the
            variable JAXSR_BLENDER, and then `blender`.
        threads: the number of threads of the renderer; the default is all cores.
    """
    from jaxsr.blender.render import Progress as RenderProgress
    from jaxsr.blender.render import render as render_scene

    bounds = _frame_range(frames)
    with Bars() as bars:
        bar = bars.start("frames", None, unit="frame")
        bar.update(0, "starting Blender")

        def show(at: RenderProgress) -> None:
            bar.update(at.done_frames, at.message, total=at.total_frames)

        render_scene(
            scene,
            out,
            bounds,
            scale,
            size=size,
            samples=samples,
            reference_samples=reference_samples,
            jitter_hr=jitter_hr,
            denoise=denoise,
            position=position,
            seed=seed,
            blender=blender,
            threads=threads,
            progress=show,
        )
    print(f"The sequence is in {out}. Check it with `jaxsr inspect {out}`.")


@app.command
def convert_weights(
    source: Positional[Path],
    out: Positional[Path],
    method: str | None = None,
    scale: int | None = None,
    buffers: tuple[str, ...] = (),
    half: bool = False,
) -> None:
    """Convert published weights (.pth, .npz, .safetensors) to jaxsr's format. Code in the file is not run.

    Args:
        source: the published file.
        out: the file to write, ending in .safetensors.
        method: the method of the weights: fusion-sr, rcan or rrn. By default the names of the arrays decide.
        scale: the scale that the weights were trained for. By default the shapes of the arrays decide; the
            scale is 4 if they cannot.
        buffers: the G-buffer channels of fusion-sr in their order, if they differ from the paper's.
        half: store float16.
    """
    from jaxsr.weights.convert import convert_published

    header = convert_published(source, out, method, scale=scale, buffers=buffers or None, half=half)
    settings = ", ".join(f"{k} {v}" for k, v in header["settings"].items() if not isinstance(v, dict))
    print(f"{out}: {header['method']}, {settings}")


@app.command(name="train")
def _train() -> None:
    """Train the network of a method: `jaxsr train fusion-sr --help` lists the options."""
    # `main` passes all arguments after "train" to the trainer, because the options depend on the method.
    raise JaxsrError("no method to train", where="jaxsr train", fix="see jaxsr train --help")


def _split_commas(values: tuple[str, ...], option: str) -> list[str]:
    """Accept the commas of earlier versions in a list; a line on stderr says how to write it now."""
    parts: list[str] = []
    for value in values:
        whole = "," not in value or Path(value).exists()
        parts += [value] if whole else [part.strip() for part in value.split(",") if part.strip()]
    if parts != list(values):
        note = f"{option} takes a list with spaces; the next version does not read commas"
        print(f"jaxsr: note: {note}", file=sys.stderr)
    return parts


def _frame_range(text: str | None) -> tuple[int, int] | None:
    """ "a:b" as two frame numbers; one number alone is that frame."""
    if text is None:
        return None
    ends = text.split(":")
    try:
        first, last = int(ends[0]), int(ends[-1])
    except ValueError:
        first, last = 1, 0
    if len(ends) > 2 or last < first:
        raise JaxsrError("bad range of frames", where="--frames", expected="a:b with a <= b", found=text)
    return first, last


def main(arguments: list[str] | None = None) -> None:
    """Entry point; exits with 2 and one line on bad input."""
    given = sys.argv[1:] if arguments is None else arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a character that the stream cannot encode is no error
            stream.reconfigure(errors="backslashreplace")
    try:
        if given[:1] == ["train"]:
            from jaxsr.training.command import run

            return run(given[1:])
        app.cli(prog="jaxsr", args=arguments, description="Upscale and extrapolate rendered frames.")
    except JaxsrError as error:
        print(f"jaxsr: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("jaxsr: interrupted", file=sys.stderr)
        if arguments is not None:  # called from Python: the caller goes on
            raise SystemExit(130) from None
        # A normal exit crashes if XLA still compiles. Files are complete at any moment, so exit at once.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(130)
    except BrokenPipeError:  # `jaxsr inspect SEQ | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except OSError as error:  # no space, no permission: print the system's message
        print(f"jaxsr: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        raise SystemExit(2) from None
