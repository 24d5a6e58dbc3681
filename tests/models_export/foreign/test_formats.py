"""Outputs are told apart by their shapes, and where shapes leave it open, the user is asked."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.foreign.formats import Output, Question, read_anchors, read_outputs
from service.errors import InputError


def outputs(*shapes: tuple[int, ...]) -> list[Output]:
    return [Output(f"o{index}", np.full(shape, 0.5, np.float32)) for index, shape in enumerate(shapes)]


def test_yolov3_heads_come_finest_first() -> None:
    reading = read_outputs("yolov3", Question(outputs((255, 13, 13), (255, 52, 52), (255, 26, 26)), 80, (416, 416)))
    assert reading.outputs == ("o1", "o2", "o0")
    assert reading.metadata["strides"] == [8, 16, 32]
    assert reading.metadata["anchors_px"][0][0] == [10, 13]
    tiny = read_outputs("yolov3", Question(outputs((255, 13, 13), (255, 26, 26)), 80, (416, 416)))
    assert tiny.metadata["anchors_px"][0] == [[23, 27], [37, 58], [81, 82]]


def test_nanodet_plus_measures_from_the_cells_corner() -> None:
    plus = read_outputs("nanodet", Question(outputs((3598, 112)), 80, (416, 416)))
    assert plus.metadata == {"strides": [8, 16, 32, 64], "cell_center": 0.0, "is_logit": False}
    older = read_outputs("nanodet", Question(outputs((3549, 112)), 80, (416, 416)))
    assert (older.metadata["strides"], older.metadata["cell_center"]) == ([8, 16, 32], 0.5)
    told = read_outputs("nanodet", Question(outputs((3598, 112)), 80, (416, 416), cell_center=0.5))
    assert told.metadata["cell_center"] == 0.5


def test_one_class_of_ultralytics_is_ambiguous() -> None:
    with pytest.raises(InputError, match="--layout"):
        read_outputs("ultralytics", Question(outputs((300, 6)), 1, (640, 640)))
    for layout in ("v5", "end2end"):
        reading = read_outputs("ultralytics", Question(outputs((300, 6)), 1, (640, 640), layout=layout))
        assert reading.metadata == {"layout": layout}


def test_rtdetr_outputs_are_put_in_order() -> None:
    labels = Output("labels", np.zeros(300, np.int64))
    shuffled = [Output("scores", np.zeros(300, np.float32)), Output("boxes", np.zeros((300, 4), np.float32)), labels]
    reading = read_outputs("rtdetr", Question(shuffled, 80, (640, 640), has_size_input=True))
    assert reading.outputs == ("labels", "boxes", "scores")
    assert reading.metadata == {"layout": "pixels"}


@pytest.mark.parametrize("form", ["yolox", "ultralytics", "rtdetr"])
def test_scores_without_their_sigmoid_are_refused(form: str) -> None:
    shape = {"yolox": (3549, 8), "ultralytics": (100, 8), "rtdetr": (100, 7)}[form]
    question = Question([Output("o", np.full(shape, 3.0, np.float32))], 3, (416, 416))
    with pytest.raises(InputError, match=r"scores in 0\.\.1, not 3\.00\.\.3\.00"):
        read_outputs(form, question)  # type: ignore[arg-type]


def test_a_wrong_count_of_cells_is_refused() -> None:
    with pytest.raises(InputError, match=r"3549 \(strides 8/16/32\)"):
        read_outputs("yolox", Question(outputs((3000, 8)), 3, (416, 416)))


def test_anchors_are_read() -> None:
    assert read_anchors("10,13 16,30 / 30,61 62,45") == [[[10, 13], [16, 30]], [[30, 61], [62, 45]]]
    with pytest.raises(InputError, match="--anchors"):
        read_anchors("10x13")
