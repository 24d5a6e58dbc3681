"""Logs and loss curves of a run: CSV, and PNG for the eye."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models_export.train.validation import ValidationLoss

TRAINING = "training"
"""Legend of the training loss in figures of validation, where it stands back."""

Row = Mapping[str, Any]
Line = tuple[str, NDArray[np.float64], NDArray[np.float64]]
"""Legend, steps, losses."""


def write_curves(out: Path, name: str, history: Sequence[Row], validation: Sequence[ValidationLoss]) -> None:
    """``<name>.csv`` and ``.png`` of training; with validation ``<name>.validation.csv`` and ``<name>.<axis>.png``.

    The axes are those of the task's labels: one figure for the cameras (the paper's figure 11), one for the weathers
    (figure 12), each with a line a label beside the training loss.
    """
    if not history:
        return
    _write_csv(out / f"{name}.csv", history)
    _draw(out / f"{name}.png", f"{name}: training loss", training_lines(history))
    if not validation:
        return
    _write_csv(out / f"{name}.validation.csv", [vars(loss) for loss in validation])
    (training,) = (line for line in training_lines(history) if line[0] == "total")
    for axis in sorted({loss.axis for loss in validation} - {"all"}):
        lines = [(TRAINING, *training[1:]), *validation_lines(validation, axis)]
        _draw(out / f"{name}.{axis}.png", f"{name}: loss by {axis}", lines)


def training_lines(history: Sequence[Row]) -> list[Line]:
    """A running mean over the steps of each term."""
    steps = np.array([row["step"] for row in history], dtype=np.float64)
    window = max(len(steps) // 100, 1)
    kernel = np.ones(window) / window
    terms = [key for key in history[0] if key not in ("step", "learning_rate")]
    return [(key, steps[window - 1 :], np.convolve([row[key] for row in history], kernel, mode="valid")) for key in terms]


def validation_lines(validation: Iterable[ValidationLoss], axis: str) -> list[Line]:
    """A line for each label of an axis."""
    chosen = [loss for loss in validation if loss.axis == axis]
    lines = []
    for label in sorted({loss.label for loss in chosen}):
        own = [loss for loss in chosen if loss.label == label]
        steps, losses = np.array([loss.step for loss in own], float), np.array([loss.loss for loss in own])
        lines.append((f"{label} ({own[-1].items} items)", steps, losses))
    return lines


def _draw(path: Path, title: str, lines: Sequence[Line]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    axes.set_prop_cycle(color=matplotlib.color_sequences["tab10" if len(lines) <= 10 else "tab20"])
    for label, steps, losses in lines:
        if label == TRAINING:
            axes.plot(steps, losses, label=label, color="0.8", zorder=1)
        else:
            axes.plot(steps, losses, label=label, marker="." if len(steps) <= 30 else None)
    axes.set(title=title, xlabel="step", ylabel="loss", yscale="log")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
