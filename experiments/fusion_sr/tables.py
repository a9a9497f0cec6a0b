"""The fusion paper's tables from the numbers of `study.py`: JSON, Markdown, a chart, crops; the page of docs.

    python experiments/fusion_sr/tables.py [table1 table3 table4 table5 figure11] [--runs DIR]

Each becomes `experiments/results/fusion_sr/TABLE.json` and `.md`, `docs/images/fusion_TABLE.png` (our numbers
beside the paper's), and its part of `docs/results_fusion_sr.md`. Where the frames of a run are still in the
folder of the runs, crops are drawn as well: `docs/images/fusion_TABLE_SCENE.png`. Nothing is measured here.

A number is the mean over the measured frames of a scene, then over the seeds that all networks of the table
were trained with; the number after ± is half the distance between the lowest and the highest seed.
"""

import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

from experiments.fusion_sr.figures import Shown, sheet  # noqa: E402
from experiments.fusion_sr.study import (  # noqa: E402
    RESULTS,
    RUNS,
    SCALE,
    VARIANTS,
    WARM_UP,
    results_file,
    settings_of,
)
from jaxsr.data.sample import unpack_sample  # noqa: E402
from jaxsr.errors import JaxsrError  # noqa: E402
from jaxsr.io.exr import atomic_path  # noqa: E402
from jaxsr.io.images import read_png, write_png  # noqa: E402
from jaxsr.io.sequence import Sequence as FrameSequence  # noqa: E402
from jaxsr.metrics import METRICS  # noqa: E402
from jaxsr.runtime.upscale import display  # noqa: E402

PAGE = ROOT / "docs" / "results_fusion_sr.md"
IMAGES = ROOT / "docs" / "images"
SCENES = ("bunker", "forest", "docks")
KEYS = ("psnr", "ssim", "lpips", "flip", "tpsnr")
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "flip": 4, "tpsnr": 2}
FRAME = 6
"""Number of the frame in the pictures."""

Paper = Mapping[str, Mapping[str, tuple[float, float]]]
"""PSNR and SSIM by scene and variant, as printed."""


@dataclass(frozen=True)
class Table:
    """What is compared, and what the paper has for it."""

    title: str
    variants: tuple[str, ...]
    paper: Paper = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    """Scenes to draw crops of."""
    not_pictured: tuple[str, ...] = ()
    """Left out of the crops, which become too small otherwise."""
    reference: str = "fusion"
    """The variant with which the PSNR of the others is compared."""


TABLES = {
    "table1": Table(
        "Table 1: methods",
        ("bicubic", "taau", "guided-taau", "rcan", "nsrr", "rrn", "fusion", "fusion-zero", "fusion-guided"),
        {
            "bunker": {
                "rcan": (26.54, 0.7966),
                "nsrr": (24.88, 0.7604),
                "rrn": (27.79, 0.8114),
                "fusion": (28.42, 0.9041),
            },
            "forest": {
                "rcan": (18.68, 0.3910),
                "nsrr": (17.25, 0.4228),
                "rrn": (19.98, 0.4071),
                "fusion": (24.25, 0.8712),
            },
            "docks": {
                "rcan": (21.24, 0.6840),
                "nsrr": (20.79, 0.7006),
                "rrn": (22.82, 0.7058),
                "fusion": (25.37, 0.8705),
            },
        },
        ("bunker", "forest", "docks"),
        ("bicubic", "guided-taau", "fusion"),
    ),
    "table3": Table(
        "Table 3: how features meet",
        ("add", "concat", "fusion", "fusion-zero"),
        {
            "bunker": {"add": (27.86, 0.8916), "concat": (28.00, 0.8959), "fusion": (28.42, 0.9041)},
            "forest": {"add": (23.91, 0.8641), "concat": (24.10, 0.8675), "fusion": (24.25, 0.8712)},
            "docks": {"add": (25.14, 0.8732), "concat": (25.32, 0.8683), "fusion": (25.37, 0.8705)},
        },
        ("bunker",),
    ),
    "table4": Table(
        "Table 4: without one buffer",
        ("no-base-color", "no-normal", "no-depth", "no-metallic", "no-roughness", "fusion-zero"),
        {
            "bunker": {
                "no-base-color": (27.91, 0.8778),
                "no-normal": (27.43, 0.8748),
                "no-depth": (28.01, 0.8974),
                "no-metallic": (28.19, 0.9013),
                "no-roughness": (28.13, 0.8948),
                "fusion-zero": (28.42, 0.9041),
            }
        },
        reference="fusion-zero",
    ),
    "table5": Table(
        "Table 5: depth alone, against NSRR",
        ("depth-only", "nsrr", "fusion-zero"),
        {"docks": {"depth-only": (22.40, 0.7305), "nsrr": (20.79, 0.7006), "fusion-zero": (25.37, 0.8705)}},
        reference="fusion-zero",
    ),
    "figure11": Table(
        "Figure 11: one branch", ("unet", "fusion", "fusion-zero"), {}, ("docks",), reference="fusion-zero"
    ),
}


class Value(NamedTuple):
    """A mean over seeds, and half the distance between the lowest and the highest."""

    mean: float
    spread: float
    seeds: int


def load(results: Path = RESULTS) -> dict[str, list[dict[str, Any]]]:
    """The runs that have numbers, by variant, in the order of their seeds."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name, variant in VARIANTS.items():
        files = [results_file(name, 0, results)]
        if variant.changes is not None:
            files = sorted(results.glob(f"{name}-s*.json"))
        runs = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.is_file()]
        if runs:
            found[name] = runs
    return found


def value(runs: list[dict[str, Any]], scene: str, key: str, region: str = "all") -> Value | None:
    """Of a metric on a scene; None if it was not measured."""
    means = []
    for run in runs:
        here = run["scenes"][scene]
        metrics = here["metrics"] if region == "all" else here["regions"][region]
        numbers = [v for v in metrics.get(key, ()) if v is not None]
        if not numbers:
            return None
        means.append(statistics.fmean(numbers))
    return Value(statistics.fmean(means), (max(means) - min(means)) / 2, len(means))


def difference(runs: list[dict[str, Any]], others: list[dict[str, Any]], scene: str) -> Value | None:
    """PSNR less that of others, seed against seed; what learns nothing is against each. None for itself."""
    if runs is others:
        return None
    pairs = [
        (run, other) for run in runs for other in others if run.get("seed", other["seed"]) == other["seed"]
    ]
    values = [_psnr(run, scene) - _psnr(other, scene) for run, other in pairs]
    return Value(statistics.fmean(values), (max(values) - min(values)) / 2, len(values)) if values else None


def _psnr(run: dict[str, Any], scene: str) -> float:
    return statistics.fmean(run["scenes"][scene]["metrics"]["psnr"])


def shown(found: Value | None, key: str) -> str:
    """A cell."""
    if found is None:
        return "–"
    digits = DIGITS[key]
    text = f"{found.mean:.{digits}f}"
    return text if found.seeds < 2 else f"{text} ± {found.spread:.{digits}f}"


def document(name: str, runs: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """All numbers of a table, and where they come from.

    Raises:
        JaxsrError: a variant was not measured, or the runs did not see the same.
    """
    table = TABLES[name]
    if missing := [variant for variant in table.variants if variant not in runs]:
        raise JaxsrError(
            f"no numbers of {', '.join(missing)}",
            where=RESULTS,
            fix=f"python experiments/fusion_sr/study.py {' '.join(missing)}",
        )
    here = _common({variant: runs[variant] for variant in table.variants})
    _check_fair(here)
    scenes: dict[str, Any] = {}
    for scene in table.paper or SCENES:
        scenes[scene] = {
            variant: {
                "measured": {
                    key: found._asdict() for key in KEYS if (found := value(here[variant], scene, key))
                },
                "less_reference": apart._asdict()
                if (apart := difference(here[variant], here[table.reference], scene))
                else None,
                "paper": dict(zip(("psnr", "ssim"), printed, strict=True))
                if (printed := table.paper.get(scene, {}).get(variant))
                else None,
            }
            for variant in table.variants
        }
    made = [run for found in here.values() for run in found]
    trained = [run for run in made if "trained" in run]
    return {
        "title": table.title,
        "reference": table.reference,
        "budget": _budget(trained),
        "learning_rates": {
            variant: found[0]["config"]["learning_rate"]
            for variant, found in here.items()
            if "config" in found[0]
        },
        "frames": made[0]["scenes"][next(iter(scenes))]["frames"],
        "seeds": {
            variant: [run["seed"] for run in found if "seed" in run] for variant, found in here.items()
        },
        "commits": sorted({run["trained"]["commit"] or "unknown" for run in trained}),
        "measured_at": sorted({run["measured"]["commit"] or "unknown" for run in made}),
        "devices": sorted({run["trained"]["device"] for run in trained}),
        "hours": round(sum(run["trained"]["seconds"] for run in trained) / 3600, 2),
        "dates": sorted({run["measured"]["date"] for run in made}),
        "display": made[0]["measured"]["display"],
        "costs": {variant: found[0]["cost"] for variant, found in here.items()},
        "scenes": scenes,
    }


def _budget(trained: list[dict[str, Any]]) -> dict[str, Any]:
    config = trained[0]["config"]
    names = ("steps", "batch", "crop", "scale", "schedule", "clip_norm")
    return {name: config[name] for name in names} | {"clips": len(trained[0]["sequences"])}


def _common(here: dict[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """The runs of the seeds that all networks were trained with.

    Raises:
        JaxsrError: there are none.
    """
    seeds = [{run["seed"] for run in found} for found in here.values() if "trained" in found[0]]
    if not (common := set.intersection(*seeds)):
        raise JaxsrError("no seed that all were trained with", where=RESULTS, fix="run study.py to its end")
    return {v: [run for run in found if run.get("seed") in {None, *common}] for v, found in here.items()}


def _check_fair(here: Mapping[str, list[dict[str, Any]]]) -> None:
    """Raise JaxsrError unless all were trained on the same, as long, and measured on the same frames."""
    runs = [run for found in here.values() for run in found]
    trained = [run for run in runs if "trained" in run]

    def same(what: str, of: Callable[[dict[str, Any]], Any], among: list[dict[str, Any]]) -> None:
        for run in among:
            if of(run) != of(among[0]):
                raise JaxsrError(
                    f"{what} of {run['name']} are not those of {among[0]['name']}",
                    where=RESULTS,
                    expected=of(among[0]),
                    found=of(run),
                    fix=f"remove the files and runs of {run['name']}, and run study.py",
                )

    def without(run: dict[str, Any], *names: str) -> dict[str, Any]:
        return {name: value for name, value in run["config"].items() if name not in names}

    # Between methods the learning rate may differ, between seeds of one nothing else.
    same("options", lambda run: without(run, "seed", "learning_rate"), trained)
    for found in here.values():
        same("options", lambda run: without(run, "seed"), [run for run in found if "trained" in run])
    same("training clips", lambda run: run["sequences"], trained)
    same("test clips", lambda run: {s: (v["sequence"], v["frames"]) for s, v in run["scenes"].items()}, runs)
    same("display", lambda run: run["measured"]["display"], runs)
    for run in trained:
        network = VARIANTS[run["name"]].build().network
        assert network is not None
        expected, found = {**network.settings, **network.loss_settings}, settings_of(run)
        if found != expected:
            raise JaxsrError(
                f"{run['name']} was another network",
                where=RESULTS,
                expected=expected,
                found=found,
                fix=f"remove the files and runs of {run['name']}, and run study.py",
            )


def markdown(found: Mapping[str, Any]) -> list[str]:
    """The table: one block of rows per scene, with the paper's number beside each of ours."""
    keys = [k for k in KEYS if all(k in v["measured"] for s in found["scenes"].values() for v in s.values())]
    head = []
    for key in keys:
        unit = f" ({METRICS[key].unit})" if METRICS[key].unit else ""
        head += [METRICS[key].label + unit, *(["paper"] if key in ("psnr", "ssim") else [])]
        head += [f"PSNR − {VARIANTS[found['reference']].label}"] if key == "psnr" else []
    lines = [
        f"| scene | method | {' | '.join(head)} | weights | multiply-adds / px |",
        "|---|---|" + "---:|" * (len(head) + 2),
    ]
    for scene, variants in found["scenes"].items():
        for name, row in variants.items():
            cells = []
            for key in keys:
                cells.append(shown(Value(**row["measured"][key]), key))
                if key in ("psnr", "ssim"):
                    cells.append(f"{row['paper'][key]:.{DIGITS[key]}f}" if row["paper"] else "")
                if key == "psnr":
                    apart = row["less_reference"]
                    cells.append(shown(Value(**apart), key) if apart else "")
            cost = found["costs"][name]
            cells += [f"{cost['parameters']:,}", f"{cost['multiply_adds_per_px']:,.0f}"]
            lines.append(f"| {scene} | {VARIANTS[name].label} | {' | '.join(cells)} |")
    budget, seeds = found["budget"], {tuple(s) for s in found["seeds"].values() if s}
    rates: dict[float, list[str]] = {}
    for name, rate in found["learning_rates"].items():
        rates.setdefault(rate, []).append(VARIANTS[name].label)
    few = len(rates) < 2
    words = ", ".join(f"{rate:g}" + ("" if few else f" ({'; '.join(of)})") for rate, of in rates.items())
    each = " or ".join(", ".join(map(str, s)) for s in sorted(seeds))
    lines += [
        "",
        f"x{budget['scale']}; {budget['steps']} steps of {budget['batch']} crops of {budget['crop']} px from "
        f"{budget['clips']} clips, Adam, rate {words}, {budget['schedule']}; seed {each}; "
        f"{found['hours']} h on {' and '.join(found['devices'])}; commit {', '.join(found['commits'])}; "
        f"measured at {', '.join(found['measured_at'])}, {', '.join(found['dates'])}, on frames "
        f"{found['frames'][0]} to {found['frames'][-1]} of "
        f"each test clip, against the aliased truth. Display-referred: {found['display']}.",
    ]
    return lines


def chart(found: Mapping[str, Any], file: Path) -> None:
    """PSNR and SSIM by scene: dots are means over seeds with their spread, rings the paper's numbers."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = list(found["scenes"])
    names = list(next(iter(found["scenes"].values())))
    figure = Figure(figsize=(3.2 * len(scenes) + 2, 0.36 * len(names) * 2 + 1.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, len(scenes), sharey=True, squeeze=False)
    for row, key in zip(grid, ("psnr", "ssim"), strict=True):
        for axes, scene in zip(row, scenes, strict=True):
            for y, name in enumerate(names):
                one = found["scenes"][scene][name]
                mine = one["measured"][key]
                axes.errorbar(mine["mean"], y, xerr=mine["spread"], fmt="o", color="tab:blue", capsize=3)
                if one["paper"]:
                    axes.plot(one["paper"][key], y, "o", mfc="none", color="tab:orange")
            axes.set_yticks(range(len(names)), [VARIANTS[name].label for name in names])
            axes.grid(axis="x", alpha=0.3)
            axes.set_xlabel(f"{METRICS[key].label} {METRICS[key].unit}".strip())
            axes.set_title(scene)
    grid[0, 0].invert_yaxis()
    figure.suptitle("dots: here; rings: the paper, on its own data")
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file) as temporary:
        figure.savefig(temporary, format="png", dpi=90)


def crops(name: str, scene: str, runs: Path) -> Path | None:
    """Crops of one output frame of each variant of a table; None if the frames do not exist."""
    table = TABLES[name]
    pictured = [variant for variant in table.variants if variant not in table.not_pictured]
    made = {v: sorted((runs / results_file(v, 0).stem / "frames").glob(f"{scene}-*/png")) for v in pictured}
    files = {v: folders[0] / f"{FRAME:04d}.png" for v, folders in made.items() if folders}
    if len(files) < len(pictured) or not all(file.is_file() for file in files.values()):
        return None
    truth, given = _truth(scene)
    metrics = {v: json.loads(results_file(v, 0, RESULTS).read_text(encoding="utf-8")) for v in pictured}
    columns = [Shown("input", given, {})]
    for v, file in files.items():
        here = metrics[v]["scenes"][scene]
        at = here["frames"].index(FRAME)
        values = {key: here["metrics"][key][at] for key in ("psnr", "lpips") if key in here["metrics"]}
        columns.append(Shown(VARIANTS[v].label, read_png(file), values))
    columns.append(Shown("truth", truth, {}))
    target = IMAGES / f"fusion_{name}_{scene}.png"
    write_png(target, sheet(f"{scene}, frame {FRAME}, x{SCALE}", columns))
    return target


def _truth(scene: str) -> tuple[Any, Any]:
    """Display-referred truth and enlarged input of the frame in the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        (clip,) = unpack_sample(Path(folder), "test", (scene,), scale=SCALE)
        sequence = FrameSequence.open(clip)
        position = [info.index for info in sequence.infos].index(FRAME)
        assert position >= WARM_UP
        truth = display(sequence.truth(position, "color"), sequence.exposure)
        given = display(sequence.frame(position, SCALE).color_linear, sequence.exposure)
    return truth, given.repeat(SCALE, 0).repeat(SCALE, 1)


def on_page(page: str, name: str, block: list[str]) -> str:
    """The page with this between its marks.

    Raises:
        JaxsrError: it has no such marks.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, mark, rest = page.partition(begin)
    _, other, after = rest.partition(end)
    if not mark or not other:
        raise JaxsrError(f"no place for {name}", where=PAGE, expected=f"{begin} and {end}")
    return "\n".join([before + begin, *block, end + after])


def write(file: Path, text: str) -> None:
    with atomic_path(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def main(names: Positional[tuple[str, ...]] = (), runs: Path = RUNS) -> None:
    """Make these tables, all by default.

    Args:
        names: of the tables.
        runs: folder of the runs, for the crops.
    """
    if unknown := [name for name in names if name not in TABLES]:
        raise JaxsrError(f"no table {unknown[0]!r}", expected=", ".join(TABLES))
    found = load(RESULTS)
    for name in names or TABLES:
        numbers = document(name, found)
        lines = markdown(numbers)
        write(RESULTS / f"{name}.json", json.dumps(numbers, indent=1) + "\n")
        write(RESULTS / f"{name}.md", "\n".join([f"# {numbers['title']}", "", *lines, ""]))
        chart(numbers, IMAGES / f"fusion_{name}.png")
        for scene in TABLES[name].pictures:
            if crops(name, scene, runs) is None:
                print(f"no frames of all methods of {name} in {runs}: the crops of {scene} stay as they are")
        block = [*lines, "", f"![{numbers['title']}: PSNR and SSIM](images/fusion_{name}.png)"]
        for scene in TABLES[name].pictures:
            file = IMAGES / f"fusion_{name}_{scene}.png"
            if file.is_file():
                block += ["", f"![{scene}: crops of each method](images/{file.name})"]
        write(PAGE, on_page(PAGE.read_text(encoding="utf-8"), name, block))
        print("\n".join(lines))


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except JaxsrError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
