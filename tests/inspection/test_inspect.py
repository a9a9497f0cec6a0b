"""jaxsr.inspection.inspect: right sequences pass, and every planted fault is found and called by its name."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from jaxsr.data import analytic
from jaxsr.inspection.conventions import CONVENTIONS, UNITS, MotionConvention
from jaxsr.inspection.images import is_sky
from jaxsr.inspection.inspect import inspect, print_report
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.sequence import Sequence
from jaxsr.ops.pinhole import pixels_from_world
from tests.builders import edit_frames, frame_info, make_sequence

SIZE = (160, 96)


def look(path, needs=None, *, frames=2, **builder):
    seq = make_sequence(path / "seq", frames=frames, size=SIZE, **builder)
    return inspect(Sequence.open(seq.path, check=False), needs)


def change_motion(change):
    def spoil(name, index, layers):
        h, w = layers["motion"].shape[:2]
        layers["motion"] = change(layers["motion"], w, h).astype(np.float32)

    return spoil


def forward_motion(name, index, layers):
    """p_next - p, from the scene."""
    h, w = layers["motion"].shape[:2]
    position, ids = layers["position"].astype(np.float64), layers["object_id"][..., 0].astype(int)
    later = position.copy()
    for number, item in enumerate(analytic.scene(), 1):
        mask = ids == number
        later[mask] = item.to_world(item.to_local(position[mask], index), index + 1)
    now, _ = pixels_from_world(position, frame_info(index, (w, h)), (h, w), np)
    motion = pixels_from_world(later, frame_info(index + 1, (w, h)), (h, w), np)[0] - now
    layers["motion"] = np.where(is_sky(layers["depth"]), 0, motion).astype(np.float32)


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    needs = {"a": frozenset({"lr.color", "hr.normal"})}
    return look(tmp_path_factory.mktemp("right"), needs, frames=3, scales=(2, 4))


def test_a_right_sequence_passes(right):
    assert {f.topic: f.level for f in right.findings} == {
        "files": "ok", "values": "ok", "motion": "ok", "camera and depth": "ok", "LR motion x2": "ok",
        "LR motion x4": "ok", "jitter x2": "ok", "jitter x4": "ok", "normal": "ok",
    }  # fmt: skip
    motion = right.finding("motion").data
    assert motion["convention"] == "backward, pixels, y down"
    assert motion["sure"]
    assert motion["votes"] == 1
    assert motion["margin"] > 2
    assert right.finding("jitter x2").data["reading"] == "as stated"
    assert right.finding("camera and depth").data["error"] < 1e-4
    assert right.level == "ok"
    assert right.missing == {"a": []}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda m, w, h: m * (-1, 1), "backward, pixels, y down, x flipped"),
        (lambda m, w, h: m * (1, -1), "backward, pixels, y up"),
        (lambda m, w, h: -m, "backward, pixels, y down, both signs flipped"),
        (lambda m, w, h: m[..., ::-1], "backward, pixels, y down, axes swapped"),
        (lambda m, w, h: m[..., ::-1] * (1, -1), "backward, pixels, y down, x flipped, axes swapped"),
        (lambda m, w, h: 0.5 * m, "backward, half pixels (times 2), y down"),
        (lambda m, w, h: 2 * m, "backward, double pixels (times 0.5), y down"),
        (lambda m, w, h: m / (w, h), "backward, UV (times width, height), y down"),
        (lambda m, w, h: m / w, "backward, widths (times width), y down"),
        (
            lambda m, w, h: m / (w / 2, -h / 2),
            "backward, NDC (times half width, half height), y up",
        ),
    ],
)
def test_wrong_motion_is_recognised(tmp_path, change, name):
    found = look(tmp_path, scales=(), spoil=change_motion(change)).finding("motion")
    assert (found.level, found.data["convention"], found.data["sure"]) == ("bad", name, True)
    assert name in found.text
    assert "convert it" in found.text


def test_forward_motion_is_recognised(tmp_path):
    found = look(tmp_path, scales=(), spoil=forward_motion).finding("motion")
    assert (found.level, found.data["convention"]) == ("bad", "forward, pixels, y down")
    assert found.data["sure"]


def test_conventions_have_names_and_invert():
    assert len({c.name for c in CONVENTIONS}) == len(CONVENTIONS)
    stored = np.array([[0.5, 0.25]])
    np.testing.assert_array_equal(MotionConvention().to_pixels(stored, SIZE), stored)
    uv = MotionConvention("UV (times width, height)", (1, -1), swapped=True)
    np.testing.assert_array_equal(uv.to_pixels(stored, (100, 10)), [[25, -5]])
    assert all(UNITS[c.unit](*SIZE) for c in CONVENTIONS)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda m, w, h: m, "backward, pixels, y down"),
        (lambda m, w, h: m * (-1, 1), "y down, x flipped"),
        (lambda m, w, h: m / (w, -h), "UV (times width, height), y up"),
    ],
)
def test_motion_is_told_by_images_alone(tmp_path, change, name):
    """With cameras that are all the same, only the warp speaks; forward motion cannot be excluded then."""
    seq = make_sequence(tmp_path, size=SIZE, scales=(), spoil=change_motion(change))
    head = json.loads((tmp_path / "sequence.json").read_text())
    for frame in head["frames"]:
        frame["camera"] = head["frames"][0]["camera"]
    (tmp_path / "sequence.json").write_text(json.dumps(head))
    report = inspect(Sequence.open(seq.path))
    found = report.finding("motion")
    assert name in found.data["convention"]
    assert all("forward" in rival or "widths" in rival for rival in found.data["rivals"])
    assert report.finding("camera and depth").level == "warn"


def test_colour_serves_where_there_is_no_base_colour(tmp_path):
    def spoil(name, index, layers):
        for layer in ("base_color", "normal"):
            del layers[layer]
        layers["motion"] = layers["motion"] * np.float32([1, -1])

    found = look(tmp_path, scales=(), spoil=spoil).finding("motion")
    assert found.data["convention"] == "backward, pixels, y up"


def test_nothing_moves(tmp_path):
    report = look(tmp_path, still=True, frozen=True)
    found = report.finding("motion")
    assert (found.level, found.data["convention"]) == ("warn", None)
    assert found.text == "cannot tell: nothing moves"
    assert report.finding("jitter x2").level == "ok"


def test_objects_move_and_the_camera_stands(tmp_path):
    found = look(tmp_path, scales=(), still=True).finding("motion")
    assert found.data["convention"] == "backward, pixels, y down"
    # They move sideways, at constant speed: y up and forward would look the same, and it says so.
    assert (found.level, found.data["sure"]) == ("warn", False)
    assert all("forward" in rival or "y up" in rival for rival in found.data["rivals"])
    assert "not quite sure" in found.text


def test_motion_that_was_not_exported(tmp_path):
    found = look(tmp_path, scales=(), spoil=change_motion(lambda m, w, h: 0 * m)).finding("motion")
    assert found.level == "bad"
    assert "zero everywhere, yet the camera moves points by" in found.text


def test_motion_that_was_not_exported_while_the_camera_stands(tmp_path):
    report = look(tmp_path, scales=(), still=True, spoil=change_motion(lambda m, w, h: 0 * m))
    assert report.finding("motion").level == "bad"
    assert "zero everywhere, yet the images change" in report.finding("motion").text


def test_motion_that_was_not_exported_of_flat_images(tmp_path):
    """Nothing in the pictures tells, but the cameras do."""

    def spoil(name, index, layers):
        for layer in layers:
            layers[layer] = 0 * layers[layer] if layer == "motion" else np.ones_like(layers[layer])

    report = look(tmp_path, scales=(), spoil=spoil)
    assert report.finding("motion").level == "bad"
    assert "the camera moves points by" in report.finding("motion").text


def test_lr_motion_that_was_not_exported(tmp_path):
    def spoil(name, index, layers):
        if name == "x2":
            layers["motion"] = 0 * layers["motion"]

    found = look(tmp_path, spoil=spoil).finding("LR motion x2")
    assert found.level == "bad"
    assert found.text.startswith("zero everywhere")


@pytest.mark.parametrize("layer", ["motion", "depth", "color"])
@pytest.mark.parametrize("whole", [True, False], ids=["layer", "channel"])
def test_missing_needed_layers_are_bad(tmp_path, layer, whole):
    seq = make_sequence(tmp_path / "seq", frames=2, size=(32, 20))
    channels, _ = read_exr(seq.path / "x2/0002.exr")
    lost = [n for n in channels if n.startswith(f"{layer}.")][: None if whole else 1]
    write_exr(seq.path / "x2/0002.exr", {n: x for n, x in channels.items() if n not in lost})
    report = inspect(Sequence.open(seq.path, check=False))
    assert report.finding("files").level == report.level == "bad"
    gone = whole or layer == "depth"  # which has one channel
    expected = f"missing layer {layer!r}" if gone else f"layer {layer!r} lacks channel"
    assert f"x2/0002.exr: {expected}" in report.finding("files").text


@pytest.mark.parametrize("frame", [1, 3])
@pytest.mark.parametrize("channels", [["base_color.G"], ["base_color.R", "base_color.G", "base_color.B"]])
def test_a_buffer_that_one_frame_lacks(tmp_path, frame, channels):
    """A method would stop there, so it must not be said to run."""
    sequence = make_sequence(tmp_path, frames=3, size=SIZE)
    file = tmp_path / "hr" / f"{frame:04d}.exr"
    found, _ = read_exr(file)
    write_exr(file, {name: x for name, x in found.items() if name not in channels})
    report = inspect(Sequence.open(sequence.path, check=False), {"any": frozenset({"hr.base_color"})})
    text = report.finding("files").text
    assert (report.level, str(file) in text, "base_color" in text) == ("bad", True, True)
    assert report.missing["any"] == ([] if len(channels) == 1 else ["hr.base_color"])


def test_nan_in_motion_alone_is_bad_and_no_missing_motion(tmp_path):
    seq = make_sequence(tmp_path / "seq", frames=2, size=SIZE, scales=())
    channels, _ = read_exr(seq.path / "hr/0002.exr")
    motion = channels["motion.X"].copy()
    motion[3, 4] = np.nan
    write_exr(seq.path / "hr/0002.exr", channels | {"motion.X": motion})
    report = inspect(Sequence.open(seq.path, check=False))
    assert report.finding("values").level == report.level == "bad"
    assert report.finding("motion").level == "ok"


def test_damaged_pixels_do_not_disturb_the_output_for_machines(tmp_path, capsys):
    seq = make_sequence(tmp_path / "seq", frames=2, size=SIZE)
    path = seq.path / "hr/0002.exr"
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 300] = b"\x55" * 300
    path.write_bytes(data)
    print(json.dumps(inspect(Sequence.open(seq.path, check=False)).to_json()))
    back = json.loads(capsys.readouterr().out)
    assert back["level"] == "bad"
    assert "hr/0002.exr: the pixel data is damaged" in back["findings"][0]["text"]


def test_random_motion_is_not_explained(tmp_path):
    noise = np.random.default_rng(0)
    found = look(
        tmp_path, scales=(), spoil=change_motion(lambda m, w, h: noise.normal(0, 4, m.shape))
    ).finding("motion")
    assert (found.level, found.data["convention"]) == ("bad", None)


def test_one_frame_tells_nothing_of_motion(tmp_path):
    report = look(tmp_path, frames=1)
    assert report.finding("motion").text == "cannot tell: no two consecutive frames"
    assert report.finding("jitter x2").level == "ok"


def test_flat_images_tell_nothing(tmp_path):
    def flat(name, index, layers):
        for layer in layers:
            if layer != "motion":
                layers[layer] = np.ones_like(layers[layer])

    report = look(tmp_path, spoil=flat)
    assert report.finding("motion").level == "warn"
    assert "flat" in report.finding("motion").text
    assert report.finding("jitter x2").text == "cannot tell: the G-buffers are flat"


@pytest.mark.parametrize(
    ("jitter", "reading"),
    [
        (lambda j: (-j[0], -j[1]), "both signs flipped"),
        (lambda j: (-j[0], j[1]), "x flipped"),
        (lambda j: (j[0], -j[1]), "y flipped"),
        (lambda j: (j[1], j[0]), "axes swapped"),
        (lambda j: (2 * j[0], 2 * j[1]), "stated in HR pixels"),
    ],
)
def test_wrong_jitter_is_recognised(tmp_path, jitter, reading):
    report = look(tmp_path, jitter=jitter, frames=3)
    found = report.finding("jitter x2")
    assert (found.level, found.data["reading"]) == ("bad", reading)
    assert repr(reading) in found.text
    assert report.finding("motion").level == "ok"


def test_jitter_that_is_not_stated_is_found(tmp_path):
    found = look(tmp_path, jitter=lambda j: (0.0, 0.0)).finding("jitter x2")
    assert found.level == "bad"
    assert "none stated" in found.text


def test_lr_motion_with_jitter_or_in_hr_pixels(tmp_path):
    def in_hr_pixels(name, index, layers):
        if name == "x2":
            layers["motion"] = 2 * layers["motion"]

    def with_jitter(name, index, layers):
        if name == "x2":
            delta = np.subtract(frame_info(index - 1, SIZE).jitter_px, frame_info(index, SIZE).jitter_px)
            layers["motion"] = layers["motion"] + delta.astype(np.float32)

    for number, (spoil, reading) in enumerate(
        [(in_hr_pixels, "HR pixels"), (with_jitter, "jitter counted in")]
    ):
        found = look(tmp_path / str(number), spoil=spoil).finding("LR motion x2")
        assert (found.level, found.data["reading"]) == ("bad", reading)


def edit_cameras(path, change):
    head = json.loads((path / "sequence.json").read_text())
    for frame in head["frames"]:
        frame["camera"]["world_from_view"] = change(np.array(frame["camera"]["world_from_view"])).tolist()
    (path / "sequence.json").write_text(json.dumps(head))
    return inspect(Sequence.open(path))


@pytest.mark.parametrize(
    ("change", "camera"),
    [
        (lambda m: m @ np.diag([1, -1, -1, 1]), "OpenGL axes (y up, z backward)"),
        (np.linalg.inv, "inverted (view_from_world)"),
    ],
)
def test_wrong_camera_is_recognised(tmp_path, change, camera):
    make_sequence(tmp_path, size=SIZE, scales=())
    found = edit_cameras(tmp_path, change).finding("camera and depth")
    assert (found.level, found.data["camera"]) == ("bad", camera)
    assert found.data["depth"] == "linear view depth"


@pytest.mark.parametrize(
    "kind", ["distance along the ray", "reciprocal of depth", "view depth in centimetres"]
)
def test_wrong_depth_is_recognised(tmp_path, kind):
    def spoil(name, index, layers):
        depth = layers["depth"]
        h, w = depth.shape[:2]
        if kind == "distance along the ray":
            view = analytic.camera(index, (w, h))
            solid = ~is_sky(depth)
            distance = np.linalg.norm(
                layers["position"] - view.world_from_view[:3, 3], axis=-1, keepdims=True
            )
            layers["depth"] = np.where(solid, distance, np.inf).astype(np.float32)
        elif kind == "reciprocal of depth":
            layers["depth"] = np.where(is_sky(depth), np.inf, 1 / depth).astype(np.float32)
        else:
            layers["depth"] = 100 * depth

    found = look(tmp_path, scales=(), spoil=spoil).finding("camera and depth")
    assert (found.level, found.data["depth"], found.data["camera"]) == ("bad", kind, "as stated")


@pytest.mark.parametrize(
    ("change", "reading"),
    [
        (lambda n, r: n @ r, "view space (y down, z forward)"),
        (lambda n, r: (n @ r) * (1, -1, -1), "view space, OpenGL (y up, z backward)"),
        (lambda n, r: -n, "world space, pointing inwards"),
        (lambda n, r: n * 0.5 + 0.5, "0..1 encoded world space"),
        (lambda n, r: np.stack([n[..., 0], n[..., 2], -n[..., 1]], -1), "world space, y up"),
    ],
)
def test_wrong_normals_are_recognised(tmp_path, change, reading):
    def spoil(name, index, layers):
        rotation = analytic.camera(index, SIZE).world_from_view[:3, :3]
        layers["normal"] = change(layers["normal"], rotation).astype(np.float32)

    found = look(tmp_path, scales=(), spoil=spoil).finding("normal")
    assert (found.level, found.data["reading"]) == ("bad", reading)


def test_normals_of_wrong_length(tmp_path):
    def spoil(name, index, layers):
        layers["normal"] = 0.9 * layers["normal"]

    found = look(tmp_path, scales=(), spoil=spoil).finding("normal")
    assert found.level == "bad"
    assert "not of unit length (off by 0.1" in found.text


def test_faults_in_files_and_values_are_findings(tmp_path):
    def spoil(name, index, layers):
        layers["depth"] = np.where(is_sky(layers["depth"]), np.float32(1e10), layers["depth"])
        layers["roughness"] = 7 * layers["roughness"]

    seq = make_sequence(tmp_path, frames=4, size=SIZE, spoil=spoil)
    channels, _ = read_exr(tmp_path / "x2/0002.exr")
    channels["color.R"] = channels["color.R"].copy()
    channels["color.R"][2, 3] = np.nan
    channels["normal.X"] = np.where(np.arange(80) < 2, np.inf, channels["normal.X"]).astype(np.float16)
    write_exr(tmp_path / "x2/0002.exr", channels)
    depth = channels["depth.Z"].copy()
    depth[9, 9] = -np.inf
    write_exr(tmp_path / "x2/0001.exr", read_exr(tmp_path / "x2/0001.exr")[0] | {"depth.Z": depth})
    whole = (tmp_path / "hr/0004.exr").read_bytes()
    (tmp_path / "hr/0004.exr").write_bytes(whole[: len(whole) // 2])
    report = inspect(Sequence.open(seq.path, check=False), {"b": frozenset({"hr.motion", "lr.albedo"})})
    assert "hr/0004.exr: the file is truncated" in report.finding("files").text
    wrong = report.finding("values").data["wrong"]
    assert "x2.color holds 1 NaN and 0 Inf" in wrong
    assert "x2.depth goes down to -inf: depth must be positive, +inf for sky" in wrong
    assert "x2.normal holds 0 NaN and 96 Inf" in wrong
    assert any("roughness runs from 0 to 5." in w for w in report.finding("values").data["odd"])
    assert "sky seems to be stored as depth 1e+10: it must be +inf" in wrong
    assert report.finding("motion").data["convention"] == "backward, pixels, y down"
    assert report.missing == {"b": ["lr.albedo"]}
    assert report.level == "bad"


def test_buffer_statistics(right):
    by_name = {(b.resolution, b.layer): b for b in right.buffers}
    assert len(by_name) == 27
    frames = [analytic.render(i, SIZE) for i in (1, 2, 3)]
    depth = by_name["hr", "depth"]
    values = np.stack([f["depth"] for f in frames])
    assert (depth.size, depth.dtype, depth.nan, depth.frames) == ("160x96", "float32", 0, 3)
    assert depth.inf == np.isinf(values).sum()
    np.testing.assert_allclose(depth.sky_share, np.isinf(values).mean())
    np.testing.assert_allclose((depth.low, depth.high), (values.min(), values[np.isfinite(values)].max()))
    roughness = by_name["hr", "roughness"]
    np.testing.assert_allclose(roughness.mean, np.mean([f["roughness"].mean() for f in frames]), rtol=1e-3)
    assert by_name["x4", "color"].size == "40x24"


def test_output_for_machines_and_people(right):
    text = json.dumps(right.to_json(), allow_nan=False)
    back = json.loads(text)
    assert back["level"] == "ok"
    assert back["findings"][2]["data"]["convention"] == "backward, pixels, y down"
    screen = io.StringIO()
    print_report(replace(right, missing={"a": [], "b": ["hr.motion"]}), Console(file=screen, width=120))
    lines = screen.getvalue().splitlines()
    assert "3 frames, HR 160x96, scales x2, x4" in lines[0]
    assert lines[1].startswith("✔ files")
    assert any(line.startswith("x4.object_id") for line in lines)
    assert lines[-2:] == ["✔ can run: a", "✘ b lacks hr.motion"]
    assert max(map(len, lines)) <= 120


def test_long_sequences_are_sampled_in_pairs(tmp_path):
    make_sequence(tmp_path, frames=9, size=(32, 20), scales=())
    report = inspect(Sequence.open(tmp_path), max_frames=4)
    assert report.frames_read == [1, 2, 8, 9]
    assert report.finding("motion").data["pairs"] == 2


def test_jitter_of_one_frame_out_of_range(tmp_path):
    """The median of many frames would hide it."""
    seq = make_sequence(tmp_path / "s", frames=5)
    head = json.loads((seq.path / "sequence.json").read_text())
    head["frames"][2]["jitter_px"] = [5, 0]
    (seq.path / "sequence.json").write_text(json.dumps(head))
    report = inspect(Sequence.open(seq.path, check=False))
    assert report.level == "bad"
    assert "first frame 3: (5, 0)" in report.finding("jitter range").text


def test_a_sequence_without_hr_images_is_judged_by_its_lr_images(tmp_path):
    needs = {"a": frozenset({"lr.color", "hr.depth", "hr.motion"}), "b": frozenset({"hr.normal"})}
    report = look(tmp_path, needs, hr=False)
    assert {f.topic: f.level for f in report.findings} == {
        "files": "ok", "values": "ok", "motion": "ok", "camera and depth": "ok", "normal": "ok",
    }  # fmt: skip
    assert report.missing == {"a": [], "b": ["hr.normal"]}


def test_wrong_motion_of_lr_images_is_recognised(tmp_path):
    found = look(tmp_path, hr=False, spoil=change_motion(lambda m, w, h: m * (1, -1))).finding("motion")
    assert (found.level, found.data["convention"]) == ("bad", "backward, pixels, y up")


def test_without_cameras_the_images_alone_are_judged(tmp_path):
    seq = make_sequence(tmp_path / "seq", frames=2, size=SIZE, scales=())
    edit_frames(seq.path, lambda frame: frame.pop("camera"))
    report = inspect(Sequence.open(seq.path))
    assert report.finding("motion").data["convention"] == "backward, pixels, y down"
    assert report.finding("camera and depth").text == "cannot tell: the camera is not known"
    json.dumps(report.to_json(), allow_nan=False)


def test_a_camera_that_is_not_rigid_is_found(tmp_path):
    seq = make_sequence(tmp_path / "seq", frames=2, size=(32, 20), scales=())
    edit_frames(
        seq.path, lambda frame: frame["camera"].update(world_from_view=np.diag([2, 2, 2, 1]).tolist())
    )
    report = inspect(Sequence.open(seq.path, check=False))
    found = report.finding("camera matrix")
    assert (report.level, found.level) == ("bad", "bad")
    assert "frame 1: world_from_view is not rigid" in found.text
    assert "(and 1 more)" in found.text


def coarse_depth(name, index, layers):
    """Depth as 8-bit codes of each image's own range, and no other buffer than colour and motion."""
    depth = layers["depth"]
    near, far = depth[np.isfinite(depth)].min(), depth[np.isfinite(depth)].max()
    codes = np.rint(np.clip((depth - near) / (far - near), 0, 1) * 255) * (1 + 0.2 * index)
    layers["depth"] = np.where(np.isfinite(depth), near + codes / 255 * (far - near), np.inf).astype(
        np.float32
    )
    del layers["base_color"], layers["normal"]


def test_coarse_depth_does_not_outvote_colour(tmp_path):
    seq = make_sequence(tmp_path / "s", frames=3, size=SIZE, scales=(), spoil=coarse_depth)
    edit_frames(seq.path, lambda frame: frame.pop("camera"))
    motion = inspect(Sequence.open(seq.path, check=False)).finding("motion")
    assert motion.data["convention"] == "backward, pixels, y down"
    assert "judged by colour" in motion.text
    assert motion.data["error"] < 0.5  # of no motion
    assert all("forward" in rival for rival in motion.data["rivals"])  # without a camera it may be either


def test_a_camera_at_rest_is_said_to_be_that(tmp_path):
    report = look(tmp_path, scales=(), still=True)
    finding = report.finding("camera and depth")
    assert finding.level == "ok"
    assert "the camera stands still" in finding.text
    assert "error" not in finding.text
    assert 0 < finding.data["moving"] < 0.9
