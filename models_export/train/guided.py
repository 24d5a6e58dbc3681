"""Training of the depth-guided detector: batches of images and maps, targets at anchors, equation 7's loss."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models_export.data.augment import NO_AUGMENT, AugmentConfig
from models_export.data.guided_frames import NO_GUIDE_NOISE, GuidedFrame, GuideNoise, augmented, frame_maps
from models_export.guided_losses import (
    GuidedLossConfig,
    class_loss,
    combine,
    corner_loss,
    focal_factor,
    heading_bins_loss,
    regression,
    wrapped,
)
from models_export.nets.guided import EdgeGuided, GuidedConfig, ResNetGuided
from models_export.train.guided_corners import Viewpoint, corners
from models_export.train.guided_targets import AssignConfig, Assignment, assign_anchors, encode, fit_spec
from models_export.train.task import Batch, ParameterGroup, decayed_groups, draw_uniform
from service.nets.guided import GuidedSpec, anchor_boxes

_MEASURED_MAPS = 256


class GuidedTask:
    """A depth-guided detector with its training frames."""

    name = "guided"

    def __init__(
        self,
        frames: Sequence[GuidedFrame],
        net: EdgeGuided | ResNetGuided,
        *,
        assign: AssignConfig,
        loss: GuidedLossConfig,
        augment: AugmentConfig,
        noise: GuideNoise,
    ) -> None:
        self.frames = frames
        self.net = net
        self.config: GuidedConfig = net.config
        self.assign, self.weights, self.augment, self.noise = assign, loss, augment, noise
        self.spec = fit_spec(frames, self.config, assign)
        every = max(len(frames) // _MEASURED_MAPS, 1)
        net.guide.measure(torch.from_numpy(np.stack([frame_maps(self.spec, frame) for frame in frames[::every]])))

    def __len__(self) -> int:
        return len(self.frames)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, anchors, data and augmentation."""
        return {
            "net": asdict(self.config),
            "spec": self.spec.to_metadata(),
            "assign": asdict(self.assign),
            "loss": asdict(self.weights),
            "augment": asdict(self.augment),
            "noise": asdict(self.noise),
            "frames": len(self.frames),
        }

    def held_out(self, frames: Sequence[GuidedFrame]) -> GuidedTask:
        """The same network and anchors over other frames, which are not augmented: for validation."""
        other = copy(self)
        other.frames, other.augment, other.noise = frames, NO_AUGMENT, NO_GUIDE_NOISE
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Every frame is as likely as the others."""
        return draw_uniform(rng, len(self), size)

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a frame."""
        return self.frames[index].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace."""
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """images (B, H, W, 3) uint8, guides (B, G, h, w); of P anchors that answer: place (P, 4: image, anchor, row, column),
        cls (P,) with the background as 0, targets (P, 11), alpha (P,); blamed (B, A, h, w); view, for the corner term.
        """
        frames = [augmented(self.frames[i], rng, self.augment, self.noise) for i in indices]
        height, width = frames[0].canvas.shape[:2]
        grid = height // self.spec.stride, width // self.spec.stride
        found = [assign_anchors(frame, self.spec, grid, self.assign) for frame in frames]
        counts = [len(a.anchor) for a in found]
        place = np.column_stack(
            [np.repeat(np.arange(len(frames)), counts)]
            + [np.concatenate([getattr(a, name) for a in found]) for name in ("anchor", "row", "column")]
        )
        boxes = anchor_boxes(self.spec, place[:, 1], place[:, 2], place[:, 3])
        targets, cls, alpha = self._targets(frames, found, boxes)
        cameras = (np.repeat(np.stack([getattr(f, name) for f in frames]), counts, 0) for name in ("K", "R_cam_world"))
        return {
            "images": torch.from_numpy(np.stack([frame.canvas for frame in frames])),
            "guides": torch.from_numpy(np.stack([frame_maps(self.spec, frame) for frame in frames])),
            "place": torch.from_numpy(place),
            "cls": torch.from_numpy(cls + 1),
            "targets": torch.from_numpy(targets).float(),
            "alpha": torch.from_numpy(alpha).float(),
            "blamed": torch.from_numpy(np.stack([a.blamed for a in found])),
            "view": Viewpoint.of(self.spec, place[:, 1], boxes, *cameras),
        }

    def _targets(
        self, frames: Sequence[GuidedFrame], found: Sequence[Assignment], boxes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        parts = np.split(boxes, np.cumsum([len(a.anchor) for a in found])[:-1])
        encoded = [encode(self.spec, f, a.vehicle, a.anchor, p) for f, a, p in zip(frames, found, parts, strict=True)]
        pairs = list(zip(frames, found, strict=True))
        cls = np.concatenate([frame.cls[a.vehicle] for frame, a in pairs])
        return np.concatenate(encoded), cls, np.concatenate([frame.alpha[a.vehicle] for frame, a in pairs])

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Equation 7: class, 2D and 3D terms (and the corners'), and their sum."""
        heads = [head.float() for head in net(batch["images"], batch["guides"])]
        return guided_loss(heads, batch, self.spec, self.weights)


def guided_loss(heads: Sequence[Tensor], batch: Batch, spec: GuidedSpec, config: GuidedLossConfig) -> dict[str, Tensor]:
    """The loss of raw heads, each (B, A * F, h, w), on a batch of :meth:`GuidedTask.batch`."""
    grids = [head.unflatten(1, (len(spec.anchors_px), -1)).permute(0, 1, 3, 4, 2) for head in heads]
    at = tuple(batch["place"].T)
    logits, box_2d, box_3d, heading, *learned = (grid[at] for grid in grids)
    log_variance = learned[0] if learned else None
    targets, cls, alpha = batch["targets"], batch["cls"], batch["alpha"]
    background = grids[0][batch["blamed"]]
    classes = torch.cat(
        [class_loss(logits, cls, config.gamma), class_loss(background, cls.new_zeros(len(background)), config.gamma)]
    )
    solid = regression(box_3d, targets[:, 4:10], None if log_variance is None else log_variance[:, :6]).sum(1)
    last = None if log_variance is None else log_variance[:, 6]
    turn, found_alpha = _heading_terms(spec, heading, batch, last)
    corner = torch.zeros_like(solid)
    if config.corner:
        view = batch["view"].to(solid.device)
        theirs = corners(spec, view, targets[:, 4:10], alpha)
        corner = corner_loss(corners(spec, view, box_3d, found_alpha), theirs)
    flat = regression(box_2d, targets[:, :4], None).sum(1)
    return combine(classes, focal_factor(logits, cls, config.gamma), flat, solid + turn, corner, config)


def _heading_terms(spec: GuidedSpec, heading: Tensor, batch: Batch, log_variance: Tensor | None) -> tuple[Tensor, Tensor]:
    """The heading's loss (P,) and the angle that the outputs mean (P,)."""
    alpha = batch["alpha"]
    bins = len(spec.bin_centers_rad)
    if not bins:
        mean, std = float(spec.mean[10]), float(spec.std[10])
        # The difference of two angles is an angle: its error is wrapped before it is weighed.
        error = wrapped((heading[:, 0] - batch["targets"][:, 10]) * std) / std
        prior = batch["view"].priors.to(alpha.device)[:, 4]
        return regression(error, torch.zeros_like(error), log_variance), prior + heading[:, 0] * std + mean
    centers = torch.tensor(spec.bin_centers_rad, dtype=torch.float32, device=alpha.device)
    best = heading[:, 2 * bins :].argmax(1, keepdim=True)
    cosine, sine = heading[:, :bins].gather(1, best)[:, 0], heading[:, bins : 2 * bins].gather(1, best)[:, 0]
    return heading_bins_loss(heading, alpha, centers, log_variance), torch.atan2(sine, cosine) + centers[best[:, 0]]
