"""k-means of box sides, in both distances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.anchors import Clusters, anchors_of, iou_clusters, log_clusters, shape_iou
from models_export.data.samples import Sample


@pytest.mark.parametrize("clusters", [log_clusters, iou_clusters])
def test_anchors_span_the_boxes(toy_samples: list[Sample], clusters: Clusters) -> None:
    anchors = np.array(anchors_of(toy_samples, (8, 16, 32), clusters))
    sides = np.concatenate([s.xyxy_px[:, 2:] - s.xyxy_px[:, :2] for s in toy_samples])
    assert anchors.shape == (3, 3, 2)
    assert np.all(anchors.reshape(-1, 2).min(0) >= sides.min(0) - 0.1)
    assert np.all(anchors.reshape(-1, 2).max(0) <= sides.max(0) + 0.1)


@pytest.mark.parametrize("clusters", [log_clusters, iou_clusters])
def test_separate_shapes_are_found(clusters: Clusters) -> None:
    rng = np.random.default_rng(0)
    shapes = np.array([[10.0, 8.0], [40.0, 20.0], [60.0, 90.0]])
    sides = np.concatenate([shape * rng.uniform(0.95, 1.05, (50, 2)) for shape in shapes])
    found = clusters(sides, 3)
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], shapes, rtol=0.02)


def test_iou_clusters_overlap_the_boxes_at_least_as_well() -> None:
    sides = np.exp(np.random.default_rng(1).normal([3.0, 2.5], 0.7, (2000, 2)))
    mean = {clusters: shape_iou(sides, clusters(sides, 9)).max(1).mean() for clusters in (log_clusters, iou_clusters)}
    assert mean[iou_clusters] >= mean[log_clusters] > 0.6


@given(st.lists(st.tuples(st.floats(1, 500), st.floats(1, 500)), min_size=1, max_size=5))
def test_a_shape_is_most_like_itself(sides: list[tuple[float, float]]) -> None:
    overlap = shape_iou(np.array(sides), np.array(sides))
    np.testing.assert_allclose(np.diag(overlap), 1.0)
    assert np.all((overlap > 0) & (overlap <= 1 + 1e-9))
    np.testing.assert_allclose(shape_iou(np.array([[10.0, 10.0]]), np.array([[20.0, 5.0]])), [[50 / 150]])
