"""What the benchmarks share: interleaved timing, peak memory of a fresh process, and the result files.

Variants of one question are timed in turn, round after round, so that whatever else the machine does falls
on all of them; the ratio to the reference variant is the median of the ratios within rounds. Memory is how
far a fresh process's resident size rises while it runs the variant, results included, inputs and code not.
"""

import argparse
import contextlib
import json
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsr.files import write_text
from jaxsr.provenance import commit, device_kind, versions

RESULTS = Path(__file__).parent / "results"
SIZES = ("480x270", "960x540", "1920x1080")
PACKAGES = (
    "jax", "jaxlib", "flax", "numpy", "numba", "opencv-python-headless", "torch", "dm-pix", "onnxruntime",
    "jax2onnx",
)  # fmt: skip

Inputs = tuple[np.ndarray, ...]


class Prepared(NamedTuple):
    """A call that is ready to be timed, and the seconds it took to compile if it was compiled."""

    call: Callable[[], Any]
    compile_s: float | None = None


class Variant(NamedTuple):
    """One way to compute something. `build(inputs)` prepares all that is not timed."""

    name: str
    build: Callable[[Inputs], Prepared]
    largest: int = 2**31
    """Pixels of the largest image worth waiting for."""


def arguments(
    description: str | None,
    sizes: Sequence[str] = SIZES,
    add: Callable[[argparse.ArgumentParser], object] = lambda parser: None,
) -> argparse.Namespace:
    """The options that all benchmarks have, and those that `add` adds to the parser."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", default=sizes, metavar="WxH")
    parser.add_argument("--rounds", type=int, default=15, help="timed calls of each variant")
    parser.add_argument("--quick", action="store_true", help="one small size, three rounds, nothing written")
    parser.add_argument("--memory", nargs=3, metavar=("QUESTION", "VARIANT", "SIZE"), help=argparse.SUPPRESS)
    add(parser)
    args = parser.parse_args()
    if args.quick:
        args.sizes, args.rounds = ["160x90"], 3
    return args


def scene(width: int, height: int, channels: int = 3, guides: int = 6) -> Inputs:
    """Previous image, motion, guide and previous guide: textured tiles that slide, turn and jump."""
    rng = np.random.default_rng(0)
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    palette = rng.random((64, guides))

    def tiles(dx: int, dy: int) -> np.ndarray:
        tile = ((x - dx) // 23 + 7 * ((y - dy) // 17)) % 64
        return palette[tile] + 0.02 * rng.random((height, width, guides))

    motion = np.stack([3 + 2 * np.sin(y / 40), 2 + 2 * np.cos(x / 70)], -1)
    motion += ((x // 50 + y // 50) % 2)[..., None] * np.array([9.0, -6.0])
    arrays = rng.random((height, width, channels)), motion, tiles(3, 2), tiles(0, 0)
    return tuple(a.astype(np.float32) for a in arrays)


def parse_size(size: str) -> tuple[int, int]:
    width, height = (int(n) for n in size.split("x"))
    return width, height


def time_interleaved(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each call in each round; the first call of each is not counted."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for round_ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            if round_:
                times[name].append((time.perf_counter() - start) * 1e3)
    return times


def summarise(times: dict[str, list[float]], reference: str) -> dict[str, dict[str, float | None]]:
    """Median, interquartile range and, where the reference was timed, the ratio to it."""
    out: dict[str, dict[str, float | None]] = {}
    for name, ms in times.items():
        low, _, high = statistics.quantiles(ms, n=4)
        base = times.get(reference)
        ratio = statistics.median(a / b for a, b in zip(ms, base, strict=True)) if base else None
        out[name] = {"median_ms": statistics.median(ms), "iqr_ms": high - low, "ratio": ratio}
    return out


def peak_memory_mb(script: str, question: str, variant: str, size: str) -> float | None:
    """Run this same script in a fresh process, for its peak memory only. None if it did not survive."""
    run = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{Path(script).stem}", "--memory", question, variant, size],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent.parent,
        check=False,
    )
    return float(run.stdout.split()[-1]) if run.returncode == 0 else None


def measure_memory(variant: Variant, size: str) -> None:
    """The other side of `peak_memory_mb`: prints megabytes."""
    jax.block_until_ready(variant.build(scene(64, 48)).call())
    call = variant.build(scene(*parse_size(size))).call
    before = _reset_peak_mb()
    jax.block_until_ready(call())
    print(_peak_mb() - before)


def _reset_peak_mb() -> float:
    """Forget the peak of compilation where the system can (Linux), and return the present resident size."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak_mb()


def _peak_mb() -> float:
    try:
        found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        found = None
    return (int(found.group(1)) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024


def compiled(fn: Callable[..., Any], inputs: Inputs) -> Prepared:
    """`fn` of the inputs, compiled by JAX, on device arrays."""
    arrays = tuple(jax.numpy.asarray(a) for a in inputs)
    start = time.perf_counter()
    executable = jax.jit(fn).lower(*arrays).compile()
    return Prepared(lambda: executable(*arrays), time.perf_counter() - start)


def run(
    script: str,
    questions: dict[str, list[Variant]],
    references: dict[str, str],
    args: argparse.Namespace,
    missing: Iterable[str] = (),
    fixed: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Time all variants of all questions at all sizes, print, and write the result files.

    Args:
        script: `__file__` of the benchmark.
        questions: variants by question.
        references: for each question the variant that the others are divided by.
        args: what `arguments` returned.
        missing: names of peers that are not installed.
        fixed: the one size of questions that do not scale with the image.
    """
    if args.memory:
        question, name, size = args.memory
        measure_memory(next(v for v in questions[question] if v.name == name), size)
        return
    for name in missing:
        print(f"{name}: not installed")
    rows = []
    sizes = args.sizes if args.quick else [*args.sizes, *fixed.values()]
    for size in dict.fromkeys(sizes):
        width, height = parse_size(size)
        inputs = scene(width, height)
        for question, variants in questions.items():
            if not args.quick and size not in ([fixed[question]] if question in fixed else args.sizes):
                continue
            built = {v.name: v.build(inputs) for v in variants if width * height <= v.largest}
            times = time_interleaved({name: prepared.call for name, prepared in built.items()}, args.rounds)
            for name, numbers in summarise(times, references[question]).items():
                row = {"size": size, "question": question, "variant": name, **numbers}
                row["compile_s"] = built[name].compile_s
                rows.append(row | {"peak_mb": peak_memory_mb(script, question, name, size)})
                print(_row(rows[-1]), flush=True)
    if not args.quick:
        _write(Path(script).stem, references, rows, args.rounds)


def _row(row: dict[str, Any]) -> str:
    def cell(key: str, digits: int) -> str:
        return "" if row[key] is None else f"{row[key]:.{digits}f}"

    numbers = [
        cell("median_ms", 2),
        cell("iqr_ms", 2),
        cell("ratio", 2),
        cell("compile_s", 1),
        cell("peak_mb", 0),
    ]
    return "| " + " | ".join([row["size"], row["question"], row["variant"], *numbers]) + " |"


def _write(name: str, references: dict[str, str], rows: list[dict[str, Any]], rounds: int) -> None:
    about = environment() | {"rounds": rounds, "ratio to": references}
    lines = [f"# {name}", "", *(f"- {key}: {value}" for key, value in about.items()), ""]
    lines += ["| size | question | variant | median ms | IQR ms | ratio | compile s | peak MB |"]
    lines += ["|---|---|---|---|---|---|---|---|", *map(_row, rows)]
    RESULTS.mkdir(exist_ok=True)
    stem = f"{name}-{_slug(about['device'])}"
    write_text(RESULTS / f"{stem}.json", json.dumps({"about": about, "rows": rows}, indent=1) + "\n")
    write_text(RESULTS / f"{stem}.md", "\n".join(lines) + "\n")
    print(f"wrote {RESULTS / stem}.json and .md")


def environment() -> dict[str, Any]:
    """Device, versions, commit, date."""
    return {
        "device": device_kind(),
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": dict.fromkeys(PACKAGES, "not installed") | versions(PACKAGES),
        "commit": commit(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
