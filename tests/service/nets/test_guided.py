"""The depth-guided detector's metadata, maps and decoding. That decoding undoes training's encoding is tested there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from service.errors import PackError
from service.nets.canvas import InputFit
from service.nets.guided import GuidedDetector, GuidedSpec, decode_guided, guide_maps, suppress_guided

SPEC = GuidedSpec(
    classes=("car", "bus"),
    stride=8,
    anchors_px=np.array([[16.0, 16.0], [32.0, 16.0]]),
    priors=np.array([[40.0, 4.4, 1.8, 1.5, 0.0], [20.0, 4.4, 1.8, 1.5, 0.0]]),
    mean=np.zeros(11),
    std=np.full(11, 0.5),
    focal_px=400.0,
    log_depth=True,
    bin_centers_rad=np.array([0.0, np.pi]),
    guides=("depth", "ground"),
    guide_stride=8,
    sigma_scale=np.full(7, 2.0),
)


CENTERED = {"width": 48, "height": 32, "place": "center", "pad": 114}


def outputs(spec: GuidedSpec, *, variances: bool = True) -> list[np.ndarray]:
    """Outputs of a 4x6 grid that see one bus at anchor 1, row 2, column 3, and a car beside it, less sure."""
    heading = 3 * len(spec.bin_centers_rad) or 1
    fields = [3, 4, 6, heading] + [7] * variances
    grids = [np.zeros((2, n, 4, 6), np.float32) for n in fields]
    grids[0][:, 0] = 8.0
    grids[0][1, :, 2, 3] = [0.0, 1.0, 5.0]
    grids[0][1, :, 2, 4] = [0.0, 2.0, -4.0]
    grids[1][1, :, 2, 3] = [0.25, 0.0, 0.0, 2 * np.log(2.0)]
    grids[2][1, 2, 2, 3] = 2 * np.log(1.1)
    if len(spec.bin_centers_rad):
        # Bin 1 is surer; its angle is 0.5 past pi.
        grids[3][1, :, 2, 3] = [1.0, np.cos(0.5), 0.0, np.sin(0.5), 1.0, 4.0]
    return [grid.reshape(-1, 4, 6) for grid in grids]


def test_decoding_one_vehicle() -> None:
    found = decode_guided(outputs(SPEC), SPEC, 200.0, 0.5)
    assert len(found) == 2
    assert found.cls.tolist() == [1, 0]
    assert found.score[0] == pytest.approx(np.exp(5) / (np.exp(5) + np.exp(1) + 1))
    # The anchor's centre is at 3 * 8 + 3.5, 2 * 8 + 3.5; an eighth of its width to the right; twice its height.
    np.testing.assert_allclose(found.xyxy_px[0], [31.5 - 16, 19.5 - 16, 31.5 + 16, 19.5 + 16], atol=1e-5)
    np.testing.assert_allclose(found.center_px[0], [27.5, 19.5], atol=1e-5)
    # Depths are those of a 400 px camera; this one has 200 px.
    assert found.depth_m[0] == pytest.approx(20.0 * 1.1 / 2, rel=1e-5)
    np.testing.assert_allclose(found.dims_lwh[0], [4.4, 1.8, 1.5])
    assert found.alpha[0] == pytest.approx(0.5 - np.pi, abs=1e-5)
    assert found.flip_log_odds[0] == pytest.approx(3.0)


def test_sigmas_are_in_the_units_of_what_they_are_about() -> None:
    found = decode_guided(outputs(SPEC), SPEC, 200.0, 0.5)
    # A log variance of 0 is one deviation of the targets (0.5), twice for the scale that was measured.
    np.testing.assert_allclose(found.sigma[0], [32, 16, found.depth_m[0], 4.4, 1.8, 1.5, 2.0], rtol=1e-5)
    unknown = decode_guided(outputs(SPEC, variances=False), SPEC, 200.0, 0.5)
    np.testing.assert_allclose(unknown.sigma, found.sigma)


def test_the_published_encoding_adds_to_the_priors() -> None:
    spec = replace(SPEC, log_depth=False, bin_centers_rad=np.zeros(0), focal_px=0.0)
    raw = outputs(spec)
    raw[3].reshape(2, 1, 4, 6)[1, 0, 2, 3] = 1.0
    found = decode_guided(raw, spec, 200.0, 0.5)
    assert found.depth_m[0] == pytest.approx(20.0 + np.log(1.1), rel=1e-5)
    assert found.alpha[0] == pytest.approx(0.5)
    assert found.flip_log_odds[0] == 0.0
    assert found.sigma[0, 6] == pytest.approx(1.0)


def test_nothing_above_the_threshold_is_no_vehicle() -> None:
    found = decode_guided(outputs(SPEC), SPEC, 200.0, 0.999)
    assert len(found) == 0
    assert found.sigma.shape == (0, 7)
    assert len(suppress_guided(found, 0.4)) == 0


def test_suppression_keeps_the_better_of_two_overlapping_boxes() -> None:
    found = decode_guided(outputs(SPEC), SPEC, 200.0, 0.5)
    assert len(suppress_guided(found, 0.2)) == 1
    assert suppress_guided(found, 0.2).cls.tolist() == [1]
    assert len(suppress_guided(found, 0.9)) == 2


def test_maps_are_cut_padded_and_in_the_specs_camera() -> None:
    metric = np.array([[0.05, 9.0, -1.0]])
    ground = np.array([[0.04, np.nan, 0.02]])
    maps = guide_maps(SPEC, (24, 8), 200.0, metric, ground)
    assert maps.shape == (2, 4, 4)
    assert maps.dtype == np.float32
    # 1 / Z in a camera of 400 px is half of that in one of 200 px.
    np.testing.assert_allclose(maps[0, 0], [0.025, 0.25, 0.0, 0.0], atol=1e-7)
    np.testing.assert_allclose(maps[1, 0], [0.02, 0.0, 0.01, 0.0], atol=1e-7)
    assert maps[:, 1:].max() == 0.0
    no_scale = guide_maps(SPEC, (24, 8), 200.0, None, ground)
    np.testing.assert_array_equal(no_scale[0], no_scale[1])


@dataclass(frozen=True)
class Replayed:
    """A network that gives the same outputs for every image."""

    metadata: dict[str, Any]
    answers: list[np.ndarray]

    def run(self, images: np.ndarray, guides: np.ndarray) -> list[np.ndarray]:
        assert images.shape == (len(guides), 32, 48, 3)
        assert guides.shape[1:] == (2, 4, 6)
        return [np.repeat(answer[None], len(images), 0) for answer in self.answers]


def test_what_is_found_on_a_fixed_canvas_lies_in_the_image() -> None:
    spec = replace(SPEC, fit=InputFit((48, 32)))
    detector = GuidedDetector(Replayed(spec.to_metadata(), outputs(SPEC)))  # type: ignore[arg-type]
    # The image is twice as large as the canvas, so the canvas' focal length is half of its camera's.
    shape, stride = spec.guide_grid((96, 64))
    assert (shape, stride) == ((4, 6), 16.0)
    maps = guide_maps(spec, (96, 64), 400.0, None, np.full(shape, 0.02))
    np.testing.assert_allclose(maps, 0.01, rtol=1e-6)
    (found,) = detector.detect([np.zeros((64, 96, 3), np.uint8)], [maps], [400.0])
    on_canvas = suppress_guided(decode_guided(outputs(SPEC), SPEC, 200.0, 0.3), 0.4)
    np.testing.assert_allclose(found.xyxy_px, 2 * on_canvas.xyxy_px + 0.5)
    np.testing.assert_allclose(found.center_px, 2 * on_canvas.center_px + 0.5)
    np.testing.assert_allclose(found.depth_m, on_canvas.depth_m)
    np.testing.assert_allclose(found.sigma[:, :2], 2 * on_canvas.sigma[:, :2])
    np.testing.assert_allclose(found.sigma[:, 2:], on_canvas.sigma[:, 2:])


def test_metadata_round_trip_and_what_is_missing() -> None:
    fixed = replace(SPEC, fit=InputFit((48, 32)))
    assert GuidedSpec.from_metadata(fixed.to_metadata()).fit == fixed.fit
    values = SPEC.to_metadata()
    again = GuidedSpec.from_metadata(values)
    assert again.to_metadata() == values
    del values["priors"]
    with pytest.raises(PackError, match="priors"):
        GuidedSpec.from_metadata(values)
    for wrong in ({"std": [0.0] * 11}, {"guides": ["sonar"]}, {"priors": [[1.0] * 5]}, {"fit": CENTERED}):
        with pytest.raises(PackError, match="incomplete"):
            GuidedSpec.from_metadata({**SPEC.to_metadata(), **wrong})
