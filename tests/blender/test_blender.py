"""Rendering through Blender: the conversion of raw channels, the finder, and a real render against geometry.

Tests marked `blender` need a Blender or a Python with bpy (JAXSR_BLENDER); the others run everywhere.
"""

import json
import math
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxsr.blender.convert import Instances, convert_color, convert_gbuffer, sky_motion
from jaxsr.blender.process import find_blender, last_meaningful_line
from jaxsr.blender.render import render
from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from jaxsr.io.sequence import Sequence
from jaxsr.ops.jitter import jitter_sequence
from tests.blender import blender_scene

SCENE = Path(__file__).with_name("blender_scene.py")
SIZE = (64, 36)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Blender's XYZ Euler angles."""
    cx, sx, cy, sy, cz, sz = (f(a) for a in (x, y, z) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


def camera_at(frame: float) -> Camera:
    """The scene's camera from its pose alone: 30 mm lens, 36 mm sensor, shifted by 0.05 and -0.04."""
    place, angles = blender_scene.camera_pose(frame)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(*angles) @ np.diag([1, -1, -1])
    matrix[:3, 3] = place
    tan = np.array([18 / 30, 18 / 30 * SIZE[1] / SIZE[0]])
    return Camera(matrix, tan, np.array([2 * 0.05, 2 * 0.04 * SIZE[0] / SIZE[1]]))


def pixels(h: int, w: int, jitter=(0.0, 0.0)) -> np.ndarray:
    y, x = np.mgrid[0:h, 0:w].astype(float)
    return np.stack([x + jitter[0], y + jitter[1]], -1)


def rays(camera: Camera, h: int, w: int, jitter=(0.0, 0.0)) -> np.ndarray:
    """World directions with unit view depth."""
    ndc = (pixels(h, w, jitter) + 0.5) / (w, h) * 2 - 1
    view = np.concatenate([(ndc + camera.lens_shift) * camera.tan_half_fov, np.ones((h, w, 1))], -1)
    return view @ camera.world_from_view[:3, :3].T


def project(camera: Camera, world: np.ndarray, h: int, w: int) -> np.ndarray:
    view = (world - camera.world_from_view[:3, 3]) @ camera.world_from_view[:3, :3]
    ndc = view[..., :2] / (view[..., 2:] * camera.tan_half_fov) - camera.lens_shift
    return (ndc + 1) / 2 * (w, h) - 0.5


def raw_channels(
    h: int = 3, w: int = 4, version: int = 5, prefix: str = "ViewLayer"
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    index, letter = ("Object Index", "X") if version == 5 else ("IndexOB", "X")
    names = [f"Combined.{c}" for c in "RGBA"] + ["Depth.Z"] + [f"Vector.{c}" for c in "XYZW"]
    names += [f"{layer}.{c}" for layer in ("Normal", "Position") for c in "XYZ"]
    names += [f"base_color.{c}" for c in "RGBA"] + [
        f"{n}.{letter}" for n in ("roughness", "metallic", "instance")
    ]
    raw = {f"{prefix}.{n}": rng.uniform(0.1, 0.9, (h, w)).astype(np.float32) for n in names}
    raw[f"{prefix}.{index}.X"] = rng.integers(1, 4, (h, w)).astype(np.float32)
    raw[f"{prefix}.Depth.Z"][0, 0] = 1e10
    return raw


STILL = Camera(np.eye(4), np.array([0.6, 0.45]), np.zeros(2))


# --- conversion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("version", "prefix"), [(5, "ViewLayer"), (4, "View Layer"), (5, "A.b.c")])
def test_convert_names_signs_and_sky(version, prefix):
    raw = raw_channels(version=version, prefix=prefix)
    layers = convert_gbuffer(raw, STILL, STILL, position=True)
    assert all(x.dtype == np.float32 and x.shape[:2] == (3, 4) for x in layers.values())
    assert layers["depth"][0, 0, 0] == np.inf
    assert np.isfinite(layers["depth"].ravel()[1:]).all()
    for name in ("normal", "base_color", "roughness", "metallic", "object_id", "position"):
        assert not layers[name][0, 0].any(), name
    assert np.abs(layers["motion"][0, 0]).max() < 1e-12, "the camera stands still"
    np.testing.assert_array_equal(layers["motion"][1, 1, 0], -raw[f"{prefix}.Vector.X"][1, 1])
    np.testing.assert_array_equal(layers["motion"][1, 1, 1], raw[f"{prefix}.Vector.Y"][1, 1])
    np.testing.assert_allclose(np.linalg.norm(layers["normal"][1], axis=-1), 1, rtol=1e-6)
    np.testing.assert_array_equal(layers["base_color"][1, 2, 1], raw[f"{prefix}.base_color.G"][1, 2])


def test_convert_numbers_instances():
    raw = raw_channels()
    random_ids = [10, 2**31, 2**32 - 9]
    raw["ViewLayer.Object Index.X"][:] = 2
    raw["ViewLayer.Object Index.X"][2] = 1
    raw["ViewLayer.instance.X"][1] = np.divide([*random_ids, 2**30], 2**32)
    out = convert_gbuffer(raw, STILL, STILL, instances=Instances(5, [2], random_ids))["object_id"][..., 0]
    assert out[1, :3].tolist() == [6, 7, 8]
    assert out[1, 3] > 8, "an instance that was not there on the first frame"
    assert (out[2] == 1).all(), "not an instance"


def test_convert_color_mends_nan():
    raw = raw_channels()
    raw["ViewLayer.Combined.G"][1, 1] = np.nan
    raw["ViewLayer.Combined.R"][1, 2] = np.inf
    out = convert_color(raw)
    assert np.isfinite(out).all()
    np.testing.assert_array_equal(out[0, 0], [raw[f"ViewLayer.Combined.{c}"][0, 0] for c in "RGB"])


def test_missing_channel_is_named():
    raw = raw_channels()
    del raw["ViewLayer.Vector.X"]
    with pytest.raises(JaxsrError, match=r"missing channel 'Vector\.X'.*ViewLayer\.Depth\.Z"):
        convert_gbuffer(raw, STILL, STILL)


@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.3, -0.45)])
def test_sky_motion_is_that_of_a_very_far_point(jitter):
    now, before = camera_at(7), camera_at(5)
    h, w = 9, 16
    far = now.world_from_view[:3, 3] + 1e9 * rays(now, h, w, jitter)
    expected = pixels(h, w, jitter) - project(before, far, h, w)
    np.testing.assert_allclose(sky_motion(now, before, (w, h), jitter), expected, atol=1e-5)
    assert np.abs(expected).max() > 0.5


def test_sky_motion_behind_the_previous_camera_is_zero():
    turned = Camera(np.diag([-1.0, 1.0, -1.0, 1.0]), STILL.tan_half_fov, STILL.lens_shift)
    assert not sky_motion(STILL, turned, (4, 3)).any()


# --- finding Blender, arguments -------------------------------------------------------------------------


def test_finder_says_how_to_get_blender(monkeypatch, tmp_path):
    monkeypatch.delenv("JAXSR_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(JaxsrError, match=r"Blender was not found.*-m venv.*pip install bpy==5\.0\.1"):
        find_blender()
    with pytest.raises(JaxsrError, match=r"--blender \(nowhere\): no such program"):
        find_blender("nowhere")
    monkeypatch.setenv("JAXSR_BLENDER", "nowhere")
    with pytest.raises(JaxsrError, match=r"JAXSR_BLENDER \(nowhere\)"):
        find_blender()
    with pytest.raises(JaxsrError, match="no bpy"):
        find_blender(sys.executable)
    with pytest.raises(JaxsrError, match="neither Blender nor Python"):
        find_blender("/bin/true" if Path("/bin/true").exists() else "/usr/bin/true")


def fake_blender(folder: Path, body: str) -> Path:
    """An executable that calls itself Blender and does `body`: for failures a real one does not offer."""
    path = folder / "blender"
    path.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo "Blender 5.0.1"; exit; fi\n{body}\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_failure_shows_the_last_meaningful_line(tmp_path, monkeypatch):
    noise = "Fra:1 Mem:10M\nSaved: 'x.exr'\n00:00.3 cycles | WARNING CUEW failed: Error\n\nBlender quit\n"
    body = f"cat >&2 <<'END'\nSystem is out of GPU memory\n{noise}END\nexit 11"
    program = fake_blender(tmp_path, body)
    assert not find_blender(program).is_python
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.delenv("JAXSR_BLENDER", raising=False)
    scene = tmp_path / "a.blend"
    scene.write_bytes(b"")
    with pytest.raises(JaxsrError, match=r"Blender failed.*System is out of GPU memory.*blender\.log"):
        render(scene, tmp_path / "out", (1, 2))
    assert last_meaningful_line(noise) is None
    assert [p.name for p in (tmp_path / "out").rglob("*")] == ["blender.log"], "only what the message names"


@pytest.fixture
def imitation(tmp_path):
    """An executable in the place of Blender that renders by copying: for what needs no real pictures."""
    script = tmp_path / "imitation.py"
    script.write_text(IMITATION)
    body = f"for job; do :; done\nexec {sys.executable} {script} $job"
    return fake_blender(tmp_path, body)


IMITATION = """
import json, sys
from pathlib import Path
import numpy as np
from jaxsr.io.exr import write_exr

def say(event, **more):
    print(json.dumps({"event": event, "cpu_seconds": 0.0, **more}), flush=True)

job = json.loads(Path(sys.argv[1]).read_text())
if "broken" in job["scene"]["blend"]:
    say("error", what="cannot open", where=job["scene"]["blend"])
    sys.exit(1)
say("scene", scene_sha256="0", blender="5", samples=1, adaptive=0, denoise=False, bounces=1, size=[4, 2],
    fps=24, exposure=1.0, frames=job["frames"], objects=0, instanced=[], instances=[])
job |= json.loads(input())
raw, plane = Path(job["out"]), np.ones((2, 4), np.float32)
camera = {"world_from_view": np.eye(4).tolist(), "tan_half_fov": [1, 1], "lens_shift": [0, 0], "name": "c"}
names = ["Depth.Z", "Vector.X", "Vector.Y", "Normal.X", "Normal.Y", "Normal.Z", "base_color.R",
         "base_color.G", "base_color.B", "roughness.X", "metallic.X", "Object Index.X", "instance.X"]
for f in range(job["frames"][0], job["frames"][1] + 1):
    if f in job["skip"]:
        continue
    write_exr(raw / f"{f:04d}_hr_gbuffer.exr", {n: plane for n in names})
    write_exr(raw / f"{f:04d}_hr_color.exr", {f"Combined.{c}": plane for c in "RGB"})
    info = {"jitter_px": [0, 0], "cut": f == 5, "camera": camera, "previous": camera}
    (raw / f"{f:04d}.json").write_text(json.dumps(info))
    say("frame", frame=f)
say("done")
"""


def test_ranges_rendered_one_after_the_other_are_joined(tmp_path, imitation):
    scene, out = tmp_path / "a.blend", tmp_path / "out"
    scene.write_bytes(b"")

    def resets(first, last):
        seq = Sequence.open(render(scene, out, (first, last), scales=(), blender=imitation))
        return {i.index: i.reset for i in seq.infos}

    assert resets(3, 6) == {3: True, 4: False, 5: True, 6: False}
    before = (out / "hr" / "0004.exr").stat().st_mtime_ns
    assert resets(1, 6) == {1: True, 2: False, 3: False, 4: False, 5: True, 6: False}
    assert (out / "hr" / "0004.exr").stat().st_mtime_ns == before, "what is whole is kept"
    assert resets(7, 8) == {1: True, 2: False, 3: False, 4: False, 5: True, 6: False, 7: False, 8: False}
    assert resets(10, 10)[10]


def test_failures_before_the_first_frame_leave_nothing(tmp_path, imitation):
    scene = tmp_path / "broken.blend"
    scene.write_bytes(b"")
    (tmp_path / "mine").mkdir()
    for name in ("new", "mine"):
        with pytest.raises(JaxsrError, match=r"broken\.blend: cannot open"):
            render(scene, tmp_path / name, (1, 2), blender=imitation)
    assert not (tmp_path / "new").exists()
    assert not list((tmp_path / "mine").iterdir())


def test_out_that_is_a_file(tmp_path, imitation):
    scene, file = tmp_path / "a.blend", tmp_path / "file"
    scene.write_bytes(b"")
    file.write_text("mine")
    with pytest.raises(JaxsrError, match="file: not a folder"):
        render(scene, file, (1, 2), blender=imitation)
    with pytest.raises(JaxsrError, match="cannot write"):
        render(scene, file / "below", (1, 2), blender=imitation)
    with pytest.raises(JaxsrError, match=r"blender\.log: cannot write"):
        render(scene, tmp_path / "out", (1, 2), blender=imitation, log=file / "blender.log")
    assert file.read_text() == "mine"
    assert not (tmp_path / "out").exists()


def test_bad_arguments(tmp_path):
    with pytest.raises(JaxsrError, match=r"not a scene.*\.blend.*no such file"):
        render(tmp_path / "x.blend", tmp_path / "out")
    with pytest.raises(JaxsrError, match=r"--frames: an empty range.*5:3"):
        render(SCENE, tmp_path / "out", (5, 3))
    with pytest.raises(JaxsrError, match="--scale"):
        render(SCENE, tmp_path / "out", scales=(0,))
    with pytest.raises(JaxsrError, match="--samples"):
        render(SCENE, tmp_path / "out", samples=0)
    assert not (tmp_path / "out").exists()


# --- real renders ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def program():
    try:
        return find_blender().executable
    except JaxsrError as e:
        pytest.skip(f"no Blender: {e}")


def render_scene(out: Path, program: str, frames=(1, 4), split="test", **more) -> Path:
    arguments = {"seed": 0, "split": split, "clip": 0, "frames": 4}
    more = {"size": SIZE, "scales": (2, 4), "threads": 1, "position": True} | more
    return render(SCENE, out, frames, blender=program, scene_arguments=arguments, **more)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory, program):
    return Sequence.open(render_scene(tmp_path_factory.mktemp("render") / "seq", program))


RESOLUTIONS = [("hr", 1), ("x2", 2), ("x4", 4)]
CUBE, PLANE = 1, 2  # objects in the order of their names: cube, plane, post


@pytest.mark.blender
def test_description(rendered):
    assert (rendered.size, rendered.scales, len(rendered)) == (SIZE, (2, 4), 4)
    assert [i.reset for i in rendered.infos] == [True, False, False, False]
    assert rendered.exposure == 0.5
    assert rendered.generator["samples"] == 1 or rendered.generator["seed"] == 0
    for info, jitter in zip(rendered.infos, jitter_sequence(32), strict=False):
        expected = camera_at(info.index)
        np.testing.assert_allclose(info.jitter_px, jitter, atol=1e-9)
        np.testing.assert_allclose(info.world_from_view, expected.world_from_view, atol=2e-6)
        np.testing.assert_allclose(info.tan_half_fov, expected.tan_half_fov, atol=1e-6)
        np.testing.assert_allclose(info.lens_shift, expected.lens_shift, atol=1e-6)


@pytest.mark.blender
@pytest.mark.parametrize(("name", "scale"), RESOLUTIONS)
def test_motion_is_the_projection_of_known_transforms(rendered, name, scale):
    for i in range(len(rendered)):
        info, frame = rendered.infos[i], rendered.frame(i, scale)
        jitter = info.jitter_px if scale > 1 else (0.0, 0.0)
        buffers = frame.lr
        h, w = buffers.depth_linear.shape[:2]
        now, before = camera_at(info.index), camera_at(info.index - 1)
        depth = buffers.depth_linear.astype(float)
        sky = ~np.isfinite(depth[..., 0])
        world = now.world_from_view[:3, 3] + rays(now, h, w, jitter) * np.where(sky[..., None], 1e9, depth)
        (place, angles), (place0, angles0) = (blender_scene.cube_pose(info.index - k) for k in (0, 1))
        carried = (world - place) @ rotation(*angles) @ rotation(*angles0).T + place0
        ids = buffers.object_id[..., 0]
        expected = pixels(h, w, jitter) - project(
            before, np.where((ids == CUBE)[..., None], carried, world), h, w
        )
        error = np.abs(buffers.motion_px - expected)
        assert sky.any()
        assert (ids == CUBE).sum() > 3
        for mask in (sky, ids == CUBE, (ids == PLANE), ids > 3):
            assert error[mask].max(initial=0) < 1e-3, (name, info.index)
        assert np.abs(expected[~sky]).max() > 0.5 / scale


@pytest.mark.blender
@pytest.mark.parametrize(("name", "scale"), RESOLUTIONS)
def test_depth_position_and_rays_agree(rendered, name, scale):
    """I_J(p) = I_N(p + J): what a pixel sees lies on the ray through p + J, on the plane or the cube."""
    for i in range(len(rendered)):
        info, buffers = rendered.infos[i], rendered.frame(i, scale).lr
        jitter = info.jitter_px if scale > 1 else (0.0, 0.0)
        h, w = buffers.depth_linear.shape[:2]
        now = camera_at(info.index)
        eye, direction = now.world_from_view[:3, 3], rays(now, h, w, jitter)
        ids, depth = buffers.object_id[..., 0], buffers.depth_linear[..., 0].astype(float)
        hit = np.isfinite(depth)
        stored = rendered.position(i, name if name == "hr" else scale)
        np.testing.assert_allclose(stored[hit], (eye + direction * depth[..., None])[hit], atol=2e-4)

        plane = -eye[2] / direction[..., 2]
        np.testing.assert_allclose(depth[ids == PLANE], plane[ids == PLANE], rtol=2e-3)  # grazing: 0.005 px
        np.testing.assert_allclose(
            buffers.normal[ids == PLANE], np.tile([0, 0, 1.0], ((ids == PLANE).sum(), 1)), atol=1e-3
        )

        place, angles = blender_scene.cube_pose(info.index)
        local_eye, local = (eye - place) @ rotation(*angles), direction @ rotation(*angles)
        slabs = (
            np.stack([-np.ones(3), np.ones(3)])[:, None, None] * blender_scene.CUBE_HALF - local_eye
        ) / local
        near, far = slabs.min(0).max(-1), slabs.max(0).min(-1)
        ground = (eye + direction * plane[..., None])[..., :2]
        on_ground = (plane > 0) & (np.abs(ground).max(-1) < blender_scene.PLANE_HALF)
        in_cube = (near < far) & (near > 0) & ~(on_ground & (plane < near))
        assert (in_cube != (ids == CUBE)).sum() <= 1 + 0.001 * h * w, "outline"
        both = in_cube & (ids == CUBE)
        np.testing.assert_allclose(depth[both], near[both], rtol=2e-3)
        assert np.abs(np.linalg.norm(buffers.normal[hit], axis=-1) - 1).max() < 2e-3


def blackman_harris(image: np.ndarray, factor: int, width: float = 3.0) -> np.ndarray:
    """Pixels `factor` times larger, each a mean under a window of `width`: twice what Cycles is told."""
    h, w, _ = image.shape

    def weights(small: int) -> np.ndarray:
        centre = factor * (np.arange(small // factor) + 0.5) - 0.5
        u = (np.arange(small) - centre[:, None]) / (factor * width) + 0.5
        terms = zip((0.35875, -0.48829, 0.14128, -0.01168), range(4), strict=True)
        window = sum(a * np.cos(2 * np.pi * k * u) for a, k in terms) * ((u > 0) & (u < 1))
        return window / window.sum(1, keepdims=True)

    return np.einsum("yi,xj,ijc->yxc", weights(h), weights(w), image)


@pytest.mark.blender
def test_the_reference_is_the_scene_under_a_wide_filter(tmp_path, program):
    more = {"scales": (), "position": False, "samples": 8}
    seq = Sequence.open(render_scene(tmp_path / "a", program, (2, 2), **more, reference_samples=256))
    assert seq.generator["reference_samples"] == 256
    large = (SIZE[0] * 6, SIZE[1] * 6)
    fine = Sequence.open(render_scene(tmp_path / "b", program, (2, 2), **more | {"size": large}))
    expected = blackman_harris(fine.truth(0), 6)
    lit = expected.max(-1) < 1.5  # of the lamp itself no few samples tell enough
    error = {
        truth: np.sqrt(np.mean((seq.truth(0, truth) - expected)[lit] ** 2))
        for truth in ("color", "reference")
    }
    assert error["reference"] < 0.2 * error["color"], error


@pytest.mark.blender
def test_only_buffers_are_jittered_at_high_resolution(tmp_path, program):
    plain, jittered = (
        Sequence.open(
            render_scene(tmp_path / name, program, (1, 2), scales=(2,), jitter_hr=name == "jittered")
        )
        for name in ("plain", "jittered")
    )
    for i in range(2):
        for truth in ("color", "reference"):
            np.testing.assert_array_equal(jittered.truth(i, truth), plain.truth(i, truth))
        np.testing.assert_array_equal(jittered.frame(i, 2).color_linear, plain.frame(i, 2).color_linear)
        jitter = jittered.infos[i].jitter_px
        assert plain.infos[i].hr_jitter_px == (0, 0)
        np.testing.assert_allclose(jittered.infos[i].hr_jitter_px, jitter)
        buffers = jittered.frame(i, 2).hr
        camera = camera_at(jittered.infos[i].index)
        plane = -camera.world_from_view[2, 3] / rays(camera, SIZE[1], SIZE[0], jitter)[..., 2]
        ground = buffers.object_id[..., 0] == PLANE
        assert ground.sum() > 100
        np.testing.assert_allclose(buffers.depth_linear[..., 0][ground], plane[ground], rtol=2e-3)


@pytest.mark.blender
def test_materials_of_the_scene(rendered):
    buffers = rendered.frame(1, 1).lr
    ids = buffers.object_id[..., 0]
    np.testing.assert_allclose(
        buffers.base_color[ids == CUBE], [[0.2, 0.4, 0.6]] * (ids == CUBE).sum(), atol=1e-3
    )
    np.testing.assert_allclose(buffers.roughness[ids == CUBE], 0.25, atol=1e-3)
    np.testing.assert_allclose(buffers.metallic[ids == CUBE], 1)
    np.testing.assert_allclose(buffers.roughness[ids == PLANE], 0.75, atol=1e-3)
    checks = np.unique(buffers.base_color[ids == PLANE][:, 0])
    np.testing.assert_allclose(checks, [0.2, 0.8], atol=1e-3)
    assert {4.0, 5.0} <= set(ids.ravel().tolist()), "the two instances of the post have ids of their own"


@pytest.mark.blender
def test_node_trees_that_describe_a_surface(tmp_path, program):
    seq = Sequence.open(
        render_scene(tmp_path / "seq", program, (1, 1), "materials", size=(90, 10), scales=())
    )
    buffers = seq.frame(0, 1).lr
    for number, (name, (color, roughness, metallic)) in enumerate(blender_scene.MATERIALS.items(), start=1):
        here = buffers.object_id[..., 0] == number
        assert here.sum() > 10, name
        found = [x[here] for x in (buffers.base_color, buffers.roughness, buffers.metallic)]
        for values, expected in zip(found, (color, (roughness,), (metallic,)), strict=True):
            np.testing.assert_allclose(values, np.tile(expected, (len(values), 1)), atol=2e-3, err_msg=name)


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a sequence but the log."""
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != "blender.log"]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def processes_that_mention(text: str) -> list[str]:
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if text in line:
            found.append(line)
    return found


@pytest.mark.blender
def test_interrupt_and_resume_give_the_same_files(rendered, tmp_path, program):
    out = tmp_path / "seq"

    def stop(progress):
        if progress.done_frames > 1.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_scene(out, program, progress=stop)
    assert not processes_that_mention(str(out)), "Blender is still running"
    assert [i.index for i in Sequence.open(out).infos] == [1]
    seen = []
    render_scene(out, program, progress=lambda p: seen.append(p.done_frames), threads=2)
    assert contents(out) == contents(rendered.path), "interrupted and resumed, on another number of threads"
    assert seen[0] > 1
    assert seen == sorted(seen)
    assert seen[-1] == 4
    with pytest.raises(JaxsrError, match="holds another sequence"):
        render_scene(out, program, seed=1)


@pytest.mark.blender
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_kill_and_resume_give_the_same_files(rendered, tmp_path, program):
    out = tmp_path / "seq"
    arguments = {"seed": 0, "split": "test", "clip": 0, "frames": 4}
    code = f"""
import os, signal
from jaxsr.blender.render import render
def stop(progress):
    if progress.done_frames > 2.5:
        os.kill(os.getpid(), signal.SIGKILL)
render({str(SCENE)!r}, {str(out)!r}, (1, 4), (2, 4), size={SIZE}, threads=1, blender={program!r},
       scene_arguments={arguments}, position=True, progress=stop)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=SCENE.parent.parent)
    assert done.returncode == -signal.SIGKILL
    deadline = time.monotonic() + 10
    while processes_that_mention(str(out)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not processes_that_mention(str(out)), "Blender outlived its parent"
    render_scene(out, program)
    assert contents(out) == contents(rendered.path)


@pytest.mark.blender
def test_other_seed_changes_colour_only(rendered, tmp_path, program):
    other = Sequence.open(render_scene(tmp_path / "seq", program, (2, 2), seed=5))
    a, b = rendered.frame(1, 2), other.frame(0, 2)
    assert (a.color_linear != b.color_linear).any()
    for x, y in zip([*a.lr, *a.hr], [*b.lr, *b.hr], strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.blender
def test_cameras_bound_to_markers_cut(tmp_path, program):
    seq = Sequence.open(render_scene(tmp_path / "seq", program, split="cut", scales=(2,)))
    assert [i.reset for i in seq.infos] == [True, False, True, False]
    np.testing.assert_allclose(seq.infos[2].world_from_view[:3, 3], [0, -9, 3], atol=1e-6)
    still = seq.frame(2, 1).lr
    assert np.abs(still.motion_px[still.object_id[..., 0] == PLANE]).max() < 1e-3, "that camera does not move"


@pytest.mark.blender
def test_motion_of_a_zoom(tmp_path, program):
    """The focal length changes and the camera stands: all scales about the optical axis."""
    seq = Sequence.open(render_scene(tmp_path / "seq", program, (2, 2), "zoom", scales=(2,)))
    info, lr = seq.infos[0], seq.frame(0, 2).lr
    h, w = lr.depth_linear.shape[:2]
    p = pixels(h, w, info.jitter_px)
    ndc = (p + 0.5) / (w, h) * 2 - 1
    before = (ndc + info.lens_shift) * (33 / 36) - info.lens_shift
    still = (lr.object_id[..., 0] == PLANE) | (lr.object_id[..., 0] == 0)
    error = np.abs(lr.motion_px - (p - ((before + 1) / 2 * (w, h) - 0.5)))
    assert np.abs(lr.motion_px).max() > 1
    assert error[still].max() < 1e-3


@pytest.mark.blender
def test_blender_executable_takes_the_same_job(rendered, tmp_path, program):
    """The command line of `blender -b --python`, spoken to a stand-in that hands it to a Python with bpy."""
    if not find_blender(program).is_python:
        pytest.skip("the other tests already run a Blender executable")
    folder = tmp_path / "bin"
    folder.mkdir()
    check = '[ "$1 $2 $3 $4 $5" = "-b --factory-startup --python-exit-code 1 --python" ] || exit 9'
    shim = fake_blender(folder, f'{check}\nshift 5\nexec "{program}" "$@"')
    out = render_scene(tmp_path / "seq", str(shim), (1, 1))
    name = "hr/0001.exr"
    assert contents(out)[name] == contents(rendered.path)[name]


@pytest.mark.blender
def test_job_errors(tmp_path, program):
    with pytest.raises(JaxsrError, match=r"not divisible by scale 4.*64x38.*--size 64 36"):
        render_scene(tmp_path / "a", program, size=(64, 38))
    with pytest.raises(JaxsrError, match=r"not a perspective camera.*ortho"):
        render_scene(tmp_path / "b", program, split="orthographic")
    broken = tmp_path / "broken.blend"
    broken.write_bytes(b"not a blend file")
    with pytest.raises(JaxsrError, match=r"broken\.blend.*cannot open"):
        render(broken, tmp_path / "c", (1, 1), blender=program)
    faulty = tmp_path / "faulty.py"
    faulty.write_text("SETTINGS = {}\ndef build():\n    raise ZeroDivisionError('in the scene')\n")
    with pytest.raises(JaxsrError, match=r"Blender failed.*ZeroDivisionError: in the scene"):
        render(faulty, tmp_path / "d", (1, 1), blender=program)
    assert not list(tmp_path.rglob("*.exr"))


@pytest.mark.blender
def test_a_blend_file_with_its_own_settings(tmp_path, program):
    """Size, frames, samples and exposure of the .blend are taken."""
    blend = tmp_path / "saved.blend"
    code = (
        f"import sys; sys.path.insert(0, {str(SCENE.parent)!r}); import bpy, blender_scene as b;"
        "bpy.ops.wm.read_factory_settings(use_empty=True);"
        "b.build(seed=0, split='test', clip=0, frames=2); s = bpy.context.scene; s.render.engine = 'CYCLES';"
        "s.render.resolution_x, s.render.resolution_y, s.render.resolution_percentage = 128, 72, 25;"
        "s.frame_start, s.frame_end, s.cycles.samples, s.view_settings.exposure = 1, 2, 3, 1.0;"
        f"bpy.ops.wm.save_as_mainfile(filepath={str(blend)!r})"
    )
    found = find_blender(program)
    if not found.is_python:
        pytest.skip("saves the file with a Python that has bpy")
    subprocess.run([program, "-c", code], check=True, capture_output=True)
    seq = Sequence.open(render(blend, tmp_path / "seq", scales=(2,), blender=program))
    assert (seq.size, len(seq), seq.exposure, seq.name) == ((32, 18), 2, 2.0, "saved")
    assert seq.generator["samples"] == 3
    assert json.loads((tmp_path / "seq" / "sequence.json").read_text())["scales"] == [2]
