"""Known answers of the losses: minima at the truth, trimming that trims, masked pixels that never matter."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models_export.losses import (
    align,
    ciou,
    depth_loss,
    gradient_matching_loss,
    likelihood_loss,
    multibin_loss,
    places_loss,
    trimmed_ssi_loss,
)
from models_export.nets.vgg_multibin import even_bins

CENTERS = torch.tensor([0.0, math.pi])


def boxes(*rows: tuple[float, float, float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float32)


def test_ciou_of_a_box_with_itself_is_one() -> None:
    box = boxes((1, 2, 11, 7), (-3, 0, 5, 40))
    assert torch.allclose(ciou(box, box), torch.ones(2), atol=1e-5)


def test_ciou_of_same_shape_is_iou_less_centre_distance() -> None:
    # Two squares of side 10, shifted by 5: IoU 1/3; hull 15 x 10, its diagonal^2 = 325; distance^2 = 25.
    value = ciou(boxes((0, 0, 10, 10)), boxes((5, 0, 15, 10)))
    assert value.item() == pytest.approx(1 / 3 - 25 / 325, abs=1e-5)


def test_ciou_has_a_gradient_where_boxes_do_not_touch() -> None:
    far = boxes((100, 100, 110, 110)).requires_grad_()
    ciou(far, boxes((0, 0, 10, 10))).sum().backward()
    assert far.grad is not None
    assert far.grad.abs().sum() > 0


def head_at(alpha: torch.Tensor, confidence: float = 20.0) -> tuple[torch.Tensor, torch.Tensor]:
    delta = alpha[:, None] - CENTERS[None]
    vectors = torch.stack([delta.cos(), delta.sin()], -1)
    nearest = torch.remainder(delta + math.pi, 2 * math.pi).sub(math.pi).abs().argmin(1)
    return vectors, confidence * torch.nn.functional.one_hot(nearest, 2).float()


def test_multibin_loss_is_zero_at_the_truth() -> None:
    alpha = torch.tensor([0.3, -2.9, 1.5, 3.1])
    vectors, confidence = head_at(alpha)
    sizes = torch.randn(4, 3)
    losses = multibin_loss(vectors, confidence, sizes, alpha, sizes, CENTERS, 0.1)
    assert losses["total"].item() == pytest.approx(0.0, abs=1e-5)


def test_multibin_angle_loss_of_a_quarter_turn_is_one() -> None:
    alpha = torch.tensor([0.2])
    vectors, confidence = head_at(alpha + math.pi / 2)
    losses = multibin_loss(vectors, confidence, torch.zeros(1, 3), alpha, torch.zeros(1, 3), CENTERS, 0.1)
    assert losses["angle"].item() == pytest.approx(1.0, abs=1e-5)


def test_multibin_loss_ignores_the_bin_that_does_not_cover() -> None:
    alpha = torch.tensor([0.1])
    vectors, confidence = head_at(alpha)
    spoiled = vectors.clone()
    spoiled[:, 1] = torch.tensor([0.0, 1.0])
    args = (torch.zeros(1, 3), alpha, torch.zeros(1, 3), CENTERS, 0.1)
    assert torch.equal(multibin_loss(vectors, confidence, *args)["angle"], multibin_loss(spoiled, confidence, *args)["angle"])


def test_angle_in_the_overlap_trains_both_bins() -> None:
    alpha = torch.tensor([math.pi / 2 + 0.05])
    vectors, confidence = head_at(alpha)
    spoiled = vectors.clone()
    spoiled[:, 0] = -spoiled[:, 0]
    losses = multibin_loss(spoiled, confidence, torch.zeros(1, 3), alpha, torch.zeros(1, 3), CENTERS, 0.1)
    assert losses["angle"].item() == pytest.approx(1.0, abs=1e-5)


@given(error=st.floats(0.01, 10), beta=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_best_sigma_is_the_size_of_the_error(error: float, beta: float) -> None:
    log_sigma = torch.tensor([math.log(error)], requires_grad=True)
    likelihood_loss(torch.tensor([error]), log_sigma, beta).sum().backward()
    assert log_sigma.grad is not None
    assert log_sigma.grad.item() == pytest.approx(0.0, abs=1e-4 * max(error**2, 1.0))


def test_likelihood_of_a_known_error() -> None:
    # Two sigmas off: half of 2 squared, plus the logarithm of sigma 1/2; with beta 1/2 all of it times sigma.
    value = likelihood_loss(torch.tensor([1.0]), torch.tensor([math.log(0.5)]), beta=0.0)
    assert value.item() == pytest.approx(2.0 - math.log(2.0), abs=1e-6)
    half = likelihood_loss(torch.tensor([1.0]), torch.tensor([math.log(0.5)]))
    assert half.item() == pytest.approx(0.5 * (2.0 - math.log(2.0)), abs=1e-6)


def test_beta_one_trains_the_error_like_squares() -> None:
    error = torch.tensor([0.3, 2.0], requires_grad=True)
    likelihood_loss(error, torch.tensor([-2.0, 1.5]), beta=1.0).sum().backward()
    assert error.grad is not None
    assert torch.allclose(error.grad, error.detach(), atol=1e-6)


def test_multibin_loss_weighs_its_three_terms() -> None:
    # Size off by 2 m in one of three values: 4/3. Two equal logits: log 2. A vector at right angles: 1.
    alpha = torch.zeros(1)
    vectors = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]])
    off = torch.tensor([[2.0, 0.0, 0.0]])
    losses = multibin_loss(vectors, torch.zeros(1, 2), off, alpha, torch.zeros(1, 3), CENTERS, 0.1)
    assert losses["total"].item() == pytest.approx(0.6 * 4 / 3 + math.log(2) + 0.4, abs=1e-6)


@given(bins=st.integers(2, 8), first=st.floats(-3, 3), alpha=st.floats(-3.1, 3.1))
def test_multibin_loss_of_any_number_of_bins_is_zero_at_the_truth_only(bins: int, first: float, alpha: float) -> None:
    centers = torch.tensor(even_bins(bins, first))
    truth = torch.tensor([alpha])
    delta = truth[:, None] - centers[None]
    nearest = torch.cos(delta).argmax(1)
    logits = 30.0 * torch.nn.functional.one_hot(nearest, bins).float()
    sizes = torch.zeros(1, 3)

    def total(turned: float) -> float:
        vectors = torch.stack([torch.cos(delta + turned), torch.sin(delta + turned)], -1)
        return multibin_loss(vectors, logits, sizes, truth, sizes, centers, 0.1)["total"].item()

    # At a border both bins are right, and the confidence may count either.
    if torch.topk(torch.cos(delta), 2).values.diff().abs().item() > 1e-4:
        assert total(0.0) == pytest.approx(0.0, abs=1e-5)
        assert total(0.5) == pytest.approx(0.4 * (1 - math.cos(0.5)), abs=1e-5)


@given(scale=st.floats(0.1, 10), shift=st.floats(-5, 5), seed=st.integers(0, 100))
def test_depth_loss_is_zero_up_to_scale_and_shift(scale: float, shift: float, seed: int) -> None:
    target = torch.rand(2, 8, 12, generator=torch.Generator().manual_seed(seed))
    mask = torch.ones_like(target, dtype=torch.bool)
    assert depth_loss(scale * target + shift, target, mask)["total"].item() == pytest.approx(0.0, abs=1e-4)


def test_masked_pixels_never_matter() -> None:
    generator = torch.Generator().manual_seed(0)
    prediction, target = torch.rand(2, 8, 12, generator=generator), torch.rand(2, 8, 12, generator=generator)
    mask = torch.rand(2, 8, 12, generator=generator) > 0.4
    noise = torch.where(mask, torch.zeros(()), 1e3 * torch.rand(2, 8, 12, generator=generator))
    expected = depth_loss(prediction, target, mask)["total"]
    assert torch.allclose(depth_loss(prediction + noise, target - noise, mask)["total"], expected, atol=1e-6)


def test_masked_pixels_may_hold_anything_and_learn_nothing() -> None:
    generator = torch.Generator().manual_seed(2)
    mask = torch.rand(2, 8, 12, generator=generator) > 0.4
    prediction = torch.where(mask, torch.rand(2, 8, 12, generator=generator), torch.nan).requires_grad_()
    target = torch.where(mask, torch.rand(2, 8, 12, generator=generator), torch.inf)
    total = depth_loss(prediction, target, mask)["total"]
    total.backward()
    assert torch.isfinite(total)
    assert prediction.grad is not None
    assert torch.all(prediction.grad[~mask] == 0)
    assert torch.all(torch.isfinite(prediction.grad))


@given(seed=st.integers(0, 100), size=st.floats(0.01, 2.0))
def test_depth_loss_is_least_at_the_truth(seed: int, size: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    target, noise = torch.rand(1, 8, 12, generator=generator), torch.randn(1, 8, 12, generator=generator)
    mask = torch.rand(1, 8, 12, generator=generator) > 0.3
    spoiled = depth_loss(target + size * noise, target, mask)["total"].item()
    assert spoiled > depth_loss(target, target, mask)["total"].item() == 0.0


def test_trimmed_loss_of_two_exchanged_pixels() -> None:
    # Median 0, mean deviation 6/5 on both sides: two residuals of 1 / 1.2 among five. Four of five are kept, over 2 x 5.
    target = torch.tensor([[[-2.0, -1.0, 0.0, 1.0, 2.0]]])
    prediction = torch.tensor([[[-1.0, -2.0, 0.0, 1.0, 2.0]]])
    mask = torch.ones_like(target, dtype=torch.bool)
    assert trimmed_ssi_loss(prediction, target, mask, trim=0.2).item() == pytest.approx(1 / 1.2 / 10, abs=1e-6)
    assert trimmed_ssi_loss(prediction, target, mask, trim=0.0).item() == pytest.approx(2 / 1.2 / 10, abs=1e-6)
    # Masked pixels beside them change neither the median nor M.
    wide = torch.nn.functional.pad(mask, (0, 20))
    padded = [torch.nn.functional.pad(values, (0, 20)) for values in (prediction, target)]
    assert trimmed_ssi_loss(*padded, wide, trim=0.2).item() == pytest.approx(1 / 1.2 / 10, abs=1e-6)


def test_trimming_really_trims() -> None:
    target = torch.linspace(0, 1, 100).reshape(1, 10, 10)
    mask = torch.ones_like(target, dtype=torch.bool)
    spoiled = target.clone()
    # Ten of a hundred pixels exchanged among themselves: the median and the mean deviation stay what they were.
    spoiled.view(-1)[95:100] = target.view(-1)[0:5]
    spoiled.view(-1)[0:5] = target.view(-1)[95:100]
    assert trimmed_ssi_loss(spoiled, target, mask, trim=0.2).item() == pytest.approx(0.0, abs=1e-6)
    assert trimmed_ssi_loss(spoiled, target, mask, trim=0.0).item() > 0.05


def test_an_image_without_depth_counts_as_nothing() -> None:
    prediction = torch.rand(1, 4, 4, requires_grad=True)
    losses = depth_loss(prediction, torch.rand(1, 4, 4), torch.zeros(1, 4, 4, dtype=torch.bool))
    losses["total"].backward()
    assert losses["total"].item() == 0.0
    assert prediction.grad is not None
    assert torch.all(torch.isfinite(prediction.grad))


def test_align_gives_median_zero_and_mean_deviation_one() -> None:
    values = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(1))
    mask = torch.ones_like(values, dtype=torch.bool)
    aligned = align(values, mask).flatten(1)
    assert torch.allclose(aligned.median(1).values, torch.zeros(3), atol=1e-6)
    assert torch.allclose(aligned.abs().mean(1), torch.ones(3), atol=1e-5)


def test_gradient_loss_sees_an_edge_of_known_height() -> None:
    target = torch.zeros(1, 2, 4)
    target[..., 2:] = 1.0
    mask = torch.ones_like(target, dtype=torch.bool)
    # Aligned target: median 0, mean deviation 1/2, so the step is 2; one step in each of two rows over 8 pixels.
    flat = torch.zeros_like(target)
    assert gradient_matching_loss(flat, target, mask, scales=1).item() == pytest.approx(2 * 2 / 8, abs=1e-6)


def test_gradient_loss_sums_four_resolutions() -> None:
    # A ramp of 16 columns: median in column 7, mean deviation 4, so a slope of 1/4 a column. Every other column doubles it.
    target = torch.arange(16.0).expand(1, 16, 16)
    mask = torch.ones_like(target, dtype=torch.bool)
    expected = 0.25 * (1 * 15 / 16 + 2 * 7 / 8 + 4 * 3 / 4 + 8 * 1 / 2)
    assert gradient_matching_loss(torch.zeros_like(target), target, mask).item() == pytest.approx(expected, abs=1e-5)


def test_depth_loss_adds_half_the_gradient_term() -> None:
    generator = torch.Generator().manual_seed(4)
    prediction, target = torch.rand(1, 8, 12, generator=generator), torch.rand(1, 8, 12, generator=generator)
    losses = depth_loss(prediction, target, torch.ones_like(target, dtype=torch.bool))
    assert losses["total"].item() == pytest.approx(losses["ssi"].item() + 0.5 * losses["gradient"].item(), abs=1e-6)


def test_the_places_of_an_exact_reading_cost_least_and_have_its_mean() -> None:
    places = torch.linspace(-0.9, 0.9, 10)
    target = torch.tensor([[0.04, -0.9, 0.9, 3.0]])
    share = (0.04 + 0.1) / 0.2
    exact = torch.full((1, 4, 10), -50.0)
    exact[0, 0, 4], exact[0, 0, 5] = math.log(1 - share), math.log(share)
    exact[0, 1, 0] = exact[0, 2, 9] = exact[0, 3, 9] = 0.0
    mean = (exact.softmax(-1) * places).sum(-1)
    assert torch.allclose(mean, torch.tensor([[0.04, -0.9, 0.9, 0.9]]), atol=1e-5)
    least = places_loss(exact, target, places)
    entropy = -(share * math.log(share) + (1 - share) * math.log(1 - share))
    assert torch.allclose(least, torch.tensor([[entropy, 0.0, 0.0, 0.0]]), atol=1e-4)
    assert (places_loss(torch.zeros(1, 4, 10), target, places) > least).all()
