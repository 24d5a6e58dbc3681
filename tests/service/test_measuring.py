"""What lifting is told of detections: whose edges count, at which size of the picture, how sure each reading is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from service.depth_scale import DepthReadings
from service.geometry.camera import Camera, yaw_from_alpha
from service.geometry.transforms import Array, pole_camera_pose
from service.measuring import DOUBT, measure, read_vehicles
from service.nets.detections import Detections
from service.nets.detector_spec import DetectorSpec
from service.nets.error_model import ErrorModel
from service.nets.multibin import UNCERTAIN, Crops, MultibinEstimates, MultibinSpec, crop_windows
from service.stills import DetectedVehicles, Still

K = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 179.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("north", 640, 360, K, pole_camera_pose([0.0, 0.0, 6.0], 0.3, 0.3))
DETECTOR = DetectorSpec(("car",), (8,), (((20.0, 10.0),),), 320, ErrorModel(1.0, 0.0, 0.0, 2.0))
HEAD = MultibinSpec(
    64, np.array([0.0, np.pi]), np.array([[4.4, 1.8, 1.5]]), (ErrorModel(0.2, 0, 0, 1),) * 3, ErrorModel(0.07, 0, 0, 1)
)
INNER, CUT = [100.0, 60.0, 160.0, 100.0], [-3.0, 60.0, 40.0, 100.0]
SURE = np.array([[0.02, 0.1, 0.05, 0.04, 1.5, 1.6, 1.7, 1.8]])


MIDDLE = [260.5, 160.5]
"""Of ``INNER``, in px of the large picture."""


def still(factor: int = 2) -> Still:
    image = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    return Still(CAMERA, image, image[::factor, ::factor].copy(), image)


def found(box: list[float], score: float = 1.0) -> Detections:
    return Detections(np.array([box]), np.array([score]), np.zeros(1, np.int64))


def says(xyxy_px: Array | None = None, alpha: float = 0.4) -> MultibinEstimates:
    sigma = None if xyxy_px is None else SURE
    size, middle = np.array([[4.5, 1.8, 1.5]]), np.array([MIDDLE])
    return MultibinEstimates(np.array([alpha]), np.ones(1), size, middle, xyxy_px, sigma)


def measured(box: list[float], estimates: MultibinEstimates, factor: int = 2):  # type: ignore[no-untyped-def]
    return measure(DetectedVehicles.of([still(factor)], [found(box)]), estimates, DepthReadings.none(1), DETECTOR, HEAD)


def test_the_detectors_edges_are_told_in_pixels_of_the_large_picture() -> None:
    told = measured(INNER, says())
    np.testing.assert_allclose(told.xyxy_px, [[200.5, 120.5, 320.5, 200.5]])
    # One pixel of the small picture is two of the large one.
    np.testing.assert_allclose(told.sigma_px, 2.0)
    np.testing.assert_allclose(told.sigma_dims, 0.2)


def test_at_one_size_nothing_is_scaled() -> None:
    told = measured(INNER, says(), factor=1)
    np.testing.assert_allclose(told.xyxy_px, [INNER])
    np.testing.assert_allclose(told.sigma_px, 1.0)


def test_a_head_that_reads_edges_is_believed_with_its_own_sigmas() -> None:
    edges = np.array([[201.0, 121.0, 322.0, 199.0]])
    told = measured(INNER, says(edges))
    np.testing.assert_array_equal(told.xyxy_px, edges)
    np.testing.assert_array_equal(told.sigma_px, SURE[:, 4:])
    np.testing.assert_array_equal(told.sigma_dims, SURE[:, 1:4])
    assert told.sigma_yaw[0] == SURE[0, UNCERTAIN.index("alpha")]


def test_what_the_detector_doubts_the_head_is_believed_less() -> None:
    edges = says(np.array([[201.0, 121.0, 322.0, 199.0]]))
    sure, unsure = (
        measure(DetectedVehicles.of([still()], [found(INNER, score)]), edges, DepthReadings.none(1), DETECTOR, HEAD)
        for score in (1.0, 0.4)
    )
    for name in ("sigma_px", "sigma_dims", "sigma_yaw"):
        np.testing.assert_allclose(getattr(unsure, name), np.exp(0.6 * DOUBT) * getattr(sure, name))
    np.testing.assert_array_equal(unsure.xyxy_px, sure.xyxy_px)


def test_an_edge_that_the_border_cuts_stays_at_the_border() -> None:
    told = measured(CUT, says(np.array([[-40.0, 121.0, 82.0, 199.0]])))
    assert told.xyxy_px[0, 0] == 0.0
    np.testing.assert_array_equal(told.xyxy_px[0, 1:], [121.0, 82.0, 199.0])


def test_cut_vehicles_are_read_worse() -> None:
    np.testing.assert_allclose(measured(CUT, says()).sigma_px, 4.0)


@pytest.mark.parametrize("alpha", [-2.0, 0.4])
def test_yaw_is_about_the_ray_through_the_crop(alpha: float) -> None:
    told = measured(INNER, says(np.array([[150.0, 121.0, 322.0, 199.0]]), alpha))
    assert told.yaw[0] == pytest.approx(float(yaw_from_alpha(CAMERA, [alpha], [MIDDLE])[0]))


def test_a_heading_that_is_no_number_may_be_any() -> None:
    told = measured(INNER, says(alpha=float("nan")))
    assert np.isfinite(told.yaw).all()
    assert told.sigma_yaw[0] == pytest.approx(np.pi / np.sqrt(3))
    assert told.flip_log_odds[0] == 0.0


def test_cameras_keep_their_order_and_none_may_be_empty_handed() -> None:
    nothing = Detections(np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64))
    detected = DetectedVehicles.of([still(), still()], [nothing, found(INNER)])
    assert detected.crops(48).pixels.shape == (1, 48, 48, 3)
    told = measure(detected, says(), DepthReadings.none(1), DETECTOR, replace(HEAD))
    np.testing.assert_array_equal(told.camera_index, [1])


def test_crops_are_cut_from_the_large_picture() -> None:
    one = still()
    crops = DetectedVehicles.of([one], [found(INNER)]).crops(156)
    np.testing.assert_array_equal(crops.window[0], [182, 82, 156])
    np.testing.assert_array_equal(crops.pixels[0], one.image[82:238, 182:338])


class _Recorder:
    """A head that reads given edges first, and others at a second look; it remembers the windows."""

    spec = HEAD

    def __init__(self, first: MultibinEstimates) -> None:
        self.windows: list[list[int]] = []
        self._next = [says(np.array([[210.0, 130.0, 330.0, 210.0]]), alpha=1.0), first]

    def estimate(self, crops: Crops, cls: NDArray[np.int64]) -> MultibinEstimates:
        assert len(crops) == len(cls)
        self.windows += crops.window.tolist()
        return self._next.pop()


@pytest.mark.parametrize(("shift", "read_again"), [(2.0, False), (12.0, True), (100.0, False)])
def test_a_vehicle_is_read_again_around_its_own_outline(shift: float, read_again: bool) -> None:
    first = says(np.array([[200.5, 120.5, 320.5 + shift, 200.5]]))
    head, detected = _Recorder(first), DetectedVehicles.of([still()], [found(INNER)])
    estimates = read_vehicles(detected, head, 0.05)  # type: ignore[arg-type]
    around = crop_windows(np.concatenate([detected.xyxy_px, first.xyxy_px]))
    assert head.windows == around[: 1 + read_again].tolist()
    assert estimates.alpha[0] == (1.0 if read_again else first.alpha[0])
