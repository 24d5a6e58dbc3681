"""The losses of the three networks. Every one takes plain tensors and a mask, and has a known-answer test."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

TRIM = 0.2
"""Share of the largest residuals that the depth loss leaves out (MiDaS)."""


def ciou(a_xyxy: Tensor, b_xyxy: Tensor) -> Tensor:
    """Complete IoU (N,) of matched boxes (N, 4): IoU less the centre distance and the aspect difference, in -1..1."""
    eps = 1e-7
    wh = (torch.minimum(a_xyxy[:, 2:], b_xyxy[:, 2:]) - torch.maximum(a_xyxy[:, :2], b_xyxy[:, :2])).clamp(min=0)
    intersection = wh.prod(1)
    size_a, size_b = a_xyxy[:, 2:] - a_xyxy[:, :2], b_xyxy[:, 2:] - b_xyxy[:, :2]
    iou = intersection / (size_a.prod(1) + size_b.prod(1) - intersection + eps)
    hull = torch.maximum(a_xyxy[:, 2:], b_xyxy[:, 2:]) - torch.minimum(a_xyxy[:, :2], b_xyxy[:, :2])
    offset = 0.5 * (a_xyxy[:, :2] + a_xyxy[:, 2:] - b_xyxy[:, :2] - b_xyxy[:, 2:])
    distance = (offset**2).sum(1) / ((hull**2).sum(1) + eps)
    aspect = (4 / math.pi**2) * (torch.atan2(size_b[:, 0], size_b[:, 1]) - torch.atan2(size_a[:, 0], size_a[:, 1])) ** 2
    with torch.no_grad():
        weight = aspect / (1 - iou + aspect + eps)
    return iou - distance - weight * aspect


def multibin_loss(
    vectors: Tensor,
    confidence: Tensor,
    residual: Tensor,
    alpha: Tensor,
    dims_residual: Tensor,
    bin_centers: Tensor,
    overlap_rad: float,
    *,
    weights: tuple[float, float, float] = (0.6, 1.0, 0.4),
) -> dict[str, Tensor]:
    """The paper's equations 2 and 3: size under L2, bins under cross entropy, angles under cosine in the covering bins.

    vectors (N, B, 2), confidence (N, B), residual (N, 3) metres: the head's outputs. alpha (N,) radians and
    dims_residual (N, 3) metres: the truth. weights: of size, confidence, angle. An angle in two bins' overlap trains both;
    the bin whose centre is nearer is the right answer for the confidence.
    """
    delta = torch.remainder(alpha[:, None] - bin_centers[None] + math.pi, 2 * math.pi) - math.pi
    half_width = math.pi / len(bin_centers) + overlap_rad
    covers = (delta.abs() <= half_width).float()
    cosine = vectors[..., 0] * torch.cos(delta) + vectors[..., 1] * torch.sin(delta)
    angle = 1 - (cosine * covers).sum(1) / covers.sum(1)
    size = F.mse_loss(residual, dims_residual)
    bins = F.cross_entropy(confidence, delta.abs().argmin(1))
    total = weights[0] * size + weights[1] * bins + weights[2] * angle.mean()
    return {"total": total, "size": size, "bins": bins, "angle": angle.mean()}


def likelihood_loss(error: Tensor, log_sigma: Tensor, beta: float = 0.5) -> Tensor:
    """Gaussian negative log-likelihood (N, ...) of errors whose standard deviation is predicted, in nats, without its constant.

    Each term is weighted by sigma^(2 beta), held constant: beta 0 is the plain likelihood, under which a network gives up on
    what it finds hard; beta 1 trains the error like squares (Seitzer et al., On the Pitfalls of Heteroscedastic Uncertainty
    Estimation). For any beta the best sigma is the error's root mean square.
    """
    weight = torch.exp(2 * beta * log_sigma).detach()
    return weight * (0.5 * (error * torch.exp(-log_sigma)) ** 2 + log_sigma)


def places_loss(logits: Tensor, target: Tensor, places: Tensor) -> Tensor:
    """Cross entropy (N, R) of distributions over evenly spaced ``places`` (P,), logits (N, R, P), for targets (N, R).

    The target is shared between the two places beside it, so that its mean is exact (distribution focal loss without its focus,
    Li et al., Generalized Focal Loss, eq. 6). Targets beyond the places count as the outermost.
    """
    step = places[1] - places[0]
    position = ((target - places[0]) / step).clamp(0, len(places) - 1)
    low = position.floor().clamp(max=len(places) - 2).long()
    share = position - low
    log_odds = logits.log_softmax(-1)
    near, far = (log_odds.gather(-1, index[..., None])[..., 0] for index in (low, low + 1))
    return -((1 - share) * near + share * far)


def align(values: Tensor, mask: Tensor) -> Tensor:
    """Values (B, H, W) less their median, over their mean absolute deviation, per image over valid pixels only.

    Masked pixels come out as 0. An image without valid pixels comes out as 0 throughout.
    """
    flat, valid = values.flatten(1), mask.flatten(1)
    count = valid.sum(1).clamp(min=1)
    # Masked pixels sort to the end as +inf: the median is then a plain index, free of them.
    ordered = torch.where(valid, flat, torch.inf).sort(1).values
    median = ordered.gather(1, ((count - 1) // 2)[:, None])
    median = torch.where(torch.isfinite(median), median, torch.zeros_like(median))
    centred = torch.where(valid, flat - median, torch.zeros_like(flat))
    deviation = (centred.abs().sum(1) / count)[:, None].clamp(min=1e-6)
    return (centred / deviation).reshape(values.shape)


def trimmed_ssi_loss(prediction: Tensor, target: Tensor, mask: Tensor, trim: float = TRIM) -> Tensor:
    """Scale-and-shift-invariant trimmed loss on inverse depth (B, H, W): a scalar.

    Both sides are aligned per image; the largest ``trim`` of the absolute residuals are left out; the rest are summed
    over 2 M, M being the image's valid pixels. Images without valid pixels count as 0.
    """
    residual = (align(prediction, mask) - align(target, mask)).abs().flatten(1)
    valid = mask.flatten(1)
    count = valid.sum(1)
    ordered = torch.where(valid, residual, torch.inf).sort(1).values
    kept = torch.arange(residual.shape[1], device=residual.device)[None] < (count * (1 - trim)).floor()[:, None]
    summed = torch.where(kept, ordered, torch.zeros_like(ordered)).sum(1)
    return (summed / (2 * count.clamp(min=1))).mean()


def gradient_matching_loss(prediction: Tensor, target: Tensor, mask: Tensor, scales: int = 4) -> Tensor:
    """Mean absolute gradient of the aligned residual over ``scales`` resolutions, between valid neighbours only."""
    residual = align(prediction, mask) - align(target, mask)
    total = prediction.new_zeros(())
    for level in range(scales):
        step = 2**level
        r, m = residual[:, ::step, ::step], mask[:, ::step, ::step]
        across = (r[:, :, 1:] - r[:, :, :-1]).abs() * (m[:, :, 1:] & m[:, :, :-1])
        down = (r[:, 1:] - r[:, :-1]).abs() * (m[:, 1:] & m[:, :-1])
        total = total + (across.sum() + down.sum()) / m.sum().clamp(min=1)
    return total


def depth_loss(prediction: Tensor, target: Tensor, mask: Tensor, gradient_weight: float = 0.5) -> dict[str, Tensor]:
    """Trimmed scale-and-shift-invariant loss plus weighted gradient matching."""
    ssi = trimmed_ssi_loss(prediction, target, mask)
    gradient = gradient_matching_loss(prediction, target, mask)
    return {"total": ssi + gradient_weight * gradient, "ssi": ssi, "gradient": gradient}
