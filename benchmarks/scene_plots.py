"""Precision-recall curves and RMSE bars as PNG: the paper's figures 14 and 15."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.scene_report import most_cameras
from benchmarks.scene_score import ALL, MIN_OVERLAPS, SINGLE, Scores
from service.errors import QuadliftError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {"easy": "#2a7f3f", "moderate": "#c77d0a", "hard": "#b3282d"}
_OTHER_COLOUR = "#35526f"
_SAMPLES = np.linspace(0.0, 1.0, 201)


def write_plots(scores: Scores, folder: Path) -> list[Path]:
    """Write ``precision_recall.png`` and ``rmse.png`` into a folder, which is made. Raises QuadliftError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise QuadliftError(
            "matplotlib is not installed.", field="--plots", remedy="Install it: pip install 'quadlift[train]'."
        ) from error
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "precision_recall.png", folder / "rmse.png"]
    for path, draw in zip(paths, (_draw_curves, _draw_rmse), strict=True):
        figure = Figure(figsize=(9.0, 4.4), layout="constrained")
        draw(figure, scores)
        figure.savefig(path, dpi=130)
    return paths


def _draw_curves(figure: Figure, scores: Scores) -> None:
    for overlap, axes in zip(MIN_OVERLAPS, figure.subplots(1, len(MIN_OVERLAPS), sharey=True), strict=True):
        for difficulty, views in scores.items():
            colour = _COLOURS.get(difficulty, _OTHER_COLOUR)
            for name, style in ((most_cameras(views), "-"), (SINGLE, "--")):
                if difficulty == ALL or name not in views:
                    continue
                curve = views[name].curve("3d", overlap)
                average = curve.average("R40")
                label = f"{difficulty}, {'each camera alone' if name == SINGLE else f'{name} cameras'} ({average:.1f})"
                axes.plot(_SAMPLES, curve.at(_SAMPLES), style, color=colour, label=label)
        axes.set(title=f"3D IoU > {overlap:g} (AP R40 in brackets)", xlabel="recall", xlim=(0, 1), ylim=(0, 1.02))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    figure.axes[0].set_ylabel("precision, largest at that recall or beyond")


def _draw_rmse(figure: Figure, scores: Scores) -> None:
    graded = {name: views for name, views in scores.items() if name != ALL}
    panels = figure.subplots(1, 2, sharey=True)
    for axes, single in zip(panels, (False, True), strict=True):
        width = 0.8 / len(graded)
        for index, (difficulty, views) in enumerate(graded.items()):
            name = SINGLE if single else most_cameras(views)
            rmse = views[name].errors().summary()["rmse_m"]
            heights = [0.0 if rmse[axis] is None else rmse[axis] for axis in "xyz"]
            places = np.arange(3) + (index - (len(graded) - 1) / 2) * width
            bars = axes.bar(places, heights, width, label=difficulty, color=_COLOURS.get(difficulty, _OTHER_COLOUR))
            axes.bar_label(bars, fmt="%.2f", fontsize=7)
        axes.set_xticks(np.arange(3), ["x (East)", "y (North)", "z (up)"])
        axes.set_title("each camera alone" if single else "all cameras fused")
        axes.grid(axis="y", alpha=0.3)
        axes.margins(y=0.2)
    panels[0].set_ylabel("RMSE of the centre, m")
    panels[0].legend(fontsize=8)
