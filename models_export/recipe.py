"""What a pack is made of: its networks, and how each is built, taught and exported. A pack's recipe is such a value."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import nn

from models_export.data.detection import DetectionSample
from models_export.data.real import RealData
from models_export.data.samples import Sample, read_samples, split_scenes
from models_export.guided import GuidedRecipe
from models_export.train import checkpoint, exported
from models_export.train.checkpoint import load_checkpoint
from models_export.train.config import TrainConfig, nested_tuples
from models_export.train.loop import fit
from models_export.train.task import Task
from service.errors import InputError

Precision = Literal["fp32", "fp16", "int8"]


class SampleTask(Task, Protocol):
    """A task over samples of scenes, and of real recordings where the network's recipe takes them."""

    def held_out(self, samples: Iterable[Any]) -> Task:
        """The same network and configuration over other samples, which are not augmented: for validation."""


def unchanged(net: nn.Module) -> nn.Module:
    """The network itself."""
    return net


def no_samples(real: RealData, classes: tuple[str, ...], max_width: int) -> tuple[list[Sample], list[Sample]]:
    """Recordings add nothing."""
    return [], []


@dataclass(frozen=True)
class NetworkRecipe:
    """One network of a pack."""

    name: str
    """Its role in the service: detector, multibin or depth."""
    config: Any
    """Frozen dataclass of the network's shape. The task replaces what the data decide: anchors, mean sizes."""
    build: Callable[[Any], nn.Module]
    """The network of a configuration."""
    task: Callable[[Iterable[Any], Any], SampleTask]
    """The task of training samples and a configuration."""
    training: TrainConfig
    outputs: tuple[str, ...]
    """Names of the graph's outputs."""
    metadata: Callable[[Any], dict[str, Any]]
    """Of the ONNX file, from the resolved configuration; what validation measures is added."""
    canvas_hw: tuple[int, int] | None = None
    """Height and width of the only input that it takes, px: frames are scaled to fit. None: any multiple of 32 px."""
    precision: Precision = "fp32"
    """In which it is exported unless asked otherwise."""
    openvino: bool = False
    """Whether OpenVINO, where it is installed, computes it rather than ONNX Runtime: where that was measured to be faster."""
    load_pretrained: Callable[[Any, Path], object] = load_checkpoint
    """Puts the weights of a user's file or folder into the network: what ``--init`` names."""
    load_foreign: Callable[[Task, Path], dict[str, Any]] | None = None
    """Puts the weights of an ONNX file that is no pack's into the network, and says whose they are."""
    real: Callable[[RealData, tuple[str, ...], int], tuple[Sequence[DetectionSample], Sequence[DetectionSample]]] = no_samples
    """What recordings add to the training and to the held-out samples, for given classes and width of images, px."""
    for_export: Callable[[Any], nn.Module] = unchanged
    """A network of the same outputs that runs faster, or that ONNX Runtime can run at all."""


@dataclass(frozen=True)
class PackRecipe:
    """Everything that decides a pack's weights, data aside."""

    name: str
    version: str
    networks: tuple[NetworkRecipe, ...]
    """In the order in which they are trained and exported; the detector first, for the others are measured on its boxes."""
    guided: GuidedRecipe
    """Of the depth-guided detector. It is trained and exported after the others, for it learns beside a pack's depth net."""

    @property
    def names(self) -> tuple[str, ...]:
        """The networks' names."""
        return tuple(network.name for network in self.networks)

    def network(self, name: str) -> NetworkRecipe:
        """A network by name. Raises InputError when the pack has none of that name."""
        for network in self.networks:
            if network.name == name:
                return network
        raise InputError(
            f"pack '{self.name}' has no network '{name}'.", field="network", remedy=f"One of {', '.join(self.names)}."
        )

    def with_training(self, name: str, training: TrainConfig) -> PackRecipe:
        """The recipe with another training of one network."""
        changed = replace(self.network(name), training=training)
        return replace(self, networks=tuple(changed if n.name == name else n for n in self.networks))

    def samples(self, scenes: Iterable[Path]) -> Iterator[Sample]:
        """Frames of scenes, as the detector and the depth net take them, read as they are taken."""
        detector, depth = self.network("detector").config, self.network("depth").config
        return read_samples(scenes, detector.classes, detector.max_width, depth.stride)


def train(
    recipe: PackRecipe,
    name: str,
    data: Sequence[Path],
    out: Path,
    *,
    real: RealData | None = None,
    init: Path | None = None,
    resume: bool = False,
) -> nn.Module:
    """Train one network on the training scenes of ``data``; checkpoint, logs and curves go to ``out``.

    real: recordings, for the networks that learn from them too. init: a file or folder of weights to start from, an earlier
    run's checkpoint or a pack's ONNX file of this network; when resuming it is not read. Raises InputError for an unknown
    network, too little data, and weights that do not fit, NotFoundError for recordings that are not there.
    """
    network = recipe.network(name)
    training, held_out = (recipe.samples(scenes) for scenes in split_scenes(data))
    detector = recipe.network("detector").config
    added, checked = network.real(real, detector.classes, detector.max_width) if real else ([], [])
    # Before the network is made: its first weights are drawn.
    torch.manual_seed(network.training.seed)
    task = network.task(chain(training, added), network.config)
    before = None
    if init is not None and resume:
        before = checkpoint.begun_with(task, out / f"{name}{checkpoint.SUFFIX}")
    elif init is not None and init.suffix == exported.SUFFIX:
        before = _from_onnx(network, task, init)
    elif init is not None and init.suffix == checkpoint.SUFFIX:
        before = checkpoint.go_on_from(task, init)
    elif init is not None:
        network.load_pretrained(task.net, init)
    config = replace(
        network.training,
        init=None if init is None else init.name,
        before=before,
        recordings=real.credits() if real and added else (),
    )
    return fit(task, config, out, task.held_out(chain(held_out, checked)), resume=resume)


def _from_onnx(network: NetworkRecipe, task: Task, path: Path) -> dict[str, Any] | None:
    """Start from an ONNX file, of a pack or of others; returns how its weights came about."""
    if network.load_foreign is not None and not exported.is_ours(path):
        return network.load_foreign(task, path)
    exported.load_exported(task, path)
    return exported.provenance(path)


def resolved_config(network: NetworkRecipe, saved: Mapping[str, Any]) -> Any:
    """The configuration that a checkpoint's network was trained with."""
    return replace(network.config, **{key: nested_tuples(value) for key, value in saved.items()})
