"""The depth-guided detector's loss (the paper's equation 7), term by term. Each takes plain tensors; each has a known answer.

As the paper writes it, (1 - s)^gamma weighs the whole loss of an anchor; its reference weighs the class alone, with gamma 1,
and leaves the corner term off. Both are options.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

_MAX_LOG_VARIANCE = 8.0


@dataclass(frozen=True)
class GuidedLossConfig:
    """Weights of the terms and where the focal factor acts."""

    gamma: float = 1.0
    focal_on: Literal["class", "all"] = "class"
    box_2d: float = 1.0
    box_3d: float = 1.0
    corner: float = 0.0


def focal_factor(logits: Tensor, cls: Tensor, gamma: float) -> Tensor:
    """(1 - s)^gamma (P,), s being the probability that logits (P, 1 + C) give to the true class (P,); no gradient."""
    s = logits.detach().softmax(1).gather(1, cls[:, None])[:, 0]
    return (1 - s) ** gamma


def class_loss(logits: Tensor, cls: Tensor, gamma: float) -> Tensor:
    """(1 - s)^gamma times the cross entropy (P,) of logits (P, 1 + C), background first."""
    return focal_factor(logits, cls, gamma) * F.cross_entropy(logits, cls, reduction="none")


def laplace_nll(error: Tensor, log_variance: Tensor) -> Tensor:
    """sqrt(2) exp(-s / 2) |error| + s / 2 (GUPNet), element by element: least where s is the log of the error's variance."""
    s = log_variance.clamp(-_MAX_LOG_VARIANCE, _MAX_LOG_VARIANCE)
    return math.sqrt(2.0) * torch.exp(-0.5 * s) * error.abs() + 0.5 * s


def regression(prediction: Tensor, target: Tensor, log_variance: Tensor | None) -> Tensor:
    """Smooth L1, or with log variances Laplace's negative log likelihood: (P, F)."""
    if log_variance is None:
        return F.smooth_l1_loss(prediction, target, reduction="none")
    return laplace_nll(prediction - target, log_variance)


def wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def heading_bins_loss(heading: Tensor, alpha: Tensor, centers: Tensor, log_variance: Tensor | None) -> Tensor:
    """Bins of the heading, as the multi-bin head's: (P,).

    heading (P, 3 K): cosines, sines, logits of K bins with ``centers`` (K,); alpha (P,) radians. The bin that holds the angle
    is chosen by cross entropy; bins that cover it turn by 1 - cosine. A log variance (P,) learns from the angle's error and
    does not move it.
    """
    bins = len(centers)
    delta = wrapped(alpha[:, None] - centers)
    covers = (delta.abs() <= math.pi / bins + 0.1).float()
    vector = F.normalize(torch.stack([heading[:, :bins], heading[:, bins : 2 * bins]], -1), dim=-1, eps=1e-4)
    turn = 1 - (vector[..., 0] * delta.cos() + vector[..., 1] * delta.sin())
    nearest = delta.abs().argmin(1)
    loss = (turn * covers).sum(1) + F.cross_entropy(heading[:, 2 * bins :], nearest, reduction="none")
    if log_variance is None:
        return loss
    angle = torch.atan2(vector[..., 1], vector[..., 0]).gather(1, nearest[:, None])[:, 0]
    error = wrapped(angle - delta.gather(1, nearest[:, None])[:, 0])
    return loss + laplace_nll(error.detach(), log_variance)


def corner_loss(ours: Tensor, theirs: Tensor) -> Tensor:
    """Smooth L1 between the corners of boxes, (P, 8, 3) metres: the mean over corners and axes (P,)."""
    return F.smooth_l1_loss(ours, theirs, reduction="none").mean((1, 2))


def combine(
    classes: Tensor, factor: Tensor, box_2d: Tensor, box_3d: Tensor, corner: Tensor, config: GuidedLossConfig
) -> dict[str, Tensor]:
    """The total and its terms.

    classes: (Q,) class losses of all anchors asked, focal factor included. factor, box_2d, box_3d, corner: (P,) of the anchors
    that answer for vehicles. All are summed over P.
    """
    count = max(len(box_2d), 1)
    weight = factor if config.focal_on == "all" else torch.ones_like(box_2d)
    terms = {
        "classes": classes.sum() / count,
        "box_2d": config.box_2d * (weight * box_2d).sum() / count,
        "box_3d": config.box_3d * (weight * box_3d).sum() / count,
        "corner": config.corner * (weight * corner).sum() / count,
    }
    return {"total": torch.stack(list(terms.values())).sum(), **terms}
