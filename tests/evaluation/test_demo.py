"""The demo and `jaxsr upscale` end to end on small sequences of the analytic scene, and honest inference."""

import dataclasses
import json

import numpy as np
import pytest

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.demo import run_demo
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.images import read_png
from jaxsr.methods import METHODS
from jaxsr.runtime.load import find_method
from jaxsr.runtime.schedule import rendered_schedule
from jaxsr.runtime.upscale import upscale
from tests.builders import make_sequence, random_weights


def _silent(title, total):
    return lambda: None


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    root = tmp_path_factory.mktemp("demo")
    sequences = [make_sequence(root / name, frames=4).path for name in ("one-test-0", "two-test-0")]
    random_weights(root / "weights" / "fusion-sr-x2.safetensors", scale=2)
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxsr.runtime.load.weights_folder", lambda: root / "weights")
        sections = run_demo(
            root / "out", sequences, scale=2, progress=lambda title, total: lambda: steps.append(title)
        )
    return root / "out", sections, steps


def test_the_demo_writes_frames_videos_metrics_and_a_page(demo):
    out, sections, steps = demo
    assert len(sections) == 4
    assert steps.count("frames") == 2 * 2 * 4 * (6 + 5)  # made and measured, sequences, frames, methods
    for name in ("one-test-0", "two-test-0"):
        for task in ("super-resolution", "extrapolation"):
            assert (out / f"{name}-{task}.mp4").stat().st_size > 1000
            folder = out / name / task / "taau"
            assert [p.name for p in sorted((folder / "exr").iterdir())] == [
                f"{i:04d}.exr" for i in range(1, 5)
            ]
            channels, _ = read_exr(folder / "exr" / "0002.exr")
            assert set(channels) == {"color.R", "color.G", "color.B"}
            assert read_png(folder / "png" / "0002.png").shape == (40, 64, 3)
    page = (out / "report.html").read_text()
    assert "guided" in page
    assert not list(out.rglob("*.tmp*"))


def test_the_metrics_are_those_of_the_frames_on_disk(demo):
    out, _, _ = demo
    metrics = json.loads((out / "metrics.json").read_text())
    section = next(
        s for s in metrics["sections"] if s["title"].startswith("one-test-0, x2, super-resolution")
    )
    result = next(t for t in section["tracks"] if t["name"] == "bilinear")
    truth = read_png(out / "one-test-0/super-resolution/truth/png/0003.png")
    made = read_png(out / "one-test-0/super-resolution/bilinear/png/0003.png")
    psnr = -10 * np.log10(np.mean((truth.astype(float) - made) ** 2))
    assert section["frames"][0] == 3  # after the warm-up
    assert result["metrics"]["psnr"][0] == pytest.approx(psnr, abs=0.05)  # the PNG is rounded to 8 bits
    assert result["timing"]["compile_s"] > 0


def test_extrapolated_frames_are_marked(demo):
    _, sections, _ = demo
    assert list(sections[1].extrapolated) == [False, True]  # frames 3 and 4, after the warm-up
    assert sections[1].inputs[1] is None


@pytest.mark.parametrize("name", sorted(METHODS))
def test_truth_is_never_seen(name, tmp_path):
    """HR colour, and LR colour of extrapolated frames, replaced by NaN: every output file stays the same."""

    clean = make_sequence(tmp_path / "clean", frames=4, reference=True)
    poisoned = make_sequence(tmp_path / "poisoned", frames=4, reference=True)
    hidden = [*(poisoned.path / "hr").iterdir(), *(poisoned.path / "x2" / f"000{i}.exr" for i in (2, 4))]
    for file in hidden:
        channels, metadata = read_exr(file)
        spoilt = ("color.", "reference.")
        nan = {k: np.full_like(v, np.nan) for k, v in channels.items() if k.startswith(spoilt)}
        assert len(nan) == (6 if file.parent.name == "hr" else 3)
        write_exr(file, channels | nan, metadata)
    learned = METHODS[name].network is not None
    given = random_weights(tmp_path / f"{name}.safetensors", scale=2, method=name) if learned else name
    method = find_method(str(given), 2)
    for sequence, out in ((clean, "a"), (poisoned, "b")):
        upscale(sequence, method, tmp_path / out, scale=2, every=2)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").glob("*/*.*"))
    assert len(files) == 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_doubling_the_rate_of_full_size_frames(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=4)
    upscale(sequence, find_method("guided", 1), tmp_path / "out", scale=1, every=2)
    channels, _ = read_exr(tmp_path / "out" / "exr" / "0003.exr")
    made = np.stack([channels[f"color.{c}"] for c in "RGB"], -1)
    np.testing.assert_allclose(made, sequence.truth(2), rtol=2e-3, atol=1e-4)  # half floats
    channels, _ = read_exr(tmp_path / "out" / "exr" / "0002.exr")
    assert np.isfinite(channels["color.R"]).all()


def test_the_first_frame_of_a_shot_is_always_rendered(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=5)
    sequence.infos[1] = dataclasses.replace(sequence.infos[1], reset=True)
    assert rendered_schedule(sequence, 3) == [True, True, False, False, True]
    with pytest.raises(JaxsrError, match="every"):
        rendered_schedule(sequence, 0)


def test_a_method_says_which_buffer_it_lacks(tmp_path):
    def strip(resolution, index, layers):
        layers.pop("normal")

    sequence = make_sequence(tmp_path / "seq", frames=2, spoil=strip)
    with pytest.raises(JaxsrError, match=r"'guided' needs hr.normal"):
        upscale(sequence, find_method("guided", 2), tmp_path / "out", scale=2, every=2)
    assert not (tmp_path / "out").exists()
    upscale(sequence, find_method("guided", 2), tmp_path / "out", scale=2)  # needs none where all is rendered
    with pytest.raises(JaxsrError, match=r"unknown method 'magic'.*one of nearest"):
        find_method("magic", 2)


def test_frames_of_two_sequences_do_not_mix(tmp_path):
    long = make_sequence(tmp_path / "long", frames=4)
    short = make_sequence(tmp_path / "short", frames=2)
    upscale(long, find_method("nearest", 2), tmp_path / "out", scale=2)
    with pytest.raises(JaxsrError, match=r"frames of another run.*frames 1 to 2.*frames 1 to 4"):
        upscale(short, find_method("nearest", 2), tmp_path / "out", scale=2)


def test_a_moving_camera_without_motion_is_an_error(tmp_path):
    def freeze(resolution, index, layers):
        layers["motion"] = np.zeros_like(layers["motion"])

    sequence = make_sequence(tmp_path / "seq", frames=2, spoil=freeze)
    with pytest.raises(JaxsrError, match="motion is zero everywhere, yet the camera moves"):
        upscale(sequence, find_method("taau", 2), tmp_path / "out", scale=2)
    upscale(sequence, find_method("bilinear", 2), tmp_path / "a", scale=2)  # does without motion
    still = make_sequence(tmp_path / "still", frames=2, still=True, frozen=True)
    upscale(still, find_method("taau", 2), tmp_path / "b", scale=2)  # nothing moves: zero is right
