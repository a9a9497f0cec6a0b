"""guided-unet: untrained it is guided-taau; training and streaming see the same inputs; it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxsr.data import analytic
from jaxsr.frames import Window
from jaxsr.methods import METHODS, guided_unet
from jaxsr.ops import jitter_sequence, sample_jittered, to_display
from jaxsr.runtime.stream import stream
from tests.networks import drawn

SIZE = (48, 32)
OPTIONS = guided_unet.Options(widths=(8, 8))


def clip(count, scale=2):
    pairs = [
        analytic.frame(t, SIZE, scale, tuple(map(float, jitter)))
        for t, jitter in enumerate(np.asarray(jitter_sequence(count)))
    ]
    return [frame for frame, _ in pairs], [truth for _, truth in pairs]


def state_of(method, seed=0):
    return nnx.state(drawn(lambda rngs: method.network.new(rngs), seed))


@pytest.mark.parametrize("scale", [2, 4])
def test_untrained_it_is_guided_taau(scale):
    frames, _ = clip(3, scale)
    method = guided_unet.method(OPTIONS)
    net = nnx.state(method.network.new(nnx.Rngs(0)))
    pairs = zip(stream(method, frames, net), stream(METHODS["guided-taau"], frames), strict=True)
    for made, base in pairs:
        a, b = (np.asarray(to_display(x.image)) for x in (made, base))
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_frames_that_were_not_rendered_are_those_of_guided_taau():
    frames, _ = clip(3)
    frames[2] = frames[2]._replace(rendered=np.asarray(False), color_linear=0 * frames[2].color_linear)
    method = guided_unet.method(OPTIONS)
    *_, made = stream(method, frames, state_of(method))
    *_, base = stream(METHODS["guided-taau"], frames)
    np.testing.assert_allclose(made.image, base.image, rtol=1e-5, atol=1e-6)


def test_the_interpolated_input_removes_the_jitter():
    frame = jax.tree.map(jnp.asarray, clip(2)[0][1])
    expected = sample_jittered(to_display(frame.exposed), frame.jitter_px, frame.size, "bilinear")
    np.testing.assert_allclose(guided_unet.interpolated(frame), expected, atol=1e-6)


def test_the_loss_sees_what_streaming_shows():
    """The loss of a window is the error of the images that the steps make of the same frames."""
    frames, truths = clip(guided_unet.LENGTH)
    loss = guided_unet.Loss(ssim_weight=0.0, l1_weight=1.0)
    method = guided_unet.method(OPTIONS, loss)
    net = state_of(method)
    stacked = jax.tree.map(lambda *xs: jnp.stack([jnp.asarray(x) for x in xs])[None], *frames)
    window = Window(stacked, jnp.stack([jnp.asarray(t) for t in truths])[None])
    graph = nnx.graphdef(nnx.eval_shape(lambda: method.network.new(nnx.Rngs(0))))
    total, _ = jax.jit(lambda net, w: method.network.loss(nnx.merge(graph, net), w))(net, window)
    images = [np.asarray(to_display(made.image)) for made in stream(method, frames, net)]
    shown = [np.asarray(to_display(truth)) for truth in truths]
    # The loss does not clip, so it is at least as large, and close: few pixels leave [0, 1].
    error = np.mean([np.abs(a - b).mean() for a, b in zip(images, shown, strict=True)])
    assert error - 1e-4 <= float(total) <= 1.1 * error + 1e-3
