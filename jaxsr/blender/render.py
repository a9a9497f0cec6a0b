"""Rendering a .blend (or a Python scene) to a canonical sequence, through Blender in a process of its own.

Blender's Python module asks for NumPy 1 and JAX for NumPy 2, so they never share an environment: `render`
starts `blender_script.py` inside Blender (blender_process.py), takes its raw multi-layer OpenEXR files and
events, converts them (blender_convert.py) and writes the sequence frame by frame.

Every frame is HR colour and G-buffer, and LR colour and G-buffer at each scale, jittered. The renders are
point samples (no anti-aliasing) by Cycles on the CPU, whatever engine the scene names, without motion blur,
depth of field, transparent film and compositing. Not handled: cameras that are not perspective, animated lens
shift, volumes, transparent surfaces (the G-buffer describes the first surface).
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsr.blender.convert import Instances, camera_from_json, convert_color, convert_gbuffer
from jaxsr.blender.process import BlenderProcess, find_blender
from jaxsr.errors import JaxsrError
from jaxsr.files import read_json
from jaxsr.io.exr import read_exr
from jaxsr.io.writing import FrameInfo, SequenceWriter

JITTER_LENGTH = 32
"""Frame f has point `(f - 1) mod 32` of the Halton jitter, whatever range is rendered."""


class Progress(NamedTuple):
    """The progress of a render; a frame counts in proportion to the work of its images."""

    done_frames: float
    total_frames: int
    message: str
    cpu_seconds: float
    """CPU time that Blender has spent so far in this run, building the scene included."""


def render(
    scene: str | Path,
    out: str | Path,
    frames: tuple[int, int] | None = None,
    scales: Sequence[int] = (2,),
    *,
    size: tuple[int, int] | None = None,
    samples: int | None = None,
    reference_samples: int | None = None,
    jitter_hr: bool = False,
    denoise: bool | None = None,
    exposure: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    name: str | None = None,
    license: str = "",
    position: bool = False,
    scene_arguments: Mapping[str, Any] | None = None,
    precision: Mapping[str, str] | None = None,
    round_bits: Mapping[str, int] | None = None,
    blender: str | Path | None = None,
    log: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Path:
    """Render a scene to a canonical sequence. Complete frames are kept: run again to resume.

    Args:
        scene: a .blend, or a Python file with `build(**scene_arguments)` and `SETTINGS`.
        out: folder of the sequence.
        frames: first and last frame; None for the scene's range.
        scales: LR scales; 1 or none renders HR only.
        size: HR `(W, H)`; None for the scene's resolution. Divisible by every scale.
        samples: of the colour; None for the scene's, with its adaptive sampling.
        reference_samples: of the anti-aliased HR colour; None for as many as the colour has, 0 for none.
        jitter_hr: jitter the HR G-buffer too, by the numbers of the frame's jitter in HR pixels.
        denoise: of the colour, with OpenImageDenoise; None for the scene's choice.
        exposure: written to sequence.json; None: 2 to the power of the scene's view exposure.
        seed: of Cycles' noise.
        threads: of Blender; None for all cores.
        name, license: written to sequence.json; the name defaults to the scene's.
        position: also store the world position (otherwise readers rebuild it from depth).
        scene_arguments: of a Python scene's `build`.
        precision, round_bits: see SequenceWriter.
        blender: see `find_blender`.
        log: what Blender prints; None for `out/blender.log`.
        progress: called after each image with a Progress. If it raises, the render ends; it can be resumed.

    Returns:
        `out`.

    Raises:
        JaxsrError: no Blender, a scene that cannot be rendered as asked, a folder that holds another
            sequence, or a failure of Blender (with its last line).
    """
    from jaxsr.ops.jitter import jitter_sequence  # late: it loads JAX

    scene, out = Path(scene).resolve(), Path(out)
    if scene.suffix not in (".blend", ".py") or not scene.is_file():
        found = "no such file" if not scene.exists() else scene.suffix or "a folder"
        raise JaxsrError("not a scene", where=scene, expected="a .blend file (or a .py scene)", found=found)
    _check_arguments(frames, scales, size, samples, threads, reference_samples)
    program = find_blender(blender)
    source: dict[str, Any] = {"blend": str(scene)}
    if scene.suffix == ".py":
        source = {"script": str(scene), "arguments": dict(scene_arguments or {})}
    scales = tuple(sorted(set(scales)))
    job = {
        "scene": source,
        "frames": list(frames) if frames else None,
        "size": list(size) if size else None,
        "scales": [s for s in scales if s > 1],
        "samples": samples,
        "denoise": denoise,
        "exposure": exposure,
        "jitter_px": jitter_sequence(JITTER_LENGTH, JITTER_LENGTH).tolist(),
        "jitter_hr": jitter_hr,
        "reference": reference_samples,
        "seed": seed,
        "threads": threads,
        "attended": True,
    }
    if out.exists() and not out.is_dir():
        raise JaxsrError("not a folder", where=out, fix="choose another folder for the sequence")
    log = Path(log) if log else out / "blender.log"
    with _tidied(out, log), BlenderProcess(program, job, out / ".raw", log) as process:
        described = process.scene()
        generator = {
            "tool": "jaxsr render",
            "scene": scene.name,
            "scene_sha256": described["scene_sha256"],
            **({"arguments": source["arguments"]} if scene_arguments else {}),
            "blender": described["blender"],
            "seed": seed,
            **{key: described[key] for key in ("samples", "adaptive", "denoise", "bounces")},
            **({"reference_samples": described.get("reference", 0)} if described.get("reference", 0) else {}),
        }
        writer = SequenceWriter(
            out,
            name=name or scene.stem,
            size=tuple(described["size"]),
            scales=scales,
            fps=described["fps"],
            exposure=described["exposure"],
            license=license,
            generator=generator,
            precision=precision,
            round_bits=round_bits,
        )
        first, last = described["frames"]
        # The first frame of a range is a reset. It is made again once the frames before it are rendered.
        done = [
            f
            for f in range(first, last + 1)
            if writer.has(f) and not (f > first and writer.is_reset(f) and not writer.has(f - 1))
        ]
        key = {**job, "threads": None, "attended": None, "described": described}
        raw = _raw_folder(out / ".raw", json.dumps(key, sort_keys=True))
        process.answer({"skip": done, "out": str(raw)})
        lr = [s for s in scales if s > 1]
        report = _Reporter(progress, first, last, len(done), described, lr)
        for event in process.events():
            report(event)
            if event["event"] == "frame":
                _take_over(raw, event["frame"], lr, described, position, jitter_hr, writer)
    writer.close()
    shutil.rmtree(out / ".raw", ignore_errors=True)
    return out


@contextlib.contextmanager
def _tidied(out: Path, log: Path) -> Iterator[None]:
    """After an error before the first image, remove everything but the log that the message names."""
    had_log, had_out = log.exists(), out.exists()
    try:
        yield
    except BaseException as e:
        if not any(out.rglob("*.exr")) and not (out / "sequence.json").exists():
            shutil.rmtree(out / ".raw", ignore_errors=True)
            with contextlib.suppress(OSError):
                if log.parent == out and not had_log and str(log) not in str(e):
                    log.unlink(missing_ok=True)
                if not had_out:
                    out.rmdir()
        raise


def _check_arguments(
    frames: Any,
    scales: Sequence[int],
    size: Any,
    samples: int | None,
    threads: int | None,
    reference_samples: int | None,
) -> None:
    if any(not 1 <= s <= 16 for s in scales):
        raise JaxsrError(
            "bad scale", where="--scale", expected="whole numbers from 1 to 16", found=list(scales)
        )
    if frames is not None and frames[1] < frames[0]:
        raise JaxsrError("an empty range of frames", where="--frames", found=f"{frames[0]}:{frames[1]}")
    for flag, number in (
        ("--samples", samples),
        ("--reference-samples", reference_samples or None),
        ("--threads", threads),
        *(("--size", n) for n in size or ()),
    ):
        if number is not None and number < 1:
            raise JaxsrError("must be positive", where=flag, found=number)


def _raw_folder(root: Path, key: str) -> Path:
    """A folder for the raw files of just this job; those of other jobs are deleted."""
    raw = root / hashlib.sha256(key.encode()).hexdigest()[:16]
    for other in root.iterdir():
        if other.is_dir() and other != raw:
            shutil.rmtree(other, ignore_errors=True)
    raw.mkdir(parents=True, exist_ok=True)
    return raw


def _take_over(
    raw: Path,
    frame: int,
    scales: Sequence[int],
    described: Mapping[str, Any],
    position: bool,
    jitter_hr: bool,
    writer: SequenceWriter,
) -> None:
    """Converts and writes one finished frame, then deletes its raw files."""
    info = read_json(raw / f"{frame:04d}.json", dict)
    camera, previous = camera_from_json(info["camera"]), camera_from_json(info["previous"])
    instances = Instances(described["objects"], described["instanced"], described["instances"])
    jitter = (float(info["jitter_px"][0]), float(info["jitter_px"][1]))

    hr_jitter = jitter if jitter_hr else (0.0, 0.0)

    def layers(resolution: str, jitter_px: tuple[float, float]) -> dict[str, np.ndarray]:
        gbuffer, _ = read_exr(raw / f"{frame:04d}_{resolution}_gbuffer.exr")
        files = {name: raw / f"{frame:04d}_{resolution}_{name}.exr" for name in ("color", "reference")}
        return {
            **{name: convert_color(read_exr(file)[0]) for name, file in files.items() if file.exists()},
            **convert_gbuffer(gbuffer, camera, previous, jitter_px, instances, position),
        }

    writer.write_frame(
        FrameInfo(frame, jitter, info["cut"] or not writer.has(frame - 1), *camera, hr_jitter_px=hr_jitter),
        layers("hr", hr_jitter),
        {s: layers(f"x{s}", jitter) for s in scales},
    )
    for path in raw.glob(f"{frame:04d}[_.]*"):
        path.unlink()


class _Reporter:
    """Turns the script's events into Progress."""

    def __init__(
        self,
        progress: Callable[[Progress], None] | None,
        first: int,
        last: int,
        done: int,
        described: Mapping[str, Any],
        scales: Sequence[int],
    ):
        self.progress, self.total, self.done, self.part = progress, last - first + 1, done, 0.0
        # A G-buffer costs about as much as two samples of colour (measured on three scenes).
        cost = {"color": described["samples"] + 0.5, "gbuffer": 2.0}
        work = {("hr" if s == 1 else f"x{s}", k): c / s**2 for s in (1, *scales) for k, c in cost.items()}
        if described.get("reference", 0):
            work["hr", "reference"] = described.get("reference", 0) + 0.5
        self.share = {key: value / sum(work.values()) for key, value in work.items()}

    def __call__(self, event: Mapping[str, Any]) -> None:
        if event["event"] == "render":
            self.part += self.share[event["name"], event["kind"]]
            message = f"frame {event['frame']}, {event['name']} {event['kind']}"
        elif event["event"] == "frame":
            self.done, self.part = self.done + 1, 0.0
            message = f"frame {event['frame']}"
        else:
            return
        if self.progress is not None:
            done = min(self.done + self.part, self.total)
            self.progress(Progress(done, self.total, message, event["cpu_seconds"]))
