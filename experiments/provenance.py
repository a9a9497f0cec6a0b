"""Which state of the code made a result."""

import subprocess
from pathlib import Path

NOT_CODE = (":!experiments/results", ":!docs", ":!README.md")
"""What results are written into: they do not change what made them."""


def commit(folder: Path = Path(__file__).parent) -> str:
    """The commit of the repository around `folder`, with "-dirty" if code has changed since; or "unknown"."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        name = git("describe", "--always")
        top = git("rev-parse", "--show-toplevel")
        changed = name and git(
            "-C", top, "status", "--porcelain", "--untracked-files=no", "--", ".", *NOT_CODE
        )
    except OSError:  # no git
        return "unknown"
    return f"{name}{'-dirty' if changed else ''}" if name else "unknown"
