"""A pack around a detector that was trained elsewhere: its classes mapped to ours, the other networks another pack's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from models_export.coco import COCO_CLASSES
from models_export.export import Exported, write_pack
from service.errors import InputError
from service.nets.pack import Manifest, load_pack

UNMEASURED_EDGE_SIGMA = (2.0, 0.03, 1.0, 1.5)
"""Error model of box edges, px, of a detector that nobody has measured: floor, slope over size, growth, cut."""


def network_classes(text: str) -> tuple[str, ...]:
    """Class names in a network's order, from ``coco``, the path of a file with one name a line, or names with commas."""
    if text == "coco":
        return COCO_CLASSES
    names = Path(text).read_text("utf-8").splitlines() if Path(text).is_file() else text.split(",")
    found = tuple(name.strip() for name in names if name.strip())
    if not found or len(set(found)) != len(found):
        raise InputError(f"'{text}' gives {list(found)}.", field="classes", remedy="Give every class once, in order.")
    return found


def class_map(network: Sequence[str], ours: Sequence[str], renamed: Mapping[str, str]) -> dict[str, str]:
    """Names of ours by ids of the network's classes: those of the same name, and ``renamed``; the rest is dropped.

    Raises InputError when a name is unknown on either side, or nothing is left.
    """
    for theirs, name in renamed.items():
        if theirs not in network or name not in ours:
            raise InputError(
                f"'{theirs}={name}'.",
                field="map",
                remedy=f"Left a class of the network, right one of the base pack: {', '.join(ours)}.",
            )
    wanted = {**{name: name for name in ours}, **renamed}
    found = {str(index): wanted[name] for index, name in enumerate(network) if name in wanted}
    if not found:
        raise InputError(
            f"the network has no class of {', '.join(ours)}.", field="classes", remedy="Map some with --map THEIRS=OURS."
        )
    return found


def write_detector_pack(
    out: Path, base: str, detector: Exported, *, name: str, licence: str, training: Mapping[str, Any], scores: Mapping[str, Any]
) -> Manifest:
    """Write a pack of ``detector`` and all other networks of pack ``base``, with the base's classes.

    training, scores: of the detector. licence: of the whole. Raises PackError when the base cannot be loaded.
    """
    loaded = load_pack(base)
    others = {key: entry for key, entry in loaded.manifest.networks.items() if key != detector.name}
    copied = [
        Exported(key, (loaded.path / entry.file).read_bytes(), entry.precision, entry.parameters)
        for key, entry in others.items()
    ]
    origin = {"pack": loaded.manifest.name, "version": loaded.manifest.version}
    return write_pack(
        out,
        [detector, *copied],
        name=name,
        version="1",
        licence=licence,
        classes=loaded.manifest.classes,
        training={detector.name: dict(training), **dict.fromkeys(others, origin)},
        scores={detector.name: dict(scores), **{key: loaded.manifest.scores.get(key, {}) for key in others}},
    )
