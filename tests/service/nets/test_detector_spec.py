"""Metadata to spec: old files go on working, and what cannot be is refused by name."""

from __future__ import annotations

from typing import Any

import pytest

from service.errors import PackError
from service.nets.canvas import PADDED, InputFit
from service.nets.detector_spec import DetectorSpec

OLD: dict[str, Any] = {
    "classes": ["car"],
    "strides": [8, 16],
    "anchors_px": [[[9, 7]], [[24, 18]]],
    "max_width": 672,
    "sigma_edge_px": [0.1, 0.02, 3.3, 1.3],
}
FIXED = {"width": 416, "height": 320, "place": "center", "pad": 0}
IMPORTED = {**OLD, "format": "ultralytics", "layout": "v8", "fit": FIXED, "network_classes": 80, "class_map": {"2": "car"}}


def test_metadata_without_a_format_is_the_projects_own() -> None:
    spec = DetectorSpec.from_metadata(OLD)
    assert (spec.format, spec.fit, spec.class_of, spec.network_classes) == ("quadlift", PADDED, None, 1)
    assert spec.anchors_px == (((9.0, 7.0),), ((24.0, 18.0),))


def test_metadata_of_another_format() -> None:
    spec = DetectorSpec.from_metadata(IMPORTED)
    assert spec.fit == InputFit((416, 320), "center", 0)
    assert (spec.strides, spec.anchors_px) == ((), ())
    assert spec.network_classes == 80
    assert spec.class_of is not None
    assert [index for index, ours in enumerate(spec.class_of) if ours >= 0] == [2]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"format": "ssd"}, "ssd"),
        ({"layout": "v9000"}, "v9000"),
        ({"fit": None}, "fixed size"),
        ({"fit": {"width": 416}}, "height"),
        ({"class_map": {"2": "tram"}}, "tuple.index|tram"),
        ({"class_map": {"80": "car"}}, "class_map"),
        ({"class_map": {}}, "class_map"),
        ({"class_map": ["car"]}, "items"),
        ({"format": "nanodet"}, "cell_center"),
        ({"format": "yolov3", "anchors_px": [[[1, 2]]]}, "1 sets of anchors for 2 strides"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(PackError, match=match):
        DetectorSpec.from_metadata({**IMPORTED, **change})
