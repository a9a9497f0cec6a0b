"""The guided reprojection at the paper's defaults (33 candidates, 4 kept), with 6 guide and 3 value channels.

    python -m benchmarks.reproject [--quick] [--forms] [--batch 4]

It compares ours with a plain numba loop over pixels (all cores, fast-math), with the plain JAX form of the
tests (per-pixel gather, top_k, softmax), and with PyTorch eager (gather of all candidates, topk). It times
the forward pass, forward with the gradient of the previous image, and forward with all gradients.
With `--forms` only the forms of ours are compared, on the default device, a CPU or a GPU. A condition, an
optimisation barrier or nothing keeps XLA from making copies, and a batch is mapped or vmapped. README.md has
the times of a GPU.

Forms of the selection that were tried, with their CPU time over that of numba:

    winners as four outputs, or keys of the whole image     1.5-1.8
    one packed output, planar guides                        0.55
    the same without signed indices                         0.5
    whole pixels of guides, where() instead of minimum      0.3, kept

Row bands and column strips gain nothing on top. The conditional boundary keeps XLA from copying the selection
into its readers; without it everything takes 5 times as long. The second pass takes twice as long with four
arrays as with the winners in the last axis. jax.checkpoint around it saves 15 % of the gradient's memory and
no time.
"""

import argparse
import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Inputs, Prepared, Variant
from jaxsr.ops import reproject
from jaxsr.ops.reprojection import Batching, Fence, _reproject, candidate_offsets
from tests.reference.reprojection import reproject_plain

SIGMAS = {"sigma_guide": 0.1, "sigma_space": 1.0}
OFFSETS = candidate_offsets((1, 3, 5, 9), 1)
COUNT = 4
GATHERS_ALL = (
    960 * 540
)  # larger images are minutes and tens of gigabytes for the forms that gather everything


def with_jax(name: str, fn: Callable[..., Any], argnums: tuple[int, ...] = (), **limits: int) -> Variant:
    def forward(*arrays: jax.Array) -> Any:
        return fn(*arrays, **SIGMAS)

    def loss(*arrays: jax.Array) -> jax.Array:
        image, confidence = forward(*arrays)
        return jnp.square(image).sum() + confidence.sum()

    timed = jax.value_and_grad(loss, argnums) if argnums else forward
    return Variant(name, lambda inputs: _common.compiled(timed, inputs), **limits)


def in_form(batching: Batching, fence: Fence) -> Callable[..., Any]:
    def form(*arrays: jax.Array, sigma_guide: float, sigma_space: float) -> Any:
        sigmas = (sigma_guide, sigma_space)
        return _reproject(arrays, sigmas, OFFSETS, COUNT, batching=batching, fence=fence)

    return form


def compare_forms(batch: int, size: str, rounds: int) -> None:
    """Print the times of every form for one image and for a batch, forward and with all gradients."""
    inputs = _common.scene(*_common.parse_size(size))
    device = jax.devices()[0].device_kind
    for question, argnums in (("forward", ()), ("all gradients", (0, 1, 2, 3))):
        for images in (1, batch):
            arrays = inputs if images == 1 else tuple(np.stack([a] * images) for a in inputs)
            calls = {
                f"{batching}, {fence}": with_jax("", in_form(batching, fence), argnums).build(arrays).call
                for batching in (("vmap",) if images == 1 else ("map", "vmap"))
                for fence in ("cond", "barrier", "none")
            }
            timed = _common.summarise(_common.time_interleaved(calls, rounds), next(iter(calls)))
            for name, row in timed.items():
                print(f"{device} {size} x {images} {question}: {name}: {row['median_ms']:.2f} ms", flush=True)


@functools.cache
def numba_loop() -> Callable[..., None]:
    import numba

    @numba.njit(fastmath=True, parallel=True)
    def loop(previous, motion, guide, previous_guide, scale, scale_space, offsets, image, confidence):
        height, width, channels = previous.shape
        for y in numba.prange(height):
            distance, at = np.empty(COUNT, np.float32), np.empty(COUNT, np.int32)
            for x in range(width):
                wx, wy = np.rint(motion[y, x, 0]), np.rint(motion[y, x, 1])
                fx, fy = motion[y, x, 0] - wx, motion[y, x, 1] - wy
                for k in range(COUNT):
                    distance[k], at[k] = np.float32(1e30), -1
                for n in range(offsets.shape[0]):
                    dx, dy = offsets[n, 0], offsets[n, 1]
                    cx, cy = x - int(wx) + dx, y - int(wy) + dy
                    if cx < 0 or cx >= width or cy < 0 or cy >= height:
                        continue
                    d = ((fx + dx) ** 2 + (fy + dy) ** 2) * scale_space
                    for c in range(guide.shape[2]):
                        e = (guide[y, x, c] - previous_guide[cy, cx, c]) * scale[c]
                        d += e * e
                    if d < distance[COUNT - 1]:
                        k = COUNT - 1
                        while k > 0 and distance[k - 1] > d:
                            distance[k], at[k] = distance[k - 1], at[k - 1]
                            k -= 1
                        distance[k], at[k] = d, cy * width + cx
                image[y, x] = 0
                if at[0] < 0:
                    cx, cy = min(max(x - int(wx), 0), width - 1), min(max(y - int(wy), 0), height - 1)
                    image[y, x], confidence[y, x] = previous[cy, cx], 0
                    continue
                total = np.float32(0)
                for k in range(COUNT):
                    if at[k] >= 0:
                        weight = np.exp(distance[0] - distance[k])
                        total += weight
                        for c in range(channels):
                            image[y, x, c] += weight * previous[at[k] // width, at[k] % width, c]
                for c in range(channels):
                    image[y, x, c] /= total
                confidence[y, x] = np.exp((fx * fx + fy * fy) * scale_space - distance[0])

    return loop


def with_numba(inputs: Inputs) -> Prepared:
    loop = numba_loop()
    previous, _, guide, _ = inputs
    scale = np.full(guide.shape[-1], np.sqrt(0.5) / SIGMAS["sigma_guide"], np.float32)
    scale_space = np.float32(0.5 / SIGMAS["sigma_space"] ** 2)

    def call() -> tuple[np.ndarray, np.ndarray]:
        image, confidence = np.empty_like(previous), np.empty(previous.shape[:2], np.float32)
        loop(*inputs, scale, scale_space, OFFSETS, image, confidence)
        return image, confidence

    return Prepared(call)


def with_torch(differentiated: tuple[int, ...] = ()) -> Variant:
    def build(inputs: Inputs) -> Prepared:
        import torch

        arrays = [torch.tensor(a) for a in inputs]
        height, width, _ = inputs[0].shape
        grid = torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1)
        size, steps = torch.tensor([width, height]), torch.tensor(OFFSETS).long()

        def forward() -> Any:
            previous, motion, guide, previous_guide = arrays
            whole = motion.detach().round()
            y = (grid - whole.long())[:, :, None] + steps
            inside = ((y >= 0) & (y < size)).all(-1)
            y = torch.minimum(y.clamp(min=0), size - 1)
            index = y[..., 1] * width + y[..., 0]
            there = previous_guide.flatten(0, 1)[index]
            log_weight = -((guide[:, :, None] - there) / SIGMAS["sigma_guide"]).square().sum(-1) / 2
            to_candidate = (whole - motion)[:, :, None] - steps
            log_weight = log_weight - to_candidate.square().sum(-1) / (2 * SIGMAS["sigma_space"] ** 2)
            log_weight = torch.where(inside, log_weight, -1e30)
            best, kept = log_weight.topk(COUNT, dim=-1)
            weights = best.softmax(-1)
            values = previous.flatten(0, 1)[index.gather(-1, kept)]
            return (weights[..., None] * values).sum(-2), best[..., 0].exp()

        def backward() -> None:
            for array in arrays:
                array.grad = None
            image, confidence = forward()
            (image.square().sum() + confidence.sum()).backward()

        if not differentiated:
            return Prepared(lambda: forward()[0].shape)
        for i in differentiated:
            arrays[i].requires_grad_()
        return Prepared(backward)

    return Variant("PyTorch eager", build, largest=GATHERS_ALL)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--forms", action="store_true", help="compare the forms of ours; write nothing")
    parser.add_argument("--batch", type=int, default=4, help="images of the batch that --forms measures")


def main() -> None:
    args = _common.arguments(__doc__, add=add_options)
    if args.forms:
        for size in args.sizes:
            compare_forms(args.batch, size, args.rounds)
        return
    has = {name: importlib.util.find_spec(name) is not None for name in ("numba", "torch")}
    questions, references = {}, {}
    for question, argnums in (
        ("forward", ()),
        ("gradient of previous", (0,)),
        ("all gradients", (0, 1, 2, 3)),
    ):
        questions[question] = [
            with_jax("jaxsr", reproject, argnums),
            with_jax("plain JAX", reproject_plain, argnums, largest=GATHERS_ALL),
        ]
        if has["torch"]:
            questions[question].append(with_torch(argnums))
        references[question] = "jaxsr"
    if has["numba"]:
        questions["forward"].append(Variant("numba", with_numba))
        references["forward"] = "numba"
    _common.run(__file__, questions, references, args, [name for name, found in has.items() if not found])


if __name__ == "__main__":
    main()
