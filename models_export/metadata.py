"""What the service reads in the ONNX files of a pack: from a network's configuration, and from measurement."""

from __future__ import annotations

from typing import Any

from service.geometry.boxes import TANGENT_DEGREES
from service.nets.multibin import UNCERTAIN

UNMEASURED: dict[str, dict[str, Any]] = {
    "detector": {"sigma_edge_px": [1.0, 0.02, 0.0, 1.0]},
    "multibin": {
        "sigma_dims_lwh": [[0.3, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0]],
        "sigma_alpha_rad": [0.07, 0.0, 0.0, 1.0],
    },
    "depth": {"bias_relative": 0.0, "sigma_relative": 0.1},
}
"""By network, the errors that validation measures; these stand for them only until it has."""


def detector_metadata(config: Any) -> dict[str, Any]:
    """Of an anchored detector: classes, strides, anchors, the width of its images."""
    return {
        "classes": list(config.classes),
        "strides": list(config.strides),
        "anchors_px": config.anchors_px,
        "max_width": config.max_width,
    }


def yolov3_metadata(config: Any) -> dict[str, Any]:
    """The same of a YOLOv3, whose heads are decoded as Darknet does."""
    return {**detector_metadata(config), "format": "yolov3"}


def multibin_metadata(config: Any) -> dict[str, Any]:
    """Of a multi-bin head: its crops, bins and mean sizes."""
    return {
        "crop_px": config.crop_px,
        "bin_centers_rad": list(config.bin_centers_rad),
        "mean_dims_lwh": config.mean_dims_lwh,
    }


def uncertain_multibin_metadata(config: Any) -> dict[str, Any]:
    """Of a head that also reads edges and tangents and predicts its own standard deviations, in crops of larger images."""
    readings = len(UNCERTAIN) + len(TANGENT_DEGREES)
    return multibin_metadata(config) | {
        "max_width": config.max_width,
        "tangents_deg": list(TANGENT_DEGREES),
        "sigma_scale": [1.0] * readings,
    }


def depth_metadata(config: Any) -> dict[str, Any]:
    """Of a depth net: canvas pixels a cell."""
    return {"stride": config.stride}
