"""What ``bench-accuracy kitti`` prints beside its JSON."""

from __future__ import annotations

from rich.table import Table

from benchmarks.kitti_folders import KittiPair
from benchmarks.kitti_protocol import DIFFICULTIES, RECALL_POINTS, Curve, as_percent

Scores = dict[str, dict[str, list[Curve] | None]]
_ROWS = (("3d", "3D"), ("bev", "bird's eye"), ("2d", "2D"), ("aos", "AOS"))


def kitti_table(curves: Scores, overlaps: dict[str, float]) -> Table:
    """Average precision in percent, a row a class, metric and recall sampling; a dash where results give no value."""
    table = Table(title="Average precision in percent, KITTI's protocol")
    for column in ("class", "overlap >", "metric", "recalls"):
        table.add_column(column)
    for difficulty in DIFFICULTIES:
        table.add_column(difficulty.name, justify="right")
    for name, metrics in as_percent(curves).items():
        for key, title in _ROWS:
            figures = metrics[key]
            for sampling in ("R11", "R40"):
                values = ["-"] * len(DIFFICULTIES) if figures is None else [f"{v:.2f}" for v in figures[sampling]]
                table.add_row(name, f"{overlaps[name]:g}", title, sampling, *values)
        table.add_section()
    return table


def kitti_notes(pair: KittiPair, curves: Scores) -> list[str]:
    """What a reader has to know to take the figures right: what was skipped, and what is too little or missing."""
    lines = [f"{count} objects of the unknown type '{name}' skipped." for name, count in sorted(pair.unknown.items())]
    for name, metrics in curves.items():
        counted = [curve.counted for curve in metrics["2d"] or []]
        if min(counted) < RECALL_POINTS:
            lines.append(
                f"{name}: {' / '.join(map(str, counted))} objects count (easy / moderate / hard); KITTI's sampling of the "
                f"recall needs {RECALL_POINTS} to reach 100."
            )
        if not (pair.results.type == name.lower()).any():
            lines.append(f"{name}: no results.")
        if metrics["aos"] is None:
            lines.append(f"{name}: no orientation similarity, for a result gives alpha -10, which means none.")
    if any(metrics["3d"] is None for metrics in curves.values()):
        lines.append("No bird's-eye and 3D figures: no result has a location.")
    return lines
