"""Training of the multi-bin head: crops of true boxes with jitter."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models_export.data.augment import NO_AUGMENT, AugmentConfig, photometric
from models_export.data.detection import VehicleSample
from models_export.losses import multibin_loss
from models_export.nets.multibin import EdgeMultibin, MultibinConfig
from models_export.train.task import Batch, ParameterGroup, decayed_groups, draw_uniform
from service.geometry.camera import ray_azimuth
from service.geometry.transforms import Array, wrap_angle
from service.nets.multibin import crop_vehicles

JITTER = 0.06
"""Standard deviation of a box edge in training over the box's side: the detector's boxes are not exact either."""


class MultibinTask:
    """The multi-bin head with the vehicles of its training samples."""

    name = "multibin"

    def __init__(self, samples: Sequence[VehicleSample], config: MultibinConfig, augment: AugmentConfig | None = None) -> None:
        self.samples = samples
        self.vehicles = vehicles_of(samples)
        self.config = replace(config, mean_dims_lwh=mean_dims(samples, len(config.classes)))
        self.augment = augment or AugmentConfig()
        self.net = EdgeMultibin(self.config)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        return {"net": asdict(self.config), "augment": asdict(self.augment), "vehicles": len(self.vehicles)}

    def __len__(self) -> int:
        return len(self.vehicles)

    def held_out(self, samples: Sequence[VehicleSample]) -> MultibinTask:
        """The same network and configuration over other samples, which are not augmented: for validation."""
        other = copy(self)
        other.samples, other.augment = samples, NO_AUGMENT
        other.vehicles = vehicles_of(samples)
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Every vehicle is as likely as the others."""
        return draw_uniform(rng, len(self), size)

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a vehicle's frame."""
        return self.samples[self.vehicles[index, 0]].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace."""
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """Crops (N, S, S, 3) uint8, alpha (N,), size residuals (N, 3) metres."""
        crops, alphas, residuals = [], [], []
        means = np.array(self.config.mean_dims_lwh)
        for sample_index, row in self.vehicles[indices]:
            sample = self.samples[sample_index]
            crop, alpha = _jittered(sample, row, rng, self.config.crop_px)
            if rng.random() < self.augment.flip:
                crop, alpha = crop[:, ::-1], -alpha
            crops.append(photometric(crop, rng, self.augment))
            alphas.append(alpha)
            residuals.append(sample.dims_lwh[row] - means[sample.cls[row]])
        return {
            "crops": torch.from_numpy(np.stack(crops)),
            "alpha": torch.tensor(np.array(alphas), dtype=torch.float32),
            "residuals": torch.tensor(np.array(residuals), dtype=torch.float32),
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The paper's equations 2 and 3."""
        vectors, confidence, residual = (out.float() for out in net(batch["crops"]))
        centers = torch.tensor(self.config.bin_centers_rad, device=vectors.device)
        return multibin_loss(
            vectors, confidence, residual, batch["alpha"], batch["residuals"], centers, self.config.bin_overlap_rad
        )


def vehicles_of(samples: Sequence[VehicleSample]) -> NDArray[np.int64]:
    """(V, 2) sample and row of every vehicle that counts and whose class is known."""
    found = [(i, j) for i, s in enumerate(samples) for j in np.flatnonzero(~s.ignore & s.class_known)]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def mean_dims(samples: Sequence[VehicleSample], classes: int) -> tuple[tuple[float, float, float], ...]:
    """Mean length, width, height of each class's vehicles, metres; a class without vehicles gets the mean of all."""
    dims = np.concatenate([s.dims_lwh[~s.ignore] for s in samples])
    cls = np.concatenate([s.cls[~s.ignore] for s in samples])
    rows = [dims[cls == c] if np.any(cls == c) else dims for c in range(classes)]
    return tuple((float(m[0]), float(m[1]), float(m[2])) for m in (np.round(r.mean(0), 4) for r in rows))


def _jittered(sample: VehicleSample, row: int, rng: np.random.Generator, crop_px: int) -> tuple[np.ndarray, float]:
    """A crop around a jittered box, and alpha about the jittered centre's ray."""
    xyxy = sample.xyxy_px[row]
    sides = np.tile(xyxy[2:] - xyxy[:2], 2)
    moved: Array = xyxy + rng.normal(0.0, JITTER, 4) * np.minimum(sides, 2 * sides.min())
    centers = np.stack([(xyxy[:2] + xyxy[2:]) / 2, (moved[:2] + moved[2:]) / 2])
    azimuth = ray_azimuth(sample.camera, centers)
    width, height = sample.image_size
    crop = crop_vehicles(sample.canvas[:height, :width], moved[None], crop_px)[0]
    return crop, float(wrap_angle(sample.alpha[row] + azimuth[0] - azimuth[1]))
