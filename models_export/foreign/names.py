"""Class lists of foreign detectors, and their map to a pack's classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from service.errors import InputError

_COCO = """person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant stop_sign parking_meter bench
bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie suitcase frisbee skis snowboard
sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork knife spoon bowl
banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch potted_plant bed dining_table toilet tv
laptop mouse remote keyboard cell_phone microwave oven toaster sink refrigerator book clock vase scissors teddy_bear
hair_drier toothbrush"""
COCO_CLASSES = tuple(name.replace("_", " ") for name in _COCO.split())
"""The 80 classes of COCO detection, in the order in which networks number them."""


def read_classes(text: str) -> tuple[str, ...]:
    """Class names from ``coco``, from a text file with one name a line, or from a list separated by commas.

    Raises InputError where none are named, or one twice.
    """
    if text == "coco":
        return COCO_CLASSES
    lines = Path(text).read_text("utf-8").splitlines() if Path(text).is_file() else text.split(",")
    names = tuple(line.strip() for line in lines if line.strip())
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"{len(names)} names, {len(set(names))} different ones.", field="--classes", remedy="Name each class once."
        )
    return names


def read_class_map(pairs: Sequence[str]) -> dict[str, str]:
    """From ``theirs=ours`` pairs, each item one or several separated by commas. Raises InputError."""
    items = [item.strip() for pair in pairs for item in pair.split(",") if item.strip()]
    for item in items:
        if item.count("=") != 1:
            raise InputError(
                f"'{item}'", field="--class-map", remedy="Write theirs=ours, as in bus=bus or 'pickup truck=truck'."
            )
    return {theirs.strip(): ours.strip() for theirs, ours in (item.split("=") for item in items)}


def class_ids(theirs: Sequence[str], ours: Sequence[str], class_map: Mapping[str, str]) -> dict[int, str]:
    """Names of ours by ids of theirs. An empty map pairs equal names, whatever their case.

    Raises InputError naming a class that either side does not have, or where nothing is left.
    """
    pairs = class_map or {name: name.lower() for name in theirs if name.lower() in ours}
    for name, target in pairs.items():
        if name not in theirs:
            raise InputError(f"the detector has no class '{name}'.", field="--class-map", remedy=f"It has {', '.join(theirs)}.")
        if target not in ours:
            raise InputError(
                f"the pack has no class '{target}'.",
                field="--class-map",
                remedy=f"Its multi-bin head knows the sizes of {', '.join(ours)}: map to these, or give another --base.",
            )
    if not pairs:
        raise InputError(
            f"none of the detector's classes is one of the pack's ({', '.join(ours)}).",
            field="--class-map",
            remedy="Give theirs=ours pairs.",
        )
    return {list(theirs).index(name): target for name, target in pairs.items()}
