"""What the service reads in the ONNX files of a pack: from a network's configuration, and from measurement."""

from __future__ import annotations

from typing import Any

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


def multibin_metadata(config: Any) -> dict[str, Any]:
    """Of a multi-bin head: its crops, bins and mean sizes."""
    return {
        "crop_px": config.crop_px,
        "bin_centers_rad": list(config.bin_centers_rad),
        "mean_dims_lwh": config.mean_dims_lwh,
    }


def depth_metadata(config: Any) -> dict[str, Any]:
    """Of a depth net: canvas pixels a cell."""
    return {"stride": config.stride}
