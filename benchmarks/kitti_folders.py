"""KITTI label and result folders as arrays over all frames, ready for the evaluator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models_export.data.kitti import KittiObject, read_labels
from service.errors import InputError, NotFoundError
from service.geometry.transforms import Array

KNOWN_TYPES = frozenset({"car", "van", "truck", "pedestrian", "person_sitting", "cyclist", "tram", "misc", "dontcare"})
"""In lower case: KITTI compares types without case."""


@dataclass(frozen=True, eq=False)
class KittiSet:
    """Objects of many frames, N rows, frame after frame and within a frame in the order of the file."""

    frame: NDArray[np.int64]
    """(N,) number of the frame, ascending."""
    type: NDArray[np.str_]
    """(N,) types in lower case."""
    truncated: Array
    """(N,) 0..1; -1 in results."""
    occluded: NDArray[np.int64]
    """(N,) 0..3; -1 in results."""
    alpha: Array
    """(N,) observation angle, radians; -10 where a result gives none."""
    bbox: Array
    """(N, 4) xyxy in px."""
    states: Array
    """(N, 7) x y z l w h yaw in a right-handed frame with z up: KITTI's (x, z, -y), yaw = -rotation_y; metres, radians."""
    score: Array
    """(N,) confidence; 0 for labels."""

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def height_px(self) -> Array:
        """(N,) heights of the 2D boxes."""
        heights: Array = self.bbox[:, 3] - self.bbox[:, 1]
        return heights


@dataclass(frozen=True, eq=False)
class KittiPair:
    """Truth and results of the same frames."""

    truth: KittiSet
    results: KittiSet
    frames: int
    unknown: dict[str, int]
    """How many objects of types that KITTI does not know were skipped, by type."""


def read_ids(path: Path) -> list[str]:
    """Frame ids, one a line. Raises InputError naming file and line for an id given twice, or when there is none."""
    try:
        lines = path.read_text("ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}.", field=str(path), remedy="Give a text file of frame ids.") from error
    ids: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        word = line.strip()
        if not word:
            continue
        if word in ids:
            raise InputError(f"frame {word} stands in line {ids[word]} already.", field=f"{path}:{number}", remedy="Drop it.")
        ids[word] = number
    if not ids:
        raise InputError("holds no frame ids.", field=str(path), remedy="Give one id a line, such as 000001.")
    return list(ids)


def read_pair(labels: Path, results: Path, ids: Sequence[str]) -> KittiPair:
    """Labels and results of the frames ``ids``: ``<labels>/<id>.txt`` and ``<results>/<id>.txt``.

    As in KITTI's evaluator every frame needs both files (a result file may be empty), and objects of unknown types are
    skipped; here they are counted too. Raises NotFoundError for a missing folder or file, InputError naming file and line.
    """
    for folder in (labels, results):
        if not folder.is_dir():
            raise NotFoundError("no such folder.", field=str(folder), remedy="Give a folder of KITTI text files.")
    truth = [_objects(labels / f"{i}.txt", "truth") for i in ids]
    found = [_objects(results / f"{i}.txt", "result") for i in ids]
    unknown = Counter(o.type for frame in (*truth, *found) for o in frame if o.type.lower() not in KNOWN_TYPES)
    return KittiPair(as_set(truth), as_set(found), len(ids), dict(unknown))


def as_set(frames: Sequence[Sequence[KittiObject]]) -> KittiSet:
    """Objects of several frames as arrays; objects of types that KITTI does not know are left out."""
    rows = [(n, o) for n, frame in enumerate(frames) for o in frame if o.type.lower() in KNOWN_TYPES]
    objects = [o for _, o in rows]
    hwl = np.array([o.dims_hwl for o in objects], dtype=np.float64).reshape(-1, 3)
    xyz = np.array([o.location for o in objects], dtype=np.float64).reshape(-1, 3)
    rotation_y = np.array([o.rotation_y for o in objects], dtype=np.float64)
    upright = np.column_stack([xyz[:, 0], xyz[:, 2], 0.5 * hwl[:, 0] - xyz[:, 1]])
    return KittiSet(
        frame=np.array([n for n, _ in rows], dtype=np.int64),
        type=np.array([o.type.lower() for o in objects], dtype=np.str_),
        truncated=np.array([o.truncated for o in objects], dtype=np.float64),
        occluded=np.array([o.occluded for o in objects], dtype=np.int64),
        alpha=np.array([o.alpha for o in objects], dtype=np.float64),
        bbox=np.array([o.bbox_xyxy for o in objects], dtype=np.float64).reshape(-1, 4),
        states=np.column_stack([upright, hwl[:, ::-1], -rotation_y]),
        score=np.array([0.0 if o.score is None else o.score for o in objects], dtype=np.float64),
    )


def _objects(path: Path, kind: str) -> list[KittiObject]:
    if not path.is_file():
        raise NotFoundError(
            f"no {kind} for this frame.", field=str(path), remedy="Every id needs both files; a result file may be empty."
        )
    objects = read_labels(path)
    if kind == "result":
        for index, item in enumerate(objects):
            if item.score is None:
                raise InputError(
                    "15 columns, no score.", field=f"{path}:{_line_of(path, index)}", remedy="A result has 16 columns."
                )
    return objects


def _line_of(path: Path, index: int) -> int:
    """Line number of the ``index``-th object of a file, whose blank lines do not count."""
    filled = [number for number, line in enumerate(path.read_text("ascii").splitlines(), 1) if line.strip()]
    return filled[index]
