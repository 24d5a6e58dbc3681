"""Augmentation: each effect can be switched, is repeatable, keeps the shape, and keeps boxes on what they frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.augment import (
    NO_AUGMENT,
    AugmentConfig,
    cut_out,
    darkened,
    flip_horizontally,
    hidden_behind,
    photometric,
    place,
    rescale,
    shrink,
    streaked,
    veiled,
)

EFFECTS = ["jpeg", "motion_blur", "night", "fog", "blur", "noise"]


def textured(height: int = 96, width: int = 160) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_no_augmentation_is_none() -> None:
    image = textured()
    np.testing.assert_array_equal(photometric(image, np.random.default_rng(0), NO_AUGMENT), image)


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_alone_changes_the_image_and_repeats(effect: str) -> None:
    image = textured()
    config = replace(NO_AUGMENT, **{effect: 1.0})
    first, second = (photometric(image, np.random.default_rng(5), config) for _ in range(2))
    assert first.shape == image.shape
    assert first.dtype == np.uint8
    assert np.abs(first.astype(int) - image).mean() > 1
    np.testing.assert_array_equal(first, second)


def test_night_keeps_lamps_and_sinks_the_rest() -> None:
    levels = np.array([[[0] * 3, [128] * 3, [255] * 3]], np.uint8)
    dark = darkened(levels, 0.25)[0, :, 0]
    assert dark[0] == 0
    assert 28 <= dark[1] <= 36
    assert dark[2] == 255


def test_fog_is_denser_at_the_top_and_hides_contrast() -> None:
    image = textured()
    foggy = veiled(image, 0.9, 200.0)
    assert foggy[:10].std() < 0.3 * image[:10].std()
    assert foggy[-10:].std() > 0.6 * image[-10:].std()


def test_a_streak_keeps_the_light_and_spreads_it_along_its_line() -> None:
    image = np.zeros((31, 31, 3), np.uint8)
    image[15, 15] = 250
    along = streaked(image, 8.0, 0.0)
    assert abs(int(along[..., 0].sum()) - 250) < 12
    assert np.count_nonzero(along[15, :, 0]) >= 7
    assert np.count_nonzero(along[14, :, 0]) == 0


def test_cut_outs_say_how_much_they_cover() -> None:
    image = np.full((100, 200, 3), 77, np.uint8)
    config = replace(AugmentConfig(), cut_outs=1, cut_out_side=(0.3, 0.6))
    for seed in range(20):
        covered, fraction = cut_out(image, np.array([[0.0, 0.0, 199.0, 99.0]]), np.random.default_rng(seed), config)
        changed = np.any(covered != 77, axis=2).mean()
        if changed:  # a patch may have the picture's own colour
            assert fraction[0] == pytest.approx(changed, abs=0.03)


@given(st.integers(0, 10_000))
def test_another_vehicle_hides_one_side_and_no_more_than_it_may(seed: int) -> None:
    crop, other = np.full((96, 96, 3), 10, np.uint8), np.full((96, 96, 3), 200, np.uint8)
    config = replace(AugmentConfig(), hidden_reach=(0.1, 0.45))
    hidden = hidden_behind(crop, other, np.random.default_rng(seed), config)[..., 0] == 200
    assert (crop == 10).all()
    rows, columns = np.flatnonzero(hidden.any(1)), np.flatnonzero(hidden.any(0))
    assert hidden.sum() == len(rows) * len(columns)
    assert rows[-1] == 95
    across = len(columns) <= 44 and {columns[0], columns[-1]} & {0, 95}
    assert across or len(rows) <= 44
    assert min(len(rows), len(columns)) >= 9


@given(st.integers(0, 10_000))
def test_boxes_follow_the_picture(seed: int) -> None:
    """A bright rectangle, flipped, scaled and shifted to another canvas, is still where its box says."""
    rng = np.random.default_rng(seed)
    image = np.zeros((100, 160, 3), np.uint8)
    image[40:61, 60:101] = 255
    box = np.array([[60.0, 40.0, 100.0, 60.0]])
    image, box = flip_horizontally(image, box, 150)
    image, box = rescale(image, box, (192, 128), rng, AugmentConfig())
    assert image.shape == (128, 192, 3)
    rows, columns = np.nonzero(image[..., 0] > 150)
    found = [columns.min(), rows.min(), columns.max(), rows.max()]
    np.testing.assert_allclose(found, np.clip(box[0], 0, [191, 127] * 2), atol=1.6)


@pytest.mark.parametrize("size", [(160, 96), (192, 128), (96, 64)])
def test_placing_cuts_or_pads_without_scaling(size: tuple[int, int]) -> None:
    image = textured()
    placed, box = place(image, np.array([[10.0, 20.0, 30.0, 40.0]]), size, np.random.default_rng(2))
    assert placed.shape == (size[1], size[0], 3)
    x, y = box[0, :2].astype(int)
    if x >= 0 and y >= 0 and x + 21 <= size[0] and y + 21 <= size[1]:
        np.testing.assert_array_equal(placed[y : y + 21, x : x + 21], image[20:41, 10:31])


@given(st.integers(0, 2**32 - 1), st.sampled_from([(80, 64), (120, 80), (320, 40)]))
def test_a_shrunk_image_fills_the_canvas_as_far_as_it_can_and_keeps_boxes_on_what_they_frame(
    seed: int, size: tuple[int, int]
) -> None:
    image = np.full((128, 192, 3), 20, np.uint8)
    image[40:80, 60:140] = 220
    config = AugmentConfig()
    canvas, box = shrink(image, np.array([[60.0, 40.0, 139.0, 79.0]]), size, np.random.default_rng(seed), config)
    assert canvas.shape == (size[1], size[0], 3)
    scale = (box[0, 2] - box[0, 0]) / 79
    assert config.tile_scale[0] - 1e-9 <= scale <= config.tile_scale[1] + 1e-9
    # Grey is left along an axis only where the whole picture does not reach, up to the interpolated rim.
    for axis, canvas_side, side in ((0, size[1], 128), (1, size[0], 192)):
        grey = np.abs(canvas.astype(int) - 114).max((1 - axis, 2)) < 3
        assert grey.sum() <= max(canvas_side - scale * side, 0) + 2
    x0, y0, x1, y1 = np.clip(box[0], 0, np.array([*size, *size]) - 1)
    inner = canvas[int(np.ceil(y0 + 1)) : int(y1), int(np.ceil(x0 + 1)) : int(x1)]
    assert inner.size == 0 or inner.min() > 150
