"""jaxsr.files: bounded readers, JSON of strangers, digests, writing that is whole or not at all."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxsr.errors import JaxsrError
from jaxsr.files import (
    ABANDONED_SECONDS,
    JSON_DEPTH,
    atomic_folder,
    atomic_path,
    digest,
    file_digest,
    open_file,
    parse_json,
    read_bytes,
    read_json,
    remove_leftovers,
    write_text,
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 200_000, "nested too deep"),
        ('{"a":' * 200_000, "nested too deep"),
        ("[" * 200_000 + "]" * 200_000, "nested too deep"),
        ("[" * (JSON_DEPTH + 2) + "]" * (JSON_DEPTH + 2), "nested too deep"),
        ('{"a": NaN}', "bad JSON; found NaN, where a finite number is needed"),
        ("[-Infinity]", "found -Infinity"),
        ("[1e999]", "found 1e999, which is too large"),
        ("[-1" + "0" * 5000 + "]", "an integer of 5002 digits"),
        (b"\xff\xfe{}", "not UTF-8"),
        (b"\x80\x04}q\x00.", "not UTF-8"),
        ('"\\ud800"', "incomplete"),
        ("", "bad JSON"),
        ("{'a': 1}", "bad JSON"),
        ('{"a": 1} x', "bad JSON; found Extra data"),
    ],
)
def test_bad_json_is_one_line(text, message):
    start = time.monotonic()
    with pytest.raises(JaxsrError, match=f"^here: .*{message}") as caught:
        parse_json(text, "here")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    assert time.monotonic() - start < 2


def test_good_json(tmp_path):
    value = {"a": [1, -2.5, True, None, "é"], "b": {"seed": 2**127}}
    text = '{"a": [1, -2.5, true, null, "\\u00e9"], "b": {"seed": 170141183460469231731687303715884105728}}'
    assert parse_json(text, "x") == value
    assert parse_json("[" * JSON_DEPTH + "]" * JSON_DEPTH, "x")
    (tmp_path / "bom.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert read_json(tmp_path / "bom.json", dict) == {"a": 1}
    assert parse_json('\ufeff"pair \\ud83d\\ude00"', "x") == "pair \U0001f600"


def test_another_kind_of_value_or_a_text_too_long(tmp_path):
    with pytest.raises(JaxsrError, match=r"expected an object \{\.\.\.\}; found list"):
        parse_json("[]", "x", dict)
    with pytest.raises(JaxsrError, match="too long; expected at most 3; found 4"):
        parse_json("[12]", "x", limit=3)
    (tmp_path / "a.json").write_bytes(b"[12]")
    with pytest.raises(JaxsrError, match="too large; expected at most 3 bytes; found 4"):
        read_json(tmp_path / "a.json", limit=3)
    with (tmp_path / "sparse.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(JaxsrError, match=f"too large.*found {1 << 40}"):
        read_json(tmp_path / "sparse.json")


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("link")
    for read in (open_file, read_bytes, read_json, file_digest):
        with pytest.raises(JaxsrError, match=r"pipe: is not a regular file; .*found a named pipe"):
            read(tmp_path / "pipe")
        with pytest.raises(JaxsrError, match="is a folder"):
            read(tmp_path)
        with pytest.raises(JaxsrError, match="gone: no such file"):
            read(tmp_path / "gone")
        with pytest.raises(JaxsrError, match="link: cannot be read"):
            read(tmp_path / "link")
        with pytest.raises(JaxsrError, match="cannot be read"):
            read("a\0b")
    with pytest.raises(JaxsrError, match="found a device"):
        read_bytes("/dev/zero")


def test_digests(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert file_digest(tmp_path / "a").startswith("ba7816bf8f01cfea414140de5dae2223")  # FIPS 180-2, B.1
    assert digest([b"ab", b"c"]) != digest([b"a", b"bc"])
    assert digest([b"ab", b"c"]) == digest(iter([b"ab", b"c"]))


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "new" / "target"

    def fail():
        with atomic_folder(target) as temporary:
            (temporary / "a").write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert list(target.parent.iterdir()) == []
    with atomic_folder(target) as temporary:
        assert temporary.parent == target.parent
        (temporary / "a").write_text("whole")
        assert not target.exists()
    with atomic_folder(target) as temporary:  # someone else was first
        (temporary / "a").write_text("again")
    assert (target / "a").read_text() == "whole"
    assert list(target.parent.iterdir()) == [target]
    expected = pytest.raises(JaxsrError, match=r"a.b: cannot write; found File exists; make room")
    with expected, atomic_folder(target / "a" / "b", fix="make room"):
        pass


def test_an_error_of_the_block_names_its_file(tmp_path):
    def fail():
        with atomic_path(tmp_path / "a") as temporary:
            temporary.write_bytes((tmp_path / "gone").read_bytes())

    with pytest.raises(JaxsrError, match=r"/a: cannot write; found No such file or directory \(.*/gone\)"):
        fail()
    assert not list(tmp_path.iterdir())


def test_texts_are_written_whole(tmp_path):
    write_text(tmp_path / "sub" / "a.txt", "é")
    assert (tmp_path / "sub" / "a.txt").read_bytes() == b"\xc3\xa9"
    with pytest.raises(JaxsrError, match="cannot write"):
        write_text(tmp_path / "sub" / "a.txt" / "b", "x")


KILLED = """
import os, signal, sys
from pathlib import Path
from jaxsr.files import atomic_folder, atomic_path

with atomic_path(Path(sys.argv[1]) / "file") as file, atomic_folder(Path(sys.argv[1]) / "folder") as folder:
    file.write_text("half")
    (folder / "inside").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_leftovers_go_only_where_their_writer_is_dead(tmp_path):
    (tmp_path / "0001.exr").write_bytes(b"x")
    (tmp_path / ".notes.tmp").write_bytes(b"the user's own")
    (tmp_path / ".notes.2-3.txt.tmp").write_bytes(b"the user's own")
    (tmp_path / ".0001.exr.9999999-1.tmp").write_bytes(b"of an earlier version")
    other = tmp_path / ".far.exr.01234567-9999999-1.tmp"  # another machine's: its processes cannot be seen
    other.write_bytes(b"half")
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path], cwd=Path(__file__).parents[1])
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob(".f*.tmp"))) == 3
    with atomic_path(tmp_path / "mine") as mine, atomic_folder(tmp_path / "ours") as ours:
        mine.write_bytes(b"half")
        (ours / "inside").write_bytes(b"half")
        assert remove_leftovers(tmp_path) == 3
        assert sorted(tmp_path.glob(".*.tmp")) == sorted(
            [other, mine, ours, tmp_path / ".notes.tmp", tmp_path / ".notes.2-3.txt.tmp"]
        )
        old = time.time() - ABANDONED_SECONDS - 10
        for path in (other, mine, ours):
            os.utime(path, (old, old))
        assert remove_leftovers(tmp_path) == 2
        assert (ours / "inside").exists(), "a file inside was just written"
        mine.write_bytes(b"whole")
    assert remove_leftovers(tmp_path / "no-such-folder") == 0
