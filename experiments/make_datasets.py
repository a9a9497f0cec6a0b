"""The data sets of the three scenes: rendered, measured, described and packed.

    python experiments/make_datasets.py render --set sample|train|test [--budget-minutes N] [--out DIR]
    python experiments/make_datasets.py floor [--scenes bunker forest docks]
    python experiments/make_datasets.py card [--out DIR]
    python experiments/make_datasets.py pack DIR ARCHIVE
    python experiments/make_datasets.py unpack OUT [--archive FILE] [--search DIR]

Sequences lie at `DIR/<set>/<scene>-<split>-<clip>`. `render` and `unpack` look for an archive (`*.jsrz`) in
`--search`, then in `../shared/datasets` beside the repository, and never render what an archive holds; both
resume. Files `reference/<set>/<clip>/<frame>.exr` beside an archive are joined to sequences that have no
reference of their own. `floor` works clip by clip and measures every clip again; `card` and `pack` start from
the beginning. Training and test clips have camera paths and scene layouts of their own: they share no frames.
All is deterministic for a seed, whatever the number of threads.
"""

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from experiments import dataset_card  # noqa: E402
from jaxsr.blender import render as blender  # noqa: E402
from jaxsr.blender.convert import convert_color  # noqa: E402
from jaxsr.blender.process import BlenderProcess, find_blender  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.files import atomic_path  # noqa: E402
from jaxsr.io.archive import pack, read_manifest, unpack_sequence, verify  # noqa: E402
from jaxsr.io.exr import read_exr  # noqa: E402
from jaxsr.io.images import read_color  # noqa: E402
from jaxsr.io.sequence import Sequence  # noqa: E402
from jaxsr.io.truth import TRUTHS, Truth  # noqa: E402
from jaxsr.ops.color import to_display  # noqa: E402
from jaxsr.progress import Bar, Bars  # noqa: E402
from jaxsr.provenance import commit, machine  # noqa: E402

SCENES = ("bunker", "forest", "docks")
CLIP_FRAMES = 12
REFERENCE_SAMPLES = {"bunker": (24, 64, 128), "docks": (32, 64, 128), "forest": (16, 48, 96)}
"""Samples per pixel of the reference: of training clips, of the test set, of the sample's test clips."""
LICENSE = "CC0-1.0"
FLOORS = ROOT / "experiments" / "results" / "noise_floor.json"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsr" / "datasets"
SHARED = ROOT.parent / "shared" / "datasets"
Set = Literal["sample", "train", "test"]


@dataclass(frozen=True)
class Clip:
    """One sequence of a set: frames 1 .. frames of the scene's clip."""

    scene: str
    split: str
    clip: int
    frames: int

    @property
    def name(self) -> str:
        return f"{self.scene}-{self.split}-{self.clip}"


@dataclass(frozen=True)
class Render:
    """Render a set, or take it from an archive."""

    set: Set
    scenes: tuple[str, ...] = SCENES
    size: tuple[int, int] | None = None
    """HR size; 384x216 for the sample, 512x288 for the others."""
    scales: tuple[int, ...] = (2, 4)
    clips: int | None = None
    """Clips per scene, at most those of the set."""
    frames: int | None = None
    """Frames per clip, at most those of the set."""
    samples: int | None = None
    """Samples per pixel; the default is the number of the scene."""
    seed: int = 0
    budget_minutes: float = math.inf
    threads: int | None = None
    blender: Path | None = None
    out: Path = CACHE
    search: Path | None = None
    """A folder with an archive, or an archive."""


@dataclass(frozen=True)
class Floor:
    """Measure the noise floor of both truths: two seeds, display PSNR of half their squared difference."""

    truths: tuple[Truth, ...] = TRUTHS
    scenes: tuple[str, ...] = SCENES
    splits: tuple[Literal["test", "train"], ...] = ("test", "train")
    clips: tuple[int, ...] = (0,)
    frames: tuple[int, ...] = (1, 6, 12)
    size: tuple[int, int] = (384, 216)
    samples: int | None = None
    """Samples per pixel; the default is the number that the sample and the training set have."""
    seeds: tuple[int, int] = (101, 202)
    threads: int | None = None
    blender: Path | None = None
    results: Path = FLOORS


@dataclass(frozen=True)
class Card:
    """Write docs/data_card.md and its pictures from what is there."""

    out: Path = CACHE
    floors: Path = FLOORS
    docs: Path = ROOT / "docs"


@dataclass(frozen=True)
class Pack:
    """Put the sequences of a folder into one archive."""

    dir: Annotated[Path, tyro.conf.Positional]
    archive: Annotated[Path, tyro.conf.Positional]
    scenes: tuple[str, ...] = SCENES
    """Only the sequences of these scenes."""
    color_bits: int = 5
    max_megabytes: float = 200.0


@dataclass(frozen=True)
class Unpack:
    """Restore the sequences of an archive."""

    out: Annotated[Path, tyro.conf.Positional] = CACHE
    archive: Path | None = None
    search: Path | None = None


def clips_of(config: Render) -> list[Clip]:
    """The sequences of a set, clip by clip over the scenes, so that a budget cuts all scenes alike."""
    kinds = {
        "sample": [("test", 0, 8), ("train", 0, 3)],
        "train": [("train", clip, CLIP_FRAMES) for clip in range(5)],
        "test": [("test", clip, CLIP_FRAMES) for clip in range(2)],
    }[config.set]
    kinds = [kind for kind in kinds if config.clips is None or kind[1] < config.clips]
    limit = config.frames or CLIP_FRAMES
    return [Clip(scene, split, c, min(n, limit)) for split, c, n in kinds for scene in config.scenes]


class OutOfTime(Exception):
    """The budget is spent; what is finished stays."""


def is_complete(folder: Path, clip: Clip, config: Render) -> bool:
    """Whether all frames are there, as the configuration asks for them."""
    if not (folder / "sequence.json").is_file():
        return False
    try:
        seq = Sequence.open(folder)
    except (
        JaxsrError
    ):  # killed between the files of a frame and its entry: the writer resumes, or says what is wrong
        return False
    same = seq.size == size_of(config) and set(config.scales) <= set(seq.scales)
    same = same and _same_render(seq.generator, config)
    return same and set(range(1, clip.frames + 1)) <= {info.index for info in seq.infos}


def _same_render(generator: Mapping[str, Any], config: Render) -> bool:
    """Whether what made a sequence had the seed and the samples that are asked for."""
    return generator.get("seed") == config.seed and config.samples in (None, generator.get("samples"))


def find_archives(search: Path | None) -> list[Path]:
    """Archives in the given place, then in ../shared/datasets."""
    places = [p for p in (search, SHARED) if p is not None]
    if search is not None and not search.exists():
        raise JaxsrError("no such file or folder", where=search)
    return [a for p in places for a in ([p] if p.is_file() else sorted(p.glob("*.jsrz")))]


def from_archive(config: Render, clip: Clip, folder: Path) -> bool:
    """Unpacks the clip if an archive holds it as it is asked for; tells whether it did."""
    for archive in find_archives(config.search):
        manifest = read_manifest(archive)
        name = f"{config.set}/{clip.name}"
        head = manifest["sequences"].get(name)
        if head is None or tuple(head["size"]) != size_of(config) or len(head["frames"]) < clip.frames:
            continue
        if not set(config.scales) <= set(head["scales"]):
            continue
        if not _same_render(head["generator"], config):
            continue
        unpack_sequence(archive, manifest, name, folder, find_references(archive, name, head))
        return True
    return False


def find_references(
    archive: Path, name: str, head: Mapping[str, Any]
) -> Callable[[int], dict[str, np.ndarray]] | None:
    """Reader of `reference/<name>/<frame>.exr` beside an archive that was made without this layer.

    Returns:
        Index of a frame -> the layer; None where it is not there for all frames.
    """
    folder = archive.parent / "reference" / name
    if not all((folder / f"{frame['index']:04d}.exr").is_file() for frame in head["frames"]):
        return None

    def read(index: int) -> dict[str, np.ndarray]:
        return {"reference": read_color(folder / f"{index:04d}.exr", layer="reference")}

    return read


def reference_kind(config: Render, clip: Clip) -> int:
    """Column of `REFERENCE_SAMPLES`: training, test set, or the test clips of the sample."""
    return 0 if clip.split == "train" else 2 if config.set == "sample" else 1


def size_of(config: Render) -> tuple[int, int]:
    return config.size or ((384, 216) if config.set == "sample" else (512, 288))


def check_scenes(scenes: tuple[str, ...]) -> None:
    for scene in scenes:
        if not (ROOT / "experiments" / "scenes" / f"{scene}.py").is_file():
            raise JaxsrError("no such scene", where="--scenes", expected=", ".join(SCENES), found=scene)


def render_set(config: Render, bars: Bars) -> None:
    """The verb `render`."""
    check_scenes(config.scenes)
    clips, base = clips_of(config), config.out / config.set
    deadline = time.monotonic() + 60 * config.budget_minutes
    bar = bars.start(config.set, sum(c.frames for c in clips), unit="frame")
    finished = 0.0
    try:
        for clip in clips:
            bar.update(finished, clip.name)
            if not is_complete(base / clip.name, clip, config) and not from_archive(
                config, clip, base / clip.name
            ):
                _render_clip(config, clip, base / clip.name, deadline, bar)
            finished += clip.frames
            bar.update(finished)
    except OutOfTime:
        bars.say(f"budget of {config.budget_minutes:g} minutes spent; run again to go on")


def _render_clip(config: Render, clip: Clip, folder: Path, deadline: float, bar: Bar) -> None:
    start, last, before = time.monotonic(), 0.0, bar.done

    def report(p: blender.Progress) -> None:
        nonlocal last
        last = p.cpu_seconds
        bar.update(before + p.done_frames, f"{clip.name} {p.message}")
        if time.monotonic() > deadline:
            raise OutOfTime

    if time.monotonic() > deadline:
        raise OutOfTime
    arguments = {"seed": config.seed, "split": clip.split, "clip": clip.clip, "frames": CLIP_FRAMES}
    try:
        blender.render(
            ROOT / "experiments" / "scenes" / f"{clip.scene}.py",
            folder,
            (1, clip.frames),
            config.scales,
            size=size_of(config),
            samples=config.samples,
            reference_samples=config.samples or REFERENCE_SAMPLES[clip.scene][reference_kind(config, clip)],
            seed=config.seed,
            threads=config.threads,
            name=clip.name,
            license=LICENSE,
            scene_arguments=arguments,
            blender=config.blender,
            log=folder.parent / "logs" / f"{clip.name}.log",
            progress=report,
        )
    finally:
        add_cost(folder / "render.json", last, time.monotonic() - start)


def add_cost(path: Path, cpu_seconds: float, wall_seconds: float) -> None:
    """Sums what a sequence has cost over all runs."""
    if not path.parent.is_dir():
        return
    old = json.loads(path.read_text()) if path.is_file() else {"cpu_seconds": 0.0, "wall_seconds": 0.0}
    new = {
        "cpu_seconds": round(old["cpu_seconds"] + cpu_seconds, 1),
        "wall_seconds": round(old["wall_seconds"] + wall_seconds, 1),
        "device": machine(),
    }
    write_json(path, new)


def write_json(path: Path, value: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, default=str) + "\n")


# --- noise floor -----------------------------------------------------------------------------------------


def floor_psnr(a: np.ndarray, b: np.ndarray, exposure: float) -> float:
    """PSNR of one of two renders against the noiseless truth, estimated from their difference."""
    shown = [np.asarray(to_display(x, exposure), np.float64) for x in (a, b)]
    return float(-10 * np.log10(np.mean((shown[0] - shown[1]) ** 2) / 2))


def _colors(
    config: Floor, clip: Clip, truth: Truth, seed: int, folder: Path, tick: Any
) -> tuple[dict[int, np.ndarray], dict]:
    """A truth of the frames at one seed."""
    arguments = {"seed": 0, "split": clip.split, "clip": clip.clip, "frames": CLIP_FRAMES}
    script = ROOT / "experiments" / "scenes" / f"{clip.scene}.py"
    job = {
        "scene": {"script": str(script), "arguments": arguments},
        "frames": [min(config.frames), max(config.frames)],
        "skip": [f for f in range(min(config.frames), max(config.frames)) if f not in config.frames],
        "size": config.size, "scales": [], "samples": config.samples, "seed": seed, "threads": config.threads,
        "reference": config.samples or REFERENCE_SAMPLES[clip.scene][0 if clip.split == "train" else 2],
        "jitter_px": [[0.0, 0.0]], "kinds": [truth], "attended": True, "out": str(folder),
    }  # fmt: skip
    log = CACHE / "logs" / f"floor-{truth}-{clip.name}-{seed}.log"
    with BlenderProcess(find_blender(config.blender), job, folder, log) as process:
        described = process.scene()
        process.answer({})
        for event in process.events():
            if event["event"] == "render":
                tick()
    files = {f: folder / f"{f:04d}_hr_{truth}.exr" for f in config.frames}
    return {f: convert_color(read_exr(path)[0]) for f, path in files.items()}, described


def measure_floor(config: Floor, bars: Bars) -> None:
    """The verb `floor`: one entry per truth and clip in the results, replaced when measured again."""
    check_scenes(config.scenes)
    clips = [Clip(s, split, c, 12) for s in config.scenes for split in config.splits for c in config.clips]
    work = [(truth, clip) for truth in config.truths for clip in clips]
    bar = bars.start("floor", 2 * len(work) * len(config.frames), unit="frame")
    for truth, clip in work:
        bar.update(bar.done, f"{clip.name}, {truth}")
        entry = _floor_of(config, clip, truth, bar)
        old = json.loads(config.results.read_text()) if config.results.is_file() else {}
        old[truth] = dict(sorted((old.get(truth, {}) | {clip.name: entry}).items()))
        write_json(config.results, old)
        bars.say(f"{clip.name}, {truth}: {entry['psnr_db']} dB at {entry['samples']} samples")


def _floor_of(config: Floor, clip: Clip, truth: Truth, bar: Bar) -> dict[str, Any]:
    """What two renders of a truth say, and how they were made."""
    images = []
    start = time.monotonic()
    for seed in config.seeds:
        with tempfile.TemporaryDirectory() as folder:
            images.append(_colors(config, clip, truth, seed, Path(folder), bar.advance))
    (a, described), (b, _) = images
    by_frame = {f: round(floor_psnr(a[f], b[f], described["exposure"]), 2) for f in config.frames}
    mean_square = np.mean([10 ** (-psnr / 10) for psnr in by_frame.values()])
    return {
        "psnr_db": round(float(-10 * np.log10(mean_square)), 2),
        "frames": by_frame,
        "size": config.size,
        "samples": described["reference" if truth == "reference" else "samples"],
        **{key: described[key] for key in ("denoise", "bounces", "exposure", "blender")},
        "scene_sha256": described["scene_sha256"],
        "seeds": config.seeds,
        "commit": commit(),
        "device": machine(),
        "seconds": round(time.monotonic() - start, 1),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


# --- archive ---------------------------------------------------------------------------------------------


def pack_set(config: Pack, bars: Bars) -> None:
    """The verb `pack`. Names in the archive are the paths below `dir`, with the set in front."""
    folders = sorted(
        p.parent
        for p in config.dir.rglob("sequence.json")
        if p.parent.name.startswith(tuple(f"{scene}-" for scene in config.scenes))
    )
    if not folders:
        raise JaxsrError(
            "no sequences",
            where=config.dir,
            expected=f"folders {{{','.join(config.scenes)}}}-* with a sequence",
        )
    top = config.dir.resolve()
    prefix = f"{top.name}/" if top.name in ("sample", "train", "test") else ""
    names = {prefix + f.resolve().relative_to(top).as_posix(): f for f in folders}
    members = 0
    for folder in folders:
        seq = Sequence.open(folder)
        members += len(seq) * len(seq.resolutions)
    bar = bars.start("pack", members, unit="image")
    digest = pack(
        names,
        config.archive,
        config.color_bits,
        config.max_megabytes,
        lambda name, size: bar.update(bar.done + 1, name),
    )
    bars.say(f"{config.archive}: {config.archive.stat().st_size / 1e6:.1f} MB, sha256 {digest}")


def unpack_set(config: Unpack, bars: Bars) -> None:
    """The verb `unpack`."""
    archives = [config.archive] if config.archive else find_archives(config.search)
    if not archives:
        raise JaxsrError("no archive", expected=f"*.jsrz in --search or {SHARED}", fix="or give --archive")
    for archive in archives:
        manifest = read_manifest(archive)
        verify(archive)
        bar = bars.start("unpack", len(manifest["sequences"]), unit="sequence")
        for name in manifest["sequences"]:
            references = find_references(archive, name, manifest["sequences"][name])
            unpack_sequence(archive, manifest, name, config.out / name, references)
            bar.update(bar.done + 1, name)


def main(arguments: list[str] | None = None) -> int:
    command = tyro.conf.subcommand
    config: Any = tyro.cli(
        Annotated[Render, command("render")]  # type: ignore[arg-type]
        | Annotated[Floor, command("floor")]
        | Annotated[Card, command("card")]
        | Annotated[Pack, command("pack")]
        | Annotated[Unpack, command("unpack")],
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    try:
        with Bars() as bars:
            if isinstance(config, Render):
                render_set(replace(config, out=config.out.expanduser()), bars)
            elif isinstance(config, Floor):
                measure_floor(config, bars)
            elif isinstance(config, Card):
                print(dataset_card.write(**asdict(config), references=REFERENCE_SAMPLES))
            elif isinstance(config, Pack):
                pack_set(config, bars)
            else:
                unpack_set(config, bars)
    except JaxsrError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; run again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
