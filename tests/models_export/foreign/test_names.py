"""Class lists and their map."""

from __future__ import annotations

from pathlib import Path

import pytest

from models_export.foreign.names import COCO_CLASSES, class_ids, read_class_map, read_classes
from service.errors import InputError


def test_cocos_ids_are_cocos() -> None:
    assert len(COCO_CLASSES) == len(set(COCO_CLASSES)) == 80
    assert [COCO_CLASSES[index] for index in (0, 2, 5, 7, 9, 79)] == [
        "person",
        "car",
        "bus",
        "truck",
        "traffic light",
        "toothbrush",
    ]


def test_classes_from_a_list_and_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "names.txt"
    path.write_text("car\n\ntraffic light\n")
    assert read_classes(str(path)) == read_classes("car, traffic light") == ("car", "traffic light")
    assert read_classes("coco") is COCO_CLASSES
    for wrong in ("", "car,car"):
        with pytest.raises(InputError, match="--classes"):
            read_classes(wrong)


def test_equal_names_pair_unless_a_map_is_given() -> None:
    theirs = ("person", "Car", "bus", "truck")
    assert class_ids(theirs, ["car", "bus"], {}) == {1: "car", 2: "bus"}
    assert class_ids(theirs, ["car", "bus"], {"truck": "bus", "bus": "bus"}) == {2: "bus", 3: "bus"}
    assert read_class_map(["a=b, c d=e", "f=g"]) == {"a": "b", "c d": "e", "f": "g"}
