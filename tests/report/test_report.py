"""The comparison page holds everything, asks for nothing, and has the numbers right; tables, JSON and CSV."""

import base64
import csv
import html.parser
import io
import json
import math
import re
import shutil
import subprocess
import tempfile

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from jaxsr.errors import JaxsrError
from jaxsr.evaluation.measuring import measured
from jaxsr.io.images import write_png
from jaxsr.metrics import available
from jaxsr.report import embedding
from jaxsr.report.documents import as_csv, as_json, write_metrics
from jaxsr.report.page import write_report
from jaxsr.report.results import MethodResult, SequenceResult, Timing
from jaxsr.report.scores import best, summarise, summary
from jaxsr.report.tables import markdown, rich_tables

H, W, N = 16, 24, 4


def picture(i, offset=0.0):
    y, x = np.mgrid[0:H, 0:W]
    image = np.stack([0.5 + 0.3 * np.sin(0.5 * x + i + c) * np.cos(0.4 * y) for c in range(3)], -1)
    return np.clip(image + offset, 0, 1).astype(np.float32)


def sections():
    truths = [picture(i) for i in range(N)]
    close, far = [picture(i, 0.02) for i in range(N)], [picture(i, 0.1) for i in range(N)]
    hold = [truths[i - i % 2] for i in range(N)]
    timing = Timing(compile_s=1.25, median_ms=12.34, spread_ms=0.5)
    plain = SequenceResult(
        "hall, x2",
        [5, 6, 7, 8],
        truths,
        [measured("Close", close, truths, timing=timing), measured("Far & <b>wide</b>", far, truths)],
        [t[::2, ::2] for t in truths],
        exposures=(1.5,),
    )
    half = SequenceResult(
        "hall, every second frame extrapolated",
        [5, 6, 7, 8],
        truths,
        [measured("Hold", hold, truths, note="repeats </script> the last"), measured("Close", close, truths)],
        [None if i % 2 else t for i, t in enumerate(truths)],
        [bool(i % 2) for i in range(N)],
    )
    return [plain, half]


@pytest.fixture(scope="module")
def made():
    return sections()


@pytest.fixture(scope="module")
def page(made, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    meta = {
        "device": "2-core CPU",
        "versions": {"jax": "0.10"},
        "odd": "</script><img src=x>",
        "scenes": ["a", "b"],
    }
    assert write_report(path, made, title="A & B <tests>", meta=meta) == path
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    return path.read_text("utf-8")


class Parser(html.parser.HTMLParser):
    """Checks nesting and collects attributes and the text of elements."""

    VOID = frozenset({"meta", "input", "br", "img", "link"})

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.texts, self.key = [], [], {}, ""

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, k, v) for k, v in attrs]
        self.key = dict(attrs).get("id", tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):  # <path .../> of SVG
        self.attributes += [(tag, k, v) for k, v in attrs]

    def handle_data(self, data):
        self.texts.setdefault(self.key, []).append(data)


def parsed(page):
    parser = Parser()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def payload(page):
    return json.loads("".join(parsed(page).texts["data"]))


def decoded(uri):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGB"))


def test_page_is_well_formed_and_self_contained(page):
    parser = parsed(page)
    assert not re.search(r"https?://", page)
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", page)
    assert not [a for a in parser.attributes if a[1] in ("src", "href", "srcset", "data", "action")]
    policy = next(v for tag, k, v in parser.attributes if k == "content" and "default-src" in v)
    assert "default-src 'none'" in policy
    assert not re.search(r"@[A-Z]{2,}@", page)
    assert "A &amp; B &lt;tests&gt;" in page
    assert "<tests>" not in page
    assert page.count("</script>") == 2  # the data and the program: no string ends one early


def test_page_holds_all_numbers(page, made):
    data = payload(page)
    for given, section in zip(made, data["sections"], strict=True):
        assert section["title"] == given.title
        assert section["frames"] == list(given.frames)
        for result, found in zip(given.methods, section["tracks"], strict=True):
            assert found["name"] == result.name
            for key, values in result.metrics.items():
                back = [math.inf if v == "inf" else v for v in found["metrics"][key]]
                assert back == values
    text = re.sub(r"<[^>]+>", "", page[: page.index('id="data"')])
    far = summary(made[0].methods[1], "psnr", range(N))
    assert f"{far.mean:.2f}" in text
    for words in (
        "12.3 ± 0.50",
        "2-core CPU",
        "versions · jax",
        "a, b",
        "sRGB(clip(ACES",
        "67 pixels per degree",
    ):
        assert words in text
    assert "repeats &lt;/script&gt; the last" in text
    assert "Crop" in text


def test_images_come_back_without_loss_and_once(page, made):
    data = payload(page)
    assert "WebP, lossless" in page
    for given, section in zip(made, data["sections"], strict=True):
        for i in range(N):
            truth = np.rint(255 * given.truths[i]).astype(np.uint8)
            assert np.array_equal(decoded(data["images"][section["truth"][i]]), truth)
            for result, found in zip(given.methods, section["tracks"], strict=True):
                image = np.rint(255 * result.images[i]).astype(np.uint8)
                assert np.array_equal(decoded(data["images"][found["images"][i]]), image)
    first, second = data["sections"]
    assert first["truth"] == second["truth"]
    assert first["tracks"][0]["images"] == second["tracks"][1]["images"]
    assert second["input"] == [second["truth"][0], None, second["truth"][2], None]
    assert second["extrapolated"] == [False, True, False, True]
    assert first["size"] == [W, H]
    assert first["input_note"] == f"{W // 2}×{H // 2}, pixels enlarged"
    flip = decoded(data["images"][first["tracks"][1]["flip"][0]])
    assert flip.mean() / 255 == pytest.approx(made[0].methods[1].metrics["flip"][0], abs=0.02)
    assert len(data["colormap"]) == 6 * 256


def test_a_small_budget_costs_quality_then_frames(made, tmp_path):
    rng = np.random.default_rng(0)
    truths = [rng.random((64, 64, 3)).astype(np.float32) for _ in range(8)]
    result = MethodResult("noise", [1 - t for t in truths], {"psnr": [10.0] * 8})
    section = SequenceResult(
        "s", list(range(8)), truths, [result], extrapolated=[bool(i % 2) for i in range(8)]
    )
    sizes, names = [], []
    for megabytes in (1.0, 0.2, 0.12, 0.05):
        page = write_report(tmp_path / "r.html", [section], title="t", max_megabytes=megabytes).read_text()
        data = payload(page)
        sizes.append(sum(map(len, data["images"])))
        names.append(re.search(r"<dt>Embedded as</dt><dd>([^<]*)", page)[1])
        assert sizes[-1] <= 1.15e6 * megabytes
    assert sizes == sorted(sizes, reverse=True)
    assert names[0] == "WebP, lossless (8 bits a channel); no error beyond 8 bits"
    assert "rms" in names[1]
    assert "of 8 frames have images here" in names[3]
    shown = data["sections"][0]["embedded"]
    assert 0 < sum(shown) < 8
    assert [x is not None for x in data["sections"][0]["truth"]] == shown
    kinds = {x for x, s in zip(section.extrapolated, shown, strict=True) if s}
    assert kinds == {False, True}


@pytest.mark.parametrize(("name", "worst"), list(zip(embedding.ENCODINGS, (0, 1, 2, 12, 20), strict=False)))
def test_error_of_encodings(name, worst):
    image = np.rint(255 * picture(1)).astype(np.uint8)
    image[0, 0], image[0, 1] = 255, 0
    error = embedding.decoded_error(image, embedding.ENCODINGS[name][1](image))
    assert abs(error).max() <= worst


def test_paths_and_arrays_make_the_same_page(tmp_path):
    truths = [np.rint(255 * picture(i)).astype(np.float32) / np.float32(255) for i in range(2)]
    for i, truth in enumerate(truths):
        write_png(tmp_path / f"{i}.png", truth)
    paths = [tmp_path / f"{i}.png" for i in range(2)]
    pages = []
    for images in (truths, paths):
        section = SequenceResult(
            "s", [0, 1], images, [MethodResult("a", images[::-1], {"psnr": [20.0, 21.0]})]
        )
        pages.append(write_report(tmp_path / "r.html", [section], title="t").read_text())
    assert pages[0] == pages[1]


def test_bad_sections_and_images(made, tmp_path):
    truths, result = made[0].truths, made[0].methods[0]

    def section(**changes):
        given = {"title": "s", "frames": [1, 2, 3, 4], "truths": truths, "methods": [result]}
        return SequenceResult(**{**given, **changes})

    for words, changes in {
        "no frames": {"frames": []},
        "no methods": {"methods": []},
        "two methods have the same name": {"methods": [result, result]},
        r"truths: wrong number; expected 4 \(frames\); found 3": {"truths": truths[:3]},
        "images of Close: wrong number": {"methods": [MethodResult("Close", truths[:2], {})]},
        "psnr of t: wrong number": {"methods": [MethodResult("t", truths, {"psnr": [1.0]})]},
        "unknown metric 'vmaf'": {"methods": [MethodResult("t", truths, {"vmaf": [1.0] * 4})]},
    }.items():
        with pytest.raises(JaxsrError, match=words):
            section(**changes)
    small, nan = [t[:-1] for t in truths], [t.copy() for t in truths]
    nan[2][0, 0, 0] = np.nan
    (tmp_path / "file").write_text("x")
    for words, changes, path in (
        ("s, t, frame 1: wrong size", {"methods": [MethodResult("t", small, {})]}, "r.html"),
        ("truth frames differ in size", {"truths": [*truths[:3], small[0]]}, "r.html"),
        ("input frames differ in size", {"inputs": [*truths[:3], small[0]]}, "r.html"),
        ("s, t, frame 3: image is not display-referred", {"methods": [MethodResult("t", nan, {})]}, "r.html"),
        ("none.png: no such file", {"truths": [tmp_path / "none.png"] * 4}, "r.html"),
        ("cannot write", {}, "file/r.html"),
    ):
        with pytest.raises(JaxsrError, match=words):
            write_report(tmp_path / path, [section(**changes)], title="t")
    with pytest.raises(JaxsrError, match="no sections"):
        write_report(tmp_path / "r.html", [], title="t")
    with pytest.raises(JaxsrError, match="max_megabytes: must be a number above 0"):
        write_report(tmp_path / "r.html", made, title="t", max_megabytes=0)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_summaries():
    assert summarise([30.0, 34.0]).mean == 32.0
    assert summarise([30.0, 34.0]).spread == 2.0
    mixed = summarise([None, math.inf, 20.0])
    assert (mixed.mean, mixed.spread, mixed.frames, mixed.identical) == (20.0, 0.0, 1, 1)
    assert summarise([math.inf, math.inf]).mean == math.inf
    assert summarise([None]).mean is None
    assert summarise([]).mean is None
    with pytest.raises(JaxsrError, match="NaN"):
        summarise([1.0, math.nan])


def test_best_marks_ties_at_shown_digits_and_direction(made):
    truths = made[0].truths
    values = {"a": (30.001, 0.2), "b": (30.002, 0.1), "c": (29.0, 0.3)}
    results = [MethodResult(n, truths, {"psnr": [p] * N, "flip": [f] * N}) for n, (p, f) in values.items()]
    section = SequenceResult("s", range(N), truths, results)
    assert best(section, "psnr", range(N)) == {"a", "b"}
    assert best(section, "flip", range(N)) == {"b"}
    assert best(SequenceResult("s", range(N), truths, results[:1]), "psnr", range(N)) == set()  # no contest
    lacking = [*results, MethodResult("d", truths, {})]
    assert best(SequenceResult("s", range(N), truths, lacking), "psnr", range(N)) == {"a", "b"}


def test_extrapolated_frames_are_averaged_apart(made):
    section = made[1]
    assert section.subsets() == {"extrapolated": [1, 3], "rendered": [0, 2], "all": [0, 1, 2, 3]}
    hold = section.methods[0]
    assert summary(hold, "psnr", [0, 2]).mean == math.inf
    assert summary(hold, "psnr", [1, 3]).mean < 40
    assert summary(hold, "psnr", range(N)).identical == 2
    assert best(section, "psnr", [0, 2]) == {"Hold"}
    assert best(section, "psnr", [1, 3]) == {"Close"}


def test_json_csv_markdown_and_terminal(made, tmp_path):
    write_metrics(tmp_path, made, title="t", meta={"seed": np.int64(3), "path": tmp_path})
    text = (tmp_path / "metrics.json").read_text()
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert data == as_json(made, title="t", meta={"seed": 3, "path": str(tmp_path)})
    assert data["format"] == "jaxsr-metrics"
    assert data["meta"]["seed"] == 3
    assert data["metrics"]["psnr"]["higher_is_better"] is True
    plain, half = data["sections"]
    assert plain["tracks"][0]["timing"] == {"compile_s": 1.25, "median_ms": 12.34, "spread_ms": 0.5}
    assert plain["tracks"][1]["timing"] is None
    assert half["tracks"][0]["metrics"]["psnr"][0] == "inf"
    assert half["tracks"][0]["metrics"]["tpsnr"][0] is None
    assert half["tracks"][0]["summary"]["all"]["psnr"]["identical"] == 2
    rows = list(csv.DictReader(io.StringIO(as_csv(made))))
    assert (tmp_path / "metrics.csv").read_text() == as_csv(made)
    assert len(rows) == 2 * 2 * N
    assert [r["extrapolated"] for r in rows[2 * N : 3 * N]] == ["0", "1", "0", "1"]
    assert float(rows[2 * N]["psnr"]) == math.inf
    assert rows[0]["tpsnr"] == ""
    assert float(rows[1]["flip"]) == made[0].methods[0].metrics["flip"][1]
    mark = markdown(made)
    columns = 1 + len(available()) + 2
    assert mark.count("|---") == 4 * columns - 3 * 2  # two timing columns only in the first table
    close = summary(made[0].methods[0], "psnr", range(N))
    assert f"| **{close.mean:.2f} ± {close.spread:.2f}** |" in mark
    console = Console(width=80, record=True, file=io.StringIO())
    for table in rich_tables(made):
        console.print(table)
    shown = console.export_text()
    assert f"{close.mean:.2f}" in shown
    assert "Far & <b>wide</b>" in shown
    assert "∞" in shown
    assert max(map(len, shown.splitlines())) <= 80
    assert "…" not in shown  # nothing is cut at 80 columns


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
def test_the_viewer_runs_in_a_browser(page, tmp_path):
    (tmp_path / "r.html").write_text(page, "utf-8")
    state = "section=1&frame=6&left=truth&right=hold&view=error&scale=0.1&split=0.25&subset=rendered"
    with tempfile.TemporaryDirectory() as profile:
        command = (
            "chromium --headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
            "--disable-background-networking --disable-component-update --disable-sync"
        )
        options = [f"--user-data-dir={profile}", "--virtual-time-budget=3000", "--dump-dom"]
        address = f"file://{tmp_path}/r.html#{state}"
        done = subprocess.run([*command.split(), *options, address], capture_output=True, timeout=120)
    dom = done.stdout.decode()
    assert re.search(r'<output id="frame-name"[^>]*>6 .*extrapolated', dom)
    assert re.search(r'aria-checked="true"[^>]*>Error<|data-value="error"[^>]*aria-checked="true"', dom)
    assert 'aria-valuetext="Truth 25 percent, Hold the rest"' in dom
    visible = re.findall(
        r'<div class="result scroll" data-section="(\d)" data-subset="(\w+)" data-region="all">', dom
    )
    assert visible == [("1", "rendered")]
    assert re.findall(r'<div class="chart" data-key="(\w+)">', dom) == list(available())
