"""Each format's decoding against its definition, written here a second time as plain loops over every cell."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.nets.canvas import InputFit
from service.nets.decoding import MAX_CANDIDATES, decode_heads
from service.nets.detections import Detections
from service.nets.detector_spec import FORMATS, LAYOUTS, DetectorSpec
from service.nets.error_model import ErrorModel

CLASSES = ("car", "bus", "truck")
NETWORK_CLASSES = 5
CLASS_OF = (-1, 0, -1, 1, 2)
"""Of five classes of the network, 0 and 2 are none of ours."""
WIDTH, HEIGHT = 96, 64
STRIDES = (8, 16, 32)
ANCHORS = (((10.0, 13.0), (16.0, 30.0)), ((30.0, 61.0), (62.0, 45.0)), ((59.0, 119.0), (116.0, 90.0)))
BINS = 8
CELLS = [(stride, row, column) for stride in STRIDES for row in range(HEIGHT // stride) for column in range(WIDTH // stride)]
SPEC = DetectorSpec(
    classes=CLASSES,
    strides=STRIDES,
    anchors_px=ANCHORS,
    max_width=672,
    sigma_edge_px=ErrorModel(1.0, 0.02, 0.0, 1.0),
    class_of=CLASS_OF,
    fit=InputFit((WIDTH, HEIGHT)),
)
Box = tuple[float, float, float, float, float, int]
"""x0, y0, x1, y1 in pixels with integer centres, score, class of ours."""


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def finish(found: list[tuple[float, float, float, float, list[float]]], threshold: float) -> list[Box]:
    """Boxes cx cy w h with the scores of all classes, as boxes of ours, best first."""
    boxes = []
    for cx, cy, w, h, scores in found:
        best = max(range(len(scores)), key=lambda index: scores[index])
        if scores[best] > threshold and CLASS_OF[best] >= 0:
            corners = (cx - w / 2 - 0.5, cy - h / 2 - 0.5, cx + w / 2 - 0.5, cy + h / 2 - 0.5)
            boxes.append((*corners, scores[best], CLASS_OF[best]))
    return sorted(boxes, key=lambda box: -box[4])[:MAX_CANDIDATES]


def assert_same(found: Detections, expected: list[Box]) -> None:
    assert len(expected) > 0, "the test shows nothing where nothing is expected"
    assert len(found) == len(expected)
    table = np.array(expected)
    np.testing.assert_allclose(found.score, table[:, 4], rtol=1e-5)
    np.testing.assert_allclose(found.xyxy_px, table[:, :4], rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(found.cls, table[:, 5])


def anchored_heads(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = 2 * (5 + NETWORK_CLASSES)
    return [rng.normal(0, 1.5, (shape, HEIGHT // s, WIDTH // s)).astype(np.float32) for s in STRIDES]


@pytest.mark.parametrize("form", ["quadlift", "yolov3"])
@pytest.mark.parametrize("threshold", [0.3, 0.6])
def test_formats_with_anchors(form: str, threshold: float) -> None:
    heads, found = anchored_heads(1), []
    for head, stride, anchors in zip(heads, STRIDES, ANCHORS, strict=True):
        for number, (width, height) in enumerate(anchors):
            for row in range(head.shape[1]):
                for column in range(head.shape[2]):
                    first = number * (5 + NETWORK_CLASSES)
                    x, y, w, h, objectness, *logits = head[first : first + 5 + NETWORK_CLASSES, row, column].tolist()
                    scores = [sigmoid(objectness) * sigmoid(logit) for logit in logits]
                    if form == "yolov3":
                        center = (sigmoid(x) + column) * stride, (sigmoid(y) + row) * stride
                        size = width * math.exp(w), height * math.exp(h)
                    else:
                        center = (2 * sigmoid(x) - 0.5 + column) * stride, (2 * sigmoid(y) - 0.5 + row) * stride
                        size = width * (2 * sigmoid(w)) ** 2, height * (2 * sigmoid(h)) ** 2
                    found.append((*center, *size, scores))
    assert_same(decode_heads(heads, replace(SPEC, format=form), threshold), finish(found, threshold))  # type: ignore[arg-type]


def test_yolox() -> None:
    rng = np.random.default_rng(2)
    head = rng.normal(0, 0.7, (len(CELLS), 5 + NETWORK_CLASSES))
    head[:, 4:] = rng.uniform(0, 1, head[:, 4:].shape)
    found = []
    for (stride, row, column), (x, y, w, h, objectness, *scores) in zip(CELLS, head.tolist(), strict=True):
        center = (x + column) * stride, (y + row) * stride
        found.append((*center, math.exp(w) * stride, math.exp(h) * stride, [objectness * score for score in scores]))
    spec = replace(SPEC, format="yolox", anchors_px=())
    assert_same(decode_heads([head.astype(np.float32)], spec, 0.4), finish(found, 0.4))


@pytest.mark.parametrize("per_stride", [False, True])
@pytest.mark.parametrize("is_logit", [False, True])
@pytest.mark.parametrize("cell_center", [0.0, 0.5])
def test_nanodet(per_stride: bool, is_logit: bool, cell_center: float) -> None:
    rng = np.random.default_rng(3)
    logits = rng.normal(-1, 1.5, (len(CELLS), NETWORK_CLASSES))
    distances = rng.normal(0, 2, (len(CELLS), 4 * BINS))
    scores = logits if is_logit else 1 / (1 + np.exp(-logits))
    found = []
    for (stride, row, column), cell_logits, sides in zip(CELLS, logits.tolist(), distances.tolist(), strict=True):
        reach = []
        for side in range(4):
            weights = [math.exp(value) for value in sides[side * BINS : (side + 1) * BINS]]
            reach.append(stride * sum(k * weight for k, weight in enumerate(weights)) / sum(weights))
        x, y = (column + cell_center) * stride, (row + cell_center) * stride
        left, top, right, bottom = x - reach[0], y - reach[1], x + reach[2], y + reach[3]
        center = (left + right) / 2, (top + bottom) / 2
        found.append((*center, right - left, bottom - top, [sigmoid(logit) for logit in cell_logits]))
    heads = [np.concatenate([scores, distances], 1).astype(np.float32)]
    if per_stride:
        ends = np.cumsum([HEIGHT // s * (WIDTH // s) for s in STRIDES])[:-1]
        heads = [part for whole in (scores, distances) for part in np.split(whole.astype(np.float32), ends)]
    spec = replace(SPEC, format="nanodet", anchors_px=(), is_logit=is_logit, cell_center=cell_center)
    assert_same(decode_heads(heads, spec, 0.35), finish(found, 0.35))


def random_boxes(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(5, 60, (count, 4)), rng.uniform(0, 1, (count, NETWORK_CLASSES))


@pytest.mark.parametrize("layout", LAYOUTS["ultralytics"])
def test_ultralytics(layout: str) -> None:
    boxes, scores = random_boxes(4)
    objectness = np.random.default_rng(5).uniform(0.3, 1, (len(boxes), 1))
    spec = replace(SPEC, format="ultralytics", layout=layout, strides=(), anchors_px=())
    if layout == "v5":
        head = np.concatenate([boxes, objectness, scores], 1)
        final = (objectness * scores).tolist()
    elif layout == "v8":
        head, final = np.concatenate([boxes, scores], 1).T, scores.tolist()
    else:
        center, half = boxes[:, :2], boxes[:, 2:] / 2
        head = np.concatenate([center - half, center + half, scores.max(1, keepdims=True), scores.argmax(1)[:, None]], 1)
        final = scores.tolist()
    found = [(*box, row) for box, row in zip(boxes.tolist(), final, strict=True)]
    assert_same(decode_heads([head.astype(np.float32)], spec, 0.5), finish(found, 0.5))  # type: ignore[arg-type]


@pytest.mark.parametrize("form", ["concatenated", "labels", "pixels"])
def test_rtdetr(form: str) -> None:
    boxes, scores = random_boxes(6)
    unit = (boxes / [WIDTH, HEIGHT, WIDTH, HEIGHT]).astype(np.float32)
    labels, best = scores.argmax(1), scores.max(1).astype(np.float32)
    heads: list[np.ndarray] = [labels, unit, best]
    if form == "concatenated":
        heads = [np.concatenate([unit, scores.astype(np.float32)], 1)]
    if form == "pixels":
        corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], 1)
        heads = [labels, corners.astype(np.float32), best]
    spec = replace(SPEC, format="rtdetr", layout="pixels" if form == "pixels" else "unit", strides=(), anchors_px=())
    found = [(*box, row) for box, row in zip(boxes.tolist(), scores.tolist(), strict=True)]
    assert_same(decode_heads(heads, spec, 0.5), finish(found, 0.5))  # type: ignore[arg-type]


def heads_of(spec: DetectorSpec, draw: Callable[[tuple[int, ...]], np.ndarray]) -> list[np.ndarray]:
    """Outputs of the shapes that a format has, filled by ``draw``."""
    shapes: dict[str, tuple[int, ...]] = {
        "yolox": (len(CELLS), 5 + NETWORK_CLASSES),
        "nanodet": (len(CELLS), NETWORK_CLASSES + 4 * BINS),
        "v8": (4 + NETWORK_CLASSES, 60),
        "v5": (60, 5 + NETWORK_CLASSES),
        "end2end": (60, 6),
        "unit": (60, 4 + NETWORK_CLASSES),
    }
    if spec.format in ("quadlift", "yolov3"):
        return [draw((2 * (5 + NETWORK_CLASSES), HEIGHT // s, WIDTH // s)) for s in STRIDES]
    if spec.layout == "pixels":
        return [draw((60,)), draw((60, 4)), draw((60,))]
    return [draw(shapes[spec.layout or spec.format])]


VARIANTS = [(form, layout) for form in FORMATS for layout in LAYOUTS.get(form, ("",))]


@pytest.mark.parametrize(("form", "layout"), VARIANTS)
@pytest.mark.parametrize("value", [-np.inf, -3e38, 0.0, 1.0, 3e38, np.inf, np.nan])
@pytest.mark.parametrize("threshold", [0.0, 0.3, 1.0])
def test_no_output_makes_a_box_that_is_no_number(form: str, layout: str, value: float, threshold: float) -> None:
    spec = replace(SPEC, format=form, layout=layout)  # type: ignore[arg-type]
    with np.errstate(invalid="ignore", over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error")
        found = decode_heads(heads_of(spec, lambda shape: np.full(shape, value, np.float32)), spec, threshold)
    assert np.isfinite(found.xyxy_px).all()
    assert (found.score > threshold).all()


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), threshold=st.floats(0.05, 0.9))
@pytest.mark.parametrize(("form", "layout"), VARIANTS)
def test_a_higher_threshold_takes_the_head_of_the_list(form: str, layout: str, seed: int, threshold: float) -> None:
    spec = replace(SPEC, format=form, layout=layout)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    heads = heads_of(spec, lambda shape: rng.uniform(0, 1, shape).astype(np.float32))
    all_of_them, some = decode_heads(heads, spec, 0.0), decode_heads(heads, spec, threshold)
    count = int((all_of_them.score > threshold).sum())
    np.testing.assert_array_equal(some.score[:count], all_of_them.score[:count])
    assert (np.diff(some.score) <= 0).all()
    assert len(some) <= MAX_CANDIDATES
    assert set(some.cls.tolist()) <= {0, 1, 2}


def test_a_huge_size_stays_a_number() -> None:
    head = np.zeros((1, 10), np.float32)
    head[0, 2:5], head[0, 6] = 80.0, 9.0
    spec = replace(SPEC, format="yolov3", strides=(32,), anchors_px=(((10.0, 10.0),),))
    found = decode_heads([head.reshape(10, 1, 1)], spec, 0.3)
    assert len(found) == 1
    assert np.isfinite(found.xyxy_px).all()
    assert (found.xyxy_px[0, 2:] - found.xyxy_px[0, :2] > 1e4).all()


def test_ids_that_the_network_cannot_have_are_dropped() -> None:
    spec = replace(SPEC, format="ultralytics", layout="end2end")
    rows = np.array([[0, 0, 10, 10, 0.9, cls] for cls in (-1, 0, 1, 5, 80, np.nan)], np.float32)
    found = decode_heads([rows], spec, 0.3)
    np.testing.assert_array_equal(found.cls, [0])
    own = replace(spec, class_of=None)
    np.testing.assert_array_equal(decode_heads([rows], own, 0.3).cls, [0, 1])


def test_a_box_of_a_dropped_class_is_not_given_to_the_next_best() -> None:
    spec = replace(SPEC, format="ultralytics", layout="v8")
    # A pedestrian at 0.9 that is a car at 0.5.
    column = np.array([30, 30, 10, 20, 0.9, 0.5, 0, 0, 0], np.float32)[:, None]
    assert len(decode_heads([column], spec, 0.3)) == 0
