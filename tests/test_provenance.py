"""What results record: the commit, the versions, the machine."""

import json
import re
import subprocess

import numpy as np

from jaxsr.provenance import changes, commit, cpu_model, provenance, versions


def test_code_that_changed_is_dirty_and_results_are_not(tmp_path):
    def git(*arguments):
        name = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", "-C", tmp_path, *name, *arguments], check=True, capture_output=True)

    assert commit(tmp_path) == "unknown"
    results = tmp_path / "experiments" / "results"
    results.mkdir(parents=True)
    (tmp_path / "code.py").write_text("1")
    (results / "a.json").write_text("1")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    name = commit(results.parent)
    assert len(name) >= 7
    (results / "a.json").write_text("2")
    assert commit(results.parent) == name
    (tmp_path / "code.py").write_text("2")
    assert commit(results.parent) == f"{name}-dirty"


def test_a_result_carries_versions_machine_and_day():
    found = provenance()
    assert re.fullmatch(r"(unknown|[0-9a-f]{7,}(-dirty)?|v?[0-9].*)", found["commit"])
    assert {"jaxlib", "flax", "numpy", "OpenEXR", "dm-pix", "orbax-checkpoint"} <= set(found["packages"])
    assert found["cpu"].startswith(cpu_model())
    assert cpu_model() in found["device"], "JAX calls every processor cpu"
    assert json.loads(json.dumps(found)) == found
    assert versions(["numpy", "no-such-package"]) == {"numpy": np.__version__}


def test_changes_are_named_one_by_one():
    old = {"jax": "1", "date": "a", "packages": {"numpy": "2.0"}}
    new = {"jax": "2", "date": "b", "packages": {"numpy": "2.1", "flax": "1"}, "cpu": "x"}
    assert changes(old, new) == ["jax 1 -> 2", "numpy 2.0 -> 2.1"]
    assert changes(new, new) == []
