"""The pictures of the networks against other methods, from weights that have learned nothing."""

import numpy as np
import pytest

from experiments.fusion_sr.figures import Config, Shown, columns, crops, write_figure
from jaxsr.errors import JaxsrError
from jaxsr.io.images import read_png
from jaxsr.runtime.load import find_method
from tests.builders import make_sequence, random_weights


@pytest.mark.slow
def test_a_figure_is_written(tmp_path):
    sequence = make_sequence(tmp_path / "hall-test-0", frames=2)
    random_weights(tmp_path / "net-hall.safetensors", scale=2)
    network = str(tmp_path / "net-{scene}.safetensors")
    file = write_figure(sequence, Config(network, scale=2, frame=2, out=tmp_path / "out"))
    assert file == tmp_path / "out" / "fusion_sr_hall.png"
    picture = read_png(file)
    assert picture.shape[1] > 6 * 192  # input, four methods, truth
    assert 0.2 < picture.mean() < 0.95
    with pytest.raises(JaxsrError, match="no such frame; expected 1 to 2; found 3"):
        columns(sequence, [find_method("nearest", 2)], 2, 3)


def test_crops_are_where_the_error_is_and_apart():
    truth = np.zeros((36, 48, 3), np.float32)
    made = truth.copy()
    made[10:14, 20:24] = 1
    made[30:34, 3:7] = 0.5
    shown = [Shown(n, image, {}) for n, image in (("input", truth + 1), ("a", made), ("truth", truth))]
    first, second = crops(shown)
    assert (first[2] - first[0], first[3] - first[1]) == (8, 8)
    assert first[0] <= 20 < 24 <= first[2]
    assert first[1] <= 10 < 14 <= first[3]
    assert second[0] <= 3 < 7 <= second[2]
    assert second[1] <= 30 < 34 <= second[3]
