"""Darknet's loss by known answers: its deltas, its one anchor of nine, and whom it leaves alone."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from models_export.nets.yolov3 import Yolov3Config
from models_export.yolo_loss import assign_best, flatten, yolo_loss
from service.nets.decoding import decode_heads
from service.nets.detector_spec import DetectorSpec
from service.nets.error_model import ErrorModel

CONFIG = Yolov3Config(classes=("car", "van"))
WIDTH, HEIGHT = 160, 96
SURE = 20.0
"""A logit whose sigmoid is 1 to the last digit."""


def heads_of(value: float, batch: int = 1) -> list[Tensor]:
    """Heads with one logit everywhere."""
    return [torch.full((batch, 21, HEIGHT // s, WIDTH // s), value, requires_grad=True) for s in CONFIG.strides]


def target(x0: float, y0: float, x1: float, y1: float, *, image: int = 0, cls: int = 0, ignore: bool = False) -> Tensor:
    return torch.tensor([[image, cls, x0, y0, x1, y1, float(ignore)]])


def cell_of(heads: list[Tensor], scale: int, anchor: int, row: int, column: int, image: int = 0) -> Tensor:
    """The seven logits of one prediction."""
    return heads[scale].unflatten(1, (3, 7))[image, anchor, :, row, column]


def gradient(heads: list[Tensor], scale: int, anchor: int, row: int, column: int) -> Tensor:
    grad = heads[scale].grad
    assert grad is not None
    return grad.unflatten(1, (3, 7))[0, anchor, :, row, column]


TRUTH = target(47.5, 39.5, 63.5, 69.5)
"""16 x 30 px like the second anchor of stride 8, its centre at 56, 55 of the continuous picture: cell 7, 6 at 0, 0.875."""


def test_at_the_truth_only_nothing_is_left() -> None:
    heads = heads_of(-SURE)
    with torch.no_grad():
        cell_of(heads, 0, 1, 6, 7).copy_(torch.tensor([-SURE, math.log(7), 0.0, 0.0, SURE, SURE, -SURE]))
    losses = yolo_loss(heads, TRUTH, CONFIG)
    # 252 predictions, each a hair above zero.
    assert losses["total"].item() == pytest.approx(0.0, abs=1e-4)


def test_the_gradients_are_darknets_deltas() -> None:
    heads = heads_of(0.3, batch=2)
    yolo_loss(heads, TRUTH, CONFIG)["total"].backward()
    sigmoid, scale = 1 / (1 + math.exp(-0.3)), 2 - 16 * 30 / (WIDTH * HEIGHT)
    expected = torch.tensor(
        [scale * sigmoid, scale * (sigmoid - 0.875), scale * 0.3, scale * 0.3, sigmoid - 1, sigmoid - 1, sigmoid]
    )
    torch.testing.assert_close(gradient(heads, 0, 1, 6, 7), expected / 2, atol=1e-5, rtol=1e-5)
    # All others are asked for objectness 0, and for nothing else.
    torch.testing.assert_close(gradient(heads, 2, 0, 0, 0), torch.tensor([0, 0, 0, 0, sigmoid / 2, 0, 0]))


def test_small_vehicles_count_for_more() -> None:
    losses = []
    for half_w, half_h in ((8.0, 15.0), (78.0, 46.5)):
        box = target(79.5 - half_w, 47.5 - half_h, 79.5 + half_w, 47.5 + half_h)
        heads = heads_of(0.0)
        (image, place), _ = assign_best(box, heads, CONFIG)
        found = flatten(heads, CONFIG)
        sides = torch.log(torch.tensor([2 * half_w, 2 * half_h]) / found.anchor[place[0]])
        scale = 2 - 4 * half_w * half_h / (WIDTH * HEIGHT)
        center = torch.tensor([80.0, 48.0]) / found.stride[place[0]] % 1
        least = -(center * center.log().nan_to_num(neginf=0) + (1 - center) * (1 - center).log().nan_to_num(neginf=0))
        expected = scale * ((math.log(2) - least) + 0.5 * sides**2).sum()
        losses.append(yolo_loss(heads, box, CONFIG)["box"].item())
        assert losses[-1] == pytest.approx(expected.item(), rel=1e-4)
        assert image.tolist() == [0]


def test_one_anchor_of_nine_answers() -> None:
    for scale, anchors in enumerate(CONFIG.anchors_px):
        for anchor, (width, height) in enumerate(anchors):
            heads = heads_of(0.0, batch=2)
            box = target(80 - width / 2, 48 - height / 2, 80 + width / 2, 48 + height / 2, image=1)
            (image, place), truth = assign_best(box, heads, CONFIG)
            found = flatten(heads, CONFIG)
            assert len(truth) == 1
            assert image.tolist() == [1]
            assert found.stride[place[0]].item() == CONFIG.strides[scale]
            assert found.anchor[place[0]].tolist() == list(CONFIG.anchors_px[scale][anchor])
            column, row = (found.cell[place[0]] * CONFIG.strides[scale]).tolist()
            assert column <= 80.5 < column + CONFIG.strides[scale]
            assert row <= 48.5 < row + CONFIG.strides[scale]


def test_the_later_of_two_targets_has_the_prediction() -> None:
    later = TRUTH.clone()
    later[0, 1] = 1
    (_, place), truth = assign_best(torch.cat([TRUTH, later]), heads_of(0.0), CONFIG)
    assert len(place) == 1
    assert truth[0, 1].item() == 1


def objectness_of_neighbour(offset: float) -> float:
    """Objectness loss of a loud prediction in the cell left of the truth's, its box ``offset`` px less high."""
    heads = heads_of(-SURE)
    with torch.no_grad():
        cell_of(heads, 0, 1, 6, 7)[4] = SURE
        wrong = cell_of(heads, 0, 1, 6, 6)
        wrong[:5] = torch.tensor([SURE, math.log(7), 0.0, math.log((30 - offset) / 30), 3.0])
    return yolo_loss(heads, TRUTH, CONFIG)["objectness"].item()


def test_a_good_box_that_need_not_answer_is_not_blamed() -> None:
    # Their boxes overlap by (30 - offset) / 30: 0.8, and 0.6.
    assert objectness_of_neighbour(6.0) == pytest.approx(0.0, abs=1e-4)
    assert objectness_of_neighbour(12.0) == pytest.approx(math.log(1 + math.exp(3.0)), rel=1e-3)


def test_ignored_vehicles_are_neither_asked_for_nor_blamed() -> None:
    heads = [torch.randn(1, 21, HEIGHT // s, WIDTH // s) for s in CONFIG.strides]
    losses = yolo_loss(heads, target(0, 0, WIDTH - 1, HEIGHT - 1, ignore=True), CONFIG)
    assert losses["total"].item() == 0.0


def test_an_unknown_class_is_not_asked_for() -> None:
    known, unknown = (yolo_loss(heads_of(0.0), TRUTH + torch.tensor([0, cls, 0, 0, 0, 0, 0]), CONFIG) for cls in (0, -1))
    assert unknown["classes"].item() == 0.0
    assert known["classes"].item() == pytest.approx(2 * math.log(2))
    assert unknown["box"].item() == known["box"].item() > 0


def test_frames_without_vehicles_ask_for_silence_only() -> None:
    losses = yolo_loss(heads_of(0.0, batch=2), torch.zeros(0, 7), CONFIG)
    assert losses["box"].item() == losses["classes"].item() == 0.0
    assert losses["objectness"].item() == pytest.approx(3 * (240 + 60 + 15) * math.log(2), rel=1e-5)


def test_the_loss_and_the_service_mean_the_same_box() -> None:
    torch.manual_seed(0)
    heads = [torch.randn(1, 21, HEIGHT // s, WIDTH // s) for s in CONFIG.strides]
    found = flatten(heads, CONFIG)
    probability = found.logits[0].sigmoid()
    best = (probability[:, 4] * probability[:, 5:].amax(1)).argmax()
    sigma = ErrorModel(1.0, 0.0, 0.0, 1.0)
    spec = DetectorSpec(CONFIG.classes, CONFIG.strides, CONFIG.anchors_px, 160, sigma, format="yolov3")
    served = decode_heads([head[0].numpy() for head in heads], spec, 0.3)
    torch.testing.assert_close(found.boxes()[0, best].double(), torch.from_numpy(served.xyxy_px[0]), atol=1e-3, rtol=1e-4)
