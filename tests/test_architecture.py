"""Arrows point down only: which parts of jaxsr may import which."""

import ast
from pathlib import Path

import jaxsr

PACKAGE = Path(jaxsr.__file__).parent
GROUND = {"errors", "files", "progress", "provenance", "layers", "needs", "frames", "srgb"}
"""What everything above `ops` may import."""
BELOW = {
    "errors": set(),
    "files": {"errors"},
    "progress": {"errors"},
    "provenance": {"errors", "files"},
    "layers": {"errors"},
    "needs": set(),
    "srgb": set(),
    "ops": {"errors", "frames", "layers", "srgb"},
    # `Frame.of` is written in a file of its own: the two are one part.
    "frames": {"errors", "layers", "frame_input"},
    "frame_input": {"errors", "layers", "frames"},
    "nets": {"ops", *GROUND},
    "losses": {"nets", "ops", *GROUND},
    "metrics": {"losses", "nets", "ops", *GROUND},
    "io": {"ops", *GROUND},
    "data": {"io", "ops", *GROUND},
    "importers": {"io", "ops", *GROUND},
    "blender": {"importers", "io", "ops", *GROUND},
    "methods": {"nets", "losses", "metrics", "ops", *GROUND},
    "weights": {"methods", "nets", *GROUND},
}
BELOW["runtime"] = {"weights", "io", *BELOW["weights"], *BELOW["methods"]}
BELOW["training"] = {"runtime", "data", *BELOW["runtime"], "metrics"}
BELOW["inspection"] = {"runtime", *BELOW["runtime"]}
BELOW["report"] = {"runtime", *BELOW["runtime"], "metrics"}
BELOW["evaluation"] = {"report", *BELOW["report"]}
ABOVE_ALL = {"cli", "__init__", "__main__"}


def imports(file: Path) -> set[str]:
    """The parts of jaxsr (files and folders in it) that a file imports, wherever in it."""
    parts = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports of jaxsr name it in full"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            package, *rest = name.split(".")
            if package == "jaxsr" and rest and (rest[0] in parts_of_jaxsr()):
                parts.add(rest[0])
    return parts


def parts_of_jaxsr() -> set[str]:
    """Modules and packages directly in jaxsr."""
    return {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}


def test_every_part_has_its_place():
    assert parts_of_jaxsr() - ABOVE_ALL <= set(BELOW)


def test_nothing_imports_what_is_above_it():
    wrong = []
    for file in sorted(PACKAGE.rglob("*.py")):
        part = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if part in ABOVE_ALL:
            continue
        for other in sorted(imports(file) - BELOW[part] - {part}):
            wrong.append(f"{file.relative_to(PACKAGE)} imports {other}")
    assert not wrong, "\n".join(wrong)
