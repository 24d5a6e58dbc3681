"""A pack around a detector that was made elsewhere: all other networks, and the classes, are another pack's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from models_export.export import Exported, write_pack
from service.errors import InputError
from service.nets.pack import Manifest, Pack, load_pack

VERSION = "1"


def open_base(base: str, out: Path) -> Pack:
    """The pack that gives the other networks: a shipped one's name, or a folder.

    Raises PackError when it cannot be loaded, InputError when the new pack would overwrite it.
    """
    pack = load_pack(base, provider="cpu")
    if out.resolve() == pack.path.resolve():
        raise InputError("it is the base pack's own folder.", field="--out", remedy="Give another folder.")
    return pack


def write_detector_pack(
    out: Path, base: Pack, detector: Exported, *, licence: str, origin: Mapping[str, Any], scores: Mapping[str, Any]
) -> Manifest:
    """Write a pack of ``detector`` and the other networks of ``base``, under the name of its folder.

    licence, origin, scores: of the detector.
    """
    others = [Exported.of_pack(base, name) for name in base.manifest.networks if name != detector.name]
    known = {name: value for name, value in base.manifest.scores.items() if name != detector.name}
    from_base = {"name": base.manifest.name, "version": base.manifest.version, "training": base.manifest.training}
    return write_pack(
        out,
        [detector, *others],
        name=out.resolve().name,
        version=VERSION,
        classes=base.manifest.classes,
        training={detector.name: dict(origin), "base": from_base},
        scores={detector.name: dict(scores), **known},
        licence=f"detector: {licence}; other networks: {base.manifest.licence}",
    )
