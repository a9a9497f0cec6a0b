"""`jaxsr evaluate` end to end: numbers as on disk, the truth unseen, runs that go on; and every refusal."""

import csv
import dataclasses
import functools
import json
import os
import shutil
import subprocess
import sys
import threading
import types
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxsr import metrics
from jaxsr.errors import JaxsrError
from jaxsr.evaluation import kept
from jaxsr.evaluation.code import method_digest
from jaxsr.evaluation.evaluate import evaluate, find_methods, part
from jaxsr.evaluation.measuring import Reference, metrics_with
from jaxsr.evaluation.regions import regions
from jaxsr.evaluation.running import Evaluation, Settings, run_method
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.images import read_png
from jaxsr.io.sequence import Sequence
from jaxsr.methods import METHODS
from jaxsr.report.results import REGIONS
from jaxsr.report.tables import rich_tables
from jaxsr.runtime import upscale
from jaxsr.runtime.load import find_method, shipped_scales
from jaxsr.runtime.upscale import display
from jaxsr.weights.file import load_weights, save_weights
from tests.builders import edit_frames, make_sequence, random_weights

KEYS = ("psnr", "ssim", "flip", "tpsnr")  # LPIPS takes longer to compile than all the rest to run
SETTINGS = Settings(2, metrics=KEYS)
SIZE = (32, 24)


def silent(title, total):
    return lambda: None


def run(places, methods, out, settings=SETTINGS, **options):
    return evaluate(places, methods, out, settings, **{"progress": silent} | options)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    for name, frames in (("one", 3), ("two", 4)):
        make_sequence(root / "set" / name, frames=frames, size=SIZE)
    random_weights(root / "net.safetensors", scale=2)
    return root


@pytest.fixture(scope="module")
def done(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "results"
    steps = []
    sections = run(
        [data / "set"],
        ["bilinear", str(data / "net.safetensors")],
        out,
        meta={"seed": 1},
        progress=lambda title, total: lambda: steps.append((title, total)),
    )
    return out, sections, steps


def test_it_writes_frames_numbers_and_a_page(done):
    out, sections, steps = done
    assert [s.title for s in sections] == [
        f"{name}, x2, super-resolution, against the aliased truth" for name in ("one", "two")
    ]
    assert [s for s in steps if s[0] == "frames"] == [("frames", 2 * 2 * 7)] * (2 * 2 * 7)
    for name, count in (("one", 3), ("two", 4)):
        for method in ("bilinear", "net"):
            assert len(list((out / name / method / "exr").iterdir())) == count
            assert len(list((out / name / method / "png").iterdir())) == count
    data = json.loads((out / "metrics.json").read_text())
    assert data["meta"] == {"seed": 1, "truth": "color"}
    net = data["sections"][0]["tracks"][1]
    assert net["name"] == "net"
    assert net["cost"]["parameters"] > 1e5
    assert net["timing"]["compile_s"] > 0
    assert set(net["regions"]) == set(REGIONS)
    rows = list(csv.DictReader((out / "metrics.csv").read_text().splitlines()))
    assert len(rows) == 2 * 7 * 3
    page, text = (out / "report.html").read_text(), (out / "metrics.md").read_text()
    for words in ("edges", "disocclusions", "Parameters", "MAC / px", "Compile [s]", "FLIP ↓"):
        assert words in page
        assert words in text
    assert [t.title for t in rich_tables(sections, brief=True)][2:4] == [
        "mean, x2, super-resolution · all (2 sequences)",
        "mean, x2, super-resolution · all (2 sequences) · edges",
    ]
    assert not list(out.rglob("*.tmp*"))


def test_numbers_are_those_of_the_frames_on_disk(done, data):
    out, sections, _ = done
    opened = upscale.FrameSequence.open(data / "set" / "two")
    result, i = sections[1].methods[1], 2
    pairs = [
        tuple(read_png(out / "two" / place / "png" / f"{n:04d}.png") for place in ("net", "truth"))
        for n in (2, 3)
    ]
    frames = [opened.frame(k, 1, rendered=False) for k in (1, 2)]
    found = metrics.measure_frame(
        *pairs[1], before=pairs[0], regions=regions(frames[1], frames[0]), keys=KEYS
    )
    for region, values in found.items():
        for key, value in values.items():
            # The PNGs are rounded to 8 bits.
            assert result.over(region)[key][i] == pytest.approx(value, rel=0.01)


def test_the_mean_over_sequences_is_that_of_their_means(done):
    out, sections, _ = done
    means = json.loads((out / "metrics.json").read_text())["means"]
    assert [m["region"] for m in means] == ["all", *REGIONS]
    for one in means:
        for k, result in enumerate(one["tracks"]):
            for key, found in result["summary"].items():
                values = [
                    [v for v in s.methods[k].over(one["region"])[key] if v is not None] for s in sections
                ]
                each = [np.mean(v) for v in values]
                assert found["mean"] == pytest.approx(np.mean(each), rel=1e-9)
                assert found["spread"] == pytest.approx(np.std(each), rel=1e-6, abs=1e-12)
                assert found["frames"] == 2


def test_the_truth_is_never_seen(done, data, tmp_path):
    """Other HR colour, and NaN as LR colour of what is to be extrapolated: the frames stay the same."""
    clean, poisoned = tmp_path / "clean", tmp_path / "poisoned"
    for copy in (clean, poisoned):
        shutil.copytree(data / "set" / "two", copy)
    for file, value in [(f, 0.25) for f in (poisoned / "hr").iterdir()] + [
        (poisoned / "x2" / f"000{i}.exr", np.nan) for i in (2, 4)
    ]:
        channels, metadata = read_exr(file)
        other = {k: np.full_like(v, value) for k, v in channels.items() if k.startswith("color.")}
        write_exr(file, channels | other, metadata)
    methods = ["guided", str(data / "net.safetensors")]
    sections = run([clean, poisoned], methods, tmp_path / "out", SETTINGS._replace(every=2))
    assert list(sections[0].extrapolated) == [False, True, False, True]
    assert sections[0].methods[0].metrics["psnr"] != sections[1].methods[0].metrics["psnr"]
    for method in ("guided", "net"):
        files = sorted((tmp_path / "out" / "clean" / method / "exr").iterdir())
        assert len(files) == 4
        for file in files:
            other = tmp_path / "out" / "poisoned" / method / "exr" / file.name
            assert file.read_bytes() == other.read_bytes()


def test_results_are_of_the_truth_that_is_asked_for(tmp_path, counted):
    """The reference by default, the colour on demand; each result says which it is."""
    make_sequence(tmp_path / "s", frames=2, size=SIZE, reference=True)
    places, out = [tmp_path / "s"], tmp_path / "out"
    for truth, named, words in (
        (None, "reference", "the anti-aliased reference"),
        ("color", "color", "the aliased truth"),
    ):
        (section,) = run(places, ["nearest"], out, truth=truth)
        assert section.title == f"s, x2, super-resolution, against {words}"
        document = json.loads((out / "metrics.json").read_text())
        assert document["meta"]["truth"] == document["sections"][0]["meta"]["truth"] == named
        assert words in (out / "report.html").read_text()
        shown = read_png(out / "s" / "truth" / "png" / "0002.png")
        expected = display(Sequence.open(places[0]).truth(1, named), 1.0)
        assert np.abs(shown - expected).max() < 1 / 255
        made = read_png(out / "s" / "nearest" / "png" / "0002.png")
        psnr = -10 * np.log10(np.mean((made.astype(float) - expected) ** 2))
        assert section.methods[0].metrics["psnr"][1] == pytest.approx(psnr, abs=0.05)
    assert counted == ["nearest", "nearest"], "what was kept for one truth does not stand for the other"


def test_a_truth_that_a_frame_lacks_is_refused_before_any_work(data, tmp_path):
    with pytest.raises(
        JaxsrError, match=r"frame 1 has no truth.*expected layer reference.*--reference-samples"
    ):
        run([data / "set"], ["nearest"], tmp_path / "out", truth="reference")
    assert not (tmp_path / "out").exists()


def test_buffers_that_are_jittered_are_refused_by_those_who_do_not_expect_it(data, tmp_path):
    shutil.copytree(data / "set" / "one", tmp_path / "s")
    edit_frames(tmp_path / "s", lambda frame: frame.update(hr_jitter_px=[0.25, 0.0]))
    with pytest.raises(JaxsrError, match=r"hr_jitter_px 0 in all frames"):
        run([tmp_path / "s"], ["guided"], tmp_path / "out")
    run([tmp_path / "s"], ["bilinear", "guided-taau"], tmp_path / "out")


@pytest.fixture
def counted(monkeypatch):
    """The names of the methods that are run, in order."""
    ran, stream = [], upscale.stream

    def counting(method, *arguments):
        ran.append(method.name)
        return stream(method, *arguments)

    monkeypatch.setattr(upscale, "stream", counting)
    return ran


def numbers(sections):
    return [[(t.metrics, t.regions, t.cost, t.flip_maps) for t in s.methods] for s in sections]


def test_what_is_finished_is_kept(done, data, tmp_path, counted):
    out = tmp_path / "again"
    shutil.copytree(done[0], out)
    methods = ["bilinear", str(data / "net.safetensors")]
    steps = []
    again = run(
        [data / "set"], methods, out, progress=lambda title, total: lambda: steps.append((title, total))
    )
    assert counted == []
    assert numbers(again) == numbers(done[1])
    assert [t.timing for s in again for t in s.methods] == [t.timing for s in done[1] for t in s.methods]
    assert steps.count(("frames", 2 * 2 * 7)) == 2 * 2 * 7  # the bar is full

    # One more method, and a damaged, an unfinished and an outdated record.
    (out / "one" / "bilinear" / "result.json").write_text("{")
    record = out / "two" / "bilinear" / "result.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"result": None}))
    (out / "one" / "net" / "png" / "0002.png").unlink()
    again = run([data / "set"], ["nearest", *methods], out)
    assert counted == ["nearest", "bilinear", "net", "nearest", "bilinear"]
    assert [s[1:] for s in numbers(again)] == numbers(done[1])


def test_what_results_depend_on_makes_them_anew(done, data, tmp_path, counted):
    out, weights = tmp_path / "again", tmp_path / "net.safetensors"
    shutil.copytree(done[0], out)
    shutil.copy(data / "net.safetensors", weights)
    one = [data / "set" / "one"]
    run(one, ["bilinear", str(weights)], out)
    assert counted == []  # the same weights elsewhere
    random_weights(weights, scale=2, seed=5)
    run(one, ["bilinear", str(weights)], out)
    assert counted == ["net"]
    run(one, ["bilinear"], out, SETTINGS._replace(metrics=("psnr",)))
    run(one, ["bilinear"], out, SETTINGS._replace(every=2))
    sections = run(one, ["bilinear"], out, SETTINGS._replace(warmup=1), frames=(2, 3))
    assert counted == ["net", "bilinear", "bilinear", "bilinear"]
    assert sections[0].frames == [3]
    assert sorted(p.name for p in (out / "one" / "bilinear" / "png").iterdir()) == ["0002.png", "0003.png"]


def test_an_interrupted_evaluation_goes_on(data, tmp_path, monkeypatch, counted):
    methods, out = ["nearest", "bilinear"], tmp_path / "out"
    expected = numbers(run([data / "set"], methods, tmp_path / "whole"))
    counted.clear()
    write, left = upscale.write_exr, [9]

    def interrupted(*arguments):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        write(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(upscale, "write_exr", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run([data / "set"], methods, out)
    assert counted == ["nearest", "bilinear", "nearest"]
    counted.clear()
    assert numbers(run([data / "set"], methods, out)) == expected
    assert counted == ["nearest", "bilinear"]  # those of the second sequence


def test_warm_up_is_made_and_not_measured(data, tmp_path):
    (whole,) = run([data / "set" / "two"], ["taau"], tmp_path / "a")
    (rest,) = run([data / "set" / "two"], ["taau"], tmp_path / "b", SETTINGS._replace(warmup=2))
    assert rest.frames == whole.frames[2:]
    for region in ("all", *REGIONS):
        for key in KEYS:
            assert rest.methods[0].over(region)[key][1:] == whole.methods[0].over(region)[key][3:]
    assert rest.methods[0].metrics["psnr"] == whole.methods[0].metrics["psnr"][2:]
    assert rest.methods[0].metrics["tpsnr"][0] is None
    assert len(list((tmp_path / "b" / "two" / "taau" / "png").iterdir())) == 4


@pytest.mark.skipif("lpips" not in metrics.available(), reason="needs the extra `perceptual`")
def test_lpips_is_one_of_the_metrics(tmp_path):
    sequence = make_sequence(tmp_path / "seq", frames=1)  # 64x40: AlexNet needs more than 32x24
    assert metrics_with(lpips=True) == metrics.available()
    assert metrics_with(lpips=False, lpips_alex=True) == ("psnr", "ssim", "lpips_alex", "flip", "tpsnr")
    settings = Settings(2, metrics=metrics_with(lpips=True, lpips_alex=True))
    (section,) = run([sequence.path], ["nearest"], tmp_path / "a", settings)
    assert section.metric_keys() == list(metrics.METRICS)
    for key in ("lpips", "lpips_alex"):
        assert section.methods[0].metrics[key][0] > 0
        assert section.methods[0].regions["edges"][key][0] > 0
    assert "LPIPS-Alex" in (tmp_path / "a" / "report.html").read_text()
    assert "LPIPS-Alex" in (tmp_path / "a" / "metrics.md").read_text()


def test_methods_are_found(data, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxsr.runtime.load.weights_folder", lambda: tmp_path / "shipped")
    assert find_method("taau", 4).net is None
    arrays, header = load_weights(data / "net.safetensors")

    def saved(name, **changes):
        path = tmp_path / f"{name}.safetensors"
        save_weights(path, arrays, header | changes)
        return str(path)

    for name in ("fusion-sr-x2", "fusion-sr-x4", "fusion-sr-hall-x2"):
        saved(f"shipped/{name}", scale=int(name[-1]))
    assert shipped_scales("fusion-sr") == [2, 4]
    assert shipped_scales("fusion-sr-hall") == [2]
    ready = find_method("fusion-sr-hall", 2)
    assert ready.method.name == "fusion-sr-hall"
    assert ready.method.needs.of(True) == METHODS["fusion-sr"].needs.of(True)
    names = ["fusion-sr", saved("run/weights"), saved("run/best")]
    assert [r.method.name for r in find_methods(names, 2)] == ["fusion-sr", "run", "run-best"]
    monkeypatch.chdir(tmp_path / "run")
    assert find_method("weights.safetensors", 2).method.name == "run"

    file = Path(saved("w"))
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(file.read_bytes()[:-50])
    for name, scale, words in (
        ("magic", 2, r"unknown method 'magic'; expected one of nearest.*file of weights"),
        ("fusion-sr", 3, r"no weights of 'fusion-sr' for scale 3; expected scale 2 or 4; train some"),
        ("fusion-sr-hall", 4, "no weights of 'fusion-sr-hall' for scale 4; expected scale 2"),
        (str(file), 4, "made for another scale; expected scale 4; found scale 2; choose --scale 2"),
        (str(tmp_path / "none.safetensors"), 2, "none.safetensors: no such file of weights"),
        (str(broken), 2, "broken.safetensors: cannot read the weights"),
    ):
        with pytest.raises(JaxsrError, match=words) as error:
            find_method(name, scale)
        assert "\n" not in str(error.value)
    settings = dict(METHODS["fusion-sr"].network.settings)
    for changes, words in (
        ({"method": "magic"}, "no method 'magic' that learns"),
        ({"method": ["taau"]}, "does not say which method"),
        ({"scale": None}, "header of the weights is damaged.*found scale None"),
        ({"format": 3}, "weights of another version; expected 2; found 3; update jaxsr"),
        ({"settings": [1]}, "header of the weights is damaged"),
        ({"settings": {}}, "the setting 'architecture' is missing"),
        ({"settings": settings | {"depth": 3}}, "no setting 'depth' is known"),
        ({"settings": settings | {"architecture": "unet"}}, "the weights do not fit the network"),
    ):
        with pytest.raises(JaxsrError, match=words):
            find_method(saved("odd", **changes), 2)
    shutil.rmtree(tmp_path / "shipped")
    with pytest.raises(JaxsrError, match=r"no weights of 'fusion-sr' for scale 2; found no weights of it"):
        find_method("fusion-sr", 2)
    for names, words in (
        ([], "no methods to evaluate"),
        (["taau", "taau"], "two methods are called 'taau'.*name each once"),
        ([str(file), "../w.safetensors"], "two methods are called 'w'"),
    ):
        with pytest.raises(JaxsrError, match=words):
            find_methods(names, 2)


def spoilt(tmp_path, name):
    """A sequence with a fault, and what is said of it."""

    def spoil(resolution, index, layers):
        if resolution == "hr" and index == 2 and name == "no truth":
            layers.pop("color")
        if name == "no normal":
            layers.pop("normal")

    sequence = make_sequence(tmp_path / "seq", frames=3, size=SIZE, spoil=spoil)
    if name == "NaN in the truth":
        file = sequence.path / "hr" / "0002.exr"
        channels, metadata = read_exr(file)
        green = channels["color.G"].copy()
        green[3, 4] = np.nan
        write_exr(file, channels | {"color.G": green}, metadata)
    return sequence.path


@pytest.mark.parametrize(
    ("name", "words", "options"),
    [
        ("no truth", "frame 2 has no truth.*jaxsr upscale", {}),
        ("no normal", "'guided' needs hr.normal", {"every": 2}),
        ("NaN in the truth", "0002.*NaN", {}),
        ("too short", "no frame is left to measure; expected a number from 0 to 2; found 3", {"warmup": 3}),
        ("negative", "no frame is left to measure", {"warmup": -1}),
        ("interval", "bad interval", {"every": 0}),
        ("scale", "scale 3 is not available", {"scale": 3}),
    ],
)
def test_refusals(tmp_path, name, words, options):
    path = spoilt(tmp_path, name)
    with pytest.raises(JaxsrError, match=words):
        run([path], ["guided"], tmp_path / "out", SETTINGS._replace(**options))
    assert not list(tmp_path.glob("out/*.*"))  # no page, no numbers
    if name != "NaN in the truth":  # that is found when the frame is read
        assert not (tmp_path / "out").exists()


def test_other_refusals(data, tmp_path):
    with pytest.raises(JaxsrError, match=r"no frame in the range.*1:3; found 7:9"):
        run([data / "set" / "one"], ["nearest"], tmp_path / "out", frames=(7, 9))
    (tmp_path / "file").write_text("x")
    with pytest.raises(JaxsrError, match="not a folder"):
        run([data / "set" / "one"], ["nearest"], tmp_path / "file")
    (tmp_path / "out" / "one" / "nearest" / "png").mkdir(parents=True)
    (tmp_path / "out" / "one" / "nearest" / "png" / "0009.png").write_text("x")
    with pytest.raises(JaxsrError, match=r"holds 0009.png, which no run.json of jaxsr names"):
        run([data / "set" / "one"], ["nearest"], tmp_path / "out")


def test_a_range_begins_anew(data):
    sequence = upscale.FrameSequence.open(data / "set" / "two")
    some = part(sequence, (2, 3))
    assert [(info.index, info.reset) for info in some.infos] == [(2, True), (3, False)]
    assert not sequence.infos[1].reset
    assert some.infos[1] is sequence.infos[2]


def test_temporal_psnr_does_not_reach_across_a_cut(data, tmp_path):
    sequence = upscale.FrameSequence.open(data / "set" / "two")
    sequence.infos[2] = dataclasses.replace(sequence.infos[2], reset=True)
    evaluation = Evaluation(sequence, SETTINGS._replace(metrics=("psnr", "tpsnr")), Reference(sequence))
    result = run_method(evaluation, find_method("nearest", 2), tmp_path / "out")
    assert [v is None for v in result.metrics["tpsnr"]] == [True, False, True, False]


def files_of(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("record", ['{"mine": 1}', '{"key": {}, "track": {}}', "{"])
def test_files_of_others_are_not_touched(data, tmp_path, record):
    folder = tmp_path / "out" / "one" / "nearest"
    for name in ("exr/9999.exr", "png/mine.txt", "flip/notes.txt"):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text("mine")
    (folder / "result.json").write_text(record)
    before = files_of(folder)
    with pytest.raises(JaxsrError, match=r"result.json: not a result of jaxsr"):
        run([data / "set" / "one"], ["nearest"], tmp_path / "out")
    assert files_of(tmp_path / "out") == before  # nor is anything written beside them
    (folder / "result.json").unlink()
    before = files_of(folder)
    with pytest.raises(JaxsrError, match=r"exr: holds 9999.exr"):
        run([data / "set" / "one"], ["nearest"], tmp_path / "out")
    assert files_of(tmp_path / "out") == before


def test_precision_and_flags_of_the_compiler_are_in_the_key(data, monkeypatch):
    sequence = upscale.FrameSequence.open(data / "set" / "two")
    evaluation = Evaluation(sequence, SETTINGS, Reference(sequence))
    loaded = find_method("nearest", 2)
    key = kept._key(evaluation, loaded)
    assert kept._key(evaluation, loaded) == key
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert kept._key(evaluation, loaded) != key
    monkeypatch.undo()
    with jax.enable_x64(not jax.config.jax_enable_x64):
        assert kept._key(evaluation, loaded) != key


def test_what_was_added_beside_results_is_not_deleted(data, tmp_path):
    run([data / "set" / "two"], ["nearest"], tmp_path / "out")
    note = tmp_path / "out" / "two" / "nearest" / "flip" / "note.txt"
    note.write_text("mine")
    before = files_of(note.parents[1])
    with pytest.raises(JaxsrError, match=r"flip: holds note.txt"):
        run([data / "set" / "two"], ["nearest"], tmp_path / "out", frames=(2, 3))
    assert files_of(note.parents[1]) == before


SCRIPT = """
import jax.numpy as jnp
from jaxsr.methods import METHODS

def upscale(net, state, frame):
    state, image = METHODS["nearest"].upscale(net, state, frame)
    return state, image * GAIN

GAIN = {gain}
"""


def mine(monkeypatch, path, gain, closed=1.0):
    """A method in a script of the user's, as `python script.py` would make it."""
    path.write_text(SCRIPT.format(gain=gain))
    module = types.ModuleType("my_script")
    module.__file__ = str(path)
    exec(compile(path.read_text(), path, "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, "my_script", module)

    def upscale(net, state, frame):
        state, image = module.upscale(net, state, frame)
        return state, image * closed

    monkeypatch.setitem(METHODS, "mine", METHODS["nearest"]._replace(name="mine", upscale=upscale))


def test_the_code_of_a_method_of_ones_own_counts(data, tmp_path, monkeypatch, counted):
    def psnr(*arguments):
        mine(monkeypatch, tmp_path / "script.py", *arguments)
        (section,) = run(
            [data / "set" / "one"], ["mine"], tmp_path / "out", SETTINGS._replace(metrics=("psnr",))
        )
        return section.methods[0].metrics["psnr"]

    bright = psnr(1.0)
    assert psnr(1.0) == bright
    assert counted == ["mine"]  # unchanged: kept
    assert psnr(0.25) != bright
    assert psnr(1.0, 0.5) != bright  # a closure holds another value
    assert psnr(1.0) == bright
    assert counted == ["mine"] * 4


def test_a_method_whose_content_is_unknown_is_not_kept(data, tmp_path, monkeypatch, counted):
    lock = threading.Lock()

    def upscale(net, state, frame):
        with lock:
            return METHODS["nearest"].upscale(net, state, frame)

    monkeypatch.setitem(METHODS, "mine", METHODS["nearest"]._replace(name="mine", upscale=upscale))
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"results of 'mine' are not kept.*_thread.lock"):
            run([data / "set" / "one"], ["mine"], tmp_path / "out", SETTINGS._replace(metrics=("psnr",)))
    assert counted == ["mine"] * 2


def test_digests_of_methods_are_stable_and_their_own():
    code = "from jaxsr.methods import METHODS\nfrom jaxsr.evaluation.code import method_digest\n" + (
        "print(*(method_digest(method) for method in METHODS.values()))"
    )
    runs = [
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONHASHSEED": seed},
        ).stdout.split()
        for seed in ("1", "2")
    ]
    assert runs[0] == runs[1]
    assert len(set(runs[0])) == len(METHODS)


@pytest.mark.slow
def test_digests_see_what_functions_hold():
    def made(value):
        return lambda x: x + value

    class Options:
        def __init__(self, weight):
            self.weight = weight

    values = [
        1, 1.0, "1", (1,), [1], {"a": 1}, {"b": 1}, np.ones(2), np.zeros(2), np.zeros(3), jax.numpy.ones(2),
        frozenset({1, 2}), frozenset({1, 3}), Options(1), Options(2), made(1), made(2), np.dtype("int8"),
        functools.partial(made, 1), functools.partial(made, 2), jax.jit(made(1)), jax.jit(made(3)), Options,
    ]  # fmt: skip
    digests = [method_digest(made(value)) for value in values]
    assert len(set(digests)) == len(values)
    assert digests == [method_digest(made(value)) for value in values]
    first, second = {"__name__": "__main__"}, {"__name__": "__main__"}
    exec("def f(x): return x + 1", first)  # as in a notebook: no file
    exec("def f(x): return x + 2", second)
    assert method_digest(first["f"]) != method_digest(second["f"])
