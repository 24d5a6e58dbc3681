"""Trained networks to a pack: converted, checked against torch, lowered in precision, measured on validation scenes."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from models_export.data.dataset import list_scenes
from models_export.data.samples import Sample, split_scenes
from models_export.data.vehicles import vehicles_of
from models_export.export import Exported, fixed_batch, to_onnx, with_metadata, write_pack
from models_export.half import to_half
from models_export.int8.quantize import for_onnxruntime, quantize
from models_export.metadata import UNMEASURED
from models_export.nets.blocks import parameter_count
from models_export.recipe import NetworkRecipe, PackRecipe, Precision, resolved_config
from models_export.train.checkpoint import load_averaged, read_checkpoint
from models_export.train.exported import training_of
from models_export.validate import (
    TooFewVehiclesError,
    depth_scores,
    detect_all,
    detector_scores,
    edge_errors,
    image_of,
    match_all,
    multibin_scores,
    reading_error,
)
from models_export.verify import require_parity
from service.errors import InputError
from service.nets.canvas import PADDED, InputFit
from service.nets.depth import DepthNet
from service.nets.detections import Detections
from service.nets.detector import Detector
from service.nets.multibin import Multibin
from service.nets.pack import Manifest, Network, Pack, load_pack, open_network

_CALIBRATION_SCENES, _CALIBRATION_IMAGES, _CALIBRATION_BATCH = 24, 96, 4
_PARITY_IMAGES, _CROPS = 4, 32
_EXAMPLE_HEIGHT = 192

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class ExportOptions:
    """How a pack is written."""

    precision: Precision | None = None
    """Of all networks; None: each in its recipe's."""
    keep_float: tuple[str, ...] = ()
    """Networks that stay in fp32 whatever ``precision`` says."""
    batch: int | None = None
    """Images of every run; the service fills up smaller batches. None: any number."""
    stand_ins: bool = False
    """Export although the detector finds too few vehicles to measure errors on; ``UNMEASURED`` values stand for them then, and
    the manifest says so."""
    base: str | None = None
    """Pack that gives the networks of which ``runs`` holds no checkpoint, as they are; None: every network needs one."""

    def precision_of(self, network: NetworkRecipe) -> Precision:
        """The precision of a network."""
        return "fp32" if network.name in self.keep_float else self.precision or network.precision


def export(
    recipe: PackRecipe,
    runs: Path,
    data: Sequence[Path],
    out: Path,
    options: ExportOptions | None = None,
    console: Console | None = None,
    validation: Sequence[Path] = (),
) -> Manifest:
    """Export the trained networks of ``runs`` to a pack in ``out``, checked, and measured on validation scenes.

    data: data sets that trained; some of their scenes set the ranges of int8. validation: data sets that did not; without any,
    those scenes of ``data`` that training holds out.
    Raises PackError when torch and ONNX Runtime disagree, InputError when a checkpoint is missing, TooFewVehiclesError when the
    detector finds too little to measure anything on.
    """
    console = console or Console()
    training, held_out = split_scenes(data)
    if validation:
        training, held_out = training + held_out, [scene for root in validation for scene in list_scenes(root)]
    some = training[:: max(len(training) // _CALIBRATION_SCENES, 1)][:_CALIBRATION_SCENES]
    calibration = list(recipe.samples(some))
    calibration = calibration[:: max(len(calibration) // _CALIBRATION_IMAGES, 1)]
    options = options or ExportOptions()
    base = None if options.base is None else load_pack(options.base, provider="cpu")
    job = _Job(recipe, runs, options, list(recipe.samples(held_out)), calibration, base)
    detections = job.detector()
    job.multibin(detections)
    job.depth(detections)
    for name, scores in job.scores.items():
        console.print(name, scores)
    provenance = {
        "data": [_data_description(root) for root in data],
        "scenes": {"training": len(training), "validation": len(held_out)},
        "networks": job.provenance,
    }
    return write_pack(
        out,
        job.exported,
        name=recipe.name,
        version=recipe.version,
        classes=job.classes(),
        training=provenance,
        scores=job.scores,
    )


@dataclass(frozen=True, eq=False)
class _Draft:
    """A network converted and checked, whose errors are not measured yet."""

    name: str
    model: bytes
    metadata: dict[str, Any]
    precision: Precision
    parameters: int
    openvino: bytes | None
    """The same in the form for OpenVINO, where the recipe wants one."""

    def open(self) -> Network:
        """The network as the service would open it."""
        return open_network(self.name, with_metadata(self.model, self.metadata | UNMEASURED[self.name]))


@dataclass(frozen=True, eq=False)
class _Job:
    """One export: its inputs, and what it learns of each network on the way."""

    recipe: PackRecipe
    runs: Path
    options: ExportOptions
    samples: list[Sample]
    """Validation frames."""
    calibration: list[Sample]
    """Training frames whose activations set the int8 ranges."""
    base: Pack | None = None
    """Gives the networks that were not trained anew."""
    exported: list[Exported] = field(default_factory=list)
    scores: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    def detector(self) -> list[Detections]:
        """The detector, and what it finds on the validation frames."""
        if (kept := self._kept("detector")) is not None:
            return detect_all(Detector(kept), self.samples)
        draft = self._frame_draft("detector")
        found = detect_all(Detector(draft.open()), self.samples)
        matches = match_all(found, self.samples)
        measured = self._measured("detector", lambda: {"sigma_edge_px": edge_errors(matches).to_metadata()})
        self._finish(draft, measured, detector_scores(found, self.samples) | measured)
        return found

    def multibin(self, found: list[Detections]) -> None:
        """The multi-bin head, measured on detected boxes."""
        if self._kept("multibin") is not None:
            return
        config = self.recipe.network("multibin").config
        draft = self._draft("multibin", _crop_batches(self.samples, config)[:4], _crop_batches(self.calibration, config))
        head, matches = Multibin(draft.open()), match_all(found, self.samples)
        scores = self._measured("multibin", lambda: multibin_scores(head, matches))
        # A head that predicts its deviations has a scale of them to be measured besides.
        measured = [key for key in UNMEASURED["multibin"] | draft.metadata if key in scores]
        self._finish(draft, {key: scores[key] for key in measured}, scores)

    def depth(self, found: list[Detections]) -> None:
        """The depth net, measured in detected boxes."""
        if self._kept("depth") is not None:
            return
        draft = self._frame_draft("depth")
        scores, errors = depth_scores(DepthNet(draft.open()), self.samples, match_all(found, self.samples))
        measured = self._measured("depth", lambda: reading_error(errors))
        self._finish(draft, measured, scores | measured)

    def classes(self) -> tuple[str, ...]:
        """The detector's classes. Raises InputError when a kept detector's are others than the recipe's first ones."""
        ours: tuple[str, ...] = self.recipe.network("detector").config.classes
        if self._checkpoint("detector").is_file() or self.base is None:
            return ours
        kept = tuple(self.base.manifest.classes)
        if kept != ours[: len(kept)]:
            raise InputError(f"its classes are {', '.join(kept)}.", field="base", remedy=f"They must be {', '.join(ours)}.")
        return kept

    def _checkpoint(self, name: str) -> Path:
        return self.runs / f"{name}.pt"

    def _kept(self, name: str) -> Network | None:
        """The base pack's network, taken over with its scores and provenance; None where there is a checkpoint, or no base."""
        if self.base is None or self._checkpoint(name).is_file():
            return None
        manifest = self.base.manifest
        self.exported.append(Exported.of_pack(self.base, name))
        self.scores[name] = manifest.scores.get(name, {})
        self.provenance[name] = training_of(manifest, name)
        return self.base.networks[name]

    def _measured(self, name: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What is measured of a network on detected vehicles, or stand-ins where there are too few and the options allow it."""
        try:
            return measure()
        except TooFewVehiclesError:
            if not self.options.stand_ins:
                raise
        return UNMEASURED[name] | {"stand_ins": True}

    def _frame_draft(self, name: str) -> _Draft:
        """The draft of a network that sees whole frames."""
        fit = _fit(self.recipe.network(name))
        draft = self._draft(name, _image_batches(self.samples, fit), self._calibration_canvases(fit))
        return replace(draft, metadata=draft.metadata | {"fit": fit.to_metadata()})

    def _draft(self, name: str, inputs: list[Images], calibration: list[Images]) -> _Draft:
        """Checkpoint to ONNX at the asked precision and batch; each form that can be is compared with torch on ``inputs``."""
        network = self.recipe.network(name)
        state = read_checkpoint(self._checkpoint(name))
        self.provenance[name] = {"training": state["config"], "task": state["task"], "steps": state["step"]}
        config = resolved_config(network, state["task"]["net"])
        net, _ = load_averaged(self._checkpoint(name), network.build(config))
        example_hw = network.canvas_hw or (_EXAMPLE_HEIGHT, self.recipe.network("detector").config.max_width)
        model = to_onnx(network.for_export(net), name, example_hw, network.outputs, dynamic_hw=network.canvas_hw is None)
        precision = self.options.precision_of(network)
        worst = {"fp32": require_parity(net, open_network(name, with_metadata(model, {})), inputs)}
        if precision == "fp16":
            model = to_half(model)
            worst["fp16"] = require_parity(net, open_network(name, with_metadata(model, {})), inputs, precision)
        elif precision == "int8":
            model = quantize(model, calibration, keep_float=network.outputs)
        openvino = model if network.openvino else None
        if precision == "int8":
            model = for_onnxruntime(model, keep_float=network.outputs)
        if self.options.batch is not None:
            model = fixed_batch(model, self.options.batch)
            openvino = None if openvino is None else fixed_batch(openvino, self.options.batch)
        self.scores[name] = {"parity_with_torch": float(f"{worst[precision if precision in worst else 'fp32']:.2e}")}
        return _Draft(name, model, network.metadata(config), precision, parameter_count(net), openvino)

    def _finish(self, draft: _Draft, measured: dict[str, Any], scores: dict[str, Any]) -> None:
        metadata = draft.metadata | measured
        model = with_metadata(draft.model, metadata)
        openvino = None if draft.openvino is None else with_metadata(draft.openvino, metadata)
        self.exported.append(Exported(draft.name, model, draft.precision, draft.parameters, openvino))
        self.scores[draft.name] |= scores

    def _calibration_canvases(self, fit: InputFit) -> list[Images]:
        groups = [batch.pixels for batch in fit.batches([image_of(sample) for sample in self.calibration])]
        return [group[i : i + _CALIBRATION_BATCH] for group in groups for i in range(0, len(group), _CALIBRATION_BATCH)]


def _fit(network: NetworkRecipe) -> InputFit:
    """How frames become canvases of a network that sees whole frames."""
    return PADDED if network.canvas_hw is None else InputFit((network.canvas_hw[1], network.canvas_hw[0]))


def _image_batches(samples: list[Sample], fit: InputFit) -> list[Images]:
    """Real frames in two non-square shapes: as they are, and a part of them."""
    images = [image_of(sample) for sample in samples[:_PARITY_IMAGES]]
    cut = [np.ascontiguousarray(image[: image.shape[0] * 2 // 3, : image.shape[1] // 2]) for image in images]
    return [batch.pixels for batch in [*fit.batches(images), *fit.batches(cut)]]


def _crop_batches(samples: list[Sample], config: Any) -> list[Images]:
    vehicles = [vehicle for sample in samples for vehicle in vehicles_of(sample, config.crop_px, config.max_width)]
    crops = np.stack([vehicle.crop(vehicle.xyxy_px, config.crop_px)[0] for vehicle in vehicles])
    return [crops[i : i + _CROPS] for i in range(0, max(len(crops) - _CROPS, 0) + 1, _CROPS)]


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
