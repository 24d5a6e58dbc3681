"""Pseudo labels: what a public detector sees in several views of one picture, and where its views agree.

A view is the picture or a tile of it, mirrored or not. Boxes of different views that overlap are one *candidate*; it counts how
many views found it, of those that had it whole. Candidates that enough views found become vehicles, the others regions that a
pupil is not blamed for. Candidates are kept on disk, so that thresholds can be set without asking the teacher again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models_export.data.detection import ANY_VEHICLE, IGNORED, Labels
from service.errors import InputError
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array
from service.nets.detections import Detections

Image = NDArray[np.uint8]

TILE = 0.6
"""Sides of a tile over the picture's: four of them overlap by a fifth."""
MIN_SCORE = 0.2
"""Boxes of a view below are not looked at."""
SAME_IOU = 0.6
"""Boxes of two views that overlap by more are one candidate."""
EDGE_PX = 3.0
"""A box this near a tile's inner border is cut by it, and is no vote."""


@dataclass(frozen=True)
class AgreeConfig:
    """When candidates become labels."""

    min_views: int = 3
    """Views that found it, at least; all of them where fewer had it whole."""
    min_share: float = 0.5
    """Of the views that had it whole, at least."""
    min_score: float = 0.4
    """Mean score over the views that found it, at least."""
    noise_score: float = 0.35
    """A candidate below that only one view found is nothing: zebra crossings, shadows."""
    max_doubt_area: float = 0.06
    """A doubtful candidate that takes a larger part of the picture is nothing: groups of vehicles, patches of road."""
    known_overlap: float = 0.4
    """A candidate of which more lies in one box that is labelled already adds nothing."""


@dataclass(frozen=True)
class View:
    """A part of a picture, fractions of its sides, and whether it is mirrored."""

    x0: float
    y0: float
    x1: float
    y1: float
    mirrored: bool


@dataclass(frozen=True, eq=False)
class Candidates:
    """N places of one picture where the teacher saw a vehicle, in falling order of views."""

    xyxy: Array
    """(N, 4) fractions of the picture: mean of the views' boxes, weighted by their score."""
    score: Array
    """(N,) mean over the views that found it."""
    found: NDArray[np.int64]
    """(N,) views that found it."""
    possible: NDArray[np.int64]
    """(N,) views that had it whole; at least ``found``."""


class Teacher(Protocol):
    """A detector of vehicles."""

    def detect(self, images: Sequence[Image], *, score_threshold: float) -> list[Detections]:
        """Boxes in the images' pixels."""


def views() -> list[View]:
    """The whole picture and four overlapping tiles, each as it is and mirrored."""
    low = 1 - TILE
    parts = [(0.0, 0.0, 1.0, 1.0)] + [(x, y, x + TILE, y + TILE) for y in (0.0, low) for x in (0.0, low)]
    return [View(*np.minimum(part, 1.0).tolist(), mirrored) for part in parts for mirrored in (False, True)]


def candidates(teacher: Teacher, image: Image) -> Candidates:
    """What the teacher sees in all views of an image (H, W, 3) RGB."""
    looks = views()
    return combine([look(teacher, image, view) for view in looks], looks, image.shape[1], image.shape[0])


def look(teacher: Teacher, image: Image, view: View) -> tuple[Array, Array]:
    """Boxes (N, 4), fractions of the picture, and scores (N,) that a view shows whole."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = np.round(np.array([view.x0, view.y0, view.x1, view.y1]) * [width, height, width, height]).astype(int)
    part = image[y0:y1, x0:x1]
    part = np.ascontiguousarray(part[:, ::-1] if view.mirrored else part)
    (found,) = teacher.detect([part], score_threshold=MIN_SCORE)
    xyxy = found.xyxy_px.copy()
    if view.mirrored:
        xyxy[:, [0, 2]] = (part.shape[1] - 1) - found.xyxy_px[:, [2, 0]]
    fractions = (xyxy + 0.5 + np.tile([x0, y0], 2)) / np.tile([width, height], 2)
    whole = shown_whole(fractions, view, width, height)
    return fractions[whole], found.score[whole]


def shown_whole(xyxy: Array, view: View, width: int, height: int) -> NDArray[np.bool_]:
    """Which boxes (N, 4), fractions, a view has whole: off its borders, except where those are the picture's own."""
    margin = EDGE_PX / np.array([width, height])
    start, end = np.array([view.x0, view.y0]), np.array([view.x1, view.y1])
    after = np.all((xyxy[:, :2] > start + margin) | (start <= 0), axis=1)
    before = np.all((xyxy[:, 2:] < end - margin) | (end >= 1), axis=1)
    return np.asarray(after & before, dtype=bool)


def combine(seen: list[tuple[Array, Array]], looks: list[View], width: int, height: int) -> Candidates:
    """Boxes and scores of each view as candidates: the best box first, each view's best match joins it."""
    pools = [(xyxy.copy(), score.copy()) for xyxy, score in seen]
    rows = []
    while best := max(((score.max(), index) for index, (_, score) in enumerate(pools) if len(score)), default=None):
        xyxy, score = pools[best[1]]
        seed = xyxy[int(score.argmax())]
        members, weights = [], []
        for index, (boxes, scores) in enumerate(pools):
            overlap = iou_2d(seed[None], boxes)[0]
            if len(scores) and overlap.max() > SAME_IOU:
                row = int(overlap.argmax())
                members.append(boxes[row])
                weights.append(scores[row])
                pools[index] = np.delete(boxes, row, 0), np.delete(scores, row)
        mean = np.average(members, axis=0, weights=weights)
        possible = sum(bool(shown_whole(mean[None], view, width, height)[0]) for view in looks)
        rows.append((*mean, float(np.mean(weights)), len(members), max(possible, len(members))))
    table = np.array(sorted(rows, key=lambda row: -row[5]), dtype=np.float64).reshape(-1, 7)
    return Candidates(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), table[:, 6].astype(np.int64))


def agreed(seen: Candidates, labelled: Labels, config: AgreeConfig) -> Labels:
    """What the candidates add to the labels that a picture has: vehicles of unknown kind, and regions to ignore."""
    kinds: list[str] = []
    taken = labelled.xyxy
    rows = []
    for row in range(len(seen.score)):
        box = seen.xyxy[row]
        noise = seen.found[row] == 1 and seen.score[row] < config.noise_score
        if noise or _share_inside(box, taken) > config.known_overlap:
            continue
        wanted = max(min(config.min_views, seen.possible[row]), config.min_share * seen.possible[row])
        sure = seen.found[row] >= wanted and seen.score[row] >= config.min_score
        if not sure and np.prod(box[2:] - box[:2]) > config.max_doubt_area:
            continue
        kinds.append(ANY_VEHICLE if sure else IGNORED)
        rows.append(box)
        if sure:
            taken = np.concatenate([taken, box[None]])
    return Labels(np.array(rows, dtype=np.float64).reshape(-1, 4), tuple(kinds))


def _share_inside(box: Array, others: Array) -> float:
    """The largest share of a box (4,) that lies in one of others (N, 4)."""
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    area = max(float(np.prod(box[2:] - box[:2])), 1e-12)
    return float(np.prod(np.maximum(sides, 0.0), axis=1).max(initial=0.0)) / area


def write_candidates(path: Path, by_picture: Mapping[str, Candidates]) -> None:
    """Candidates of pictures as JSON, rows of x0 y0 x1 y1 (fractions), score, found, possible."""
    document = {
        name: [
            [*np.round(c.xyxy[k], 5).tolist(), round(float(c.score[k]), 4), int(c.found[k]), int(c.possible[k])]
            for k in range(len(c.score))
        ]
        for name, c in by_picture.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(document), "utf-8")
    temporary.replace(path)


def read_candidates(path: Path) -> dict[str, Candidates]:
    """What :func:`write_candidates` wrote. Raises InputError when the file is not that."""
    try:
        document = json.loads(path.read_text("utf-8"))
        tables = {str(name): np.array(rows, dtype=np.float64).reshape(-1, 7) for name, rows in document.items()}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            f"not a teacher's file: {error}.", field=str(path), remedy="Write it with `quadlift teach`."
        ) from error
    return {
        name: Candidates(t[:, :4], t[:, 4], t[:, 5].astype(np.int64), t[:, 6].astype(np.int64)) for name, t in tables.items()
    }
