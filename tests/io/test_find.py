from pathlib import Path

import pytest

from jaxsr.errors import JaxsrError
from jaxsr.io.find import find_sequences


@pytest.fixture
def tree(tmp_path) -> Path:
    for name in ("set/b", "set/a", "other", "deep/1/2/3"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "sequence.json").write_text("{}")
    (tmp_path / "set/logs").mkdir()
    return tmp_path


def test_sequences_and_folders_of_them(tree):
    a, b, other = tree / "set/a", tree / "set/b", tree / "other"
    assert find_sequences([a]) == [a]
    assert find_sequences([tree / "set"]) == [a, b]
    assert find_sequences([other, str(tree / "set")]) == [other, a, b]
    assert find_sequences([tree / "deep"]) == [tree / "deep/1/2/3"]


def test_each_comes_once_where_it_is_first_named(tree):
    a, b = tree / "set/a", tree / "set/b"
    assert find_sequences([b / "sequence.json", tree / "set", a, tree / "other" / ".." / "set"]) == [b, a]


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["set/a/sequence.json", "nowhere/sequence.json"], "nowhere: no such folder"),
        (["other", "set/logs"], "logs: no sequence in the folder; expected a file sequence.json in it"),
        ([], "no sequences"),
    ],
)
def test_what_is_no_sequence(tree, places, message):
    with pytest.raises(JaxsrError, match=message):
        find_sequences([tree / place for place in places])
