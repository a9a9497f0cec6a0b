"""What README promises: commands in the form that CI relies on, numbers of the committed results."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from experiments.demo_results import BEGIN, END, picture, readme_block
from jaxsr.data import analytic
from jaxsr.frames import FIELDS
from jaxsr.io.images import write_png
from jaxsr.report.results import MethodResult, SequenceResult

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def test_one_command_under_each_heading():
    for heading in ("Run it", "Test it"):
        section = README.split(f"## {heading}\n")[1].split("\n## ")[0]
        blocks = re.findall(r"```sh\n(.*?)```", section, re.S)
        assert len(blocks) == 1
        assert len(blocks[0].strip().splitlines()) == 1


def test_results_are_those_of_the_committed_run():
    document = json.loads((ROOT / "experiments/results/demo.json").read_text())
    assert README.split(BEGIN)[1].split(END)[0].strip() == readme_block(document).strip()


def test_better_methods_are_better_on_every_scene_and_scale():
    """The claims of README, against the anti-aliased reference: temporal over interpolated, guided-taau at
    least half a decibel over TAAU, the network that corrects it over all."""
    document = json.loads((ROOT / "experiments/results/demo.json").read_text())
    assert len(document["sections"]) == 12
    for section in document["sections"]:
        subset = "extrapolated" if any(section["extrapolated"]) else "all"
        psnr = {t["name"]: t["summary"][subset]["psnr"]["mean"] for t in section["tracks"]}
        assert psnr["taau"] > max(psnr["nearest"], psnr["bilinear"])
        assert section["meta"]["truth"] == "reference"
        assert psnr["guided-taau"] > psnr["taau"] + 0.5
        if subset == "all":
            by_name = {t["name"]: t["summary"][subset] for t in section["tracks"]}
            network, others = by_name.pop("guided-unet"), by_name.values()
            assert network["psnr"]["mean"] > max(o["psnr"]["mean"] for o in others)
            assert network["ssim"]["mean"] > max(o["ssim"]["mean"] for o in others)


def test_pictures_of_frames_in_memory_and_on_disk_are_alike(tmp_path):
    rng = np.random.default_rng(0)
    truth = np.rint(rng.random((80, 128, 3)) * 255) / 255
    low, made = truth[::2, ::2], truth.copy()
    made[20:60, 40:104] = 0

    def section(convert):
        results = [
            MethodResult(name, [convert(name, image)], {"psnr": [20.0]}) for name, image in images.items()
        ]
        truths, inputs = [convert("truth", truth)], [convert("input", low)]
        return SequenceResult(
            "a",
            [6],
            truths,
            results,
            inputs=inputs,
            extrapolated=[False],
            meta={"sequence": "a-0", "scale": 2},
        )

    def on_disk(name, image):
        write_png(tmp_path / f"{name}.png", np.rint(image * 255).astype(np.uint8))
        return tmp_path / f"{name}.png"

    images = {"bilinear": made, "taau": truth}
    in_memory = picture([section(lambda _, image: image)], "super-resolution", 6)
    np.testing.assert_array_equal(in_memory, picture([section(on_disk)], "super-resolution", 6))
    # The truth, and crops of the input, both methods and the truth; the first method is black where it errs.
    assert in_memory.shape == (40 * 4 + 22 + 4, 256 + 4 + 4 * (256 + 4), 3)
    assert not in_memory[30:150, 540:760].any()


PAGES = sorted(
    {
        *ROOT.glob("*.md"),
        *(p for d in ("docs", "benchmarks", "experiments") for p in (ROOT / d).rglob("*.md")),
    }
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_is_finished_and_its_links_lead_somewhere(page):
    text = page.read_text()
    assert not re.search("PLACEHOLDER|TODO|FIXME", text)
    for target in re.findall(r"\]\(([^)#:{]+)\)", text):
        assert (page.parent / target).exists(), target


def test_the_examples_of_readme_run():
    import jax
    import jax.numpy as jnp

    streaming, extrapolating = re.findall(r"```python\n(.*?)```", README, re.S)
    frames = []
    for t in range(2):
        frame, truth = analytic.frame(t, (32, 24), 4, (0.25, -0.1))
        lr, hr = ({n: getattr(g, f) for n, f in FIELDS.items()} for g in (frame.lr, frame.hr))
        frames.append(lr | {"color": frame.color_linear, "jitter": (0.25, -0.1), "hr": hr})
    scope: dict = {"frames": frames}
    exec(streaming, scope)  # our own page
    assert scope["image"].shape == (24, 32, 3)
    assert float(jnp.mean(jnp.abs(scope["image"] - truth))) < 0.1

    scope = {}
    exec(extrapolating, scope)
    gbuffer = jax.tree.map(jnp.asarray, frame.hr)
    image, confidence = scope["extrapolate"](jnp.asarray(truth), gbuffer, gbuffer, jnp.zeros((24, 32, 2)))
    assert float(jnp.mean(jnp.abs(image - truth))) < 0.03  # its four best candidates lie side by side
    assert float(confidence.min()) == 1.0
