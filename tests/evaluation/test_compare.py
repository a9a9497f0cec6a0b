"""Folders of frames against the truth: the numbers, the files, and every way folders can be wrong."""

import csv
import json
import math
import shutil

import numpy as np
import pytest

from jaxsr import metrics
from jaxsr.errors import JaxsrError
from jaxsr.evaluation.compare import check_match, compare, find_frames, labels
from jaxsr.io.exr import write_exr
from jaxsr.io.images import read_png, write_png
from jaxsr.ops.color import to_display
from tests.builders import make_sequence

H, W = 20, 24


def frame(i, offset=0.0):
    y, x = np.mgrid[0:H, 0:W]
    image = np.stack([0.5 + 0.3 * np.sin(0.4 * x + i + c) * np.cos(0.3 * y) for c in range(3)], -1)
    return (image + offset).astype(np.float32)


def write_folder(folder, offset=0.0, numbers=(1, 2, 3), kind="png", name="{:04d}"):
    folder.mkdir(parents=True)
    for i in numbers:
        if kind == "png":
            write_png(folder / f"{name.format(i)}.png", frame(i, offset))
        else:
            prefix = {"exr": "", "color": "color.", "blender": "ViewLayer.Combined."}[kind]
            channels = {f"{prefix}{c}": frame(i, offset)[..., k] for k, c in enumerate("RGB")}
            write_exr(folder / f"{name.format(i)}.exr", channels)
    return folder


@pytest.fixture
def folders(tmp_path):
    write_folder(tmp_path / "truth")
    write_folder(tmp_path / "exact")
    write_folder(tmp_path / "bright", offset=0.1)
    return tmp_path


def test_end_to_end(folders):
    steps = []
    section = compare(
        [folders / "exact", folders / "bright"],
        folders / "truth",
        folders / "out",
        progress=lambda title, total: steps.append((title, total)) or (lambda: steps.append(1)),
    )
    assert steps == [("measuring", 6), *[1] * 6]
    exact, bright = section.methods
    assert (exact.name, bright.name) == ("exact", "bright")
    assert section.frames == (1, 2, 3)
    assert exact.metrics["psnr"] == [math.inf] * 3
    assert exact.metrics["flip"] == [0.0] * 3
    expected = metrics.measure(
        [read_png(folders / "bright" / f"{i:04d}.png") for i in (1, 2, 3)],
        [read_png(folders / "truth" / f"{i:04d}.png") for i in (1, 2, 3)],
    )
    for key, values in expected.items():
        first = 1 if key == "tpsnr" else 0
        assert bright.metrics[key][first:] == pytest.approx(values[first:])
    assert bright.metrics["tpsnr"][0] is None
    written = json.loads((folders / "out" / "metrics.json").read_text())
    assert written["sections"][0]["tracks"][0]["metrics"]["psnr"] == ["inf"] * 3
    rows = list(csv.DictReader((folders / "out" / "metrics.csv").read_text().splitlines()))
    assert len(rows) == 6
    assert float(rows[5]["psnr"]) == pytest.approx(bright.metrics["psnr"][2])
    page = (folders / "out" / "report.html").read_text()
    assert "bright" in page
    assert not list((folders / "out").glob(".*"))


@pytest.mark.parametrize("kind", ["exr", "color", "blender"])
def test_linear_frames_go_through_the_tone_map(tmp_path, kind):
    write_folder(tmp_path / "truth", kind=kind)
    write_folder(tmp_path / "a", offset=0.2, kind=kind)
    section = compare([tmp_path / "a"], tmp_path / "truth", tmp_path / "out", exposure=2.0)
    images = [np.asarray(to_display(frame(1, offset), 2.0)) for offset in (0.2, 0.0)]
    assert section.methods[0].metrics["psnr"][0] == pytest.approx(metrics.psnr(*images), abs=1e-3)
    assert set(section.exposures) == {2.0}
    # What the page embeds is the same image, 8 bits.
    assert np.abs(read_png(section.truths[0]) - images[1]).max() <= 0.5 / 255 + 1e-6


def test_a_sequence_brings_its_exposure_and_its_cuts(tmp_path):
    write_folder(tmp_path / "truth" / "hr", kind="color")
    infos = [
        {
            "index": i,
            "jitter_px": [0, 0],
            "cut": i != 2,
            "camera": {"world_from_view": np.eye(4).tolist(), "tan_half_fov": [1, 1], "lens_shift": [0, 0]},
        }
        for i in (1, 2, 3)
    ]
    head = {"format": "jaxsr-sequence", "version": 1, "name": "s", "size": [W, H], "scales": [1], "fps": 24}
    head |= {"exposure": 0.5, "license": "CC0-1.0", "generator": {}, "frames": infos}
    (tmp_path / "truth" / "sequence.json").write_text(json.dumps(head))
    write_folder(tmp_path / "a", offset=0.1, kind="exr")
    section = compare([tmp_path / "a"], tmp_path / "truth", tmp_path / "out")
    assert set(section.exposures) == {0.5}
    assert [v is None for v in section.methods[0].metrics["tpsnr"]] == [True, False, True]


def test_matching_by_number_by_name_and_with_gaps(folders):
    write_folder(folders / "other", name="render_v2.{}")  # the last number counts
    section = compare([folders / "other"], folders / "truth", folders / "out")
    assert section.methods[0].metrics["psnr"] == [math.inf] * 3
    for name in ("t", "a"):
        write_folder(folders / name, numbers=(1, 2, 10, 11), name="f{}")  # f10 sorts before f2
    section = compare([folders / "a"], folders / "t", folders / "out2")
    assert section.frames == (1, 2, 10, 11)
    assert [v is None for v in section.methods[0].metrics["tpsnr"]] == [True, False, True, False]
    for name in ("left", "right"):
        (folders / name).mkdir()
        for word, i in (("ant", 1), ("bee", 2)):
            write_png(folders / name / f"{word}.png", frame(i))
    section = compare([folders / "left"], folders / "right", folders / "out3")
    assert section.frames == (1, 2)
    assert section.methods[0].metrics["psnr"] == [math.inf] * 2


def test_frames_have_an_exposure_of_their_own(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=2, size=(32, 24))
    head = json.loads((sequence.path / "sequence.json").read_text())
    head["frames"][1]["exposure"] = 0.25
    (sequence.path / "sequence.json").write_text(json.dumps(head))
    section = compare([sequence.path / "hr"], sequence.path, tmp_path / "out", keys=("psnr",))
    for i, exposure in enumerate((1.0, 0.25)):
        path, linear = section.truths[i], sequence.truth(i)
        assert np.abs(read_png(path) - np.asarray(to_display(linear, exposure))).max() < 1 / 255


@pytest.mark.parametrize(
    ("numbers", "follows"),
    [
        ((1, 3, 5, 7), [False, True, True, True]),  # every second frame
        ((1, 3, 5, 6, 8, 20), [False, True, True, True, True, False]),  # one frame between, then a gap
        ((1, 2, 3, 5, 6), [False, True, True, False, True]),
        ((7,), [False]),
    ],
)
def test_a_frame_follows_by_one_or_by_the_most_common_step(folders, numbers, follows):
    for name in ("t", "a"):
        write_folder(folders / name, numbers=numbers)
    section = compare([folders / "a"], folders / "t", folders / "out", keys=("tpsnr",))
    assert [v is not None for v in section.methods[0].metrics["tpsnr"]] == follows


def test_what_upscale_writes_is_found(folders):
    write_folder(folders / "method" / "png")
    write_folder(folders / "method" / "exr", kind="exr")
    assert find_frames(folders / "method", "png").files[0].suffix == ".png"
    assert find_frames(folders / "method", "exr").files[0].suffix == ".exr"
    section = compare([folders / "method"], folders / "truth", folders / "out")
    assert section.methods[0].metrics["psnr"] == [math.inf] * 3


def test_labels(tmp_path):
    assert labels([tmp_path / "a", tmp_path / "b"]) == ["a", "b"]
    assert labels([tmp_path / "x" / "a", tmp_path / "y" / "a"]) == ["x/a", "y/a"]
    assert labels([tmp_path / "taau" / "png", tmp_path / "guided" / "png"]) == ["taau", "guided"]
    with pytest.raises(JaxsrError, match="the same folder is given twice"):
        labels([tmp_path / "a", tmp_path / "a"])


def missing_folder(root):
    return "none: no such folder", root / "none"


def file_instead(root):
    (root / "file").write_text("x")
    return "file: no such folder; found a file", root / "file"


def empty(root):
    (root / "bad").mkdir()
    (root / "bad" / "notes.txt").write_text("x")
    return "bad: no frames in the folder; expected files .exr, .png or .jpg", root / "bad"


def both_kinds(root):
    shutil.copytree(root / "exact", root / "bad")
    write_exr(root / "bad" / "0004.exr", {c: frame(1)[..., 0] for c in "RGB"})
    return "OpenEXR and PNG", root / "bad"


def too_few(root):
    write_folder(root / "bad", numbers=(1, 3))
    return r"frame 2 is missing \(truth: 0002.png\); expected 3 frames; found 2 frames", root / "bad"


def too_many(root):
    write_folder(root / "bad", numbers=(1, 2, 3, 4))
    return r"frame 4 \(0004.png\) has no truth; expected 3 frames; found 4 frames", root / "bad"


def shifted(root):
    write_folder(root / "bad", numbers=(0, 1, 2))
    return "frame 3 is missing.*files are numbered from 0, those of the truth from 1", root / "bad"


def unnumbered(root):
    (root / "bad").mkdir()
    for word in ("ant", "bee"):
        write_png(root / "bad" / f"{word}.png", frame(1))
    return r"unequal numbers of frames, the folder has none for 0003.png; expected 3 frames", root / "bad"


def wrong_size(root):
    shutil.copytree(root / "exact", root / "bad")
    write_png(root / "bad" / "0002.png", frame(2)[:, :-1])
    return rf"bad/0002.png: wrong size; expected {W}x{H}; found {W - 1}x{H}", root / "bad"


def truncated(root):
    shutil.copytree(root / "exact", root / "bad")
    data = (root / "bad" / "0003.png").read_bytes()
    (root / "bad" / "0003.png").write_bytes(data[: len(data) // 2])
    return "bad/0003.png: cannot be read as a picture; found .*truncated", root / "bad"


def truncated_exr(root):
    write_folder(root / "bad", kind="exr")
    data = (root / "bad" / "0003.exr").read_bytes()
    (root / "bad" / "0003.exr").write_bytes(data[: len(data) - 50])
    return "bad/0003.exr: the file is truncated", root / "bad"


def not_an_image(root):
    shutil.copytree(root / "exact", root / "bad")
    (root / "bad" / "0001.png").write_text("hello")
    return "bad/0001.png: cannot be read as a picture", root / "bad"


def nan(root):
    write_folder(root / "bad", kind="exr")
    broken = frame(2)
    broken[5, 7, 1] = np.nan
    write_exr(root / "bad" / "0002.exr", {c: broken[..., k] for k, c in enumerate("RGB")})
    return "bad/0002.exr: the frame holds NaN or infinity; found 1 pixels, the first at x=7 y=5", root / "bad"


def no_color(root):
    write_folder(root / "bad", kind="exr")
    write_exr(root / "bad" / "0001.exr", {"depth.Z": frame(1)[..., 0]})
    return "bad/0001.exr: no colour layer", root / "bad"


@pytest.mark.parametrize(
    "make",
    [
        missing_folder,
        file_instead,
        empty,
        both_kinds,
        too_few,
        too_many,
        shifted,
        unnumbered,
        wrong_size,
        truncated,
        truncated_exr,
        not_an_image,
        nan,
        no_color,
    ],
)
def test_bad_folders(folders, make):
    words, bad = make(folders)
    with pytest.raises(JaxsrError, match=words) as caught:
        compare([folders / "bright", bad], folders / "truth", folders / "out")
    assert "\n" not in str(caught.value)
    assert not (folders / "out").exists()
    assert not list(folders.glob(".*"))


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_an_error_at_the_end_leaves_the_last_results_as_they_were(tmp_path, kind):
    write_folder(tmp_path / "truth", kind=kind)
    write_folder(tmp_path / "good", offset=0.1, kind=kind)
    compare([tmp_path / "good"], tmp_path / "truth", tmp_path / "deep" / "out")
    before = {p: p.read_bytes() for p in (tmp_path / "deep").rglob("*") if p.is_file()}
    assert len(before) == (4 if kind == "png" else 10)
    bad = write_folder(tmp_path / "bad", offset=0.2, kind="exr")
    broken = frame(3)
    broken[0, 0] = np.nan
    write_exr(bad / "0003.exr", {c: broken[..., k] for k, c in enumerate("RGB")})
    with pytest.raises(JaxsrError, match=r"bad/0003\.exr: the frame holds NaN"):
        compare([tmp_path / "good", bad], tmp_path / "truth", tmp_path / "deep" / "out")
    assert {p: p.read_bytes() for p in (tmp_path / "deep").rglob("*") if p.is_file()} == before


def test_an_interrupted_comparison_leaves_nothing(folders):
    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare([folders / "exact"], folders / "truth", folders / "out", progress=lambda title, total: stop)
    assert sorted(p.name for p in folders.iterdir()) == ["bright", "exact", "truth"]


@pytest.mark.parametrize(
    "numbers", [{"exposure": x} for x in (-1.0, 0.0, math.inf, math.nan)] + [{"fps": 0.0}, {"fps": math.nan}]
)
def test_numbers_are_checked_before_anything_is_read(tmp_path, numbers):
    with pytest.raises(JaxsrError, match=f"{next(iter(numbers))}: must be a number above 0"):
        compare([tmp_path / "none"], tmp_path / "none", tmp_path / "out", **numbers)
    assert not list(tmp_path.iterdir())


def test_out_that_cannot_be_a_folder(folders):
    (folders / "file").write_text("mine")
    for out in (folders / "file", folders / "file" / "below"):
        with pytest.raises(JaxsrError, match="file"):
            compare([folders / "exact"], folders / "truth", out)
    assert (folders / "file").read_text() == "mine"


def test_bad_truth_and_no_folders(folders):
    with pytest.raises(JaxsrError, match="none: no such folder"):
        compare([folders / "exact"], folders / "none", folders / "out")
    with pytest.raises(JaxsrError, match="no folders to compare"):
        compare([], folders / "truth", folders / "out")
    write_png(folders / "truth" / "0002.png", frame(2)[1:])
    with pytest.raises(JaxsrError, match=r"truth/0002.png: wrong size"):
        compare([folders / "exact"], folders / "truth", folders / "out")


def test_counts_are_checked_before_anything_is_read(folders):
    write_folder(folders / "bad", numbers=(1, 2))
    with pytest.raises(JaxsrError, match="frame 3 is missing"):
        check_match(find_frames(folders / "bad"), find_frames(folders / "truth"))


def test_the_layer_of_a_sequence_that_frames_are_compared_with(tmp_path, folders):
    """The reference by default, the colour on demand; a folder of pictures has no layers."""
    sequence = make_sequence(tmp_path / "s", frames=2, size=(W, H), reference=True)
    made = tmp_path / "made"
    made.mkdir()
    for i in range(2):
        write_png(made / f"{i + 1:04d}.png", np.asarray(to_display(sequence.truth(i, "reference"))))
    psnr = {}
    for layer in (None, "color"):
        section = compare([made], sequence.path, tmp_path / "out", layer=layer)
        assert section.meta["layer"] == (layer or "reference")
        psnr[layer] = section.methods[0].metrics["psnr"]
    assert min(psnr[None]) > 50
    assert max(psnr["color"]) < 30
    with pytest.raises(JaxsrError, match="truth is no sequence: it has no layers"):
        compare([folders / "exact"], folders / "truth", tmp_path / "out", layer="reference")
