"""Shares of data sets, and pictures of several sizes in one batch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models_export.data.augment import NO_AUGMENT
from models_export.data.detection import DetectionSample
from models_export.data.mix import MixConfig, draw_by_odds, draw_odds
from models_export.data.samples import Sample
from models_export.nets.detector import DetectorConfig
from models_export.train.detector import DetectorTask
from service.errors import InputError

MIX = MixConfig((("simulated", 0.6), ("gantry", 0.3), ("absent", 0.1)))


def renamed(samples: list[Sample]) -> list[Sample]:
    return [replace(sample, source="simulated/toy" if i < 7 else "gantry/day") for i, sample in enumerate(samples)]


def test_a_set_is_drawn_by_its_share_however_few_its_samples() -> None:
    odds = draw_odds(["simulated/a"] * 90 + ["gantry/b"] * 10, MIX)
    assert odds.sum() == pytest.approx(1)
    assert odds[:90].sum() == pytest.approx(2 / 3)
    drawn = draw_by_odds(np.random.default_rng(0), odds, 6000)
    assert np.mean(drawn >= 90) == pytest.approx(1 / 3, abs=0.02)
    np.testing.assert_array_equal(drawn, draw_by_odds(np.random.default_rng(0), odds, 6000))


def test_the_gantry_is_at_most_forty_percent_of_the_roadside() -> None:
    shares = dict(MixConfig().shares)
    roadside = [shares[n] for n in ("rf100_vehicles_tollroad_id", "atl_v2_highway_mix", "farzad_overpass_vehicle_boxonly")]
    assert roadside[0] <= 0.4 * sum(roadside)
    assert sum(shares.values()) <= 1.0 + 1e-9


def test_a_source_without_a_share_is_refused() -> None:
    with pytest.raises(InputError, match="no share for moon"):
        draw_odds(["moon/1"], MIX)


def tall(sample: Sample) -> DetectionSample:
    """The same picture twice, one above the other, as of another data set."""
    return DetectionSample(
        np.concatenate([sample.canvas, sample.canvas]),
        (sample.image_size[0], 2 * sample.image_size[1]),
        np.concatenate([sample.xyxy_px, sample.xyxy_px + np.array([0, 96, 0, 96])]),
        np.tile(sample.ignore, 2),
        np.tile(sample.cls, 2),
        np.zeros(2 * len(sample.cls), dtype=bool),
        "gantry/day",
    )


def test_low_pictures_are_stacked_until_they_fill_the_canvas(toy_samples: list[Sample]) -> None:
    low = [replace(sample, source="simulated/toy") for sample in toy_samples]
    task = DetectorTask([*low, tall(low[0])], DetectorConfig(), NO_AUGMENT, MIX)
    batch = task.batch(np.array([0, 8]), np.random.default_rng(0))
    assert batch["images"].shape == (2, 192, 160, 3)
    targets = batch["targets"].numpy()
    first = targets[targets[:, 0] == 0]
    np.testing.assert_array_equal(first[:2, 2:6], low[0].xyxy_px.astype(np.float32))
    assert np.all(first[2:, 3] >= 96)
    assert set(targets[targets[:, 0] == 1][:, 1]) == {-1.0}
    # Each box frames a bright rectangle wherever it stands now.
    for row, _, x0, y0, x1, y1, _ in targets.astype(int):
        assert batch["images"][row, y0 : y1 + 1, x0 : x1 + 1].numpy().max(2).min() > 150


def test_tiled_pictures_are_four_times_as_many_and_smaller(toy_samples: list[Sample]) -> None:
    low = [replace(sample, source="simulated/toy") for sample in toy_samples]
    augment = replace(NO_AUGMENT, tiles=1.0, tile_scale=(0.5, 0.5))
    task = DetectorTask([*low, tall(low[0])], DetectorConfig(), augment, MIX)
    batch = task.batch(np.array([0, 8]), np.random.default_rng(0))
    assert batch["images"].shape == (2, 192, 160, 3)
    targets = batch["targets"].numpy()
    # Eight low pictures at half size fill the canvas, and four tall ones; each shows its two or four vehicles whole.
    for row, vehicles in ((0, 16), (1, 16)):
        boxes = targets[targets[:, 0] == row, 2:6]
        assert len(boxes) == vehicles
        assert (boxes[:, 2] - boxes[:, 0]).max() <= 22
        cell = np.array([80, 48]) if row == 0 else np.array([80, 96])
        assert np.all(boxes[:, :2] // cell == boxes[:, 2:] // cell)
        assert len(np.unique(boxes[:, :2] // cell, axis=0)) == (8, 4)[row]


def test_strips_that_do_not_divide_the_canvas_leave_it_grey(toy_samples: list[Sample]) -> None:
    low = [replace(sample, source="simulated/toy") for sample in toy_samples]
    high = replace(tall(low[0]), canvas=np.full((352, 160, 3), 50, np.uint8))
    task = DetectorTask([*low, high], DetectorConfig(), NO_AUGMENT, MIX)
    images = task.batch(np.array([0, 8]), np.random.default_rng(0))["images"].numpy()
    assert images.shape == (2, 352, 160, 3)
    assert (images[0, 351] == 114).all()


def test_batches_repeat_and_follow_the_mix(toy_samples: list[Sample]) -> None:
    task = DetectorTask(renamed(toy_samples), DetectorConfig(), mix=MIX)
    indices = task.draw(np.random.default_rng(1), 300)
    assert np.mean(indices == 7) == pytest.approx(1 / 3, abs=0.08)
    first, second = (task.batch(indices[:4], np.random.default_rng(2)) for _ in range(2))
    assert np.array_equal(first["images"].numpy(), second["images"].numpy())
    assert np.array_equal(first["targets"].numpy(), second["targets"].numpy())
    assert task.describe()["samples"] == {"gantry": 1, "simulated": 7}
