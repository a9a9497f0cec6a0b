"""The command line: what it prints, what it exits with, and one clear line for every bad input."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxsr.cli
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.images import write_png
from tests.builders import make_sequence, random_weights


def run(capsys, *arguments) -> tuple[int, str, str]:
    try:
        jaxsr.cli.main([str(a) for a in arguments])
        status = 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
    out, err = capsys.readouterr()
    return status, out, err


def error_line(capsys, *arguments) -> str:
    """The only line of an error, which begins with the name of the program; no traceback, status 2."""
    status, _, err = run(capsys, *arguments)
    lines = [line for line in err.splitlines() if line.startswith("jaxsr: ")]
    assert status == 2
    assert len(lines) == 1
    assert "Traceback" not in err
    return lines[0]


@pytest.fixture
def sequence(tmp_path):
    return make_sequence(tmp_path / "seq", frames=3)


def test_help_answers_without_loading_jax():
    import subprocess
    import sys

    code = "import jaxsr.cli, sys\ntry: jaxsr.cli.main(['--help'])\nexcept SystemExit: pass\n" + (
        "assert 'jax' not in sys.modules, 'jax was imported'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for verb in (
        "demo",
        "inspect",
        "compare",
        "upscale",
        "evaluate",
        "render",
        "train",
        "convert-weights",
    ):
        assert verb in done.stdout


def test_inspect_prints_and_speaks_json(capsys, sequence):
    status, out, _ = run(capsys, "inspect", sequence.path)
    assert status == 0
    assert "motion" in out
    status, out, _ = run(capsys, "inspect", sequence.path, "--json")
    assert status == 0
    assert json.loads(out)["name"] == "seq"


def test_upscale_writes_frames(capsys, sequence, tmp_path):
    status, out, _ = run(capsys, "upscale", sequence.path, "--method", "bilinear", "--out", tmp_path / "out")
    assert status == 0
    assert "3 frames" in out
    assert len(list((tmp_path / "out" / "png").iterdir())) == 3


def test_compare_writes_a_page(capsys, sequence, tmp_path):
    run(capsys, "upscale", sequence.path, "--method", "nearest", "--out", tmp_path / "a")
    run(capsys, "upscale", sequence.path, "--method", "bilinear", "--out", tmp_path / "b")
    out = tmp_path / "cmp"
    status, text, _ = run(
        capsys, "compare", tmp_path / "a", tmp_path / "b", "--truth", sequence.path, "-o", out
    )
    assert status == 0
    assert "PSNR" in text
    assert (out / "report.html").is_file()


def test_a_file_of_weights_is_a_method(capsys, sequence, tmp_path):
    weights = random_weights(tmp_path / "mine.safetensors", scale=2)
    out = tmp_path / "out"
    status, text, _ = run(
        capsys, "evaluate", sequence.path, "--methods", "nearest", weights, "--scale", 2, "--no-lpips",
        "--every", 2, "--warmup", 1, "-o", out,
    )  # fmt: skip
    assert status == 0
    assert "mine" in text
    assert "extrapolated" in text
    assert "edges" in text
    assert json.loads((out / "metrics.json").read_text())["meta"]["warmup"] == 1
    assert len(list((out / "seq" / "mine" / "png").iterdir())) == 3
    for name in ("report.html", "metrics.csv", "metrics.md"):
        assert (out / name).is_file()


@pytest.mark.parametrize("verb", ["inspect", "upscale", "evaluate"])
class TestSequenceCommands:
    """Commands that read a sequence."""

    def test_missing(self, capsys, tmp_path, verb):
        assert "no such folder" in error_line(capsys, *self.arguments(verb, tmp_path / "nothing"))

    def test_not_a_sequence(self, capsys, tmp_path, verb):
        (tmp_path / "empty").mkdir()
        assert "sequence.json" in error_line(capsys, *self.arguments(verb, tmp_path / "empty"))

    def test_mismatched_count(self, capsys, sequence, verb):
        (sequence.path / "x2" / "0002.exr").unlink()
        assert "0002.exr" in error_line(capsys, *self.arguments(verb, sequence.path))

    def arguments(self, verb, path):
        return (verb, path, *(("--methods", "nearest", "--scale", 2) if verb == "evaluate" else ()))


def rewrite(file, change):
    """Let `change` edit the channels of an OpenEXR file: what no writer of ours would write."""
    channels, metadata = read_exr(file)
    channels = dict(channels)
    change(channels)
    write_exr(file, channels, metadata)


def test_upscale_truncated(capsys, sequence, tmp_path):
    file = sequence.path / "x2" / "0002.exr"
    file.write_bytes(file.read_bytes()[:-400])
    line = error_line(capsys, "upscale", sequence.path, "-o", tmp_path / "out", "--method", "nearest")
    assert "0002.exr" in line
    assert not list((tmp_path / "out").rglob("0002.*"))


def test_upscale_missing_channel(capsys, sequence, tmp_path):
    rewrite(sequence.path / "hr" / "0002.exr", lambda channels: channels.pop("motion.Y"))
    line = error_line(capsys, "upscale", sequence.path, "-o", tmp_path / "out")
    assert "motion" in line
    assert "0002" in line


def test_upscale_wrong_size(capsys, sequence, tmp_path):
    other = make_sequence(tmp_path / "other", frames=3, size=(32, 20))
    (other.path / "x2" / "0002.exr").replace(sequence.path / "x2" / "0002.exr")
    line = error_line(capsys, "upscale", sequence.path, "-o", tmp_path / "out", "--method", "nearest")
    assert "0002.exr" in line
    assert "size" in line


def test_upscale_nan(capsys, sequence, tmp_path):
    def spoil(channels):
        channels["color.G"] = channels["color.G"].copy()
        channels["color.G"][3, 4] = np.nan

    rewrite(sequence.path / "x2" / "0002.exr", spoil)
    line = error_line(capsys, "upscale", sequence.path, "-o", tmp_path / "out", "--method", "nearest")
    assert "NaN" in line
    assert "0002.exr" in line


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--method", "magic"], "one of nearest"),
        (["--scale", "3"], "scale 3 is not available"),
        (["--every", "0"], "every"),
    ],
)
def test_upscale_arguments(capsys, sequence, tmp_path, arguments, expected):
    assert expected in error_line(capsys, "upscale", sequence.path, "-o", tmp_path / "out", *arguments)
    assert not list((tmp_path / "out").rglob("*.exr"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--methods", "taau", "magic"], "unknown method 'magic'"),
        (["--methods", "taau", "taau"], "two methods are called 'taau'"),
        (["--methods", "fusion-sr"], "no weights of 'fusion-sr' for scale 2"),
        (["--methods", "none.safetensors"], "none.safetensors: no such file of weights"),
        (["--methods", "text.safetensors"], "text.safetensors: cannot read the weights"),
        (["--methods", "taau", "--scale", "3"], "scale 3 is not available"),
        (["--methods", "taau", "--every", "0"], "every"),
        (["--methods", "taau", "--warmup", "3"], "no frame is left to measure"),
        (["--methods", "taau", "--frames", "8:9"], "no frame in the range"),
        (["--methods", "taau", "--frames", "x"], "bad range of frames"),
        (["--methods", "taau", "-o", "text.safetensors"], "not a folder"),
    ],
)
def test_evaluate_arguments(capsys, sequence, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxsr.runtime.load.weights_folder", lambda: tmp_path / "none")
    (tmp_path / "text.safetensors").write_text("these are no weights")
    command = ("evaluate", sequence.path, "--scale", "2", "-o", tmp_path / "out", *arguments)
    assert expected in error_line(capsys, *command)
    assert not (tmp_path / "out").exists()


def test_lists_with_commas_still_work_and_say_so(capsys, sequence, tmp_path):
    """As earlier versions took them; a path with a comma is one path."""
    command = ("evaluate", sequence.path, "--scale", 2, "-o", tmp_path / "out")
    status, _, err = run(capsys, *command, "--methods", "nearest, magic")
    assert status == 2
    note, error = (line for line in err.splitlines() if line.startswith("jaxsr: "))
    assert "--methods takes a list with spaces" in note
    assert "unknown method 'magic'" in error
    (tmp_path / "a,b.safetensors").write_text("these are no weights")
    assert "a,b.safetensors: " in error_line(capsys, *command, "--methods", tmp_path / "a,b.safetensors")


@pytest.mark.parametrize("name", ["report.html", "metrics.json", "metrics.md"])
@pytest.mark.parametrize("verb", ["evaluate", "compare", "demo"])
def test_results_of_others_are_not_overwritten(capsys, sequence, tmp_path, name, verb):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text('{"mine": 1}')
    arguments = {"evaluate": (sequence.path, "--scale", 2), "compare": (tmp_path, "--truth", sequence.path)}
    line = error_line(capsys, verb, *arguments.get(verb, ()), "-o", out)
    assert f"holds {name}, which jaxsr did not write" in line
    assert (out / name).read_text() == '{"mine": 1}'


def test_evaluate_wants_sequences(capsys, tmp_path):
    assert "no sequences" in error_line(capsys, "evaluate", "--methods", "taau", "-o", tmp_path / "out")


def test_upscale_without_weights(capsys, sequence, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxsr.runtime.load.weights_folder", lambda: tmp_path / "none")
    line = error_line(capsys, "upscale", sequence.path, "--method", "fusion-sr", "-o", tmp_path / "out")
    assert "no weights of 'fusion-sr' for scale 2; found no weights of it in the package" in line
    assert not (tmp_path / "out").exists()


def test_inspect_finds_what_is_wrong_with_the_pixels(capsys, sequence):
    """Faults of the pixels are findings: all of them are listed, and the status is 1."""
    for file in (sequence.path / "hr").iterdir():
        rewrite(file, lambda channels: channels.update({"normal.X": channels["normal.X"] * np.nan}))
    status, out, _ = run(capsys, "inspect", sequence.path, "--json")
    assert status == 1
    assert any("NaN" in finding["text"] for finding in json.loads(out)["findings"])


def test_inspect_flipped_motion(capsys, tmp_path):
    def flip(resolution, index, layers):
        layers["motion"] = -layers["motion"]

    seq = make_sequence(tmp_path / "s", frames=3, size=(96, 54), spoil=flip)
    status, out, _ = run(capsys, "inspect", seq.path)
    assert status == 1
    assert "forward" in out or "flipped" in out


def test_inspect_zero_motion(capsys, tmp_path):
    seq = make_sequence(
        tmp_path / "s", frames=3, spoil=lambda r, i, layers: layers.update(motion=0 * layers["motion"])
    )
    _, out, _ = run(capsys, "inspect", seq.path)
    assert "zero" in out.lower() or "nothing moves" in out.lower()


def test_compare_errors(capsys, sequence, tmp_path):
    def frames(name, count, size=(24, 16)):
        for i in range(count):
            write_png(tmp_path / name / f"{i:04d}.png", np.full((size[1], size[0], 3), 0.5, np.float32))
        return tmp_path / name

    truth, good = frames("truth", 3), frames("good", 3)
    arguments = ("--truth", truth, "-o", tmp_path / "cmp")
    assert "no such folder" in error_line(capsys, "compare", tmp_path / "none", *arguments)
    assert "no folders" in error_line(capsys, "compare", *arguments)
    short = frames("short", 2)
    assert "expected 3 frames; found 2 frames" in error_line(capsys, "compare", good, short, *arguments)
    small = frames("small", 3, (12, 8))
    assert "small" in error_line(capsys, "compare", small, *arguments)
    broken = frames("broken", 3)
    data = (broken / "0001.png").read_bytes()
    (broken / "0001.png").write_bytes(data[: len(data) // 2])
    assert "0001.png" in error_line(capsys, "compare", broken, *arguments)
    (tmp_path / "bare").mkdir()
    assert "no frames" in error_line(capsys, "compare", tmp_path / "bare", *arguments)
    assert not (tmp_path / "cmp" / "report.html").exists()


def test_render_errors(capsys, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert "not a scene" in error_line(capsys, "render", tmp_path / "none.blend", "-o", out)
    (tmp_path / "a.txt").write_text("x")
    assert "not a scene" in error_line(capsys, "render", tmp_path / "a.txt", "-o", out)
    scene = tmp_path / "a.blend"
    scene.write_bytes(b"BLENDER-v500")
    assert "range" in error_line(capsys, "render", scene, "-o", out, "--frames", "5:2")
    assert "range" in error_line(capsys, "render", scene, "-o", out, "--frames", "x")
    line = error_line(capsys, "render", scene, "-o", out, "--blender", tmp_path / "no-blender")
    assert "no-blender" in line
    assert not out.exists()


def test_demo_errors(capsys, tmp_path, monkeypatch):
    assert "no scene 'moon'" in error_line(capsys, "demo", "-o", tmp_path, "--scenes", "moon")
    assert "scale 3 is not available" in error_line(capsys, "demo", "-o", tmp_path / "d", "--scale", "3")
    monkeypatch.setattr("jaxsr.data.sample.sample_folder", lambda: tmp_path / "none")
    assert "sample is missing" in error_line(capsys, "demo", "-o", tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_stdout_that_knows_only_ascii(tmp_path):
    sequence = make_sequence(tmp_path / "größe", size=(32, 24), frames=1, license="© – ∞")
    done = subprocess.run(
        [sys.executable, "-c", "from jaxsr.cli import main; main()", "inspect", sequence.path],
        env=os.environ | {"PYTHONIOENCODING": "ascii", "JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr.decode()
    assert rb"gr\xf6\xdfe" in done.stdout
    assert b"Traceback" not in done.stderr
