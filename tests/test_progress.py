"""jaxsr.progress: bars, lines where there is no terminal, and streams that know only ASCII."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxsr import progress
from jaxsr.progress import Bars, silent


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the test sets."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_lines_now_and_then_where_there_is_no_terminal(capsys, clock):
    with Bars() as bars:
        advance = bars("frames", 10)
        for _ in range(8):
            clock[0] += 10
            advance()
        bar = bars.start("steps", 3)
        bar.update(0, "loss 0.5")
        clock[0] += 31
        bar.advance()
        bars.say("a [line] above")
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "frames 4/10: 10.00 s/step, 0:01:00 left",
        "frames 8/10: 10.00 s/step, 0:00:20 left",
        "steps 1/3: loss 0.5, 31.00 s/step, 0:01:02 left",
        "a [line] above",
    ]


def test_rates_notes_and_totals(clock):
    bar = Bars(quiet=True).start("steps", None, done=5, unit="frame")
    bar.update(5.0)
    assert bar.rate == "-"
    clock[0] += 2
    bar.update(15.5, "loss 0.1", total=100)
    assert bar.rate == "5.25 frames/s"
    assert bar._count() == "15.5/100"
    bar.pause()
    clock[0] += 1000
    bar.update(16)
    clock[0] += 4
    bar.update(17)
    assert bar.rate == "4.00 s/frame"
    clock[0] -= 50  # a clock that stands still or a step done twice gives no rate, and no error
    bar.update(17)
    bar.update(200, "more than there are")


def test_quiet_says_nothing(capsys, monkeypatch):
    monkeypatch.setattr(Bars, "LINE_SECONDS", 0.0)
    with Bars(quiet=True) as bars:
        bars("frames", 3)()
        bars.say("nothing")
    silent("frames", 3)()
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_a_terminal_of_any_encoding(encoding):
    code = (
        "from jaxsr.progress import Bars\n"
        "with Bars() as bars:\n"
        "    bar = bars.start('Bilder für [bold]é', 2, unit='frame')\n"
        "    bar.update(1, '[red]Größe ∞')\n"
        "    bars.say('fertig: ∞ [x]')\n"
        "    bar.advance()\n"
    )
    for force in ({}, {"FORCE_COLOR": "1", "TERM": "xterm"}):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONIOENCODING": encoding, "PATH": ""} | force,
            cwd=Path(__file__).parents[1],
            capture_output=True,
            timeout=60,
            check=False,
        )
        text = done.stderr.decode(encoding, "replace")
        assert done.returncode == 0, text
        assert done.stdout == b""
        assert "fertig" in text
        assert "[x]" in text


def test_stderr_that_is_closed():
    code = "from jaxsr.progress import Bars\nwith Bars() as bars:\n    bars('a', 1)()\n    bars.say('b')\n"
    command = f'exec "{sys.executable}" -c "{code}" 2>&-'
    assert subprocess.run(["sh", "-c", command], cwd=Path(__file__).parents[1]).returncode == 0
