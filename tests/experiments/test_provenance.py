"""The commit that results name."""

import subprocess

from experiments.provenance import commit


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
