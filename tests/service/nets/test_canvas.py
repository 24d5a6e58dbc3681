"""Canvases hold their images, and every point finds its way back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.nets.canvas import PADDED, Canvases, InputFit, canvas_size, to_canvas

SIDES = st.integers(1, 900)
FITS = st.builds(
    InputFit,
    st.one_of(st.none(), st.tuples(st.integers(8, 700), st.integers(8, 700))),
    st.sampled_from(["corner", "center"]),
    st.integers(0, 255),
)


def ramp(width: int, height: int, steps: int = 1) -> np.ndarray:
    """An image whose red tells the column and whose green the row, in so many steps a pixel."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = steps * np.arange(width)
    image[..., 1] = steps * np.arange(height)[:, None]
    return image


@given(fit=FITS, width=SIDES, height=SIDES, seed=st.integers(0, 99))
def test_points_and_boxes_come_back(fit: InputFit, width: int, height: int, seed: int) -> None:
    placement = fit.placement(width, height)
    boxes = np.random.default_rng(seed).uniform(-50, 950, (7, 4))
    np.testing.assert_allclose(placement.to_image(placement.to_canvas(boxes)), boxes, atol=1e-6)
    points = boxes.reshape(-1, 2)
    np.testing.assert_allclose(placement.to_canvas(points).reshape(-1, 4), placement.to_canvas(boxes))


@settings(deadline=None)
@given(fit=FITS, width=SIDES, height=SIDES)
def test_the_image_lies_where_its_placement_says(fit: InputFit, width: int, height: int) -> None:
    image = np.full((height, width, 3), 200, np.uint8)
    canvas, placement = to_canvas(image, fit), fit.placement(width, height)
    assert canvas.shape[1::-1] == fit.canvas_size(width, height)
    (left, top), (columns, rows) = placement.offset_px, placement.size_px
    inside = np.zeros(canvas.shape[:2], dtype=bool)
    inside[top : top + rows, left : left + columns] = True
    assert inside.sum() == columns * rows
    assert (canvas[inside] == 200).all()
    assert (canvas[~inside] == fit.pad_value).all()


@settings(deadline=None)
@given(fit=FITS, width=SIDES, height=SIDES)
def test_a_fixed_canvas_is_filled_along_one_side(fit: InputFit, width: int, height: int) -> None:
    placement = fit.placement(width, height)
    if fit.size is None:
        assert (placement.scale, placement.size_px) == (1.0, (width, height))
        return
    assert placement.size_px[0] == fit.size[0] or placement.size_px[1] == fit.size[1]
    # One scale for both axes: sides are what it makes of the image's, but for rounding.
    np.testing.assert_allclose(placement.size_px, np.array([width, height]) * placement.scale, atol=1.0)


@pytest.mark.parametrize(("width", "height"), [(61, 29), (29, 61), (50, 49), (62, 20)])
@pytest.mark.parametrize("place", ["corner", "center"])
@pytest.mark.parametrize("size", [(97, 97), (150, 80), (41, 32)])
def test_a_pixel_is_found_where_its_coordinates_lead(width: int, height: int, place: str, size: tuple[int, int]) -> None:
    fit = InputFit(size, place)  # type: ignore[arg-type]
    canvas, placement = to_canvas(ramp(width, height, 4), fit), fit.placement(width, height)
    (left, top), (columns, rows) = placement.offset_px, placement.size_px
    v, u = np.mgrid[top + 3 : top + rows - 3, left + 3 : left + columns - 3]
    # The colours are the coordinates: what lies at (u, v) must come from there, a rounding of a colour aside.
    expected = placement.to_image(np.stack([u, v], -1))
    np.testing.assert_allclose(canvas[v, u][..., :2] / 4, expected, atol=0.2)


def test_padding_moves_nothing() -> None:
    image = ramp(130, 47)
    canvas = to_canvas(image)
    assert canvas.shape == (64, 160, 3)
    assert canvas_size(130, 47) == (160, 64)
    np.testing.assert_array_equal(canvas[:47, :130], image)
    assert (canvas[47:] == 114).all()
    assert (canvas[:, 130:] == 114).all()


def test_images_are_grouped_by_their_canvas() -> None:
    images = [ramp(64, 64), ramp(96, 32), ramp(60, 40)]
    batches = PADDED.batches(images)
    assert [batch.members for batch in batches] == [(0, 2), (1,)]
    assert [batch.pixels.shape for batch in batches] == [(2, 64, 64, 3), (1, 32, 96, 3)]
    fixed = InputFit((64, 64)).batches(images)
    assert [batch.members for batch in fixed] == [(0, 1, 2)]
    assert PADDED.batches([]) == []


def test_canvases_are_made_once_a_fit() -> None:
    canvases = Canvases([ramp(64, 64)])
    assert canvases.batches(PADDED) is canvases.batches(InputFit())
    assert canvases.batches(InputFit((32, 32)))[0].pixels.shape == (1, 32, 32, 3)


@given(fit=FITS)
def test_metadata_comes_back(fit: InputFit) -> None:
    read = InputFit.from_metadata(fit.to_metadata())
    assert read == (fit if fit.size else PADDED)


@pytest.mark.parametrize("change", [{"width": 0}, {"height": 10**6}, {"place": "left"}, {"pad": 256}])
def test_impossible_metadata_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="fit"):
        InputFit.from_metadata({"width": 416, "height": 416, "place": "corner", "pad": 0, **change})
