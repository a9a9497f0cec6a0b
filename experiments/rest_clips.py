"""Clips of a camera at rest: one frame of each scene's first training clip, with one jitter after the other.

    python experiments/rest_clips.py OUT [--frames 10] [--size 512 288]

Writes `OUT/<scene>-rest` and, with jittered HR G-buffers, `OUT/<scene>-rest-jittered`; both have the same LR
frames, the same truth and no motion. Frames that are there already are kept. `experiments/antialiasing.py`
measures on them how methods converge.
"""

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from experiments.make_datasets import CLIP_FRAMES, LICENSE, REFERENCE_SAMPLES, SCENES  # noqa: E402
from jaxsr.blender.convert import camera_from_json, convert_color, convert_gbuffer  # noqa: E402
from jaxsr.blender.process import BlenderProcess, find_blender  # noqa: E402
from jaxsr.blender.render import JITTER_LENGTH  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.io.exr import read_exr  # noqa: E402
from jaxsr.io.sequence import FrameInfo, SequenceWriter  # noqa: E402
from jaxsr.ops.jitter import jitter_sequence  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402


@dataclass(frozen=True)
class Config:
    out: Annotated[Path, tyro.conf.Positional]
    scenes: tuple[str, ...] = SCENES
    frame: int = 6
    """The frame of the clip that is shown."""
    frames: int = 10
    """How often, each time with another jitter."""
    size: tuple[int, int] = (512, 288)
    scales: tuple[int, ...] = (2, 4)
    seed: int = 0
    threads: int | None = None
    blender: Path | None = None


def rendered(config: Config, scene: str, kinds: list[str], jitter: Any, seed: int, folder: Path) -> dict:
    """Raw files of one frame in a folder, and what Blender says of the scene."""
    arguments = {"seed": config.seed, "split": "train", "clip": 0, "frames": CLIP_FRAMES}
    job = {
        "scene": {"script": str(ROOT / "experiments" / "scenes" / f"{scene}.py"), "arguments": arguments},
        "frames": [config.frame, config.frame],
        "size": config.size,
        "scales": config.scales,
        "jitter_px": [list(jitter)],
        "jitter_hr": True,
        "seed": seed,
        "threads": config.threads,
        "reference": REFERENCE_SAMPLES[scene][1],
        "kinds": kinds,
        "attended": True,
        "out": str(folder),
    }
    with BlenderProcess(find_blender(config.blender), job, folder, folder.parent / "blender.log") as process:
        described = process.scene()
        process.answer({})
        for _ in process.events():
            pass
    return described


def make(config: Config, scene: str, bars: Bars) -> None:
    """Both sequences of one scene."""
    jitters = jitter_sequence(JITTER_LENGTH, JITTER_LENGTH)[: config.frames]
    bar = bars.start(scene, config.frames, unit="frame")
    writers: dict[str, SequenceWriter] = {}
    still: dict[str, np.ndarray] = {}
    for k, jitter in enumerate(np.asarray(jitters).tolist()):
        bar.update(k, "rendering")
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "raw"
            folder.mkdir()
            described = rendered(config, scene, ["gbuffer", "color"], jitter, config.seed + k, folder)
            if not still:
                plain = Path(place) / "plain"
                plain.mkdir()
                rendered(config, scene, ["gbuffer", "color", "reference"], (0.0, 0.0), config.seed, plain)
                still = layers(plain, config.frame, "hr", (0.0, 0.0))
            camera = camera_of(folder, config.frame)
            moved = still | {
                n: x for n, x in layers(folder, config.frame, "hr", jitter).items() if n != "color"
            }
            low = {s: layers(folder, config.frame, f"x{s}", jitter) for s in config.scales}
        for name, hr, hr_jitter in (("rest", still, (0.0, 0.0)), ("rest-jittered", moved, tuple(jitter))):
            if name not in writers:
                writers[name] = SequenceWriter(
                    config.out / f"{scene}-{name}",
                    name=f"{scene}-{name}",
                    size=config.size,
                    scales=config.scales,
                    exposure=described["exposure"],
                    license=LICENSE,
                    generator={"script": "rest_clips.py", "frame": config.frame, "seed": config.seed},
                )
            info = FrameInfo(k + 1, tuple(jitter), k == 0, *camera, hr_jitter_px=hr_jitter)
            writers[name].write_frame(info, hr, low)
    for writer in writers.values():
        writer.close()
    bar.update(config.frames)


def camera_of(folder: Path, frame: int) -> Any:
    return camera_from_json(json.loads((folder / f"{frame:04d}.json").read_text())["camera"])


def layers(folder: Path, frame: int, resolution: str, jitter: Any) -> dict[str, np.ndarray]:
    """Layers of one image, without motion: the camera and all objects are at rest."""
    camera = camera_of(folder, frame)
    raw, _ = read_exr(folder / f"{frame:04d}_{resolution}_gbuffer.exr")
    made = convert_gbuffer(raw, camera, camera, tuple(jitter))
    made["motion"] = np.zeros_like(made["motion"])
    for name in ("color", "reference"):
        file = folder / f"{frame:04d}_{resolution}_{name}.exr"
        if file.exists():
            made[name] = convert_color(read_exr(file)[0])
    return made


def main(config: Config) -> None:
    with Bars() as bars:
        for scene in config.scenes:
            make(config, scene, bars)


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"rest_clips: {error}") from None
