"""The methods that ship on the 960x540 test set, against both truths.

    python experiments/make_datasets.py render --set test --size 960 540 --clips 1 --frames 8
    python experiments/test_set.py DATASETS/test

Frames 5 to 8 of each scene, after a warm-up of four: no network and no constant has seen these clips. Writes
experiments/results/test_set.json and .md. LPIPS is left out for its time unless `--lpips` asks for it.
"""

import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402

from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.evaluation.demo import LEARNED, UPSCALERS, description  # noqa: E402
from jaxsr.evaluation.evaluate import evaluate  # noqa: E402
from jaxsr.evaluation.measuring import metrics_with  # noqa: E402
from jaxsr.evaluation.running import TRUTH_WORDS, Settings  # noqa: E402
from jaxsr.files import atomic_path  # noqa: E402
from jaxsr.io.truth import TRUTHS, Truth  # noqa: E402
from jaxsr.progress import Bars  # noqa: E402
from jaxsr.report.documents import as_json  # noqa: E402
from jaxsr.report.scores import summary  # noqa: E402
from jaxsr.report.tables import cell, header  # noqa: E402
from jaxsr.runtime.load import shipped_scales  # noqa: E402

RESULTS = ROOT / "experiments" / "results"
WARMUP = 4


@dataclass(frozen=True)
class Config:
    data: Annotated[Path, tyro.conf.Positional]
    """Folder of the test set."""
    scales: tuple[int, ...] = (2, 4)
    truths: tuple[Truth, ...] = TRUTHS
    lpips: bool = False


def main(config: Config) -> None:
    start, documents, lines = time.monotonic(), dict[str, Any](), list[str]()
    for truth in config.truths:
        for scale in config.scales:
            names = [n for n in UPSCALERS if n != "nearest"]
            names += [n for n in LEARNED if scale in shipped_scales(n)]
            settings = Settings(scale, warmup=WARMUP, metrics=metrics_with(config.lpips))
            with tempfile.TemporaryDirectory() as out, Bars() as bars:
                sections = evaluate(
                    [config.data],
                    names,
                    Path(out) / "out",
                    settings,
                    frames=(1, 8),
                    truth=truth,
                    progress=bars,
                )
            documents[f"{truth}/x{scale}"] = as_json(sections, title=f"test set, x{scale}, {truth}", meta={})
            keys = sections[0].metric_keys()
            lines += [
                f"x{scale}, against {TRUTH_WORDS[truth]}:",
                "",
                "| scene | method | " + " | ".join(map(header, keys)) + " |",
                "|---|---|" + "---:|" * len(keys),
            ]
            for section in sections:
                for result in section.methods:
                    cells = [cell(summary(result, key, section.subsets()["all"]), key) for key in keys]
                    scene = str(section.meta["sequence"]).split("-")[0]
                    lines.append(f"| {scene} | `{result.name}` | {' | '.join(cells)} |")
            lines.append("")
    meta = description(
        seconds=round(time.monotonic() - start),
        seed="none: nothing is random",
        warmup=WARMUP,
        script="experiments/test_set.py",
    )
    with atomic_path(RESULTS / "test_set.json") as temporary:
        temporary.write_text(json.dumps({"meta": meta, **documents}, indent=1) + "\n")
    title = f"Measured by `experiments/test_set.py` at {meta['commit']} on {meta['date']} ({meta['device']})."
    note = "960x540, frames 5 to 8, mean ± standard deviation over frames, display-referred colour, no crop."
    with atomic_path(RESULTS / "test_set.md") as temporary:
        temporary.write_text("\n".join([title, note, "", *lines]))
    print("\n".join(lines))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except JaxsrError as error:
        raise SystemExit(f"test_set: {error}") from None
