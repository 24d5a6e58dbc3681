"""The Darknet file behind a pack's detector, run by torch on the same frames. Needs torch, so only ``--weights`` imports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.drive_score import DriveScore, score_drive
from benchmarks.drive_truth import DriveFrame
from models_export.darknet_import import config_of
from models_export.darknet_weights import read_weights
from models_export.nets.yolov3 import Yolov3
from models_export.verify import TorchNetwork, require_parity
from service.errors import InputError
from service.frames import decode
from service.nets.canvas import to_canvas
from service.nets.detector import Detector
from service.nets.pack import Network

_PARITY_FRAMES = 6


def score_darknet(
    network: Network, weights: Path, frames: Sequence[DriveFrame], thresholds: Sequence[float]
) -> tuple[list[DriveScore], float]:
    """Scores of the Darknet file that a pack was made from, run by torch; and how far the heads differ, over their range.

    Raises InputError when the pack's detector is not from a Darknet file, PackError when the two disagree.
    """
    if network.metadata.get("format") != "yolov3" or "network_classes" not in network.metadata:
        raise InputError(
            "this pack's detector is not from Darknet.", field="--weights", remedy="Make one with quadlift import-darknet."
        )
    net = Yolov3(config_of(network.metadata)).eval()
    read_weights(net, weights)
    # A detector asks of a network no more than metadata and outputs.
    detector = Detector(TorchNetwork(network.name, net, network.metadata))  # type: ignore[arg-type]
    width = detector.spec.max_width
    canvases = [to_canvas(decode(f.jpeg, f.camera, width), detector.fit)[None] for f in frames[:_PARITY_FRAMES]]
    return score_drive(detector, width, frames, thresholds), require_parity(net, network, canvases)
