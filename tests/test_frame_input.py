"""`Frame.of`: frames from the arrays that one has, and one clear line for what is wrong with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr import Camera, Frame, JaxsrError
from jaxsr.data import analytic
from jaxsr.layers import FIELDS

LR, HR = (6, 8), (12, 16)


def ones(size, channels, value=1.0):
    return np.full((*size, channels), value, np.float32)


def arguments(**changes):
    given = {
        "color": ones(LR, 3),
        "depth": ones(LR, 1),
        "motion": ones(LR, 2, 0.0),
        "hr": {"depth": ones(HR, 1), "motion": ones(HR, 2, 0.0)},
    }
    return given | changes


def test_it_is_the_frame_of_the_same_buffers():
    frame, _ = analytic.frame(3, (32, 24), 2, (0.25, -0.5))
    layers = {
        place: {n: getattr(getattr(frame, place), f) for n, f in FIELDS.items()} for place in ("lr", "hr")
    }
    made = Frame.of(
        frame.color_linear,
        depth=layers["lr"].pop("depth"),
        motion=layers["lr"].pop("motion"),
        jitter=(0.25, -0.5),
        lr=layers["lr"],
        hr=layers["hr"],
        camera=frame.camera,
    )
    assert jax.tree.structure(made) == jax.tree.structure(frame)
    for a, b in zip(jax.tree.leaves(made), jax.tree.leaves(frame), strict=True):
        assert (np.asarray(a).dtype, np.shape(a)) == (np.asarray(b).dtype, np.shape(b))
        np.testing.assert_array_equal(a, b)


def test_what_is_left_out_is_filled_in():
    frame = Frame.of(color=ones(LR, 3))
    assert (frame.scale, frame.lr.depth_linear, frame.camera) == (0, None, None)
    np.testing.assert_array_equal(frame.jitter_px, [0, 0])
    assert (bool(frame.reset), bool(frame.rendered), float(frame.exposure)) == (False, True, 1.0)
    assert Frame.of(color=ones(LR, 3), scale=4).size == (24, 32)
    frame = Frame.of(depth=ones(LR, 1)[..., 0], rendered=False, hr={"depth": ones(HR, 1)})  # [h, w] will do
    assert (frame.scale, frame.size, frame.lr.depth_linear.shape) == (2, HR, (*LR, 1))
    np.testing.assert_array_equal(frame.color_linear, np.zeros((*LR, 3)))
    frame = Frame.of(hr={"depth": ones(HR, 1)}, rendered=False, scale=4)
    assert frame.color_linear.shape == (3, 4, 3)


def test_the_colour_of_a_frame_that_was_not_rendered_is_hidden():
    frame = Frame.of(**arguments(color=ones(LR, 3, np.nan), rendered=False))
    np.testing.assert_array_equal(frame.color_linear, 0)


def test_numbers_keep_their_precision():
    assert Frame.of(**arguments(color=np.ones((*LR, 3), np.float64))).color_linear.dtype == np.float64
    frame = Frame.of(**arguments(lr={"object_id": np.ones(LR, np.uint32)}))
    assert frame.lr.object_id.dtype == np.float32


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_half_precision_becomes_float32(dtype):
    """Pixel coordinates are computed in the type of the colour, and half precision cannot hold them."""
    frame = Frame.of(**arguments(color=jnp.ones((*LR, 3), dtype), depth=np.ones((*LR, 1), np.float16)))
    assert {x.dtype for x in (frame.color_linear, frame.lr.depth_linear, frame.hr.depth_linear)} == {
        np.dtype(np.float32)
    }
    assert frame.jitter_px.dtype == np.float32


def test_it_can_be_called_while_a_function_is_compiled():
    @jax.jit
    def mean(color, depth, jitter):
        frame = Frame.of(color, depth=depth, jitter=jitter, scale=2)
        return frame.exposed.mean() + frame.jitter_px.sum()

    assert float(mean(jnp.ones((*LR, 3)), -jnp.ones((*LR, 1)), jnp.zeros(2))) == 1.0


SCALED = Camera(2 * np.eye(4), np.ones(2), np.zeros(2))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"color": None}, "a rendered frame has no colour; expected color"),
        ({"color": ones(LR, 4)}, r"lr color: wrong shape; expected \[h, w, 3\]; found \[6, 8, 4\]"),
        ({"color": np.ones((*LR, 3), np.uint8)}, "not floating-point numbers.*8-bit colour"),
        ({"depth": ones(LR, 1, 0.0)}, "depth is not above 0 everywhere.*smallest value 0.*sky"),
        ({"depth": ones(LR, 1, np.nan)}, "depth is not above 0"),
        ({"depth": ones((6, 7), 1)}, "sizes differ; expected one size; found color 8x6, depth 7x6"),
        ({"hr": {"depth": ones((12, 17), 1)}}, "do not belong together.*found 17x12 and 8x6"),
        ({"hr": {"depth": ones((3, 4), 1)}}, "do not belong together"),
        ({"hr": {"color": ones(HR, 3)}}, "hr: unknown layer 'color'; expected depth, motion"),
        ({"lr": {"albedo": ones(LR, 3)}}, "lr: unknown layer 'albedo'; expected color, depth"),
        ({"scale": 4}, "whole multiple of the LR size, 4 times"),
        ({"scale": 0}, "bad scale"),
        (
            {"depth": None, "motion": None, "rendered": False, "scale": 32},
            "whole multiple of the LR size, 32 times; found 16x12 and 1x1",
        ),
        (
            {"jitter": (0.8, 0.0)},
            r"bad jitter.*\[-0.5, 0.5\]; found \[0.8, 0.0\].*texture coordinates",
        ),
        ({"jitter": (np.nan, 0.0)}, "bad jitter"),
        ({"jitter": 0.25}, "bad jitter"),
        ({"jitter": "left"}, "bad jitter.*found left"),
        ({"jitter": None}, "bad jitter"),
        ({"exposure": "bright"}, "bad exposure.*found bright"),
        ({"exposure": None}, "bad exposure"),
        ({"exposure": 0.0}, "bad exposure"),
        ({"exposure": np.inf}, "bad exposure"),
        ({"reset": "false"}, "bad reset; expected True or False; found false"),
        ({"camera": SCALED}, "the camera is not rigid.*take the scale out"),
        ({"camera": SCALED._replace(world_from_view=np.diag([1.0, -1, 1, 1]))}, "not rigid.*mirror image"),
        ({"camera": SCALED._replace(world_from_view=np.full((4, 4), np.nan))}, "the camera is not rigid"),
        (
            {"camera": Camera(np.eye(3), np.ones(2), np.zeros(2))},
            r"wrong shape; expected \[4, 4\]",
        ),
    ],
)
def test_what_is_wrong_is_one_line(changes, line):
    with pytest.raises(JaxsrError, match=line) as caught:
        Frame.of(**arguments(**changes))
    assert "\n" not in str(caught.value)


def test_a_size_that_nothing_tells():
    with pytest.raises(JaxsrError, match="size of the low resolution is not known"):
        Frame.of(hr={"depth": ones(HR, 1)}, rendered=False)
    with pytest.raises(JaxsrError, match="no images"):
        Frame.of(rendered=False)


def test_jitter_of_hr_buffers_is_at_most_half_an_lr_pixel():
    np.testing.assert_array_equal(Frame.of(**arguments()).hr_jitter_px, [0, 0])
    frame = Frame.of(**arguments(hr_jitter=(1.0, -0.75)))
    np.testing.assert_array_equal(frame.hr_jitter_px, np.float32([1.0, -0.75]))
    for wrong in ((1.25, 0), (0, float("nan")), (0,), 0.5):
        with pytest.raises(JaxsrError, match=r"hr_jitter: bad hr_jitter.*each in .*half an LR pixel"):
            Frame.of(**arguments(hr_jitter=wrong))
