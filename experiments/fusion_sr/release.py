"""Put trained networks into the package, with one model card per network.

    python experiments/fusion_sr/release.py [NAME ...] [--runs DIR]
    python experiments/fusion_sr/release.py --renew

For each run of `train_released.py` that has ended: store its weights as float16 in
`jaxsr/weights/released/NAME.safetensors`, measure that file and the other methods on the test frames of
the sample, and write `docs/models/NAME.md` with data, budget, metrics and limits, and
`experiments/results/NAME.json` with every number of every frame.

`--renew` rewrites the headers of the released files as this version of jaxsr writes them. The arrays do not
change.
"""

import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.fusion_sr.train_released import Run, chosen  # noqa: E402
from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import description  # noqa: E402
from jaxsr.evaluation.evaluate import evaluate  # noqa: E402
from jaxsr.evaluation.running import TRUTH_WORDS, Settings  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.io.truth import Truth  # noqa: E402
from jaxsr.methods import build  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402
from jaxsr.report.documents import as_json  # noqa: E402
from jaxsr.report.results import SequenceResult  # noqa: E402
from jaxsr.report.scores import summary  # noqa: E402
from jaxsr.report.tables import cell, header  # noqa: E402
from jaxsr.runtime.load import settings_of  # noqa: E402
from jaxsr.weights.file import load_weights, new_header, save_weights  # noqa: E402

RIVALS = ("bicubic", "taau", "guided-taau")
MAX_MEGABYTES = 2.0
WEIGHTS, CARDS = ROOT / "jaxsr" / "weights" / "released", ROOT / "docs" / "models"
RESULTS = ROOT / "experiments" / "results"


def main(
    names: Positional[tuple[str, ...]] = (),
    runs: Path = ROOT / "experiments" / "cache" / "runs",
    renew: bool = False,
) -> None:
    """Release these runs; all that have ended by default.

    Args:
        names: of the runs.
        runs: folder of the runs.
        renew: only write the headers of the files that ship anew.
    """
    if renew:
        for name in chosen(names):
            renew_header(WEIGHTS / f"{name}.safetensors")
        return
    for name, run in chosen(names).items():
        file = runs / name / "weights.safetensors"
        if not names and not file.is_file():
            continue
        arrays, head = load_weights(file)
        if head["training"]["steps"] != run.config.steps:
            raise JaxsrError(
                "the run has not ended",
                where=file,
                expected=f"{run.config.steps} steps",
                found=head["training"]["steps"],
                fix="run train_released.py again: it goes on",
            )
        target = WEIGHTS / f"{name}.safetensors"
        save_weights(target, arrays, head, half=True)
        if (size := target.stat().st_size / 1e6) > MAX_MEGABYTES:
            raise JaxsrError(
                "too large", where=target, expected=f"{MAX_MEGABYTES} MB", found=f"{size:.1f} MB"
            )
        release(name, run, target, head)


def renew_header(file: Path) -> None:
    """Write all settings into the header of a file that an earlier version of jaxsr made; the arrays stay.

    Raises:
        JaxsrError: the file is damaged, or the arrays would change.
    """
    arrays, head = load_weights(file)
    settings = settings_of(head, file)
    network = build(head["method"], settings, file).network
    assert network is not None  # `build` knows only methods that learn
    training = dict(head["training"])
    if "arguments" in head:  # version 0.1 kept the weights of the loss among the settings
        names = network.loss_settings
        loss = {name: value for name, value in head["arguments"].items() if name in names}
        training["loss"] = {"ssim_weight": 1.0} | loss  # it was fixed then
    new = new_header(head["method"], settings, head["scale"], training=training)
    new["jaxsr"] = head["jaxsr"]  # that trained it
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / file.name
        save_weights(copy, arrays, new, half=True)
        written, _ = load_weights(copy)
        if written.keys() != arrays.keys() or any((written[k] != arrays[k]).any() for k in arrays):
            raise JaxsrError("the arrays would change", where=file, expected="arrays of float16")
    save_weights(file, arrays, new, half=True)


def release(name: str, run: Run, weights: Path, head: dict[str, Any]) -> None:
    """Measure the file as it ships, and write the card and the numbers."""
    with tempfile.TemporaryDirectory() as folder, Bars() as progress:
        sample = unpack_sample(Path(folder) / "sample", "test", run.scenes, run.config.scale, progress)
        sections = evaluate(
            sample,
            [*RIVALS, str(weights)],
            Path(folder) / "out",
            Settings(scale=run.config.scale),
            truth=truth_of(head),
            title=name,
            progress=progress,
        )
    meta = description(weights=weights.name, truth=truth_of(head))
    results = as_json(sections, title=name, meta=meta)
    write(RESULTS / f"{name}.json", json.dumps(results, indent=1) + "\n")
    write(CARDS / f"{name}.md", card(name, run, head, sections, weights))
    print(f"{weights.name}: {weights.stat().st_size / 1e6:.2f} MB")


def truth_of(head: dict[str, Any]) -> Truth:
    """What a network was trained on, and is measured against; before there was a choice it was the colour."""
    truth: Truth = head["training"]["config"].get("truth", "color")
    return truth


def table(sections: list[SequenceResult]) -> list[str]:
    """Means over the frames of each scene."""
    keys = sections[0].metric_keys()
    lines = [
        "| test clip | method | " + " | ".join(map(header, keys)) + " |",
        "|---|---|" + "---:|" * len(keys),
    ]
    for section in sections:
        everything = section.subsets()["all"]
        for result in section.methods:
            cells = [cell(summary(result, key, everything), key) for key in keys]
            lines.append(f"| {section.title.split(',')[0]} | `{result.name}` | " + " | ".join(cells) + " |")
    return lines


def card(name: str, run: Run, head: dict[str, Any], sections: list[SequenceResult], weights: Path) -> str:
    """The model card as Markdown."""
    sizes = {name: math.prod(array.shape) for name, array in load_weights(weights)[0].items()}
    statistics = sum(size for name, size in sizes.items() if name.endswith((".mean", ".var")))
    training, settings = head["training"], head["settings"]
    values = {**settings, **training["loss"], **training["config"], **training["made"]}
    values |= {
        "name": name,
        "truth": TRUTH_WORDS[truth_of(head)],
        "weights": f"{sum(sizes.values()) - statistics:,}",
        "statistics": f"{statistics:,}",
        "megabytes": f"{weights.stat().st_size / 1e6:.2f}",
        "buffers": ", ".join(settings["buffers"]),
        "color": "lighting" if settings["demodulated"] else "display",
        "clips": len(training["sequences"]),
        "scenes": ", ".join(run.scenes),
        "hours": f"{training['seconds'] / 3600:.2f}",
        "origin": f"; starts from the weights of [`{run.start}`]({run.start}.md)" if run.start else "",
        "track": sections[0].methods[-1].name,
        "table": "\n".join(table(sections)),
        "measured": time.strftime("%Y-%m-%d"),
        "day": training["made"]["date"][:10],
    }
    return (Path(__file__).parent / "model_card.md.in").read_text(encoding="utf-8").format(**values)


def write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
