from __future__ import annotations

import numpy as np
import pytest

from models_export.data.samples import Sample
from models_export.validate import true_map
from service.nets.depth import InverseDepth


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
