"""Training of the multi-bin head: crops of true boxes with jitter."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models_export.data.ahead import mapped_ahead
from models_export.data.augment import NO_AUGMENT, AugmentConfig, border_within, hidden_behind, photometric
from models_export.data.detection import VehicleSample
from models_export.data.mix import draw_by_odds
from models_export.data.vehicles import Vehicle, vehicles_of
from models_export.losses import likelihood_loss, multibin_loss, places_loss
from models_export.nets.multibin import SIGMA_UNITS, EdgeMultibin, MultibinConfig, outline_places
from models_export.nets.vgg_multibin import VggMultibinConfig
from models_export.train.task import Batch, ParameterGroup, decayed_groups
from service.geometry.boxes import TANGENT_DEGREES, cut_edges
from service.geometry.transforms import Array

JITTER, MAX_JITTER = 0.08, 0.2
"""Standard deviation and limit of a box edge in training over the box's side: the detector's boxes are not exact either."""
SIZE_WEIGHT, OUTLINE_WEIGHT, PLACES_WEIGHT = 4.0, 2.0, 6.0
"""Of the likelihoods of size and outline, and of the outline's places, over the angle's. At 1 the head learned little more of a
size than its class's mean; the outline is what the lift takes sizes and places from."""
CROP_AUGMENT = AugmentConfig(motion_px=4, jpeg_quality=(40, 95), noise_sigma=8.0, night=0.06, fog=0.06, hidden=0.3, cut=0.35)
"""Milder than a picture's: a crop is a few dozen pixels of it, and streaks and blocks do not shrink with it."""
_PLAIN_HEIGHT, _LEAST_ODDS, _MOST_ODDS, _CUT_ODDS = 30 / 672, 0.4, 2.5, 1.5
"""A vehicle is drawn as often as it is high, over a plain one's share of the picture's width, within limits; more often when
the border cuts it. Near vehicles, of which the picture often shows a part, are those whose boxes are wrong most often."""
_MIRRORED = [2, 1, 0, 3, *(4 + TANGENT_DEGREES.index((180 - angle) % 360) for angle in TANGENT_DEGREES)]
_MIRRORED_SIGN = [-1.0, 1.0, -1.0, 1.0, *(1.0,) * len(TANGENT_DEGREES)]
"""Where each reading of the outline comes from in the mirror, and its sign: edges are coordinates, tangents lengths."""


class MultibinTask:
    """The multi-bin head with its training vehicles."""

    name = "multibin"

    def __init__(
        self,
        samples: Iterable[VehicleSample],
        config: MultibinConfig | VggMultibinConfig,
        augment: AugmentConfig | None = None,
        *,
        build: Callable[[Any], nn.Module] = EdgeMultibin,
    ) -> None:
        """build: the head of a configuration, which gets the vehicles' mean sizes as its priors."""
        self.vehicles = _vehicles(samples, config)
        self.odds = vehicle_odds(self.vehicles)
        self.config = replace(config, mean_dims_lwh=mean_dims(self.vehicles, len(config.classes)))
        self.augment = augment or CROP_AUGMENT
        self.net = build(self.config)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        return {"net": asdict(self.config), "augment": asdict(self.augment), "vehicles": len(self.vehicles)}

    def __len__(self) -> int:
        return len(self.vehicles)

    def held_out(self, samples: Iterable[VehicleSample]) -> MultibinTask:
        """The same network and configuration over other samples, which are not augmented: for validation."""
        other = copy(self)
        other.vehicles, other.augment = _vehicles(samples, self.config), NO_AUGMENT
        other.odds = vehicle_odds(other.vehicles)
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Vehicles by their odds."""
        return draw_by_odds(rng, self.odds, size)

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a vehicle's frame."""
        return self.vehicles[index].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace."""
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """Crops (N, S, S, 3) uint8, alpha (N,), size residuals (N, 3) metres, outline (N, 12) in sides of the crop."""
        plain, crops, alphas, residuals, outlines = [], [], [], [], []
        means = np.array(self.config.mean_dims_lwh)
        for index in indices:
            vehicle = self.vehicles[index]
            if rng.random() < self.augment.cut:
                vehicle = vehicle.within(border_within(vehicle.xyxy_px, rng, self.augment))
            crop, alpha, outline = vehicle.crop(jittered(vehicle.xyxy_px, rng), self.config.crop_px)
            if rng.random() < self.augment.flip:
                crop, alpha, outline = crop[:, ::-1], -alpha, mirrored_outline(outline)
            plain.append(crop)
            if rng.random() < self.augment.hidden:
                # The first of a batch has nobody but itself to stand before it.
                crop = hidden_behind(crop, plain[rng.integers(len(plain))], rng, self.augment)
            crops.append(photometric(crop, rng, self.augment))
            alphas.append(alpha)
            residuals.append(vehicle.dims_lwh - means[vehicle.cls])
            outlines.append(outline)
        arrays = {"alpha": alphas, "residuals": residuals, "outline": outlines}
        tensors = {name: torch.tensor(np.array(values), dtype=torch.float32) for name, values in arrays.items()}
        return {"crops": torch.from_numpy(np.stack(crops)), **tensors}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The paper's equations 2 and 3; of a head that predicts more, also the likelihood of angle, size and outline."""
        found = net.with_places(batch["crops"]) if isinstance(net, EdgeMultibin) else net(batch["crops"])
        vectors, confidence, residual, *more = (out.float() for out in found)
        centers = torch.tensor(self.config.bin_centers_rad, device=vectors.device)
        alpha, residuals = batch["alpha"], batch["residuals"]
        paper = multibin_loss(vectors, confidence, residual, alpha, residuals, centers, self.config.bin_overlap_rad)
        if not more:
            return paper
        outline, log_sigma, logits = more
        turn = angle_error(vectors, alpha, centers)
        errors = torch.cat([turn[:, None], residual - residuals, outline - batch["outline"]], 1)
        units = torch.tensor(SIGMA_UNITS, device=errors.device)
        terms = likelihood_loss(errors / units, log_sigma - units.log()).mean(0)
        likelihood = {"angle_nll": terms[0], "size_nll": terms[1:4].mean(), "outline_nll": terms[4:].mean()}
        places = places_loss(logits, batch["outline"], outline_places().to(logits.device)).mean()
        weighted = SIZE_WEIGHT * likelihood["size_nll"] + OUTLINE_WEIGHT * likelihood["outline_nll"] + PLACES_WEIGHT * places
        total = paper["total"] + likelihood["angle_nll"] + weighted
        return {**paper, **likelihood, "places": places, "total": total}


def _vehicles(samples: Iterable[VehicleSample], config: MultibinConfig | VggMultibinConfig) -> list[Vehicle]:
    # Samples are let go as soon as their vehicles are cut out: frames of many scenes would not fit into memory.
    parts = mapped_ahead(lambda sample: vehicles_of(sample, config.crop_px, config.max_width), samples)
    return [vehicle for part in parts for vehicle in part]


def angle_error(vectors: Tensor, alpha: Tensor, bin_centers: Tensor) -> Tensor:
    """Angle (N,) of the bin vectors (N, B, 2) less the truth ``alpha`` (N,), in the bin nearest to the truth, in -pi..pi."""
    delta = torch.remainder(alpha[:, None] - bin_centers + torch.pi, 2 * torch.pi) - torch.pi
    nearest = delta.abs().argmin(1, keepdim=True)
    delta = delta.gather(1, nearest)[:, 0]
    cosine, sine = vectors.gather(1, nearest[..., None].expand(-1, -1, 2))[:, 0].unbind(-1)
    return torch.atan2(sine * delta.cos() - cosine * delta.sin(), cosine * delta.cos() + sine * delta.sin())


def vehicle_odds(vehicles: list[Vehicle]) -> Array:
    """Probabilities (N,) of drawing each vehicle: large and cut ones more often (``_PLAIN_HEIGHT``)."""
    height = np.array([(v.xyxy_px[3] - v.xyxy_px[1]) / v.camera.width for v in vehicles])
    is_cut = np.array([cut_edges(v.camera, v.xyxy_px[None]).any() for v in vehicles], dtype=bool)
    odds = np.clip(height / _PLAIN_HEIGHT, _LEAST_ODDS, _MOST_ODDS) * np.where(is_cut, _CUT_ODDS, 1.0)
    return odds / odds.sum()


def mean_dims(vehicles: list[Vehicle], classes: int) -> tuple[tuple[float, float, float], ...]:
    """Mean length, width, height of each class's vehicles, metres; a class without vehicles gets the mean of all."""
    dims = np.array([v.dims_lwh for v in vehicles])
    cls = np.array([v.cls for v in vehicles])
    rows = [dims[cls == c] if np.any(cls == c) else dims for c in range(classes)]
    return tuple((float(m[0]), float(m[1]), float(m[2])) for m in (np.round(r.mean(0), 4) for r in rows))


def mirrored_outline(outline: Array) -> Array:
    """Edges and tangents (12,) of a crop, about its middle, when it is mirrored left to right."""
    mirrored: Array = outline[_MIRRORED] * _MIRRORED_SIGN
    return mirrored


def jittered(xyxy_px: Array, rng: np.random.Generator) -> Array:
    """A box (4,) as a detector might give it."""
    sides = np.tile(xyxy_px[2:] - xyxy_px[:2], 2)
    noise = np.clip(rng.normal(0.0, JITTER, 4), -MAX_JITTER, MAX_JITTER)
    moved: Array = xyxy_px + noise * np.minimum(sides, 2 * sides.min())
    return moved
