"""Anchors, their priors, who answers for whom, and that encoding and decoding are inverses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models_export.data.augment import AugmentConfig
from models_export.data.guided_frames import NO_GUIDE_NOISE, GuidedFrame, augmented
from models_export.nets.guided import PAPER, GuidedConfig
from models_export.train.guided_targets import AssignConfig, assign_anchors, corners_of, encode, fit_spec
from service.errors import InputError
from service.geometry.iou import iou_2d
from service.geometry.transforms import wrap_angle
from service.nets.guided import GuidedSpec, anchor_boxes, decode_boxes

WIDTH, HEIGHT = 160, 96
CONFIG = GuidedConfig(anchor_heights_px=(16.0, 32.0), anchor_ratios=(1.0, 2.0), focal_px=240.0)


def frame_of(
    xyxy: list[list[float]], depth: list[float], alpha: list[float], dims: tuple[float, float, float] = (4.0, 1.8, 1.5)
) -> GuidedFrame:
    n = len(xyxy)
    boxes = np.array(xyxy, dtype=np.float64).reshape(n, 4)
    maps = np.full((HEIGHT // 8, WIDTH // 8), 0.05, np.float32)
    return GuidedFrame(
        canvas=np.full((HEIGHT, WIDTH, 3), 114, np.uint8),
        labels={"camera": "north"},
        image_size=(WIDTH, HEIGHT),
        K=np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]]),
        R_cam_world=np.eye(3),
        xyxy_px=boxes,
        ignore=np.zeros(n, dtype=bool),
        cls=np.zeros(n, np.int64),
        center_px=(boxes[:, :2] + boxes[:, 2:]) / 2 + [1.0, -2.0],
        depth_m=np.array(depth),
        dims_lwh=np.tile(dims, (n, 1)),
        alpha=np.array(alpha),
        metric=maps,
        truth=maps,
        ground=maps,
    )


TWO = frame_of([[20.0, 40.0, 52.0, 56.0], [90.0, 30.0, 122.0, 62.0]], [20.0, 10.0], [0.2, 2.0])


@pytest.fixture(scope="module")
def spec() -> GuidedSpec:
    return fit_spec([TWO, frame_of([[60.0, 40.0, 90.0, 58.0]], [18.0], [-0.4], (4.4, 1.7, 1.4))], CONFIG, AssignConfig())


def test_anchors_stand_at_the_cells_centres(spec: GuidedSpec) -> None:
    box = anchor_boxes(spec, np.array([1]), np.array([0]), np.array([2]))
    # Cell 2 of stride 8 spans pixels 16..23, whose centre is 19.5.
    assert box.tolist() == [[19.5, 3.5, 32.0, 16.0]]


def test_priors_are_means_of_the_vehicles_that_overlap() -> None:
    first = frame_of([[20.0, 40.0, 52.0, 56.0]], [20.0], [3.0])
    second = frame_of([[100.0, 40.0, 132.0, 56.0]], [30.0], [-3.0], (5.0, 2.0, 2.0))
    priors = fit_spec([first, second], CONFIG, AssignConfig()).priors
    # 32x16 at a nearby cell overlaps both. Depths are those of a focal length of 240 instead of 120; 3 and -3 rad meet at pi.
    np.testing.assert_allclose(priors[1, :4], [50.0, 4.5, 1.9, 1.75], atol=1e-4)
    assert abs(priors[1, 4]) == pytest.approx(np.pi, abs=1e-4)
    published = fit_spec(
        [first, second], replace(PAPER, stride=8, anchor_heights_px=(16.0,), anchor_ratios=(2.0,)), AssignConfig()
    )
    assert published.priors[0, 0] == pytest.approx(25.0)


def test_a_vehicles_best_anchor_answers_even_below_the_foreground_overlap(spec: GuidedSpec) -> None:
    grid = HEIGHT // 8, WIDTH // 8
    # 20x20 at (70, 50): no anchor of 16x16, 32x16 .. reaches 0.7, the best one reaches 0.35.
    frame = frame_of([[60.0, 40.0, 80.0, 60.0]], [20.0], [0.0])
    strict = assign_anchors(frame, spec, grid, AssignConfig(foreground_iou=0.7))
    assert strict.anchor.tolist() == [0]
    none = assign_anchors(frame, spec, grid, AssignConfig(foreground_iou=0.7, best_iou=0.7))
    assert len(none.anchor) == 0
    assert none.blamed.sum() < none.blamed.size


def test_assignment_equals_the_definition(spec: GuidedSpec) -> None:
    grid, config = (HEIGHT // 8, WIDTH // 8), AssignConfig(foreground_iou=0.5, background_iou=0.4)
    found = assign_anchors(TWO, spec, grid, config)
    ours = anchor_boxes(spec, found.anchor, found.row, found.column)
    overlap = iou_2d(corners_of(ours), TWO.xyxy_px)
    assert (overlap[np.arange(len(ours)), found.vehicle] >= 0.5).all()
    assert set(found.vehicle.tolist()) == {0, 1}
    anchor, row, column = np.nonzero(found.blamed)
    assert (iou_2d(corners_of(anchor_boxes(spec, anchor, row, column)), TWO.xyxy_px) < 0.4).all()


def test_ignored_vehicles_are_neither_asked_for_nor_blamed(spec: GuidedSpec) -> None:
    grid = HEIGHT // 8, WIDTH // 8
    found = assign_anchors(replace(TWO, ignore=np.array([True, True])), spec, grid, AssignConfig())
    assert len(found.anchor) == 0
    row, column = 48 // 8, 36 // 8
    assert not found.blamed[1, row, column]
    assert found.blamed[1, 0, WIDTH // 8 - 1]


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(0, 100), st.floats(0, 60), st.floats(6, 50), st.floats(6, 30)),
    st.floats(2, 120),
    st.floats(-np.pi, np.pi, exclude_max=True),
    st.integers(0, 3),
    st.booleans(),
)
def test_decoding_undoes_encoding(
    box: tuple[float, float, float, float], depth: float, alpha: float, anchor: int, log_depth: bool
) -> None:
    x, y, w, h = box
    frame = frame_of([[x, y, x + w, y + h]], [depth], [alpha])
    spec = fit_spec([TWO], replace(CONFIG, log_depth=log_depth, bin_centers_rad=()), AssignConfig())
    number = np.array([anchor])
    place = anchor_boxes(spec, number, np.array([int(y // 8)]), np.array([int(x // 8)]))
    t = encode(spec, frame, np.array([0]), number, place)
    out = decode_boxes(spec, number, place, t[:, :4], t[:, 4:10], t[:, 10:])
    np.testing.assert_allclose(out.xyxy_px, frame.xyxy_px, atol=1e-9)
    np.testing.assert_allclose(out.center_px, frame.center_px, atol=1e-9)
    np.testing.assert_allclose(out.depth_m / spec.depth_factor(120.0), [depth], rtol=1e-9)
    np.testing.assert_allclose(out.dims_lwh, frame.dims_lwh, rtol=1e-9)
    np.testing.assert_allclose(wrap_angle(out.alpha - alpha), [0.0], atol=1e-9)


def test_targets_are_standardised(spec: GuidedSpec) -> None:
    frames = [TWO, frame_of([[60.0, 40.0, 90.0, 58.0]], [18.0], [-0.4], (4.4, 1.7, 1.4))]
    targets = []
    for frame in frames:
        found = assign_anchors(frame, spec, (HEIGHT // 8, WIDTH // 8), AssignConfig())
        targets.append(
            encode(spec, frame, found.vehicle, found.anchor, anchor_boxes(spec, found.anchor, found.row, found.column))
        )
    every = np.concatenate(targets)
    np.testing.assert_allclose(every.mean(0), 0.0, atol=1e-3)
    np.testing.assert_allclose(every.std(0), 1.0, atol=1e-3)


def test_frames_without_vehicles_fit_no_anchors() -> None:
    with pytest.raises(InputError, match="no vehicles"):
        fit_spec([frame_of([], [], [])], CONFIG, AssignConfig())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_augmentation_moves_pixels_boxes_maps_and_intrinsics_together(seed: int) -> None:
    out = augmented(TWO, np.random.default_rng(seed), AugmentConfig(), NO_GUIDE_NOISE)
    # The 3D centres are where they were, seen through the new intrinsics.
    old, new = (np.linalg.solve(f.K, np.concatenate([f.center_px, np.ones((2, 1))], 1).T) for f in (TWO, out))
    np.testing.assert_allclose(new, old, atol=1e-9)
    mirrored = out.K[0, 0] < 0
    np.testing.assert_allclose(out.alpha, -TWO.alpha if mirrored else TWO.alpha)
    # Inside the picture the constant map stays what it was.
    assert out.metric.max() == pytest.approx(0.05, abs=1e-6)
    inside = (out.center_px[:, 0] > 12) & (out.center_px[:, 0] < WIDTH - 12)
    inside &= (out.center_px[:, 1] > 12) & (out.center_px[:, 1] < HEIGHT - 12)
    cells = np.floor((out.center_px[inside] + 0.5) / 8).astype(int)
    np.testing.assert_allclose(out.metric[cells[:, 1], cells[:, 0]], 0.05, atol=1e-6)
