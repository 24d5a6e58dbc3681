from __future__ import annotations

import numpy as np
import pytest

from models_export.data.samples import Sample
from models_export.validate import Matched, TooFewVehiclesError, edge_errors, multibin_scores, reading_error, true_map
from service.nets.depth import InverseDepth
from service.nets.multibin import Multibin
from service.nets.pack import load_pack


def test_the_true_map_is_the_samples_own_at_its_stride(toy_samples: list[Sample]) -> None:
    sample = toy_samples[0]
    cells = InverseDepth(np.zeros((11, 20), np.float32), 8)
    np.testing.assert_array_equal(true_map(sample, cells), sample.inverse_depth[:11])


@pytest.mark.parametrize("stride", [4.0, 11.3, 16.0, 27.0])
def test_the_true_map_follows_the_cells_of_another_stride(stride: float, toy_samples: list[Sample]) -> None:
    sample = toy_samples[0]
    height, width = (int(-(-side // stride)) for side in sample.canvas.shape[:2])
    truth = true_map(sample, InverseDepth(np.zeros((height, width), np.float32), stride))
    # The toy's inverse depth rises by 0.01 a cell of 8 px down the image.
    rows = np.minimum((np.arange(height) + 0.5) * stride / 8, 11.99)
    assert truth.shape == (height, width)
    assert np.all(np.abs(truth - (0.02 + 0.01 * (rows - 0.5))[:, None]) <= 0.005 + 1e-6)


def test_nothing_is_measured_on_nothing(toy_samples: list[Sample]) -> None:
    missed = Matched(toy_samples[0], np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64))
    with pytest.raises(TooFewVehiclesError, match="finds next to nothing"):
        edge_errors([missed])
    with pytest.raises(TooFewVehiclesError):
        multibin_scores(shipped_head(), [missed])
    with pytest.raises(TooFewVehiclesError):
        reading_error(np.zeros(0))
    # Two readings 10 % too far, two 30 %: the median is 20 %, and each is 0.1 of 1.2 from it.
    found = reading_error(np.array([0.1, 0.1, 0.3, 0.3]))
    assert found == {"bias_relative": 0.2, "sigma_relative": pytest.approx(0.1 / 1.2, abs=1e-4)}


def shipped_head() -> Multibin:
    return Multibin(load_pack("edge").networks["multibin"])
