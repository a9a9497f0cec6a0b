"""Videos are read back: number of frames, size, what is where; and every refusal."""

import re
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.io.images import write_png
from jaxsr.report import video
from jaxsr.report.video import write_video


def read_back(path):
    """What ffmpeg says of the video stream, and its frames [n, h, w, 3]."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    info = re.search(r"Video: (.*)", done.stderr.decode())[1]
    w, h = map(int, re.search(r"(\d+)x(\d+)[, ]", info).groups())
    return info, np.frombuffer(done.stdout, np.uint8).reshape(-1, h, w, 3)


def flat(value, h=30, w=45):
    return np.full((h, w, 3), value, np.float32)


def test_frames_size_and_content(tmp_path):
    columns = {
        "red": [flat((t, 0, 0)) for t in (0.2, 0.6, 1.0)],
        "grey": [flat((0.5, 0.5, 0.5)) for _ in range(3)],
    }
    steps = []
    path = write_video(tmp_path / "sub" / "v.mp4", columns, fps=8, scale=3, advance=lambda: steps.append(1))
    assert len(steps) == 3
    info, frames = read_back(path)
    assert info.startswith("h264")
    assert "yuv420p(tv, bt709" in info
    assert " 8 fps" in info
    assert len(frames) == 3
    strip = 16
    assert frames[0].shape == (30 * 3 + strip, 2 * 45 * 3 + 4, 3)
    middle = strip + 45
    for t, frame in zip((0.2, 0.6, 1.0), frames, strict=True):
        assert np.abs(frame[middle, 60].astype(int) - [round(255 * t), 0, 0]).max() <= 6
        assert np.abs(frame[middle, 200].astype(int) - 128).max() <= 6
    label = frames[0][:strip, :135].astype(int)
    assert label.max() > 150  # the name is there, on dark paper
    assert np.median(label) < 40
    assert [p.name for p in (tmp_path / "sub").iterdir()] == ["v.mp4"]


def test_odd_sizes_grid_captions_and_files(tmp_path):
    write_png(tmp_path / "a.png", flat((0, 1, 0), 11, 13))
    columns = {
        "file": [tmp_path / "a.png"] * 2,
        "array": [flat((0, 0, 1), 11, 13)] * 2,
        "a name that is much too long": [flat((1, 1, 1), 11, 13)] * 2,
    }
    path = write_video(
        tmp_path / "v.mp4", columns, fps=24, scale=1, per_row=2, captions=["frame 1", "frame 2, extrapolated"]
    )
    _, frames = read_back(path)
    assert len(frames) == 2
    # Two rows of 16 + 11 lines and a gap of 4; 2 * 13 + 4 columns.
    assert frames[0].shape == (58, 30, 3)
    assert frames[0][16 + 5, 6, 1] > 200
    assert frames[0][16 + 5, 17 + 6, 2] > 200
    assert frames[0][27 + 4 + 16 + 5, 6].min() > 200


def test_automatic_scale_fills_the_width(tmp_path):
    path = write_video(tmp_path / "v.mp4", {"a": [flat(0.5, 9, 16)], "b": [flat(0.2, 9, 16)]}, fps=1)
    _, frames = read_back(path)
    width = frames[0].shape[1]
    assert width <= video.TARGET_WIDTH
    assert width + 2 * 16 > video.TARGET_WIDTH


def test_labels_that_do_not_fit_are_cut():
    short, long = video._label("abc", 120, 20), video._label("abc" * 40, 120, 20)
    assert short.shape == long.shape == (20, 120, 3)
    assert long[:, -8:].max() < 40  # nothing runs out of the strip


@pytest.mark.parametrize(
    ("columns", "options", "words"),
    [
        ({}, {}, "no frames for the video"),
        ({"a": []}, {}, "no frames for the video"),
        ({"a": [flat(0.5)], "b": [flat(0.5)] * 2}, {}, "unequal numbers of frames"),
        ({"a": [flat(0.5)], "b": [flat(0.5, 10, 10)]}, {}, "columns differ in size"),
        ({"a": [flat(0.5), flat(0.5, 10, 10)]}, {}, "a, frame 1: frames differ in size"),
        ({"a": [flat(1.5)]}, {}, "not display-referred"),
        ({"a": [flat(0.5), flat(np.nan)]}, {}, "a, frame 1: image is not display-referred"),
        ({"a": [flat(0.5)]}, {"fps": 0.0}, "bad frame rate"),
        ({"a": [flat(0.5)]}, {"scale": 0}, "must be at least 1"),
        ({"a": [flat(0.5)]}, {"captions": []}, "wrong number of captions"),
    ],
)
def test_refusals_leave_nothing_behind(tmp_path, columns, options, words):
    with pytest.raises(JaxsrError, match=words):
        write_video(tmp_path / "v.mp4", columns, **{"fps": 4.0, **options})
    assert list(tmp_path.iterdir()) == []


def test_wrong_suffix_and_failing_ffmpeg(tmp_path, monkeypatch):
    with pytest.raises(JaxsrError, match="unknown kind of video"):
        write_video(tmp_path / "v.avi", {"a": [flat(0.5)]}, fps=4)
    # H.264 has a largest size of picture; a program that is not ffmpeg fails at once.
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(JaxsrError, match="ffmpeg could not write the video; found status 1"):
        write_video(tmp_path / "v.mp4", {"a": [flat(0.5)] * 50}, fps=4)
    assert list(tmp_path.iterdir()) == []
