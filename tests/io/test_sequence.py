"""jaxsr.io.sequence and jaxsr.io.writing: round trips, resuming, and one clear line for each thing wrong."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxsr.cli import main
from jaxsr.data import analytic
from jaxsr.errors import JaxsrError
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.sequence import FrameInfo, Sequence, SequenceWriter, prefetch
from jaxsr.io.writing import round_mantissa
from jaxsr.layers import LAYERS, channels
from jaxsr.ops.motion import hr_from_lr_on_host
from tests.builders import frame_info, halton_jitter, make_sequence, random_weights

SIZE = (32, 24)


@pytest.fixture
def seq(tmp_path):
    return make_sequence(tmp_path / "seq", size=SIZE, scales=(2, 4))


def edit(seq, change):
    path = seq.path / "sequence.json"
    head = json.loads(path.read_text())
    change(head)
    path.write_text(json.dumps(head))


def change_frame(seq, file, change):
    channels, metadata = read_exr(seq.path / file)
    channels = {k: v.copy() for k, v in channels.items()}
    change(channels)
    write_exr(seq.path / file, channels, metadata)


def test_description(seq):
    assert (len(seq), seq.size, seq.scales, seq.fps, seq.exposure) == (3, SIZE, (2, 4), 24, 1)
    assert (seq.name, seq.license, seq.resolutions) == ("seq", "CC0-1.0", ("hr", "x2", "x4"))
    assert [i.index for i in seq.infos] == [1, 2, 3]
    assert [i.reset for i in seq.infos] == [True, False, False]
    assert set(seq.layers("x2")) == {
        "color", "depth", "motion", "normal", "base_color", "roughness", "metallic", "object_id", "position",
    }  # fmt: skip
    assert Sequence.open(seq.path / "sequence.json").name == "seq"


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_frames_come_back(seq, scale):
    for i, index in enumerate((1, 2, 3)):
        frame = seq.frame(i, scale)
        jitter = (0.0, 0.0) if scale == 1 else halton_jitter(index)
        lr = analytic.render(index, (SIZE[0] // scale, SIZE[1] // scale), jitter_px=jitter)
        hr = analytic.render(index, SIZE)
        assert frame.scale == scale
        half = {"rtol": 1e-3, "atol": 1e-6}
        np.testing.assert_allclose(frame.color_linear, lr["color"], **half)
        np.testing.assert_allclose(seq.truth(i), hr["color"], **half)
        for buffers, layers in ((frame.lr, lr), (frame.hr, hr)):
            np.testing.assert_array_equal(buffers.depth_linear, layers["depth"])
            np.testing.assert_array_equal(buffers.motion_px, layers["motion"])
            np.testing.assert_array_equal(buffers.object_id, layers["object_id"])
            for name in ("normal", "base_color", "roughness", "metallic"):
                np.testing.assert_allclose(getattr(buffers, name), layers[name], **half)
        assert all(x.dtype == np.float32 for x in (frame.color_linear, *frame.lr, *frame.hr, frame.jitter_px))
        np.testing.assert_allclose(frame.jitter_px, jitter, atol=1e-7)
        assert (bool(frame.reset), bool(frame.rendered)) == (i == 0, True)
        view = analytic.camera(index, SIZE)
        np.testing.assert_allclose(frame.camera.world_from_view, view.world_from_view, atol=1e-6)


def test_an_unrendered_frame_never_looks_at_colour(seq):
    def poison(channels):
        channels["color.R"][:] = np.nan

    change_frame(seq, "x2/0002.exr", poison)
    frame = seq.frame(1, 2, rendered=False)
    assert not frame.rendered
    assert not frame.color_linear.any()
    with pytest.raises(JaxsrError, match="NaN"):
        seq.frame(1, 2)


def test_positions_are_rebuilt_from_depth_camera_and_jitter(seq):
    stored = {r: seq.position(1, r) for r in ("hr", 2, 4)}
    for file in ("hr/0002.exr", "x2/0002.exr", "x4/0002.exr"):
        change_frame(seq, file, lambda c: [c.pop(f"position.{k}") for k in "XYZ"])
    assert "position" not in seq.layers("hr", 1)
    for r, expected in stored.items():
        assert np.abs(expected).max() > 1
        np.testing.assert_allclose(seq.position(1, r), expected, atol=2e-5)


def test_missing_layers_are_none_or_named(tmp_path):
    def only_needed(name, index, layers):
        for layer in set(layers) - {"color", "depth", "motion"}:
            del layers[layer]
        if name == "hr":
            del layers["color"]

    seq = make_sequence(tmp_path / "seq", size=SIZE, spoil=only_needed)
    frame = seq.frame(0, 2)
    assert frame.hr.normal is None
    assert frame.lr.base_color is None
    with pytest.raises(
        JaxsrError,
        match=r"hr/0002\.exr: frame 2: missing layer 'color'; expected channels color\.R, "
        r"color\.G, color\.B; found layers depth, motion",
    ):
        seq.truth(1)
    with pytest.raises(JaxsrError, match="missing layer 'color'"):
        seq.frame(0, 1)
    seq.frame(0, 1, rendered=False)


def test_missing_channel_and_layer(seq):
    change_frame(seq, "x2/0001.exr", lambda c: c.pop("motion.Y"))
    with pytest.raises(JaxsrError, match=r"x2/0001\.exr: frame 1: layer 'motion' lacks channel 'motion\.Y'"):
        seq.frame(0, 2)
    change_frame(seq, "hr/0002.exr", lambda c: c.pop("depth.Z"))
    with pytest.raises(JaxsrError, match=r"frame 2: missing layer 'depth'.*found layers base_color, "):
        seq.frame(1, 4, needs=frozenset({"hr.depth"}))
    assert seq.frame(1, 4).hr.depth_linear is None, "without needs nothing but colour must be there"


@pytest.mark.parametrize("layer", ["color.G", "motion.X", "normal.Z", "base_color.B", "depth.Z"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_inf_are_found(seq, layer, value):
    def spoil(channels):
        channels[layer][3, 5] = channels[layer][4, 2] = value

    change_frame(seq, "x2/0002.exr", spoil)
    if layer == "depth.Z" and value == np.inf:
        assert np.isposinf(seq.frame(1, 2).lr.depth_linear[3, 5, 0])
        return
    found = (
        rf"x2/0002\.exr: frame 2: layer '{layer[:-2]}' holds NaN or Inf.*found 2 pixels, the first x=5 y=3"
    )
    with pytest.raises(JaxsrError, match=found):
        seq.frame(1, 2)
    Sequence.open(seq.path, check=False).frame(1, 2)


def test_wrong_sizes(seq):
    def crop(channels):
        for name in channels:
            channels[name] = channels[name][:-1]

    change_frame(seq, "x2/0002.exr", crop)
    with pytest.raises(
        JaxsrError,
        match=r"x2/0002.*wrong size; expected 16x12 \(.*: HR 32x24, scale 2\); found 16x11",
    ):
        seq.frame(1, 2)
    edit(seq, lambda head: head.update(size=[64, 48]))
    with pytest.raises(JaxsrError, match=r"expected 64x48 .*found 32x24"):
        Sequence.open(seq.path).truth(0)


def test_frames_and_files_do_not_match(seq):
    (seq.path / "x4/0003.exr").rename(seq.path / "x4/kept.exr.bak")
    with pytest.raises(JaxsrError, match=r"x4: file 0003\.exr is missing; expected 3 frames.*found 2 files"):
        Sequence.open(seq.path)
    (seq.path / "x4/kept.exr.bak").rename(seq.path / "x4/0003.exr")
    edit(seq, lambda head: head["frames"].pop())
    with pytest.raises(JaxsrError, match=r"file 0003\.exr is not in sequence\.json.*2 frames.*found 3 files"):
        Sequence.open(seq.path)
    edit(seq, lambda head: head.update(scales=[2, 8]))
    (seq.path / "hr/0003.exr").unlink()
    (seq.path / "x2/0003.exr").unlink()
    with pytest.raises(JaxsrError, match=r"x8.*no such folder"):
        Sequence.open(seq.path)


def test_a_file_lost_or_cut_after_opening(seq):
    path = seq.path / "hr/0001.exr"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(JaxsrError, match=r"hr/0001\.exr: the file is truncated"):
        seq.truth(0)
    path.unlink()
    with pytest.raises(JaxsrError, match=r"hr/0001\.exr: no such file"):
        seq.frame(0, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(version=9), "unsupported version.*expected 1 or 2; found 9"),
        (lambda h: h.update(format="other"), 'not a sequence.*"jaxsr-sequence"; found "other"'),
        (lambda h: h.update(size=[32]), r"bad size.*found \[32\]"),
        (lambda h: h.update(scales=[5]), "scale 5 does not divide the size"),
        (lambda h: h.update(scales="2"), "bad scales"),
        (lambda h: h.update(frames=[]), "no frames"),
        (lambda h: h["frames"][1]["camera"].pop("tan_half_fov"), "entry 1 of frames.*missing 'tan_half_fov'"),
        (lambda h: h["frames"][1].pop("index"), "entry 1 of frames.*missing 'index'"),
        (lambda h: h["frames"][1].update(jitter_px=[0]), "entry 1 of frames"),
        (lambda h: h["frames"][2].update(jitter_px=[0, float("nan")]), "bad JSON.*NaN"),
        (lambda h: h["frames"][1].update(index=7), "frame 7 follows frame 1"),
        (lambda h: h["frames"].reverse(), "frame 2 follows frame 3"),
        (lambda h: h.update(fps="abc"), 'bad fps; expected a number above 0; found "abc"'),
        (lambda h: h.update(fps=0), "bad fps.*found 0"),
        (lambda h: h["frames"][1].update(jitter_px=[10**400, 0]), "bad JSON.*integer of 401 digits"),
        (lambda h: h.update(fps=float("inf")), "bad JSON.*found Infinity"),
        (lambda h: h.update(exposure=None), "bad exposure; expected a number above 0; found null"),
        (lambda h: h.update(exposure=0.0), "bad exposure.*found 0.0"),
        (lambda h: h.update(exposure=1e60), r"bad exposure.*found 1e\+60"),
        (lambda h: h.update(exposure=-1), "bad exposure.*found -1"),
        (lambda h: h.update(exposure=float("nan")), "bad JSON.*found NaN"),
        (lambda h: h.update(exposure=True), "bad exposure.*found true"),
        (lambda h: h.update(name=["a"]), r'bad name; expected a text; found \["a"\]'),
        (lambda h: h.update(generator="x"), 'bad generator.*found "x"'),
        (lambda h: h["frames"][1].update(index=float("inf")), "bad JSON.*found Infinity"),
        (lambda h: h["frames"][1].update(index=1.5), "bad index.*found 1.5"),
        (lambda h: h["frames"][1].update(index="2"), 'bad index.*found "2"'),
        (lambda h: h["frames"][0].update(index=-1), "bad index; expected 0 to .*found -1"),
        (lambda h: h["frames"][1]["camera"].update(tan_half_fov=[0, 0]), "frame 2: bad tan_half_fov"),
        (lambda h: h["frames"][1]["camera"].update(tan_half_fov=[0.5, -0.3]), "above 0; found .0.5, -0.3."),
        (
            lambda h: h["frames"][1]["camera"].update(lens_shift=[float("nan"), 0]),
            "bad JSON.*found NaN",
        ),
        (
            lambda h: h["frames"][1]["camera"].update(world_from_view=[[0] * 4] * 4),
            "frame 2: world_from_view",
        ),
        (lambda h: h["frames"][1].update(jitter_px=[0.8, 0.25]), r"frame 2: jitter of.*found \[0.8, 0.25\]"),
        (lambda h: h["frames"][1].update(jitter_px=["0.1", 0]), "entry 1 of frames.*found jitter_px"),
        (lambda h: h["frames"][1].update(reset="false"), 'frame 2: bad reset.*true or false; found "false"'),
        (lambda h: h["frames"][1].update(cut=True), "found .reset. and .cut."),
        (lambda h: h["frames"][1].update(exposure=0), "frame 2: bad exposure.*above 0; found 0"),
        (lambda h: h["frames"][1].update(exposure=1e60), r"frame 2: bad exposure.*found 1e\+60"),
        (lambda h: h["frames"][1].update(exposure=1e-300), "frame 2: bad exposure.*found 1e-300"),
        (lambda h: h["frames"][1].update(exposure=True), "frame 2: bad exposure.*found true"),
        (
            lambda h: h["frames"][1]["camera"].update(world_from_view=np.diag([2, 2, 2, 1]).tolist()),
            "not rigid",
        ),
        (lambda h: h["frames"][1]["camera"].update(world_from_view=np.diag([-1, 1, 1, 1]).tolist()), "rigid"),
        (lambda h: h["frames"][1]["camera"]["world_from_view"][3].__setitem__(0, 0.1), "not rigid"),
        (
            lambda h: h.update(size=[2**40, 24]),
            r"bad size; expected 1 to 65536 pixels.*found \[1099511627776",
        ),
        (lambda h: h.update(size=[True, True]), r"bad size.*found \[true, true\]"),
        (lambda h: h.update(hr="no"), 'bad hr; expected true or false; found "no"'),
        (lambda h: h.update(hr=False, scales=[1]), "there are no images"),
        (lambda h: h["frames"][1]["camera"]["world_from_view"][0].__setitem__(3, float("inf")), "bad JSON"),
    ],
)
def test_bad_descriptions(seq, change, message):
    edit(seq, change)
    with pytest.raises(JaxsrError, match=message) as caught:
        Sequence.open(seq.path)
    assert "\n" not in str(caught.value)


def test_what_is_no_sequence(tmp_path, seq):
    with pytest.raises(JaxsrError, match="gone: no such folder"):
        Sequence.open(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(JaxsrError, match=r"not a sequence; expected a file sequence\.json; found none"):
        Sequence.open(tmp_path / "empty")
    with pytest.raises(JaxsrError, match=r"another layout \(0001\.exr\); docs/data\.md"):
        Sequence.open(seq.path / "hr")
    (seq.path / "sequence.json").write_text('{"format": ')
    with pytest.raises(JaxsrError, match="bad JSON"):
        Sequence.open(seq.path)


def test_scales_and_positions_that_are_not_there(seq):
    with pytest.raises(JaxsrError, match=r"scale 3 is not available; expected one of \[1, 2, 4\]"):
        seq.frame(0, 3)
    for i in (3, -1):
        with pytest.raises(JaxsrError, match=f"no such frame; expected 0 to 2; found {i}"):
            seq.frame(i, 2)


def layers(index=1, scale=1, **more):
    out = analytic.render(index, (SIZE[0] // scale, SIZE[1] // scale))
    out.pop("visible_before")
    return out | more


def writer(path, **more):
    return SequenceWriter(
        path, **({"name": "w", "size": SIZE, "scales": (2,), "generator": {"seed": 1}} | more)
    )


def test_a_killed_writer_resumes(tmp_path):
    first = writer(tmp_path)
    first.write_frame(frame_info(1, SIZE, reset=True), layers(1), {2: layers(1, 2)})
    # Killed inside frame 2: HR is there, LR half-written under its temporary name.
    write_exr(tmp_path / "hr/0002.exr", {"depth.Z": np.zeros((24, 32), np.float32)})
    (tmp_path / "x2/.0002.exr.9999999-1.tmp").write_bytes(b"half")
    again = writer(tmp_path)
    assert not list(tmp_path.rglob("*.tmp"))
    assert again.has(1)
    assert not again.has(2)
    again.write_frame(frame_info(2, SIZE), layers(2), {2: layers(2, 2)})
    again.close()
    seq = Sequence.open(tmp_path)
    assert len(seq) == 2
    np.testing.assert_array_equal(seq.frame(1, 2).hr.depth_linear, layers(2)["depth"])
    (tmp_path / "x2/0001.exr").unlink()
    assert not writer(tmp_path).has(1)


def test_resuming_another_sequence_is_refused(tmp_path):
    writer(tmp_path).close()
    with pytest.raises(JaxsrError, match=r"'generator' differs; expected {'seed': 2}; found {'seed': 1}"):
        writer(tmp_path, generator={"seed": 2})
    with pytest.raises(JaxsrError, match="'size' differs"):
        writer(tmp_path, size=(64, 48))
    with pytest.raises(JaxsrError, match="already holds a sequence"):
        writer(tmp_path, resume=False)
    (tmp_path / "sequence.json").write_text("{")
    with pytest.raises(JaxsrError, match="not the description"):
        writer(tmp_path)


@pytest.mark.parametrize(
    ("hr", "lr", "message"),
    [
        ({}, {2: {"color": None}}, "x2: missing layer 'color'"),
        (dict.fromkeys(LAYERS), {2: {}}, "hr: no layers"),
        ({"colour": np.zeros((24, 32, 3))}, {2: {}}, "unknown layer 'colour'"),
        ({"normal": np.zeros((24, 31, 3))}, {2: {}}, r"'normal' has the wrong size; expected \(24, 32, 3\)"),
        ({"roughness": np.zeros((24, 32, 3))}, {2: {}}, "'roughness' has the wrong size"),
        ({"color": np.full((24, 32, 3), np.nan)}, {2: {}}, "'color' holds NaN or Inf.*found 768 pixels"),
        ({"base_color": np.full((24, 32, 3), 1e6)}, {2: {}}, "'base_color' does not fit half"),
        ({}, {4: {}}, r"wrong LR scales; expected \[2\]; found \[4\]"),
    ],
)
def test_writer_refuses(tmp_path, hr, lr, message):
    with pytest.raises(JaxsrError, match=message):
        writer(tmp_path).write_frame(
            frame_info(1, SIZE), layers(**hr), {s: layers(1, s, **more) for s, more in lr.items()}
        )


def test_writing_needs_no_jax():
    code = (
        "import sys; sys.modules['jax'] = sys.modules['jaxtyping'] = None; "
        "import jaxsr.io.writing, jaxsr.io.exr, jaxsr.layers, jaxsr.srgb; "
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    code = "import sys; import jaxsr.io.images; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_writer_arguments(tmp_path):
    with pytest.raises(JaxsrError, match="scale 5 does not divide"):
        writer(tmp_path, scales=(5,))
    with pytest.raises(JaxsrError, match="bad fps; expected a number above 0; found 0"):
        writer(tmp_path, fps=0)
    with pytest.raises(JaxsrError, match=r"bad exposure.*found NaN"):
        writer(tmp_path, exposure=float("nan"))
    with pytest.raises(JaxsrError, match="bad precision of 'depth'"):
        writer(tmp_path, precision={"depth": "double"})
    with pytest.raises(JaxsrError, match="not JSON"):
        writer(tmp_path, generator={"a": object()})


def test_precision_and_special_values(tmp_path):
    ids = np.full((24, 32), 70000)
    color = np.full((24, 32, 3), 1e9)
    with writer(tmp_path, scales=(), precision={"motion": "half", "normal": "float"}) as out:
        out.write_frame(frame_info(1, SIZE, reset=True), layers(object_id=ids, color=color), {})
    channels, _ = read_exr(tmp_path / "hr/0001.exr")
    kinds = {name: channels[name].dtype for name in ("motion.X", "normal.X", "depth.Z", "object_id.V")}
    assert kinds == {"motion.X": "f2", "normal.X": "f4", "depth.Z": "f4", "object_id.V": "u4"}
    frame = Sequence.open(tmp_path).frame(0, 1)
    assert (frame.hr.object_id == 70000).all()
    assert (frame.color_linear == 65504).all()
    assert np.isposinf(frame.hr.depth_linear).any()
    assert not frame.jitter_px.any()


def test_rounding_the_mantissa_shrinks_files(tmp_path):
    x = np.concatenate([10.0 ** np.random.default_rng(0).uniform(-6, 6, 1000), [0, np.inf, -np.inf]])
    x = x.astype(np.float32)
    for bits in (1, 8, 22, 23):
        y = round_mantissa(x, bits)
        np.testing.assert_array_equal(y[-3:], x[-3:])
        assert np.max(np.abs(y[:1000] / x[:1000] - 1)) <= 2.0 ** -(bits + 1) * 1.0001
        assert not (y.view(np.uint32)[:1000] & np.uint32((1 << (23 - bits)) - 1)).any()
    assert np.isnan(round_mantissa(np.array([np.nan], np.float32), 5)).all()
    with pytest.raises(JaxsrError, match="mantissa bits"):
        round_mantissa(x, 0)
    sizes = []
    for name, bits in (("fine", {}), ("round", {"depth": 8, "motion": 8, "position": 8})):
        make_sequence(tmp_path / name, frames=1, size=SIZE, round_bits=bits)
        sizes.append((tmp_path / name / "hr/0001.exr").stat().st_size)
    assert sizes[1] < 0.75 * sizes[0]


def test_frame_info_round_trip(seq):
    info = seq.infos[1]
    again = FrameInfo(info.index, info.jitter_px, info.reset, info.world_from_view, info.tan_half_fov)
    assert again.to_json() == json.loads((seq.path / "sequence.json").read_text())["frames"][1]


def test_prefetch_reads_ahead_in_order(seq):
    frames = list(prefetch(seq.frame(i, 2) for i in range(3)))
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color_linear, seq.frame(i, 2).color_linear)
    made = []

    def slow():
        for k in range(10):
            made.append(k)
            yield k

    items = prefetch(slow(), depth=2)
    assert next(items) == 0
    deadline = time.monotonic() + 5
    while len(made) < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert made == [0, 1, 2, 3], "one in hand, two waiting, one made"
    before = threading.active_count()
    items.close()
    assert threading.active_count() == before - 1


def test_prefetch_hands_errors_over(seq):
    (seq.path / "x2/0002.exr").unlink()
    frames = prefetch(seq.frame(i, 2) for i in range(3))
    assert next(frames).reset
    with pytest.raises(JaxsrError, match="no such file"):
        next(frames)


def test_the_examples_of_the_documentation_run(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs/data.md").read_text()
    monkeypatch.chdir(tmp_path)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(block, {})
    assert len(Sequence.open(tmp_path / "wall")) == 3
    head = json.loads(re.search(r"```json\n(.*?)```", text, re.S)[1])
    assert set(head) == set(json.loads((tmp_path / "wall/sequence.json").read_text()))


def layer_row(layer):
    """The row of a layer in docs/data.md."""
    span = {(-np.inf, np.inf): "any", (0.0, np.inf): "above 0"}
    limits = span.get((layer.low, layer.high), f"{layer.low:g} to {layer.high:.0f}")
    sky = {None: "as seen", np.inf: "+inf"}.get(layer.sky, f"{layer.sky or 0:g}")
    cells = (layer.name, " ".join(channels(layer.name)), layer.stored, layer.unit, limits, sky)
    return f"| {' | '.join(cells)} |"


def test_the_table_of_layers_in_the_documentation():
    text = (Path(__file__).parents[2] / "docs/data.md").read_text()
    table = [line for line in text.splitlines() if re.match(r"\| [a-z_]+ \| [a-z_]+\.[A-Z]", line)]
    assert table == [layer_row(layer) for layer in LAYERS.values()]


# --- what is needed decides what is read -----------------------------------------------------------------


def needs(*buffers):
    return frozenset(buffers)


@pytest.fixture
def opened(monkeypatch):
    """The files that are opened for their pixels, as "x2/0001.exr"."""
    names = []

    def reading(path, **kwargs):
        names.append(f"{path.parent.name}/{path.name}")
        return read_exr(path, **kwargs)

    monkeypatch.setattr("jaxsr.io.sequence.read_exr", reading)
    return names


def test_files_of_which_nothing_is_needed_are_not_opened(seq, opened):
    frame = seq.frame(0, 2, needs=needs("lr.color"))
    assert frame.lr == frame.hr == (None,) * 7
    assert frame.color_linear.any()
    assert opened == ["x2/0001.exr"]
    opened.clear()
    frame = seq.frame(0, 2, needs=needs("hr.normal"))
    assert (frame.hr.normal is not None, frame.lr.normal, frame.color_linear.any()) == (True, None, False)
    assert frame.color_linear.shape == (12, 16, 3)
    assert opened == ["hr/0001.exr"]
    opened.clear()
    assert not seq.frame(0, 2, rendered=False, needs=needs("lr.color")).color_linear.any()
    assert opened == []
    frame = seq.frame(0, 1, needs=needs("lr.color", "hr.depth"))
    assert (frame.lr.depth_linear, frame.hr.depth_linear.shape) == (None, (24, 32, 1))
    assert opened == ["hr/0001.exr"]
    opened.clear()
    seq.truth(1), seq.lr_color(1, 4)
    assert opened == ["hr/0002.exr", "x4/0002.exr"]
    with pytest.raises(JaxsrError, match=r"unknown buffer 'hr\.color'"):
        seq.frame(0, 2, needs=needs("hr.color"))


@pytest.mark.parametrize("fault", ["missing", "lacks a channel", "nan", "no file"])
def test_what_is_not_needed_may_be_broken(seq, fault):
    def spoil(channels):
        if fault == "missing":
            for k in "XY":
                channels.pop(f"motion.{k}")
        elif fault == "lacks a channel":
            channels.pop("motion.Y")
        else:
            channels["motion.X"][:] = np.nan

    if fault == "no file":
        (seq.path / "hr/0002.exr").unlink()
    else:
        change_frame(seq, "hr/0002.exr", spoil)
        assert seq.frame(1, 2, needs=needs("lr.color", "hr.depth")).hr.depth_linear is not None
        assert seq.truth(1).shape == (24, 32, 3)
    assert seq.frame(1, 2, needs=needs("lr.color", "lr.motion")).lr.motion_px is not None
    words = {"missing": "missing layer", "lacks a channel": "lacks channel 'motion.Y'", "nan": "NaN or Inf"}
    with pytest.raises(JaxsrError, match=rf"hr/0002\.exr: .*{words.get(fault, 'no such file')}"):
        seq.frame(1, 2, needs=needs("lr.color", "hr.motion"))


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_depth_must_be_above_zero(seq, value):
    change_frame(seq, "x2/0002.exr", lambda c: c["depth.Z"].__setitem__((3, 5), value))
    with pytest.raises(JaxsrError, match=rf"'depth' is not above 0; .*sky is \+inf; .*depth.Z = {value:g}"):
        seq.frame(1, 2, needs=needs("lr.depth"))
    seq.frame(1, 2, needs=needs("lr.color"))
    with pytest.raises(JaxsrError, match=f"frame 1, hr: layer 'depth' is not above 0.*= {value:g}"):
        writer(seq.path / "w").write_frame(
            frame_info(1, SIZE), layers(depth=np.full((24, 32, 1), value)), {2: layers(1, 2)}
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jitter_px": (0.8, 0.25)}, "jitter of more than half a pixel.*found .0.8, 0.25."),
        ({"jitter_px": (3, 1e30)}, "jitter of more than half a pixel"),
        ({"jitter_px": (0, np.nan)}, "bad jitter_px.*finite"),
        ({"index": -1}, "bad index"),
        ({"exposure": -1.0}, "bad exposure"),
        ({"world_from_view": np.diag([2.0, 2, 2, 1])}, "not rigid"),
        ({"world_from_view": np.eye(3)}, "bad world_from_view; expected 4 x 4"),
        ({"tan_half_fov": (0.5, np.inf)}, "bad tan_half_fov"),
        ({"tan_half_fov": None}, "half a camera"),
    ],
)
def test_the_writer_refuses_what_the_reader_would(tmp_path, change, message):
    info = replace(frame_info(1, SIZE), **change)
    with pytest.raises(JaxsrError, match=message):
        writer(tmp_path).write_frame(info, layers(), {2: layers(1, 2)})
    assert not list(tmp_path.rglob("*.exr"))


def test_the_writer_refuses_numbers_that_do_not_fit(tmp_path):
    for more, message in (
        ({"depth": np.full((24, 32, 1), 1e-9)}, "'depth' does not fit half precision; found 1e-09"),
        ({"depth": np.full((24, 32, 1), 1e39)}, "'depth' does not fit half precision"),
        ({"object_id": np.full((24, 32, 1), -1.0)}, "object_id is out of range"),
    ):
        with pytest.raises(JaxsrError, match=message):
            writer(tmp_path, precision={"depth": "half"}).write_frame(
                frame_info(1, SIZE), layers(**more), {2: layers(1, 2)}
            )


def test_a_gap_without_a_reset_is_refused_when_the_writer_closes(tmp_path):
    out = writer(tmp_path, scales=())
    out.write_frame(frame_info(1, SIZE, reset=True), layers(), {})
    out.write_frame(frame_info(3, SIZE), layers(3), {})
    with pytest.raises(JaxsrError, match="frame 3 follows frame 1"):
        out.close()
    assert writer(tmp_path, scales=()).has(3), "what was written stays"


@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_a_frame_that_is_no_file(seq, kind):
    path = seq.path / "x2/0002.exr"
    path.unlink()
    os.mkfifo(path) if kind == "pipe" else path.mkdir()
    with pytest.raises(JaxsrError, match=r"x2/0002\.exr: is (a folder|not a regular file)"):
        seq.frame(1, 2)


# --- versions --------------------------------------------------------------------------------------------


def test_version_1_reads(seq):
    def old(head):
        head["version"] = 1
        del head["hr"]
        for frame in head["frames"]:
            frame["cut"] = frame.pop("reset")

    edit(seq, old)
    again = Sequence.open(seq.path)
    assert [i.reset for i in again.infos] == [True, False, False]
    assert again.hr
    assert again.frame(1, 2).hr.normal is not None
    more = SequenceWriter(seq.path, name="seq", size=SIZE, scales=(2, 4), license="CC0-1.0")
    assert more.has(3), "a writer goes on where version 1 was"
    more.close()
    assert json.loads((seq.path / "sequence.json").read_text())["version"] == 2


def test_exposure_and_camera_of_each_frame(tmp_path):
    with writer(tmp_path, scales=(), exposure=2.0) as out:
        out.write_frame(FrameInfo(1, reset=True, exposure=0.5), layers(), {})
        out.write_frame(frame_info(2, SIZE), layers(2), {})
    seq = Sequence.open(tmp_path)
    first, second = (seq.frame(i, 1) for i in (0, 1))
    assert (float(first.exposure), float(second.exposure)) == (0.5, 2.0)
    assert first.camera is None
    assert second.camera is not None
    assert not first.jitter_px.any()
    change_frame(seq, "hr/0001.exr", lambda c: [c.pop(f"position.{k}") for k in "XYZ"])
    with pytest.raises(JaxsrError, match="frame 1 has no camera: positions cannot be rebuilt"):
        seq.position(0, "hr")


# --- sequences without HR images -------------------------------------------------------------------------


def only_rendered(name, index, layers):
    for layer in set(layers) - {"color", "depth", "motion"}:
        del layers[layer]


@pytest.fixture
def lr_only(tmp_path):
    return make_sequence(tmp_path / "lr", size=(64, 48), hr=False, spoil=only_rendered)


def test_hr_depth_and_motion_are_derived(lr_only, opened):
    assert (lr_only.hr, lr_only.resolutions, lr_only.size) == (False, ("x2",), (64, 48))
    frame = lr_only.frame(1, 2, needs=needs("lr.color", "hr.depth", "hr.motion"))
    lr = lr_only.frame(1, 2).lr
    depth, motion = hr_from_lr_on_host(lr.depth_linear, lr.motion_px, lr_only.infos[1].jitter_px, 2)
    np.testing.assert_array_equal(frame.hr.depth_linear, depth)
    np.testing.assert_array_equal(frame.hr.motion_px, motion)
    assert frame.lr.depth_linear is None, "it is not needed"
    assert lr_only.frame(1, 2).hr.motion_px is not None, "without needs, too"
    opened.clear()
    lr_only.frame(1, 2, needs=needs("lr.color"))
    assert opened == ["x2/0002.exr"]


def test_what_cannot_be_derived_is_named(lr_only):
    with pytest.raises(JaxsrError, match=r"missing HR buffers hr\.base_color, hr\.normal; .*derived from LR"):
        lr_only.frame(0, 2, needs=needs("lr.color", "hr.depth", "hr.normal", "hr.base_color"))
    with pytest.raises(JaxsrError, match="the sequence has no HR images"):
        lr_only.truth(0)
    with pytest.raises(JaxsrError, match=r"no HR images; expected one of the scales \[2\]"):
        lr_only.frame(0, 1)
    change_frame(lr_only, "x2/0002.exr", lambda c: c.pop("depth.Z"))
    with pytest.raises(JaxsrError, match=r"x2/0002\.exr: frame 2: missing layer 'depth'"):
        lr_only.frame(1, 2, needs=needs("lr.color", "hr.motion"))


def test_hr_truth_without_hr_buffers(tmp_path):
    """What engines write as training data: a reference, and buffers at render size."""

    def spoil(name, index, layers):
        for layer in set(layers) - ({"color"} if name == "hr" else {"color", "depth", "motion"}):
            del layers[layer]

    seq = make_sequence(tmp_path / "seq", size=SIZE, spoil=spoil)
    assert seq.frame(1, 2, needs=needs("hr.motion")).hr.motion_px.shape == (24, 32, 2)
    assert seq.truth(1).any()


def test_the_writer_is_told_of_sequences_without_hr_images(tmp_path):
    with pytest.raises(JaxsrError, match="there are no images"):
        writer(tmp_path, hr=False, scales=(1,))
    with pytest.raises(JaxsrError, match="wrong HR images; expected None"):
        writer(tmp_path / "a", hr=False).write_frame(frame_info(1, SIZE), layers(), {2: layers(1, 2)})
    with pytest.raises(JaxsrError, match="wrong HR images; expected HR layers"):
        writer(tmp_path / "b").write_frame(frame_info(1, SIZE), None, {2: layers(1, 2)})


@pytest.mark.parametrize("method", ["bilinear", "bicubic", "taau", "rcan", "rrn", "nsrr"])
def test_methods_upscale_what_has_no_hr_images(lr_only, tmp_path, method):
    if method in ("rcan", "rrn", "nsrr"):
        method = str(random_weights(tmp_path / f"{method}.safetensors", scale=2, method=method))
    main(["upscale", str(lr_only.path), "--method", method, "--out", str(tmp_path / "out")])
    assert len(list((tmp_path / "out/png").glob("*.png"))) == 3
