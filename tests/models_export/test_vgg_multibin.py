"""The VGG16 multi-bin head: its published size, ImageNet's weights, what it learns, and that the service reads it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from models_export.data.augment import NO_AUGMENT
from models_export.data.samples import Sample
from models_export.export import to_onnx, with_metadata
from models_export.nets.blocks import parameter_count
from models_export.nets.vgg_multibin import VggMultibin, VggMultibinConfig, even_bins
from models_export.train.multibin import MultibinTask
from models_export.verify import require_parity
from service.errors import InputError
from service.nets.multibin import Crops, Multibin, crop_vehicles
from service.nets.pack import open_network

SMALL = VggMultibinConfig(
    crop_px=64, channels=(8, 16, 32, 32), convolutions=(1, 1, 2, 2), angle_width=32, size_width=32, dropout=0.0
)  # fmt: skip


@pytest.fixture(scope="module")
def published() -> VggMultibin:
    with torch.device("meta"):
        return VggMultibin(VggMultibinConfig())


def fully_connected(*widths: int) -> int:
    return sum(a * b + b for a, b in pairwise(widths))


def test_the_convolutions_are_vgg16s(published: VggMultibin) -> None:
    assert parameter_count(published.features) == 14_714_688
    convolutions = [int(name) for name, m in published.features.named_children() if isinstance(m, nn.Conv2d)]
    assert convolutions == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    assert published.features(torch.zeros(2, 3, 224, 224, device="meta")).shape == (2, 512, 7, 7)


@pytest.mark.parametrize("bins", [2, 4])
def test_the_whole_has_the_published_size(bins: int) -> None:
    with torch.device("meta"):
        net = VggMultibin(VggMultibinConfig(bin_centers_rad=even_bins(bins)))
    orientation, confidence = fully_connected(25088, 256, 256, 2 * bins), fully_connected(25088, 256, 256, bins)
    dimensions = fully_connected(25088, 512, 512, 3)
    assert parameter_count(net) == 14_714_688 + orientation + confidence + dimensions
    assert bins != 2 or parameter_count(net) == 40_803_145
    vectors, logits, residual = net(torch.zeros(5, 224, 224, 3, dtype=torch.uint8, device="meta"))
    assert (vectors.shape, logits.shape, residual.shape) == ((5, bins, 2), (5, bins), (5, 3))
    assert sum(isinstance(m, nn.Linear) for m in net.modules()) == 9


def test_vectors_have_length_one_and_crops_are_told_apart() -> None:
    torch.manual_seed(0)
    crops = torch.randint(0, 255, (5, 64, 64, 3), dtype=torch.uint8)
    net = VggMultibin(SMALL).eval()
    vectors, _, residual = net(crops)
    assert torch.allclose(vectors.norm(dim=-1), torch.ones(5, 2), atol=1e-5)
    assert torch.all(residual.std(0) > 1e-4)
    seen = net.normalise(torch.full((1, 1, 1, 3), 124, dtype=torch.uint8)).flatten()
    expected = [(124 / 255 - m) / s for m, s in ((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))]
    assert seen.tolist() == pytest.approx(expected, abs=1e-5)


def test_bins_that_leave_a_gap_are_refused() -> None:
    assert even_bins(2) == pytest.approx((0.0, math.pi))
    with pytest.raises(InputError, match="evenly"):
        VggMultibinConfig(bin_centers_rad=(0.0, 1.0))


def test_imagenet_weights_are_read_by_torchvisions_names(tmp_path: Path) -> None:
    torch.manual_seed(0)
    state = {f"features.{key}": value for key, value in VggMultibin(SMALL).features.state_dict().items()}
    torch.save({**state, "classifier.0.weight": torch.zeros(3)}, tmp_path / "vgg16.pth")
    net = VggMultibin(SMALL)
    net.load_imagenet(tmp_path / "vgg16.pth")
    for key, value in net.features.state_dict().items():
        assert torch.equal(value, state[f"features.{key}"])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ({"features.3.weight": None}, "'features.3.weight' is missing"),
        ({"features.6.bias": torch.zeros(3)}, r"'features.6.bias' has shape \(3,\)"),
    ],
)
def test_other_weights_are_refused(spoil: dict[str, torch.Tensor | None], message: str, tmp_path: Path) -> None:
    state = {f"features.{key}": value for key, value in VggMultibin(SMALL).features.state_dict().items()} | spoil
    torch.save({key: value for key, value in state.items() if value is not None}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=message):
        VggMultibin(SMALL).load_imagenet(tmp_path / "other.pth")


def test_what_is_no_state_dict_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_text("not weights")
    torch.save(torch.zeros(2), tmp_path / "tensor.pth")
    for name, message in (("text.pth", "cannot be read"), ("tensor.pth", "no state dict"), ("none.pth", "cannot be read")):
        with pytest.raises(InputError, match=message):
            VggMultibin(SMALL).load_imagenet(tmp_path / name)


def test_eight_crops_are_learned_by_heart_and_served(toy_samples: list[Sample]) -> None:
    torch.manual_seed(0)
    task = MultibinTask(toy_samples, replace(SMALL, bin_centers_rad=even_bins(3)), build=VggMultibin)
    net = task.net
    crops, alpha, dims = eight_of(toy_samples)
    residuals = dims - np.array(task.config.mean_dims_lwh)
    batch = {"crops": crops, "alpha": torch.tensor(alpha).float(), "residuals": torch.tensor(residuals).float()}
    groups = task.parameter_groups(net)
    assert [group.rate for group in groups] == [1.0, 1.0]
    assert sum(len(group.parameters) for group in groups) == len(list(net.parameters()))
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3)
    for _ in range(150):
        optimizer.zero_grad()
        losses = task.loss(net, batch)
        losses["total"].backward()
        optimizer.step()
    assert losses["total"].item() < 0.01
    metadata = {
        "crop_px": 64, "bin_centers_rad": task.config.bin_centers_rad, "mean_dims_lwh": task.config.mean_dims_lwh,
        "sigma_dims_lwh": [[0.1, 0.0, 0.0, 1.0]] * 3, "sigma_alpha_rad": [0.1, 0.0, 0.0, 1.0],
    }  # fmt: skip
    model = to_onnx(net.eval(), "multibin", (64, 64), ("vectors", "confidence", "residual"), dynamic_hw=False)
    network = open_network("multibin", with_metadata(model, metadata))
    require_parity(net, network, [crops.numpy(), crops.numpy()[:1]])
    found = Multibin(network).estimate(Crops(crops.numpy(), np.zeros((8, 3), np.int64)), np.zeros(8, np.int64))
    assert np.all(np.cos(found.alpha - alpha) > 0.95)
    np.testing.assert_allclose(found.dims_lwh, dims, atol=0.15)


def eight_of(samples: list[Sample]) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """One vehicle of each of eight frames: crops, alpha, sizes."""
    crops = np.concatenate([crop_vehicles(s.canvas, s.xyxy_px[:1], 64) for s in samples[:8]])
    return torch.from_numpy(crops), np.array([s.alpha[0] for s in samples[:8]]), np.array([s.dims_lwh[0] for s in samples[:8]])


def test_the_task_jitters_true_boxes(toy_samples: list[Sample]) -> None:
    one = replace(toy_samples[0], ignore=np.array([False, True]))
    task = MultibinTask([one], SMALL, NO_AUGMENT, build=VggMultibin)
    batch = task.batch(np.zeros(8, np.int64), np.random.default_rng(1))
    # A crop's place is rounded to whole pixels, so that two of eight may agree.
    assert len(np.unique(batch["crops"].numpy(), axis=0)) > 4
    # The crop's ray moves with the box, and alpha with the ray: by a few degrees, not more.
    off = batch["alpha"].numpy() - one.alpha[0]
    assert 0.001 < np.std(off) < 0.05
    assert torch.all(batch["residuals"].abs() < 1e-4)
