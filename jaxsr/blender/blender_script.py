"""Runs inside Blender (or a Python with bpy): renders the raw buffers that one job file asks for.

    python blender_script.py job.json
    blender -b --factory-startup --python blender_script.py -- job.json

Imports bpy and the standard library only. The job is a JSON object: `scene` ({"blend": path} or {"script":
path, "arguments": {...}} with a function `build` and a dict `SETTINGS`), `out` (folder), and, each null for
the scene's own: `frames` [first, last], `size` [W, H], `samples`, `denoise`, `exposure`; further `scales`,
`jitter_px` (a cycle of [x, y] in LR pixels: frame f uses entry (f - 1) mod length), `seed`, `threads`, `skip`
(frame numbers), `only` (subset of "hr", "x2", ... or null), `kinds`
(subset of "gbuffer", "color", "reference" or null), `jitter_hr` (the HR G-buffer is
jittered too, by the same numbers in HR pixels), `reference` (samples per pixel of an anti-aliased HR colour,
0 for none, null for as many as the colour has). With `attended`, one line of JSON with further entries of the
job is read from stdin after the scene was loaded, and the end of stdin (the parent is gone) ends the process,
also in the middle of a render.

Writes `scene.json`, `0001.json` (cameras of frames f and f - 1, without jitter) and `0001_hr_color.exr`,
`0001_hr_gbuffer.exr`, `0001_hr_reference.exr`, `0001_x2_color.exr`, ... Each is written under a temporary
name and renamed; files that exist are not rendered again. stdout carries one JSON object per line:
{"event": "scene" | "render" | "frame" | "done" | "error", ...}; what Blender prints goes to stderr.

Rendering: Cycles on the CPU, no anti-aliasing (all samples of a pixel within 0.005 pixels of its centre), no
motion blur, no depth of field, no compositing. The G-buffer is a render of its own at one sample. The
reference alone is anti-aliased: its samples lie under a Blackman-Harris filter of 1.5 pixels.
"""

import hashlib
import importlib.util
import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))

from blender_aovs import RENDERED_TYPES, prepare_materials

FILTER_WIDTH = 0.01
REFERENCE_FILTER_WIDTH = 1.5


class JobError(Exception):
    """A fault of the scene or the job that the user can correct: the arguments of JaxsrError."""

    def __init__(self, what: str, **more: Any):
        self.fields = {"what": what, **{key: str(value) for key, value in more.items()}}
        super().__init__(what)


class Events:
    """JSON lines on the real stdout; everything else that prints to stdout goes to stderr from here on."""

    def __init__(self) -> None:
        self._stream = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
        os.dup2(2, 1)

    def __call__(self, event: str, **fields: Any) -> None:
        spent = {"cpu_seconds": round(time.process_time(), 3)}
        self._stream.write(json.dumps({"event": event, **fields, **spent}) + "\n")
        self._stream.flush()


def write_json(path: Path, value: Any) -> None:
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(json.dumps(value, indent=1))
    temporary.replace(path)


def exit_with_parent() -> None:
    """End this process when the parent has ended: the parent holds the other end of stdin."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os._exit(3)

    threading.Thread(target=wait, daemon=True).start()


def load_scene(job: dict) -> tuple[Any, dict]:
    """Opens the .blend or builds the scene; returns the scene and the settings that a script declares."""
    source = job["scene"]
    if "blend" in source:
        if not Path(source["blend"]).is_file():
            raise JobError("no such file", where=source["blend"])
        try:
            bpy.ops.wm.open_mainfile(filepath=source["blend"], use_scripts=False, load_ui=False)
        except RuntimeError as error:
            raise JobError(f"Blender cannot open it ({error})", where=source["blend"]) from error
        return bpy.context.scene, {}
    path = Path(source["script"])
    if not path.is_file():
        raise JobError("no such file", where=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    sys.path.insert(0, str(path.resolve().parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise JobError("not a Python file", where=path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.build(**source["arguments"])
    settings = dict(module.SETTINGS)
    scene = bpy.context.scene
    for name in ("max_bounces", "diffuse_bounces", "glossy_bounces"):
        if name in settings:
            setattr(scene.cycles, name, settings[name])
    settings["samples"] = settings.get(f"{source['arguments'].get('split')}_samples")
    return scene, settings


def plan(scene: Any, settings: dict, job: dict) -> dict:
    """Takes the values that the job leaves open from the scene, checks them, and returns the complete job."""
    where = job["scene"].get("blend") or job["scene"].get("script")
    if scene.camera is None:
        raise JobError("the scene has no camera", where=where, fix="set scene.camera")
    render = scene.render
    percentage = render.resolution_percentage / 100
    own_size = [round(render.resolution_x * percentage), round(render.resolution_y * percentage)]
    size = job.get("size") or own_size
    for scale in job["scales"]:
        if size[0] % scale or size[1] % scale:
            raise JobError(
                f"the size is not divisible by scale {scale}",
                where=where,
                found=f"{size[0]}x{size[1]}",
                fix=f"use --size {size[0] // scale * scale} {size[1] // scale * scale}",
            )
    if abs(render.pixel_aspect_x / render.pixel_aspect_y - 1) > 1e-6:
        raise JobError("pixels are not square", where=where, expected="pixel aspect 1:1")
    arguments = job["scene"].get("arguments")
    own_frames = [1, arguments["frames"]] if arguments else [scene.frame_start, scene.frame_end]
    first, last = job.get("frames") or own_frames
    if last < first:
        raise JobError("an empty range of frames", where=where, found=f"{first}:{last}")

    def choose(name: str, own: Any) -> Any:
        for value in (job.get(name), settings.get(name)):
            if value is not None:
                return value
        return own

    return {
        "size": list(size),
        "frames": [first, last],
        "samples": int(choose("samples", scene.cycles.samples)),
        "adaptive": bool(
            scene.cycles.use_adaptive_sampling and job.get("samples") is None and not settings.get("samples")
        ),
        "reference": int(choose("reference", choose("samples", scene.cycles.samples))),
        "denoise": bool(choose("denoise", scene.cycles.use_denoising)),
        "exposure": float(choose("exposure", 2.0**scene.view_settings.exposure)),
        "fps": render.fps / render.fps_base,
        "blender": bpy.app.version_string,
        "bounces": scene.cycles.max_bounces,
    }


def set_up(scene: Any, job: dict) -> None:
    """Sets up what is constant over the clip."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    cycles.device = "CPU"
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = FILTER_WIDTH
    cycles.time_limit = 0
    cycles.sample_offset = 0
    cycles.use_animated_seed = False
    if hasattr(cycles, "denoising_use_gpu"):
        cycles.denoising_use_gpu = False
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_prefilter = "NONE"
    render.use_motion_blur = False
    render.film_transparent = False
    render.use_border = False
    render.use_compositing = False
    render.use_sequencer = False
    render.use_freestyle = False
    render.use_multiview = False
    render.use_persistent_data = True
    render.resolution_percentage = 100
    render.use_file_extension = False
    render.use_overwrite = True
    if job.get("threads"):
        render.threads_mode = "FIXED"
        render.threads = job["threads"]
    image = render.image_settings
    if hasattr(image, "media_type"):  # Blender 5 offers multi-layer formats only under this type
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "NONE"

    layers = [layer for layer in scene.view_layers if layer.use] or list(scene.view_layers)
    for layer in scene.view_layers:
        layer.use = layer == layers[0]
    layer = layers[0]
    for name in ("z", "position", "normal", "vector", "object_index"):
        setattr(layer, f"use_pass_{name}", True)
    prepare_materials(scene, layer)
    for data in bpy.data.cameras:
        data.dof.use_dof = False
    ordered = sorted((o for o in bpy.data.objects if o.type in RENDERED_TYPES), key=lambda o: o.name_full)
    for number, obj in enumerate(ordered, start=1):
        obj.pass_index = number


def instances() -> tuple[list[int], list[int]]:
    """pass_index of the objects that appear as instances, and the random ids of all instances."""
    graph = bpy.context.evaluated_depsgraph_get()
    found = [(i.object.original.pass_index, i.random_id) for i in graph.object_instances if i.is_instance]
    return sorted({index for index, _ in found} - {0}), sorted({random & 0xFFFFFFFF for _, random in found})


def fingerprint(source: dict) -> str:
    """SHA-256 of the .blend, or of the scene's script and the modules beside it that it imported."""
    if "blend" in source:
        with Path(source["blend"]).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    script = Path(source["script"]).resolve()
    loaded = [
        Path(source_file).resolve()
        for m in list(sys.modules.values())
        if (source_file := getattr(m, "__file__", None))
    ]
    digest = hashlib.sha256()
    for path in sorted({script, *(p for p in loaded if p.parent == script.parent and p.suffix == ".py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def projection(camera: Any, size: list[int]) -> Any:
    graph = bpy.context.evaluated_depsgraph_get()
    return camera.evaluated_get(graph).calc_matrix_camera(
        graph, x=size[0], y=size[1], scale_x=1.0, scale_y=1.0
    )


def camera_now(camera: Any, size: list[int]) -> dict:
    """The camera at the current frame in jaxsr's conventions (view space x right, y down, z forward)."""
    graph = bpy.context.evaluated_depsgraph_get()
    world = camera.evaluated_get(graph).matrix_world.copy()
    columns = [world.col[i].to_3d().normalized() for i in range(3)]  # Cycles ignores the scale too
    x, y, z, origin = columns[0], -columns[1], -columns[2], world.translation
    p = projection(camera, size)
    return {
        "name": camera.name_full,
        "world_from_view": [[x[i], y[i], z[i], origin[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]],
        "tan_half_fov": [1 / p[0][0], 1 / p[1][1]],
        "lens_shift": [p[0][2], -p[1][2]],
    }


def check_camera(scene: Any, camera: Any, frame: int) -> None:
    if camera.type != "CAMERA" or camera.data.type != "PERSP":
        kind = camera.data.type.lower() if camera.type == "CAMERA" else camera.type.lower()
        raise JobError(f"camera '{camera.name}' is not a perspective camera", expected="PERSP", found=kind)
    own = camera.data.shift_x, camera.data.shift_y
    camera.data.shift_x, camera.data.shift_y = own[0] + 0.25, own[1] + 0.25
    scene.frame_set(frame)
    animated = max(abs(camera.data.shift_x - own[0] - 0.25), abs(camera.data.shift_y - own[1] - 0.25)) > 1e-4
    camera.data.shift_x, camera.data.shift_y = own
    if animated:
        raise JobError(f"the lens shift of camera '{camera.name}' is animated", fix="remove its key-frames")


class Renderer:
    """Renders the buffers of one frame after the other; knows the cameras' own shifts."""

    def __init__(self, scene: Any, described: dict, job: dict, events: Events):
        self.scene, self.described, self.job, self.events = scene, described, job, events
        self.out = Path(job["out"])
        self.own_shift: dict[str, tuple[float, float]] = {}
        self.last: tuple[int, dict] | None = None

    def resolutions(self) -> list[tuple[str, list[int], int]]:
        width, height = self.described["size"]
        named = [("hr", [width, height], 0)]
        named += [(f"x{s}", [width // s, height // s], s) for s in self.job["scales"] if s != 1]
        only = self.job.get("only")
        return [n for n in named if only is None or n[0] in only]

    def kinds(self, name: str) -> tuple[str, ...]:
        reference = ("reference",) if name == "hr" and self.described["reference"] else ()
        wanted = self.job.get("kinds")
        return tuple(k for k in ("gbuffer", "color", *reference) if wanted is None or k in wanted)

    def shift(self, camera: Any, jitter_px: list[float], size: list[int]) -> None:
        """Moves the lens so that I_J(p) = I_N(p + J), whatever the camera's sensor fit."""
        own_x, own_y = self.own_shift[camera.name_full]
        data = camera.data
        data.shift_x, data.shift_y = 0.0, 0.0
        bpy.context.view_layer.update()
        zero = projection(camera, size)
        data.shift_x, data.shift_y = 1.0, 1.0
        bpy.context.view_layer.update()
        one = projection(camera, size)
        data.shift_x = own_x + 2 * jitter_px[0] / size[0] / (one[0][2] - zero[0][2])
        data.shift_y = own_y - 2 * jitter_px[1] / size[1] / (one[1][2] - zero[1][2])

    def cameras(self, frame: int) -> tuple[Any, dict]:
        """Moves to the frame; returns its camera object and the cameras of it and of the frame before."""
        scene, size = self.scene, self.described["size"]
        for name, (x, y) in self.own_shift.items():
            bpy.data.objects[name].data.shift_x, bpy.data.objects[name].data.shift_y = x, y
        if self.last is not None and self.last[0] == frame - 1:
            before = self.last[1]
        else:
            scene.frame_set(frame - 1)
            before = camera_now(scene.camera, size)
        scene.frame_set(frame)
        camera = scene.camera
        if camera.name_full not in self.own_shift:
            check_camera(scene, camera, frame)
            self.own_shift[camera.name_full] = (camera.data.shift_x, camera.data.shift_y)
        now = camera_now(camera, size)
        cut = now["name"] != before["name"]
        if cut:  # the Vector pass uses the new camera's position one frame ago
            scene.frame_set(frame - 1)
            before = camera_now(camera, size)
            scene.frame_set(frame)
        self.last = (frame, now)
        return camera, {"frame": frame, "camera": now, "previous": before, "cut": cut}

    def render(self, frame: int, number: int, name: str, size: list[int], kind: str, path: Path) -> None:
        scene, cycles, described = self.scene, self.scene.cycles, self.described
        scene.render.resolution_x, scene.render.resolution_y = size
        color = kind != "gbuffer"
        cycles.samples = {"color": described["samples"], "reference": described["reference"]}.get(kind, 1)
        cycles.filter_width = REFERENCE_FILTER_WIDTH if kind == "reference" else FILTER_WIDTH
        cycles.use_adaptive_sampling = described["adaptive"] and color
        cycles.use_denoising = described["denoise"] and color
        cycles.seed = (self.job["seed"] * 7919 + frame * 31 + number) % (2**31) if color else 0
        temporary = path.with_name(f".{path.name}.part")
        scene.render.filepath = str(temporary)
        start = time.monotonic()
        bpy.ops.render.render(write_still=True)
        if not temporary.is_file():
            raise JobError("Blender did not write the image", where=path)
        temporary.replace(path)
        seconds = time.monotonic() - start
        self.events("render", frame=frame, name=name, kind=kind, seconds=round(seconds, 3))

    def frame(self, frame: int) -> None:
        jobs = [
            (number, name, size, scale, kind, self.out / f"{frame:04d}_{name}_{kind}.exr")
            for number, (name, size, scale) in enumerate(self.resolutions())
            for kind in self.kinds(name)
        ]
        info = self.out / f"{frame:04d}.json"
        missing = [j for j in jobs if not j[-1].is_file()]
        if missing or not info.is_file():
            cycle = self.job["jitter_px"]
            jitter = cycle[(frame - 1) % len(cycle)]
            camera, described = self.cameras(frame)
            for number, name, size, scale, kind, path in missing:
                moved = scale or (kind == "gbuffer" and self.job.get("jitter_hr"))
                self.shift(camera, jitter if moved else [0.0, 0.0], size)
                self.render(frame, number, name, size, kind, path)
            write_json(info, {**described, "jitter_px": jitter})
        self.events("frame", frame=frame)


def run(job: dict, events: Events) -> None:
    scene, settings = load_scene(job)
    scene.render.engine = "CYCLES"
    described = plan(scene, settings, job)
    set_up(scene, job)
    first, last = described["frames"]
    scene.frame_set(first)
    described["instanced"], described["instances"] = instances()
    described["objects"] = max((o.pass_index for o in bpy.data.objects), default=0)
    described["scene_sha256"] = fingerprint(job["scene"])
    events("scene", **described)
    if job.get("attended"):
        job = job | json.loads(sys.stdin.readline())
        exit_with_parent()
    skip = set(job.get("skip") or ())
    out = Path(job["out"])
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "scene.json", described)
    renderer = Renderer(scene, described, job, events)
    for frame in range(first, last + 1):
        if frame not in skip:
            renderer.frame(frame)
    events("done")


def main(arguments: list[str]) -> int:
    if len(arguments) != 1:
        print("usage: blender_script.py job.json", file=sys.stderr)
        return 2
    job = json.loads(Path(arguments[0]).read_text())
    events = Events()
    try:
        run(job, events)
    except JobError as error:
        events("error", **error.fields)
        return 2
    return 0


if __name__ == "__main__":
    after = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    code = main(after)
    sys.stdout.flush()
    os._exit(code)  # all files are written; Blender's own exit can crash after a persistent render
