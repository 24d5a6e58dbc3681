"""Corners of the depth-guided detector's boxes, with gradients: what the optional corner term compares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from service.geometry.boxes import CORNER_SIGNS
from service.geometry.transforms import Array
from service.nets.guided import GuidedSpec


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Anchors (P) and the cameras of their frames: what turns standardised outputs into boxes. The lens is left out."""

    anchors: Tensor
    """(P, 4) centre and size, px."""
    priors: Tensor
    """(P, 5) as in the spec."""
    K: Tensor
    """(P, 3, 3); the focal length along u is negative in mirrored frames."""
    R_cam_world: Tensor
    """(P, 3, 3)."""

    @staticmethod
    def of(spec: GuidedSpec, anchor: Array, boxes: Array, K: Array, R_cam_world: Array) -> Viewpoint:
        """From anchor numbers (P,), their boxes (P, 4) and cameras (P, 3, 3)."""
        parts = (boxes, spec.priors[anchor], K, R_cam_world)
        return Viewpoint(*(torch.from_numpy(np.ascontiguousarray(part)).float() for part in parts))

    def to(self, device: torch.device) -> Viewpoint:
        """The same on a device."""
        return Viewpoint(self.anchors.to(device), self.priors.to(device), self.K.to(device), self.R_cam_world.to(device))


def corners(spec: GuidedSpec, view: Viewpoint, boxes: Tensor, alpha: Tensor) -> Tensor:
    """World-oriented corners (P, 8, 3), metres from the camera, of standardised boxes (P, 6: u v depth l w h) and alpha (P,).

    alpha is in the frame's own sense: mirrored frames turn it back.
    """
    mean, std = (boxes.new_tensor(values[4:10]) for values in (spec.mean, spec.std))
    values = boxes * std + mean
    pixel = view.anchors[:, :2] + values[:, :2] * view.anchors[:, 2:]
    prior = view.priors[:, 0]
    depth = prior * values[:, 2].exp() if spec.log_depth else prior + values[:, 2]
    if spec.focal_px:
        depth = depth * view.K[:, 1, 1].abs() / spec.focal_px
    dims = view.priors[:, 1:4] * values[:, 3:6].exp()
    ray_cam = torch.linalg.solve(view.K, torch.cat([pixel, torch.ones_like(pixel[:, :1])], 1))
    ray = (ray_cam[:, None] @ view.R_cam_world)[:, 0]
    yaw = view.K[:, 0, 0].sign() * alpha + torch.atan2(ray[:, 1], ray[:, 0])
    offsets = 0.5 * boxes.new_tensor(CORNER_SIGNS) * dims[:, None]
    c, s = yaw.cos()[:, None], yaw.sin()[:, None]
    turned = torch.stack(
        [c * offsets[..., 0] - s * offsets[..., 1], s * offsets[..., 0] + c * offsets[..., 1], offsets[..., 2]], -1
    )
    return (ray * depth[:, None])[:, None] + turned
