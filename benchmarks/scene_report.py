"""The tables of ``bench-accuracy scenes``."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from benchmarks.scene_score import SINGLE

PAPER_AP = {"easy": 54.1, "moderate": 44.7, "hard": 27.6}
"""The paper's claims (its Table 1): average precision at IoU 0.7 on its own CARLA recordings, four cameras."""
PAPER_CAVEAT = (
    "The data differ: the paper scored its own CARLA recordings, which are not published, and does not name its recall "
    "sampling. The figures stand side by side, but do not compare."
)

_AVERAGES = (
    ("AP3D@.5", "ap_3d", "0.5", "R40"),
    ("AP3D@.7", "ap_3d", "0.7", "R40"),
    ("AP3D@.7 R11", "ap_3d", "0.7", "R11"),
    ("APBEV@.5", "ap_bev", "0.5", "R40"),
    ("APBEV@.7", "ap_bev", "0.7", "R40"),
)

Figures = dict[str, dict[str, dict[str, Any]]]
"""By difficulty, then by view: summaries of ``ViewScore``."""


def accuracy_table(figures: Figures, title: str) -> Table:
    """A row a difficulty and view: average precision, recall, errors."""
    table = Table(title=title)
    for column in ("difficulty", "cameras", "vehicles"):
        table.add_column(column)
    for column in (*(name for name, *_ in _AVERAGES), "recall", "precision", "RMSE x y z m", "p50 m", "p90 m"):
        table.add_column(column, justify="right")
    for difficulty, views in figures.items():
        for name, view in views.items():
            rmse = " ".join(_text(view["rmse_m"][axis], 2) for axis in "xyz")
            table.add_row(
                difficulty,
                "each alone" if name == SINGLE else name,
                str(view["vehicles"]),
                *(_text(view[key][overlap][sampling]) for _, key, overlap, sampling in _AVERAGES),
                _text(view["recall_percent"]),
                _text(view["precision_percent"]),
                rmse,
                _text(view["error_m"]["p50"], 2),
                _text(view["error_m"]["p90"], 2),
            )
        table.add_section()
    table.caption = "AP in percent over 40 recalls (R40) unless R11 stands there."
    return table


def distance_table(figures: Figures) -> Table:
    """Recall and error percentiles by distance, of the view with most cameras."""
    table = Table(title="By distance to the nearest camera that shows the vehicle; all cameras fused")
    for column in ("difficulty", "m", "vehicles", "recall", "p50 m", "p90 m", "p99 m"):
        table.add_column(column, justify="left" if column == "difficulty" else "right")
    for difficulty, views in figures.items():
        for band in views[most_cameras(views)]["by_distance"]:
            errors = (_text(band[f"p{p}"], 2) for p in (50, 90, 99))
            span = f"{band['from_m']:g}-{band['to_m']:g}"
            table.add_row(difficulty, span, str(band["vehicles"]), _text(band["recall_percent"]), *errors)
        table.add_section()
    return table


def tracking_table(figures: Figures) -> Table:
    """MOTA, IDF1, HOTA and switches, a row a difficulty and number of cameras."""
    table = Table(title="Tracking, volume IoU; MOTA and IDF1 from 0.5, in percent")
    for column in ("difficulty", "cameras", "MOTA", "IDF1", "HOTA", "switches"):
        table.add_column(column, justify="left" if column == "difficulty" else "right")
    for difficulty, views in figures.items():
        for name, view in views.items():
            if "tracking" in view:
                scores = view["tracking"]
                percent = (_text(scores[key]) for key in ("mota", "idf1", "hota"))
                table.add_row(difficulty, name, *percent, str(scores["switches"]))
        table.add_section()
    return table


def paper_table(figures: Figures) -> Table:
    """Ours beside the paper's Table 1, with what keeps them from being compared."""
    table = Table(title="Average precision at IoU 0.7 beside the paper's claims", caption=PAPER_CAVEAT)
    for column in ("", *PAPER_AP):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("the paper, its CARLA data", *(f"{value:.1f}" for value in PAPER_AP.values()))
    for sampling in ("R11", "R40"):
        ours = [
            _text(figures[d][most_cameras(figures[d])]["ap_3d"]["0.7"][sampling]) if d in figures else "-" for d in PAPER_AP
        ]
        table.add_row(f"here, this data, 3D, {sampling}", *ours)
    return table


def most_cameras(views: dict[str, Any]) -> str:
    """The view that fuses most cameras."""
    return max((name for name in views if name != SINGLE), key=int)


def _text(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
