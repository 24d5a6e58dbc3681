"""Shapes of the networks, and that torch and the service read one detector output alike."""

from __future__ import annotations

import numpy as np
import torch

from models_export.nets.blocks import parameter_count
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.nets.multibin import OUTLINE_REACH, EdgeMultibin, MultibinConfig
from models_export.train.detector import assign, decode, detector_loss
from service.geometry.boxes import TANGENT_DEGREES
from service.nets.decoding import decode_heads
from service.nets.detector_spec import DetectorSpec
from service.nets.error_model import ErrorModel
from service.nets.multibin import UNCERTAIN

CONFIG = DetectorConfig(classes=("car",))


def spec_of(config: DetectorConfig) -> DetectorSpec:
    return DetectorSpec(config.classes, config.strides, config.anchors_px, config.max_width, ErrorModel(1.0, 0.02, 0.0, 1.0))


def test_detector_gives_three_scales_for_any_multiple_of_32() -> None:
    heads = EdgeDetector(CONFIG).eval()(torch.zeros(2, 96, 160, 3, dtype=torch.uint8))
    assert [tuple(head.shape) for head in heads] == [(2, 18, 12, 20), (2, 18, 6, 10), (2, 18, 3, 5)]


def test_an_untrained_detector_is_quiet() -> None:
    heads = EdgeDetector(CONFIG).eval()(torch.zeros(1, 96, 160, 3, dtype=torch.uint8))
    assert len(decode_heads([head[0].detach().numpy() for head in heads], spec_of(CONFIG), 0.3)) == 0


def test_multibin_vectors_have_length_one() -> None:
    crops = torch.randint(0, 255, (5, 96, 96, 3), dtype=torch.uint8)
    config = MultibinConfig()
    vectors, confidence, residual, outline, log_sigma = EdgeMultibin(config).eval()(crops)
    bins = len(config.bin_centers_rad)
    assert torch.allclose(vectors.norm(dim=-1), torch.ones(5, bins), atol=1e-4)
    assert confidence.shape == (5, bins)
    assert residual.shape == (5, 3)
    assert outline.shape == (5, 4 + len(TANGENT_DEGREES))
    assert outline.abs().max() < OUTLINE_REACH
    assert log_sigma.shape == (5, len(UNCERTAIN) + len(TANGENT_DEGREES))


def test_depth_gives_a_sixteenth_of_any_canvas() -> None:
    net = EdgeDepth(DepthConfig()).eval()
    assert net(torch.zeros(1, 96, 160, 3, dtype=torch.uint8)).shape == (1, 6, 10)
    assert net(torch.zeros(2, 64, 96, 3, dtype=torch.uint8)).shape == (2, 4, 6)


def test_folding_the_pooling_changes_no_output() -> None:
    torch.manual_seed(0)
    net = EdgeDepth(DepthConfig()).eval()
    images = torch.randint(0, 255, (2, 96, 160, 3), dtype=torch.uint8)
    folded = net.with_folded_pooling()
    assert not any(isinstance(module, torch.nn.AvgPool2d) for module in folded.modules())
    assert torch.allclose(folded.eval()(images), net(images), atol=1e-4)


def test_networks_are_small() -> None:
    assert parameter_count(EdgeDetector(CONFIG)) < 4e6
    assert parameter_count(EdgeMultibin(MultibinConfig())) < 4e6
    assert parameter_count(EdgeDepth(DepthConfig())) < 3e6


def heads_for(box: torch.Tensor, config: DetectorConfig) -> list[torch.Tensor]:
    """Logits of a detector that has learned one box by heart: found by descending the loss on the logits themselves."""
    heads = [torch.full((1, 18, 96 // s, 160 // s), -4.0, requires_grad=True) for s in config.strides]
    target = torch.cat([torch.tensor([[0.0, 0.0]]), box, torch.tensor([[0.0]])], 1)
    optimizer = torch.optim.Adam(heads, lr=0.3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 250)
    for _ in range(250):
        optimizer.zero_grad()
        detector_loss(heads, target, config)["total"].backward()
        optimizer.step()
        schedule.step()
    return heads


def test_the_loss_and_the_service_mean_the_same_box() -> None:
    box = torch.tensor([[41.0, 30.0, 78.0, 55.0]])
    heads = heads_for(box, CONFIG)
    found = decode_heads([head[0].detach().numpy() for head in heads], spec_of(CONFIG), 0.5)
    assert len(found) > 0
    np.testing.assert_allclose(found.xyxy_px, np.repeat(box.numpy(), len(found), axis=0), atol=1.0)


def test_decoding_in_torch_equals_decoding_in_numpy() -> None:
    generator = torch.Generator().manual_seed(3)
    heads = [torch.randn(1, 18, 96 // s, 160 // s, generator=generator) for s in CONFIG.strides]
    ours = []
    for head, stride, anchors in zip(heads, CONFIG.strides, CONFIG.anchors_px, strict=True):
        grid = head.unflatten(1, (3, 6)).permute(0, 1, 3, 4, 2)
        score = grid[..., 4].sigmoid() * grid[..., 5].sigmoid()
        index = (score > 0.6).nonzero(as_tuple=True)
        ours.append(torch.cat([score[index][:, None], decode(grid[index], index, stride, torch.tensor(anchors))], 1))
    expected = torch.cat(ours).numpy()
    found = decode_heads([head[0].numpy() for head in heads], spec_of(CONFIG), 0.6)
    expected = expected[np.argsort(-expected[:, 0], kind="stable")][: len(found)]
    np.testing.assert_allclose(found.score, expected[:, 0], atol=1e-5)
    np.testing.assert_allclose(found.xyxy_px, expected[:, 1:], atol=1e-3)


def test_every_assigned_cell_can_reach_its_target() -> None:
    target = torch.tensor([[0.0, 0.0, 41.0, 30.0, 78.0, 55.0, 0.0]])
    anchors = torch.tensor(CONFIG.anchors_px[0])
    (_, anchor, row, column), truth = assign(target, (12, 20), 8, anchors)
    assert len(truth) == 3 * len(set(anchor.tolist()))
    center = ((truth[:, 2:4] + truth[:, 4:6]) / 2 + 0.5) / 8
    offset = center - torch.stack([column, row], 1)
    # 2 sigmoid(t) - 0.5 reaches from -0.5 to 1.5.
    assert torch.all((offset >= -0.5) & (offset <= 1.5))


def test_ignored_vehicles_are_neither_asked_for_nor_blamed() -> None:
    heads = [torch.randn(1, 18, 96 // s, 160 // s) for s in CONFIG.strides]
    whole = torch.tensor([[0.0, 0.0, 0.0, 0.0, 159.0, 95.0, 1.0]])
    losses = detector_loss(heads, whole, CONFIG)
    assert losses["total"].item() == 0.0
