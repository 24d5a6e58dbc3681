"""Sigmas from score, size and the border; and that fitting finds the model that errors were drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.validate import fit_error_model
from service.errors import InputError
from service.nets.error_model import ErrorModel


def test_sigma_of_known_numbers() -> None:
    model = ErrorModel(0.5, 0.01, 2.0, 3.0)
    assert model.sigma(1.0, False, 100.0) == pytest.approx(1.5)
    assert model.sigma(0.5, False, 0.0) == pytest.approx(0.5 * np.e)
    assert model.sigma(1.0, True, 0.0) == pytest.approx(1.5)
    assert model.sigma(np.ones(4), np.zeros(4, bool), np.ones(4)).shape == (4,)


def test_metadata_round_trip() -> None:
    model = ErrorModel(0.5, 0.01, 2.0, 3.0)
    assert ErrorModel.from_metadata(model.to_metadata()) == model


@pytest.mark.parametrize("values", [[0.0, 0.1, 1.0, 1.0], [1.0, -0.1, 1.0, 1.0], [1.0, 0.1, float("nan"), 1.0], [1.0], "abcd"])
def test_impossible_models_are_refused(values: object) -> None:
    with pytest.raises(ValueError, match=r"error model|not enough values|could not convert"):
        ErrorModel.from_metadata(values)


def test_fitting_finds_the_model_that_errors_were_drawn_from() -> None:
    rng = np.random.default_rng(0)
    truth = ErrorModel(0.4, 0.02, 2.5, 2.0)
    score, size, is_cut = rng.uniform(0.3, 1, 40_000), rng.uniform(10, 100, 40_000), rng.random(40_000) < 0.2
    error = np.abs(rng.normal(0, truth.sigma(score, is_cut, size)))
    found = fit_error_model(error, score, is_cut, size)
    assert found.floor == pytest.approx(truth.floor, rel=0.25)
    assert found.slope == pytest.approx(truth.slope, rel=0.15)
    assert found.growth == pytest.approx(truth.growth, rel=0.1)
    assert found.cut == pytest.approx(truth.cut, rel=0.1)


def test_too_few_errors_measure_nothing() -> None:
    with pytest.raises(InputError, match="Train it longer"):
        fit_error_model(np.ones(5), np.ones(5), np.zeros(5, bool))
