"""Checkpoints of a training: everything that a killed one needs to go on as if it had never stopped.

Orbax writes each under a temporary name and renames it, so there is no half of one. Arrays are stored by name
as the host sees them, whatever devices they lie on; what is not an array (position in the data, best result,
seconds) is JSON beside them, with a hash over all arrays.
`checkpoints.json` holds a hash of each file. Files are checked against it before Orbax reads them: on a
damaged file Orbax goes on to read all others, and prints complaints until it has.
"""

import contextlib
import hashlib
import json
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from jaxsr.errors import JaxsrError
from jaxsr.files import atomic_path, read_json
from jaxsr.training.state import TrainState

KEEP = 3
"""Checkpoints that are kept: the last ones."""


FOLDER = "checkpoints"
"""In the folder of a training."""


def has_checkpoints(out: Path) -> bool:
    """Whether the training in this folder has a whole one."""
    folder = out / FOLDER
    return folder.is_dir() and any(p.name.isdigit() for p in folder.iterdir())


class Checkpoints:
    """The checkpoints in a folder; use it in a `with` block.

    Raises:
        JaxsrError: the folder cannot be read or written.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder).absolute()
        self._hashes = self.folder.with_name(f"{self.folder.name}.json")
        policies = ocp.training
        try:
            with _silent():
                self._orbax = ocp.training.Checkpointer(
                    self.folder,
                    save_decision_policy=policies.save_decision_policies.FixedIntervalPolicy(1),
                    preservation_policy=policies.preservation_policies.LatestN(KEEP),
                    cleanup_tmp_directories=True,
                )
        except Exception as e:  # whatever Orbax meets: a user needs the place and one line
            raise JaxsrError("the checkpoints cannot be read", where=self.folder, found=_line(e)) from e

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        try:
            with _silent():
                self._orbax.close()
        except Exception as e:
            if kind is None:  # else Orbax says again what `save` said
                raise JaxsrError("the checkpoint cannot be written", where=self.folder, found=_line(e)) from e

    @property
    def latest(self) -> int | None:
        """The step of the last checkpoint."""
        last = self._orbax.latest
        return None if last is None else int(last.step)

    def save(self, state: TrainState, run: dict[str, Any]) -> None:
        """Write a checkpoint of the state's step, unless there is one; returns when it is whole on disk.

        Args:
            run: anything else, as JSON types.

        Raises:
            JaxsrError: it cannot be written.
        """
        arrays = _to_arrays(state)
        step = int(arrays["step"])
        if self.latest == step:
            return
        hashes = {k: v for k, v in self._read_hashes().items() if k != str(step)}
        self._write_hashes(hashes)  # not those of one that was deleted, if we are killed now
        try:
            with _silent():
                self._orbax.save(step, arrays, custom_metadata={"run": run, "sha256": _digest(arrays)})
        except Exception as e:
            raise JaxsrError("the checkpoint cannot be written", where=self.folder, found=_line(e)) from e
        kept = {str(c.step) for c in self._orbax.checkpoints}
        new = {str(step): _file_hashes(self.folder / str(step))}
        self._write_hashes({k: v for k, v in (hashes | new).items() if k in kept})

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """The last checkpoint, on the host, and its `run`.

        Args:
            like: a state of the same structure.

        Raises:
            JaxsrError: it is damaged, or of another network.
        """
        step = self.latest
        wanted = _to_arrays(like)
        then, now = self._read_hashes().get(str(step)), _file_hashes(self.folder / str(step))
        if then is not None and then != now:
            changed = sorted(name for name in {*then, *now} if then.get(name) != now.get(name))
            raise self._damaged(step, f"another file than was written: {changed[0]}")
        try:
            with _silent():
                metadata = self._orbax.metadata(step)
                found = metadata.custom_metadata or {}
                self._check_layout(step, metadata.metadata, wanted)
                arrays = self._orbax.load(step, {k: np.empty(a.shape, a.dtype) for k, a in wanted.items()})
        except JaxsrError:
            raise
        except Exception as e:
            raise self._damaged(step, _line(e)) from e
        run = found.get("run")
        if run is None or _digest(arrays) != found.get("sha256"):
            raise self._damaged(step, "numbers that do not match their hash")
        return _from_arrays(arrays, like), run

    def _read_hashes(self) -> dict[str, dict[str, str]]:
        try:
            read = read_json(self._hashes, dict)
        except JaxsrError:  # a second opinion, and no more
            return {}
        return {step: files for step, files in read.items() if isinstance(files, dict)}

    def _write_hashes(self, hashes: dict[str, dict[str, str]]) -> None:
        with atomic_path(self._hashes) as temporary:
            temporary.write_text(json.dumps(hashes, indent=1), encoding="utf-8")

    def _check_layout(self, step: int | None, stored: Any, wanted: dict[str, np.ndarray]) -> None:
        """See that a whole checkpoint has the arrays of this version's state.

        Raises:
            JaxsrError: it has others, as those of earlier versions of jaxsr have.
        """
        if not isinstance(stored, dict) or stored.keys() == wanted.keys():
            return
        lacking, more = sorted(wanted.keys() - stored.keys()), sorted(stored.keys() - wanted.keys())
        raise JaxsrError(
            "the checkpoint is of another version of jaxsr, whose training state had other parts",
            where=self.folder / str(step),
            expected=lacking[0] if lacking else "no other parts",
            found=more[0] if more else "no such part",
            fix="resume with the version that wrote it, or start anew in another --out, "
            "with --init and the weights that lie beside the checkpoints",
        )

    def _damaged(self, step: int | None, found: str) -> JaxsrError:
        return JaxsrError(
            "the checkpoint is damaged, or of another network",
            where=self.folder / str(step),
            found=found,
            fix="delete that folder to go on from the checkpoint before it",
        )


def _named(state: TrainState) -> list[tuple[str, Any]]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return [
        (jax.tree_util.keystr(p, simple=True, separator=".").removesuffix(".value"), x) for p, x in leaves
    ]


def _is_key(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _to_arrays(state: TrainState) -> dict[str, np.ndarray]:
    # Copies: what NumPy shows of a JAX array on the CPU is the buffer that the next step overwrites.
    return {n: np.array(jax.random.key_data(x) if _is_key(x) else x) for n, x in _named(state)}


def _from_arrays(arrays: dict[str, np.ndarray], like: TrainState) -> TrainState:
    def leaf(name: str, old: Any) -> Any:
        new = arrays[name]
        return (
            jax.random.wrap_key_data(jnp.asarray(new), impl=jax.random.key_impl(old)) if _is_key(old) else new
        )

    return jax.tree.unflatten(jax.tree.structure(like), [leaf(name, x) for name, x in _named(like)])


def _file_hashes(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()[:16] for p in files}


def _digest(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Orbax logs whole tracebacks before it raises; what it raises is enough."""
    logs = [logging.getLogger(name) for name in ("absl", "asyncio")]
    before = [log.disabled for log in logs]
    for log in logs:
        log.disabled = True
    try:
        yield
    finally:
        for log, disabled in zip(logs, before, strict=True):
            log.disabled = disabled


def _line(e: Exception) -> str:
    if isinstance(e, OSError) and e.strerror:
        return e.strerror
    if code := re.search(r"os_error_code='(\d+)'", str(e)):  # TensorStore says it at the end of a long text
        return os.strerror(int(code[1]))
    text = " ".join(str(e).split()) or type(e).__name__
    return text if len(text) <= 200 else text[:197] + "..."
