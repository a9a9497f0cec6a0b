"""Time per frame: each method at 480x270 -> 1920x1080, and rendering with Blender (Table 2).

    python experiments/fusion_sr/timing.py methods [--rounds 5]
    python experiments/fusion_sr/timing.py render [--blender-path PATH] [--samples 16]

`methods` times a step of every method of Table 1 on the analytic scene, the methods in turn, round after
round (median, quartiles; compilation apart). Times do not depend on weights: these are random, of the sizes
of `study.py`, and RCAN and RRN of the published sizes as well (RCAN in one round: it takes half a minute).

`render` renders one frame of each test clip: HR and LR colour with so many samples, and the G-buffer, all on
the CPU; scenes that have numbers are not rendered again (`--again`). The seconds are CPU seconds of Blender
from one image to the next, saving included. A frame begins with its HR G-buffer, whose time includes the
change from the previous frame; building the scene does not count.

Both write into experiments/results/fusion_sr/ (runtime and render, .json and .md), docs/images/ and
docs/results_fusion_sr.md.
"""

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import jax  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from flax import nnx  # noqa: E402

from benchmarks._common import environment, summarise, time_interleaved  # noqa: E402
from experiments.fusion_sr.study import RESULTS, VARIANTS, Variant  # noqa: E402
from experiments.fusion_sr.tables import IMAGES, PAGE, on_page, write  # noqa: E402
from experiments.make_datasets import SCENES  # noqa: E402
from jaxsr.blender import render as blender  # noqa: E402
from jaxsr.data import analytic  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.methods import METHODS  # noqa: E402
from jaxsr.methods.base import step as step_of  # noqa: E402
from jaxsr.provenance import commit, machine  # noqa: E402
from jaxsr.runtime.cost import count_parameters, multiply_adds_of  # noqa: E402

SIZE, SCALE = (1920, 1080), 4
JITTER = ((0.0, -0.17), (-0.25, 0.17))
PUBLISHED = {
    "rcan-published": Variant("RCAN 10x20x64", "rcan", {}),
    "rrn-published": Variant("RRN 10x128", "rrn", {}),
}
TIMED = (
    "bicubic",
    "taau",
    "guided-taau",
    "rcan",
    "rcan-published",
    "nsrr",
    "rrn",
    "rrn-published",
    "fusion",
    "fusion-guided",
)
SLOW = ("rcan-published",)
"""In the first round only."""
PAPER_MS = {"rcan-published": 41.52, "nsrr": 24.42, "rrn-published": 93.17, "fusion": 23.04}
PAPER_RENDER_MS = {
    "bunker": {"gbuffer": 0.11, "lr": 5.18, "hr": 40.58},
    "forest": {"gbuffer": 1.40, "lr": 4.37, "hr": 14.21},
    "docks": {"gbuffer": 0.20, "lr": 9.75, "hr": 98.62},
}
PAPER_NETWORK_MS = 23.04

app = tyro.extras.SubcommandApp()


def prepare(variant: Variant) -> tuple[Callable[[], Any], dict[str, Any]]:
    """A call that makes one frame with a full history, compiled; and what it costs."""
    method = METHODS[variant.method] if variant.changes is None else variant.build()
    network = method.network
    net = None if network is None else jax.jit(lambda: nnx.state(network.new(nnx.Rngs(0))))()
    first, second = (jax.device_put(analytic.frame(t, SIZE, SCALE, JITTER[t])[0]) for t in (0, 1))
    start = time.perf_counter()
    traced = jax.jit(step_of(method)).trace(net, jax.eval_shape(method.init, first), first)
    step = traced.lower().compile()
    seconds = time.perf_counter() - start
    state, _ = step(net, jax.jit(method.init)(first), first)
    cost = {"compile_s": round(seconds, 1), "parameters": count_parameters(net)}
    cost["multiply_adds_per_px"] = round(multiply_adds_of(traced.jaxpr.jaxpr) / (SIZE[0] * SIZE[1]))
    return (lambda: step(net, state, second)), cost


@app.command
def methods(rounds: int = 5) -> None:
    """Time a step of every method.

    Args:
        rounds: timed calls of each method, at least two.
    """
    if rounds < 2:
        raise JaxsrError("bad rounds", where="--rounds", expected="a whole number from 2", found=rounds)
    about = environment() | {"size": SIZE, "scale": SCALE, "rounds": rounds}  # the load is that before
    variants = {name: (VARIANTS | PUBLISHED)[name] for name in TIMED}
    calls, costs = {}, {}
    for name, variant in variants.items():
        calls[name], costs[name] = prepare(variant)
        print(f"{variant.label}: compiled in {costs[name]['compile_s']} s", flush=True)
    slow = {name: [_once(calls.pop(name))] for name in SLOW}
    times = time_interleaved(calls, rounds)
    found = summarise(times, "fusion")
    for name, ms in slow.items():
        ratio = ms[0] / statistics.median(times["fusion"])
        found[name] = {"median_ms": ms[0], "iqr_ms": None, "ratio": ratio}
    rows = {name: found[name] | costs[name] | {"paper_ms": PAPER_MS.get(name)} for name in TIMED}
    rows["fusion"]["cpu_ms"] = cpu_ms(calls["fusion"], rounds)
    write(RESULTS / "runtime.json", json.dumps({"about": about, "methods": rows}, indent=1) + "\n")
    put("runtime", runtime_table(rows, about))


def put(name: str, lines: list[str], picture: str = "") -> None:
    """A table into its file, the page and the terminal."""
    write(RESULTS / f"{name}.md", "\n".join([*lines, ""]))
    block = [*lines, "", picture] if picture else lines
    write(PAGE, on_page(PAGE.read_text(encoding="utf-8"), name, block))
    print("\n".join(lines))


def cpu_ms(call: Callable[[], Any], rounds: int) -> float:
    """Milliseconds of a call summed over the cores, the unit in which Blender's images are measured."""
    start = time.process_time()
    for _ in range(rounds):
        jax.block_until_ready(call())
    return (time.process_time() - start) * 1e3 / rounds


def _once(call: Callable[[], Any]) -> float:
    """Milliseconds of the second call: the first touches new memory."""
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    return (time.perf_counter() - start) * 1e3


def runtime_table(rows: dict[str, Any], about: dict[str, Any]) -> list[str]:
    """Markdown of `runtime.json`."""
    lines = [
        "| method | ms here | IQR | over fusion | paper, ms | over fusion | weights | multiply-adds / px |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, row in rows.items():
        iqr = "one round" if row["iqr_ms"] is None else f"{row['iqr_ms']:,.0f}"
        paper = row["paper_ms"]
        printed = (f"{paper:.2f}", f"{paper / PAPER_NETWORK_MS:.2f}") if paper else ("", "")
        cells = [f"{row['median_ms']:,.0f}", iqr, f"{row['ratio']:.2f}", *printed]
        cells += [f"{row['parameters']:,}", f"{row['multiply_adds_per_px']:,}"]
        lines.append(f"| {(VARIANTS | PUBLISHED)[name].label} | {' | '.join(cells)} |")
    return [
        *lines,
        "",
        f"480x270 to 1920x1080, float32, {about['rounds']} rounds in turn, median; {about['cores']} cores of "
        f"{about['device']}, load {about['load']} before; jax {about['versions']['jax']}; commit "
        f"{about['commit']}, {about['date']}. The paper: TensorRT, 16 bits, RTX 3090.",
    ]


@app.command
def render(
    blender_path: Path | None = None,
    samples: int = 16,
    size: tuple[int, int] = SIZE,
    again: bool = False,
) -> None:
    """Time what Blender renders.

    Args:
        blender_path: see `jaxsr render --blender`.
        samples: of the colour.
        size: of the HR frames.
        again: render what has numbers already.
    """
    runtime, file = RESULTS / "runtime.json", RESULTS / "render.json"
    if not runtime.is_file():
        raise JaxsrError("no time of the network", where=runtime, fix="run `timing.py methods` first")
    times = json.loads(runtime.read_text(encoding="utf-8"))
    about = {"size": list(size), "scale": SCALE, "samples": samples, "device": machine()}
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() and not again else {}
    same = {key: known.get("about", {}).get(key) for key in about} == about
    found = dict(known["seconds"]) if same else {}
    about |= {"commit": commit(), "date": time.strftime("%Y-%m-%d")}
    for scene in SCENES:
        if scene in found:
            continue
        with tempfile.TemporaryDirectory() as folder:
            colors = _images(scene, Path(folder) / "colors", 1, samples, size, blender_path)
            buffers = _images(scene, Path(folder) / "buffers", 2, 1, size, blender_path)
        found[scene] = {
            "gbuffer": buffers["frame 2, hr gbuffer"],
            "lr": colors[f"frame 1, x{SCALE} color"],
            "hr": colors["frame 1, hr color"],
        }
        print(scene, found[scene], flush=True)
        write(file, json.dumps({"about": about, "seconds": found}, indent=1) + "\n")
    render_chart(found, times, IMAGES / "fusion_table2.png")
    put("table2", render_table(found, about, times), "![Where the time goes](images/fusion_table2.png)")


def render_chart(found: dict[str, Any], runtime: dict[str, Any], file: Path) -> None:
    """One bar per scene and way: G-buffer, LR colour and network on top of each other, beside HR colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    network = runtime["methods"]["fusion"]["cpu_ms"] / 1e3
    left = np.zeros(len(found))
    rows = np.arange(len(found))
    for label, values in (
        ("G-buffer", [found[scene]["gbuffer"] for scene in found]),
        ("LR colour", [found[scene]["lr"] for scene in found]),
        ("network", [network] * len(found)),
    ):
        axes.barh(rows - 0.2, values, 0.36, left=left, label=label)
        left = left + np.array(values)
    axes.barh(rows + 0.2, [found[scene]["hr"] for scene in found], 0.36, label="HR colour", color="tab:gray")
    axes.set_yticks(rows, list(found))
    axes.invert_yaxis()
    axes.set_xlabel("CPU seconds")
    axes.legend()
    with atomic_path(file) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def _images(
    scene: str, out: Path, frames: int, samples: int, size: tuple[int, int], program: Path | None
) -> dict[str, float]:
    """CPU seconds of each image of a test clip's first frames, by Blender's name for it."""
    spent: dict[str, float] = {}
    last = 0.0

    def note(progress: blender.Progress) -> None:
        nonlocal last
        spent[progress.message] = round(progress.cpu_seconds - last, 2)
        last = progress.cpu_seconds

    blender.render(
        ROOT / "experiments" / "scenes" / f"{scene}.py",
        out,
        (1, frames),
        (SCALE,),
        size=size,
        samples=samples,
        scene_arguments={"seed": 0, "split": "test", "clip": 0, "frames": 12},
        blender=program,
        progress=note,
    )
    return spent


def render_table(found: dict[str, Any], about: dict[str, Any], runtime: dict[str, Any]) -> list[str]:
    """Markdown of `render.json`, with the network's time beside it."""
    network = runtime["methods"]["fusion"]["cpu_ms"] / 1e3
    width, height = about["size"]
    low = f"{width // SCALE}x{height // SCALE}"
    lines = [
        "| | " + " | ".join(f"{scene} | paper, ms" for scene in found) + " |",
        "|---|" + "---:|---:|" * len(found),
    ]
    titles = {"gbuffer": f"G-buffer ({width}x{height})", "lr": f"LR colour ({low})"}
    for key, title in titles.items():
        cells = [f"{found[s][key]:.1f} s | {PAPER_RENDER_MS[s][key]:.2f}" for s in found]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    lines.append(
        "| network | " + " | ".join(f"{network:.1f} s | {PAPER_NETWORK_MS:.2f}" for _ in found) + " |"
    )
    totals = [
        f"{found[s]['gbuffer'] + found[s]['lr'] + network:.1f} s | "
        f"{PAPER_RENDER_MS[s]['gbuffer'] + PAPER_RENDER_MS[s]['lr'] + PAPER_NETWORK_MS:.2f}"
        for s in found
    ]
    lines.append(f"| together | {' | '.join(totals)} |")
    cells = [f"{found[s]['hr']:.1f} s | {PAPER_RENDER_MS[s]['hr']:.2f}" for s in found]
    lines.append(f"| HR colour ({width}x{height}) | {' | '.join(cells)} |")
    return [
        *lines,
        "",
        f"CPU seconds, summed over cores: of Blender (Cycles, {about['samples']} samples per pixel, G-buffer "
        f"1; {about['device']}; commit {about['commit']}, {about['date']}), and of the network "
        f"({runtime['about']['device']}).",
    ]


if __name__ == "__main__":
    try:
        app.cli()
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
