"""The recipe of pack ``edge``: which networks, trained how, exported how."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import nn

from models_export.data.dataset import list_scenes
from models_export.data.mix import MixConfig
from models_export.data.real import RealData
from models_export.data.samples import Sample, load_samples, split_scenes
from models_export.export import Exported, canvases_of, to_onnx, with_metadata, write_pack
from models_export.nets.blocks import parameter_count
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.nets.multibin import EdgeMultibin, MultibinConfig
from models_export.quantize import quantize
from models_export.train.checkpoint import load_averaged, read_checkpoint
from models_export.train.config import TrainConfig
from models_export.train.depth import DepthTask
from models_export.train.detector import DetectorTask
from models_export.train.loop import fit
from models_export.train.multibin import MultibinTask
from models_export.validate import (
    depth_scores,
    detect_all,
    detector_scores,
    edge_errors,
    image_of,
    match_all,
    multibin_scores,
)
from models_export.verify import require_parity
from service.errors import InputError
from service.nets.canvas import to_canvas
from service.nets.depth import DepthNet
from service.nets.detections import Detections
from service.nets.detector import Detector
from service.nets.multibin import Multibin, crop_vehicles
from service.nets.pack import Manifest, open_network

NETWORKS = ("detector", "multibin", "depth")
VERSION = "1"
_CALIBRATION_SCENES, _CALIBRATION_IMAGES = 24, 96
_PARITY_IMAGES = 4
_OUTPUTS = {"detector": ("p8", "p16", "p32"), "multibin": ("vectors", "confidence", "residual"), "depth": ("inverse_depth",)}
# Stand in the metadata only until validation has measured the real ones.
_SIGMA_UNKNOWN: dict[str, Any] = {
    "edge_px": [1.0, 0.02, 0.0, 1.0],
    "dims_lwh": [[0.3, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0]],
    "alpha_rad": [0.07, 0.0, 0.0, 1.0],
    "depth_relative": 0.1,
}

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class EdgeRecipe:
    """Everything that decides the weights, data aside."""

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    multibin: MultibinConfig = field(default_factory=MultibinConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    training: dict[str, TrainConfig] = field(
        default_factory=lambda: {
            "detector": TrainConfig(steps=4500, batch_size=16),
            "multibin": TrainConfig(steps=5000, batch_size=128, learning_rate=1e-3),
            "depth": TrainConfig(steps=2500, batch_size=16, learning_rate=1e-3),
        }
    )
    mix: MixConfig = field(default_factory=MixConfig)
    """Shares of the data sets in what the detector is given, where real recordings train too."""
    int8: tuple[str, ...] = NETWORKS
    """Networks that are quantized."""


def train(
    network: str,
    data: Sequence[Path],
    out: Path,
    recipe: EdgeRecipe,
    *,
    real: RealData | None = None,
    resume: bool = False,
) -> nn.Module:
    """Train one network of the pack on the training scenes of ``data``; checkpoints, log and curve go to ``out``.

    ``real`` adds recordings to the detector's frames and to the multi-bin head's vehicles. Raises InputError for an unknown
    network or too little data, NotFoundError for a recording that is not there.
    """
    if network not in NETWORKS:
        raise InputError(f"'{network}' is no network of this pack.", field="network", remedy=f"One of {', '.join(NETWORKS)}.")
    training, held_out = (_load(scenes, recipe) for scenes in split_scenes(data))
    classes, max_width = recipe.detector.classes, recipe.detector.max_width
    # Before the network is made: its first weights are drawn.
    torch.manual_seed(recipe.training[network].seed)
    if network == "detector":
        added, checked = real.detection(classes, max_width) if real else ([], [])
        detector = DetectorTask([*training, *added], recipe.detector, mix=recipe.mix if real else None)
        return fit(detector, recipe.training[network], out, detector.held_out([*held_out, *checked]), resume=resume)
    if network == "multibin":
        turned, verified = real.vehicles(classes, max_width) if real else ([], [])
        head = MultibinTask([*training, *turned], recipe.multibin)
        return fit(head, recipe.training[network], out, head.held_out([*held_out, *verified]), resume=resume)
    depth = DepthTask(training, recipe.depth)
    return fit(depth, recipe.training[network], out, depth.held_out(held_out), resume=resume)


def export(runs: Path, data: Sequence[Path], out: Path, recipe: EdgeRecipe, console: Console | None = None) -> Manifest:
    """Export the trained networks of ``runs`` to a pack in ``out``, checked, quantized and scored on validation scenes.

    Raises PackError when torch and ONNX Runtime disagree, InputError when a checkpoint is missing.
    """
    console = console or Console()
    training, validation = split_scenes(data)
    job = _Job.load(runs, training, validation, recipe)
    detector, found = job.detector()
    networks = [detector, job.multibin(found), job.depth(found)]
    for name in NETWORKS:
        console.print(name, job.scores[name])
    provenance = {
        "data": [_data_description(root) for root in data],
        "scenes": {"training": len(training), "validation": len(validation)},
        "networks": job.provenance,
    }
    classes = recipe.detector.classes
    return write_pack(out, networks, name="edge", version=VERSION, classes=classes, training=provenance, scores=job.scores)


@dataclass(frozen=True, eq=False)
class _Job:
    """One export: its inputs, and what it learns of each network on the way."""

    runs: Path
    recipe: EdgeRecipe
    samples: list[Sample]
    """Validation frames."""
    calibration: list[Sample]
    """Training frames whose activations set the int8 ranges."""
    scores: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def load(runs: Path, training: list[Path], validation: list[Path], recipe: EdgeRecipe) -> _Job:
        some = training[:: max(len(training) // _CALIBRATION_SCENES, 1)][:_CALIBRATION_SCENES]
        calibration = _load(some, recipe)
        return _Job(runs, recipe, _load(validation, recipe), calibration[:: max(len(calibration) // _CALIBRATION_IMAGES, 1)])

    def detector(self) -> tuple[Exported, list[Detections]]:
        saved = self._checkpoint("detector")
        config = replace(self.recipe.detector, anchors_px=_tuples(saved["anchors_px"]))
        net = self._weights("detector", EdgeDetector(config))
        metadata: dict[str, Any] = {
            "classes": list(config.classes),
            "strides": list(config.strides),
            "anchors_px": config.anchors_px,
            "max_width": config.max_width,
            "sigma_edge_px": _SIGMA_UNKNOWN["edge_px"],
        }
        model = to_onnx(net, "detector", (192, config.max_width), _OUTPUTS["detector"], dynamic_hw=True)
        model = self._checked(net, "detector", model, metadata, _image_batches(self.samples), self._calibration_canvases())
        found = detect_all(Detector(open_network("detector", with_metadata(model, metadata))), self.samples)
        metadata["sigma_edge_px"] = edge_errors(match_all(found, self.samples)).to_metadata()
        self.scores["detector"] |= detector_scores(found, self.samples) | {"sigma_edge_px": metadata["sigma_edge_px"]}
        return self._exported("detector", model, metadata, net), found

    def multibin(self, found: list[Detections]) -> Exported:
        saved = self._checkpoint("multibin")
        config = replace(self.recipe.multibin, mean_dims_lwh=_tuples(saved["mean_dims_lwh"]))
        net = self._weights("multibin", EdgeMultibin(config))
        metadata: dict[str, Any] = {
            "crop_px": config.crop_px,
            "bin_centers_rad": list(config.bin_centers_rad),
            "mean_dims_lwh": config.mean_dims_lwh,
            "sigma_dims_lwh": _SIGMA_UNKNOWN["dims_lwh"],
            "sigma_alpha_rad": _SIGMA_UNKNOWN["alpha_rad"],
        }
        side = config.crop_px
        model = to_onnx(net, "multibin", (side, side), _OUTPUTS["multibin"], dynamic_hw=False)
        inputs, crops = _crop_batches(self.samples, side)[:4], _crop_batches(self.calibration, side)
        model = self._checked(net, "multibin", model, metadata, inputs, crops)
        head = Multibin(open_network("multibin", with_metadata(model, metadata)))
        measured = multibin_scores(head, match_all(found, self.samples))
        metadata |= {key: measured[key] for key in ("sigma_dims_lwh", "sigma_alpha_rad")}
        self.scores["multibin"] |= measured
        return self._exported("multibin", model, metadata, net)

    def depth(self, found: list[Detections]) -> Exported:
        self._checkpoint("depth")
        net = EdgeDepth(self.recipe.depth)
        self._weights("depth", net)
        metadata: dict[str, Any] = {
            "stride": self.recipe.depth.stride,
            "bias_relative": 0.0,
            "sigma_relative": _SIGMA_UNKNOWN["depth_relative"],
        }
        model = to_onnx(
            net.with_folded_pooling(), "depth", (192, self.recipe.detector.max_width), _OUTPUTS["depth"], dynamic_hw=True
        )
        model = self._checked(net, "depth", model, metadata, _image_batches(self.samples), self._calibration_canvases())
        ours = DepthNet(open_network("depth", with_metadata(model, metadata)))
        measured = depth_scores(ours, self.samples, match_all(found, self.samples))
        metadata |= {key: measured[key] for key in ("bias_relative", "sigma_relative")}
        self.scores["depth"] |= measured
        return self._exported("depth", model, metadata, net)

    def _checkpoint(self, name: str) -> dict[str, Any]:
        state = read_checkpoint(self.runs / f"{name}.pt")
        self.provenance[name] = {"training": state["config"], "task": state["task"], "steps": state["step"]}
        net: dict[str, Any] = state["task"]["net"]
        return net

    def _weights(self, name: str, net: nn.Module) -> nn.Module:
        return load_averaged(self.runs / f"{name}.pt", net)[0]

    def _checked(
        self,
        net: nn.Module,
        name: str,
        model: bytes,
        metadata: dict[str, Any],
        inputs: list[Images],
        calibration: list[Images],
    ) -> bytes:
        """Parity of the float model, then int8 where the recipe says so."""
        difference = require_parity(net, open_network(name, with_metadata(model, metadata)), inputs)
        self.scores[name] = {"parity_with_torch": float(f"{difference:.2e}")}
        return quantize(model, calibration, keep_float=_OUTPUTS[name]) if name in self.recipe.int8 else model

    def _exported(self, name: str, model: bytes, metadata: dict[str, Any], net: nn.Module) -> Exported:
        precision = "int8" if name in self.recipe.int8 else "fp32"
        return Exported(name, with_metadata(model, metadata), precision, parameter_count(net))

    def _calibration_canvases(self) -> list[Images]:
        return canvases_of([sample.canvas for sample in self.calibration])


def _load(scenes: list[Path], recipe: EdgeRecipe) -> list[Sample]:
    return load_samples(scenes, recipe.detector.classes, recipe.detector.max_width, recipe.depth.stride)


def _image_batches(samples: list[Sample]) -> list[Images]:
    """Real frames in two non-square shapes: as they are, and a part of them."""
    images = [image_of(sample) for sample in samples[:_PARITY_IMAGES]]
    cut = [to_canvas(np.ascontiguousarray(image[: image.shape[0] * 2 // 3, : image.shape[1] // 2])) for image in images]
    return [np.stack([to_canvas(image) for image in images]), np.stack(cut)]


def _crop_batches(samples: list[Sample], side: int, batch: int = 32) -> list[Images]:
    crops = np.concatenate([crop_vehicles(image_of(s), s.xyxy_px[~s.ignore], side) for s in samples])
    return [crops[i : i + batch] for i in range(0, len(crops) - batch + 1, batch)]


def _tuples(rows: Any) -> Any:
    return tuple(_tuples(row) for row in rows) if isinstance(rows, list | tuple) else rows


def _data_description(root: Path) -> dict[str, Any]:
    """What a data set says of itself: every scene's world and seed."""
    scenes = [json.loads((scene / "scene.json").read_text("utf-8")) for scene in list_scenes(root)]
    return {
        "source": "simulator (models_export.scenes), generated data, no third-party images",
        "generators": sorted({str(scene["generator"]) for scene in scenes}),
        "worlds": sorted({str(scene["world"]) for scene in scenes}),
        "seeds": _ranges(sorted({int(scene["seed"]) for scene in scenes})),
    }


def _ranges(numbers: list[int]) -> list[str]:
    """Rising numbers as ``first-last`` of each run without gaps."""
    breaks = [i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1] + 1]
    runs = [numbers[a:b] for a, b in itertools.pairwise([0, *breaks, len(numbers)])]
    return [f"{run[0]}-{run[-1]}" for run in runs if run]
