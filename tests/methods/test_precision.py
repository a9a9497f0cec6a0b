"""Methods under 64-bit JAX, in a process of its own since the switch is for a whole process; and batches."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from jaxsr.data import analytic
from jaxsr.methods import METHODS

ROOT = Path(__file__).resolve().parents[2]

METHODS_64 = """
import jax, jax.numpy as jnp, numpy as np
from flax import nnx
from jaxsr.data import analytic
from jaxsr.methods import METHODS, variant
from jaxsr.methods.base import step
from tests.networks import SMALL, drawn

assert jax.config.jax_enable_x64
clip = [analytic.frame(t, (16, 8), 2, (0.3, -0.2), rendered=t != 1)[0] for t in range(3)]
for name, method in METHODS.items():
    net = None
    if method.network is not None:
        method = variant(name, SMALL.get(name, {}) | ({"scale": 2} if name in SMALL else {}))
        net = nnx.state(drawn(lambda rngs: method.network.new(rngs)))
    for dtype in (np.float32, np.float64):
        cast = lambda x: jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype)
        frames = jax.tree.map(lambda *xs: jnp.stack([cast(x) for x in xs]), *clip)
        init = method.init(jax.tree.map(lambda x: x[0], frames))
        run = lambda s, fs: jax.lax.scan(lambda s, f: step(method)(net, s, f), s, fs)
        if method.network is None:
            _, images = jax.jit(run)(init, frames)
            assert np.isfinite(images).all(), name
        else:  # shapes and types alone: compiling takes long
            _, images = jax.eval_shape(run, init, frames)
        assert images.dtype == dtype, (name, images.dtype)
        print(name, images.dtype)
"""

TRAINING_64 = """
import sys
from pathlib import Path
import jax
from jaxsr.methods import fusion_sr
from jaxsr.methods.image_loss import ImageLoss
from jaxsr.training import TrainConfig, train
from tests.builders import make_sequence

assert jax.config.jax_enable_x64
folder = Path(sys.argv[1])
make_sequence(folder / "clip", frames=2, size=(32, 16))
options = fusion_sr.Options(buffers=("depth",), fusion="add")
method = fusion_sr.method(options, ImageLoss(perceptual_weight=0.0, l1_weight=1.0))
config = TrainConfig(
    data=(folder / "clip",), out=folder / "out", cache=folder / "cache", scale=2, steps=1, batch=2, crop=16
)
print(train(method, config, quiet=True))
"""


def run_64(code, *arguments):
    env = os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=ROOT, env=env, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.split()


@pytest.mark.slow
def test_every_method_runs_in_both_precisions():
    """The image has the type of the frames, and the state keeps its types, or `scan` would refuse it."""
    out = run_64(METHODS_64)
    assert out == [word for name in METHODS for dtype in ("float32", "float64") for word in (name, dtype)]


@pytest.mark.slow
def test_a_training_step_runs(tmp_path):
    assert run_64(TRAINING_64, tmp_path)[-1].endswith("weights.safetensors")


def test_a_batch_keeps_its_sharding():
    devices = jax.devices()[:2]
    assert len(devices) == 2
    mesh = jax.sharding.Mesh(np.array(devices), ("data",))
    split = NamedSharding(mesh, PartitionSpec("data"))
    frames = [analytic.frame(t, (16, 8), 2, (0.3, -0.2))[0] for t in range(2)]
    frames = jax.tree.map(lambda *xs: jax.device_put(np.stack(xs), split), *frames)
    method = METHODS["guided-taau"]
    state = jax.jit(jax.vmap(method.init))(frames)
    state = jax.tree.map(lambda x: jax.device_put(x, split), state)
    step = jax.jit(jax.vmap(method.upscale, (None, 0, 0))).lower(None, state, frames).compile()
    state, images = step(None, state, frames)
    for leaf in jax.tree.leaves((state, images)):
        assert leaf.sharding.is_equivalent_to(split, leaf.ndim)
    assert "all-gather" not in step.as_text()
    one = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[0]), frames)
    _, alone = jax.jit(method.upscale)(None, method.init(one), one)
    np.testing.assert_allclose(images[0], alone, rtol=1e-4, atol=1e-5)
