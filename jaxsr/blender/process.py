"""Finding Blender, and running `blender_script.py` in it as a child process that ends with its parent."""

import contextlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxsr.errors import JaxsrError

SCRIPT = Path(__file__).with_name("blender_script.py")

_INSTALL = (
    "install Blender 4.5 or 5, or make a Python for it: python3.11 -m venv ~/.jaxsr-blender && "
    "~/.jaxsr-blender/bin/pip install bpy==5.0.1 && export JAXSR_BLENDER=~/.jaxsr-blender/bin/python"
)


class Blender(NamedTuple):
    """How to start Blender: its executable, or a Python interpreter that has bpy."""

    executable: str
    is_python: bool
    version: str

    def command(self, job: Path) -> list[str]:
        if self.is_python:
            return [self.executable, str(SCRIPT), str(job)]
        flags = ["-b", "--factory-startup", "--python-exit-code", "1"]
        return [self.executable, *flags, "--python", str(SCRIPT), "--", str(job)]


def find_blender(path: str | Path | None = None) -> Blender:
    """The Blender to use: `path`, else $JAXSR_BLENDER, else `blender` on PATH, else this Python's bpy.

    Raises:
        JaxsrError: there is no Blender, or the named program does not run or lacks bpy;
            the message says how to install one.
    """
    named, where = (path, "--blender") if path else (os.environ.get("JAXSR_BLENDER"), "JAXSR_BLENDER")
    if named:
        return _probe(str(named), where)
    found = shutil.which("blender")
    if found:
        return _probe(found, "blender on PATH")
    if importlib.util.find_spec("bpy") is not None:
        return _probe(sys.executable, "bpy of this Python")
    raise JaxsrError(
        "Blender was not found", expected="--blender, JAXSR_BLENDER or blender on PATH", fix=_INSTALL
    )


def _probe(executable: str, where: str) -> Blender:
    resolved = shutil.which(str(Path(executable).expanduser()))
    if resolved is None:
        raise JaxsrError(
            "no such program",
            where=f"{where} ({executable})",
            expected="a Blender or Python executable",
            fix=_INSTALL,
        )

    def ask(*arguments: str) -> str:
        try:
            done = subprocess.run(
                [resolved, *arguments], capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL
            )
        except (OSError, subprocess.TimeoutExpired) as e:
            raise JaxsrError("does not run", where=f"{where} ({executable})", found=e, fix=_INSTALL) from e
        return done.stdout if done.returncode == 0 else ""

    version = re.search(r"(Python|Blender) (\d+\.\d+\S*)", ask("--version"))
    if version is None:
        raise JaxsrError("neither Blender nor Python", where=f"{where} ({executable})", fix=_INSTALL)
    if version[1] == "Blender":
        return Blender(resolved, False, version[2])
    bpy = re.search(r"bpy (\S+)", ask("-c", "import bpy; print('bpy', bpy.app.version_string)"))
    if bpy is None:
        raise JaxsrError("this Python has no bpy", where=f"{where} ({executable})", fix=_INSTALL)
    return Blender(resolved, True, bpy[1])


class BlenderProcess:
    """The Blender process: it starts on entry and has always ended after the exit, also after an error."""

    def __init__(self, program: Blender, job: Mapping[str, Any], folder: Path, log: Path):
        self.program, self.log = program, log
        self.job = folder / "job.json"
        with _writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self.job.write_text(json.dumps(job))

    def __enter__(self) -> "BlenderProcess":
        with _writing(self.log):
            self.log.parent.mkdir(parents=True, exist_ok=True)
            self._log = self.log.open("wb")
        try:
            self._process = subprocess.Popen(
                self.program.command(self.job),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                text=True,
                encoding="utf-8",
                start_new_session=True,  # Ctrl-C reaches this process alone, which then ends Blender
            )
        except OSError as e:
            self._log.close()
            raise JaxsrError("Blender does not start", where=self.program.executable, found=e) from e
        return self

    def __exit__(self, *exc: object) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                try:
                    stream.close()
                except BrokenPipeError:
                    continue
        self._log.close()

    def answer(self, more: Mapping[str, Any]) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(more) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError as e:
            raise self._failure() from e

    def scene(self) -> dict[str, Any]:
        """The complete description of the job, with the values that the script read from the scene."""
        for event in self.events():
            if event["event"] == "scene":
                return {k: v for k, v in event.items() if k not in ("event", "cpu_seconds")}
        raise self._failure()

    def events(self) -> Iterator[dict[str, Any]]:
        """The script's events until it is done.

        Raises:
            JaxsrError: it reports an error, or ends without being done.
        """
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if not line.startswith('{"event"'):
                continue
            event = json.loads(line)
            if event["event"] == "error":
                raise JaxsrError(**{k: v for k, v in event.items() if k not in ("event", "cpu_seconds")})
            yield event
            if event["event"] == "done":
                return
        raise self._failure()

    def _failure(self) -> JaxsrError:
        code = self._process.wait()
        return JaxsrError(
            "Blender failed",
            where=self.program.executable,
            found=last_meaningful_line(self.log.read_text(errors="replace")) or f"exit status {code}",
            fix=f"see {self.log}",
        )


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        raise JaxsrError(
            "cannot write", where=path, found=e.strerror or e, fix="choose another folder"
        ) from e


def last_meaningful_line(log: str) -> str | None:
    """The line of Blender's output that most likely names the error."""
    noise = re.compile(
        r"^\s*$|Saved:|^Fra:|\| (WARNING|INFO)|^Blender (quit|\d)|^\s+(File|at) |^\s|^Color management"
    )
    lines = [line.strip() for line in log.splitlines() if not noise.search(line)]
    errors = [line for line in lines if re.search(r"error|exception|abort|killed|memory|signal", line, re.I)]
    candidates = errors or lines
    return candidates[-1] if candidates else None
