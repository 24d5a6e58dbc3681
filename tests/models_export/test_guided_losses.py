"""Known answers of every term of the depth-guided detector's loss."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from models_export.guided_losses import (
    GuidedLossConfig,
    class_loss,
    combine,
    corner_loss,
    focal_factor,
    heading_bins_loss,
    laplace_nll,
    regression,
)

BINS = torch.tensor([0.0, math.pi])


def test_the_focal_factor_weighs_the_cross_entropy() -> None:
    # Probabilities 0.9 and 0.1 of the true class.
    logits = torch.tensor([[math.log(0.9), math.log(0.1)], [math.log(0.9), math.log(0.1)]])
    cls = torch.tensor([0, 1])
    torch.testing.assert_close(focal_factor(logits, cls, 1.0), torch.tensor([0.1, 0.9]))
    expected = torch.tensor([0.1**2 * -math.log(0.9), 0.9**2 * -math.log(0.1)])
    torch.testing.assert_close(class_loss(logits, cls, 2.0), expected)
    torch.testing.assert_close(class_loss(logits, cls, 0.0), -torch.log(torch.tensor([0.9, 0.1])))


def test_smooth_l1_is_square_near_the_truth_and_linear_far_from_it() -> None:
    out = regression(torch.tensor([[0.5, 3.0, 0.0]]), torch.zeros(1, 3), None)
    torch.testing.assert_close(out, torch.tensor([[0.125, 2.5, 0.0]]))


def test_laplaces_likelihood_is_best_where_the_variance_is_the_errors() -> None:
    torch.testing.assert_close(laplace_nll(torch.tensor(2.0), torch.tensor(0.0)), torch.tensor(2 * math.sqrt(2.0)))
    error = torch.distributions.Laplace(0.0, 0.7).sample((200_000,))
    s = torch.linspace(-4, 4, 161)
    mean = torch.stack([laplace_nll(error, value).mean() for value in s])
    # Laplace's variance is 2 b^2.
    assert s[mean.argmin()].item() == pytest.approx(math.log(2 * 0.7**2), abs=0.1)


def heading_of(angle: float) -> torch.Tensor:
    """Outputs that mean an angle, surely."""
    delta = angle - BINS
    logits = 30.0 * torch.cos(delta)
    return torch.cat([delta.cos(), delta.sin(), logits])[None]


@pytest.mark.parametrize("alpha", [0.3, -1.2, 3.0, -3.1])
def test_the_headings_loss_is_least_at_the_truth(alpha: float) -> None:
    truth = torch.tensor([alpha])
    assert heading_bins_loss(heading_of(alpha), truth, BINS, None).item() == pytest.approx(0.0, abs=1e-4)
    # A quarter turn of the vectors costs 1, a flip of the bins as much as their logits say.
    turned = heading_of(alpha)
    turned[:, :2], turned[:, 2:4] = -heading_of(alpha)[:, 2:4], heading_of(alpha)[:, :2]
    assert heading_bins_loss(turned, truth, BINS, None).item() == pytest.approx(1.0, abs=1e-4)


def test_the_headings_sigma_learns_from_the_angle_without_moving_it() -> None:
    heading = heading_of(0.5).requires_grad_()
    log_variance = torch.zeros(1, requires_grad=True)
    heading_bins_loss(heading, torch.tensor([0.5]), BINS, log_variance).sum().backward()
    assert log_variance.grad is not None
    assert log_variance.grad.item() == pytest.approx(0.5, abs=1e-3)
    assert heading.grad is not None
    assert heading.grad.abs().max() < 1e-3


def test_the_corner_term_is_a_distance() -> None:
    corners = torch.randn(2, 8, 3, generator=torch.Generator().manual_seed(0))
    assert corner_loss(corners, corners).tolist() == [0.0, 0.0]
    torch.testing.assert_close(corner_loss(corners + 3.0, corners), torch.full((2,), 2.5))


def test_options_of_the_sum() -> None:
    classes, factor = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.5, 0.1])
    flat, solid, corner = torch.tensor([1.0, 1.0]), torch.tensor([2.0, 4.0]), torch.tensor([10.0, 10.0])
    plain = combine(classes, factor, flat, solid, corner, GuidedLossConfig())
    assert {k: v.item() for k, v in plain.items()} == {
        "total": 7.0,
        "classes": 3.0,
        "box_2d": 1.0,
        "box_3d": 3.0,
        "corner": 0.0,
    }
    with_corner = combine(classes, factor, flat, solid, corner, GuidedLossConfig(corner=0.5))
    assert with_corner["total"].item() == 12.0
    everywhere = combine(classes, factor, flat, solid, corner, replace(GuidedLossConfig(), focal_on="all"))
    assert everywhere["box_3d"].item() == pytest.approx((0.5 * 2 + 0.1 * 4) / 2)
    nothing = combine(classes[:0], factor[:0], flat[:0], solid[:0], corner[:0], GuidedLossConfig())
    assert nothing["total"].item() == 0.0
