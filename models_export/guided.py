"""The depth-guided detector: its recipe, its training beside a pack's depth net, and its export into that pack."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import nn
from torch.export import Dim

from models_export.data.augment import AugmentConfig
from models_export.data.guided_frames import GuidedFrame, GuideNoise, Map, frame_maps, guided_frames
from models_export.data.samples import Sample, read_samples, split_scenes
from models_export.export import MAX_TILES, Exported, trace, with_metadata, write_pack
from models_export.guided_losses import GuidedLossConfig
from models_export.guided_scores import measure
from models_export.nets.blocks import parameter_count
from models_export.nets.guided import OUTPUTS, EdgeGuided, GuidedConfig, ResNetGuided
from models_export.train.checkpoint import load_averaged, load_checkpoint, read_checkpoint
from models_export.train.config import TrainConfig
from models_export.train.guided import GuidedTask
from models_export.train.guided_targets import AssignConfig
from models_export.train.loop import fit
from models_export.verify import require_parity
from service.nets.canvas import ALIGN_PX, PADDED, InputFit
from service.nets.depth import DepthNet
from service.nets.guided import GuidedDetector, GuidedSpec
from service.nets.pack import Manifest, Pack, load_pack, open_network

_PARITY_FRAMES = 4


@dataclass(frozen=True)
class GuidedRecipe:
    """Everything that decides the weights, data aside; the defaults are the edge size's."""

    net: GuidedConfig = field(default_factory=GuidedConfig)
    build: Callable[[GuidedConfig], EdgeGuided | ResNetGuided] = EdgeGuided
    """The network of a configuration."""
    assign: AssignConfig = field(default_factory=lambda: AssignConfig(best_iou=0.2, background_iou=0.4))
    """Roadside vehicles are small: at least one anchor answers for each, and near misses are not blamed."""
    loss: GuidedLossConfig = field(default_factory=lambda: GuidedLossConfig(gamma=2.0))
    """Gamma 2, for no anchors are left out of the background here, and most are easy."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    noise: GuideNoise = field(default_factory=GuideNoise)
    load_pretrained: Callable[[Any, Path], object] = load_checkpoint
    """Puts the weights of a user's file into the network."""
    training: TrainConfig = field(
        default_factory=lambda: TrainConfig(steps=4000, batch_size=8, learning_rate=6e-3, ema_decay=0.995, amp=False)
    )


def train_guided(
    data: Sequence[Path], pack: str, out: Path, recipe: GuidedRecipe, *, init: Path | None = None, resume: bool = False
) -> nn.Module:
    """Train on the training scenes of ``data``, guided by the maps of the pack's own depth net.

    Checkpoint, logs and curves go to ``out``. init: weights to start from; not read when resuming. Raises InputError for too
    little data and weights that do not fit, PackError for an unusable pack.
    """
    depth = DepthNet(load_pack(pack).networks["depth"])
    training, held_out = (_frames(scenes, depth, recipe)[1] for scenes in split_scenes(data))
    # Before the network is made: its first weights are drawn.
    torch.manual_seed(recipe.training.seed)
    net = recipe.build(recipe.net)
    task = GuidedTask(training, net, assign=recipe.assign, loss=recipe.loss, augment=recipe.augment, noise=recipe.noise)
    if init is not None and not resume:
        recipe.load_pretrained(net, init)
    config = replace(recipe.training, init=None if init is None else init.name)
    return fit(task, config, out, task.held_out(held_out), resume=resume)


def _frames(scenes: Sequence[Path], depth: DepthNet, recipe: GuidedRecipe) -> tuple[list[Sample], list[GuidedFrame]]:
    samples = list(read_samples(scenes, recipe.net.classes, recipe.net.max_width, recipe.net.guide_stride))
    return samples, guided_frames(samples, depth)


def export_guided(
    runs: Path, data: Sequence[Path], pack: str, out: Path, recipe: GuidedRecipe, console: Console | None = None
) -> Manifest:
    """A copy of a pack in ``out`` with the trained detector of ``runs`` in it, checked and scored on validation scenes.

    Raises PackError when torch and ONNX Runtime disagree, InputError when the checkpoint is missing.
    """
    base = load_pack(pack)
    state = read_checkpoint(runs / f"{GuidedTask.name}.pt")
    net = load_averaged(runs / f"{GuidedTask.name}.pt", recipe.build(recipe.net))[0]
    samples, frames = _frames(split_scenes(data)[1], DepthNet(base.networks["depth"]), recipe)
    spec = replace(GuidedSpec.from_metadata(state["task"]["spec"]), fit=fit_of(net, frames))
    model = guided_onnx(net, recipe.net, frames[0].canvas.shape[:2])
    network = open_network(GuidedTask.name, with_metadata(model, spec.to_metadata()))
    inputs = [real_inputs(spec, frames[:_PARITY_FRAMES])]
    if isinstance(net, EdgeGuided):
        inputs.append(real_inputs(spec, frames[:1], cut=True))
    difference = require_parity(net, network, inputs)
    errors = measure(GuidedDetector(network), samples, frames)
    spec = replace(spec, sigma_scale=errors.sigma_scale)
    scores = {"parity_with_torch": float(f"{difference:.2e}"), **errors.scores}
    (console or Console()).print(GuidedTask.name, scores)
    added = Exported(GuidedTask.name, with_metadata(model, spec.to_metadata()), "fp32", parameter_count(net))
    provenance = {"training": state["config"], "task": state["task"], "steps": state["step"], "data": [d.name for d in data]}
    return add_to_pack(base, out, added, provenance, scores)


def fit_of(net: nn.Module, frames: Sequence[GuidedFrame]) -> InputFit:
    """Any canvas for the edge size; for the published one that of the frames."""
    height, width = frames[0].canvas.shape[:2]
    return PADDED if isinstance(net, EdgeGuided) else InputFit((width, height))


def guided_onnx(net: nn.Module, config: GuidedConfig, canvas_hw: tuple[int, int]) -> bytes:
    """The ONNX file: images (B, H, W, 3) uint8 and guides (B, G, H / s, W / s) float32.

    The edge size takes any canvas, in multiples of 32 px; the published one only that of ``canvas_hw``.
    """
    height, width = canvas_hw
    cells = ALIGN_PX // config.guide_stride
    examples = {
        "images": torch.zeros((2, height, width, 3), dtype=torch.uint8),
        "guides": torch.zeros((2, len(config.guides), height // config.guide_stride, width // config.guide_stride)),
    }
    images, guides = {0: Dim("batch")}, {0: Dim("batch")}
    if isinstance(net, EdgeGuided):
        rows, columns = (Dim(axis, min=1, max=MAX_TILES) for axis in ("rows", "columns"))
        images |= {1: ALIGN_PX * rows, 2: ALIGN_PX * columns}
        guides |= {2: cells * rows, 3: cells * columns}
    return trace(net, GuidedTask.name, examples, (images, guides), OUTPUTS[: 4 + config.learned_sigma])


def real_inputs(spec: GuidedSpec, frames: Sequence[GuidedFrame], *, cut: bool = False) -> tuple[NDArray[np.uint8], Map]:
    """Canvases and guides of real frames; with ``cut`` their left halves, for a second shape."""
    maps = np.stack([frame_maps(spec, frame) for frame in frames])
    images = np.stack([frame.canvas for frame in frames])
    if not cut:
        return images, maps
    width = images.shape[2] // 2 // ALIGN_PX * ALIGN_PX
    return np.ascontiguousarray(images[:, :, :width]), np.ascontiguousarray(maps[..., : width // spec.guide_stride])


def add_to_pack(base: Pack, out: Path, added: Exported, provenance: dict[str, Any], scores: dict[str, Any]) -> Manifest:
    """Write the pack ``base`` with one network more to ``out``, which may be its own folder."""
    old = base.manifest
    kept = [Exported.of_pack(base, name) for name in old.networks if name != added.name]
    networks = {**old.training.get("networks", {}), added.name: provenance}
    return write_pack(
        out, [*kept, added], name=old.name, version=old.version, classes=old.classes,
        training={**old.training, "networks": networks}, scores={**old.scores, added.name: scores},
    )  # fmt: skip
