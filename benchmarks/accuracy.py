"""``bench-accuracy``: how many vehicles are found, and how exactly."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from benchmarks.clip_score import score_clip, score_roadside
from benchmarks.confidence_fit import candidates, confidence_figures, confidence_table
from benchmarks.drive import RULES as DRIVE_RULES
from benchmarks.drive import drive_figures, drive_table, score_pack, write_pictures
from benchmarks.drive_centres import score_single_cameras
from benchmarks.drive_truth import drive_frames
from benchmarks.flat_score import carla_results, contenders, drive_results, flat_curve, flat_summary
from benchmarks.kitti_folders import read_ids, read_pair
from benchmarks.kitti_protocol import CLASSES, DEFAULT_OVERLAPS, as_percent, evaluate
from benchmarks.kitti_report import kitti_notes, kitti_table
from benchmarks.machine import describe_machine
from benchmarks.recordings import PANDASET_CLIP, open_roadside_clip, recording
from benchmarks.scene_plots import write_plots
from benchmarks.scene_report import accuracy_table, distance_table, paper_table, tracking_table
from benchmarks.scene_score import RULES, score_scenes, settings_of, summaries
from benchmarks.scene_sets import SceneSets, open_scene_sets
from clients.clip import SHIPPED, ClipError
from models_export.data.carla2d import ARCHIVE as CARLA_FRAMES
from models_export.data.pandaset import open_pandaset
from models_export.data.pandaset_samples import HELD_OUT_STEPS
from service.errors import InputError, QuadliftError
from service.guidance import HardMode
from service.nets.pack import load_pack
from service.pipeline import Pipeline, PipelineSettings

app = typer.Typer(help="How many vehicles are found, and how exactly.", no_args_is_help=True)
PIPED_WIDTH = 150
console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
notes = Console(stderr=True, soft_wrap=True)
"""What is said beside the result, so that standard output stays JSON with --json."""

PackOption = Annotated[str, typer.Option(help="Pack: a shipped one's name, or a folder.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
WidthOption = Annotated[
    int | None,
    typer.Option("--detector-width", min=64, help="Bring all pictures to this width for the detector, px."),
]


@app.command("clip")
def clip_command(
    clip: Annotated[Path, typer.Argument(help="Folder of a clip; the shipped one if left out.")] = SHIPPED,
    pack: PackOption = "edge",
    cameras: Annotated[int | None, typer.Option(help="Use only the first cameras.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Fused boxes on the demo clip against its truth."""
    _report("clip", pack, lambda pipeline: score_clip(pipeline, clip, cameras), as_json)


@app.command("roadside")
def roadside_command(pack: PackOption = "edge", detector_width: WidthOption = None, as_json: JsonOption = False) -> None:
    """Three real roadside cameras against a LiDAR system's tracks (needs the recording)."""
    settings = PipelineSettings(detector_width=detector_width, min_fused_score=0.0)
    _report("roadside", pack, lambda pipeline: score_roadside(pipeline, open_roadside_clip()), as_json, settings)


@app.command("carla2d")
def carla2d_command(pack: PackOption = "edge", as_json: JsonOption = False) -> None:
    """The 2D detector on held-out frames of a driving CARLA camera: AP at IoU 0.5 (needs the recording)."""
    with _errors_named():
        archive = recording(CARLA_FRAMES)
        found = contenders(load_pack(pack), archive.parent)
        results = {c.name: flat_summary(flat_curve(carla_results(c, archive))) for c in found}
    _print_figures("carla2d", pack, results, as_json)


@app.command("pandaset-held-out")
def pandaset_held_out_command(
    pack: PackOption = "edge",
    every: Annotated[int, typer.Option(min=1, help="Score every n-th held-out step.")] = 3,
    as_json: JsonOption = False,
) -> None:
    """The end of a real drive that no training sees: AP of 2D boxes, and where one camera alone puts vehicles (needs it)."""
    with _errors_named():
        archive, loaded = recording(PANDASET_CLIP), load_pack(pack)
        found = contenders(loaded, archive.parent)
        results: dict[str, Any] = {c.name: flat_summary(flat_curve(drive_results(c, archive, every))) for c in found}
        pipeline = Pipeline(loaded, PipelineSettings())
        centres = score_single_cameras(pipeline, open_pandaset(archive), HELD_OUT_STEPS[::every])
    results["3d_one_camera_within_40_m"] = centres.summary()
    _print_figures("pandaset-held-out", pack, results, as_json)


@app.command("pandaset")
def pandaset_command(
    pack: PackOption = "edge",
    recording_path: Annotated[
        Path | None, typer.Option("--recording", help="Zip of a drive; the known one if left out.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Score every n-th step.")] = 5,
    scores: Annotated[list[float] | None, typer.Option("--score", min=0.01, max=0.99, help="Least score. Repeatable.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Darknet file of the pack's detector, to run by torch as well.")] = None,
    pictures: Annotated[Path | None, typer.Option(help="Folder for the frames with truth and boxes.")] = None,
    as_json: JsonOption = False,
) -> None:
    """The 2D detector on six real cameras of a moving car: recall and false boxes at IoU 0.5 (needs the recording)."""
    thresholds = scores or [0.1, 0.3, 0.5]
    with _errors_named():
        drive = open_pandaset(recording_path or recording(PANDASET_CLIP))
        frames = list(drive_frames(drive, range(0, drive.steps, every)))
        network = load_pack(pack).networks["detector"]
        found = {"ONNX Runtime": score_pack(network, frames, thresholds)}
        difference = None
        if weights is not None:
            # Imported here: the other commands need no torch.
            from benchmarks.drive_torch import score_darknet

            found["torch"], difference = score_darknet(network, weights, frames, thresholds)
        if pictures is not None:
            write_pictures(network, frames, thresholds[0], pictures)
    if as_json:
        about = {"pack": pack, "rules": DRIVE_RULES, "machine": describe_machine(), "torch_difference": difference}
        typer.echo(json.dumps({**about, "scores": drive_figures(found)}, indent=1))
        return
    console.print(drive_table(f"pandaset, pack {pack}, every {every} steps", found))
    if difference is not None:
        notes.print(f"torch and ONNX Runtime: heads differ by {difference:.1e} of their range at most")


@app.command("kitti")
def kitti_command(
    labels: Annotated[Path, typer.Option(help="Folder of KITTI label files (label_2).")],
    results: Annotated[Path, typer.Option(help="Folder of result files in KITTI's format, with scores.")],
    ids: Annotated[Path, typer.Option(help="Text file of frame ids, one a line.")],
    min_overlap: Annotated[float, typer.Option(min=0, max=1, help="Least overlap of a car.")] = DEFAULT_OVERLAPS["Car"],
    min_overlap_others: Annotated[
        float, typer.Option(min=0, max=1, help="Least overlap of a pedestrian or cyclist.")
    ] = DEFAULT_OVERLAPS["Pedestrian"],
    as_json: JsonOption = False,
) -> None:
    """Average precision by KITTI's own protocol: 2D, orientation, bird's-eye view and 3D, at 11 and 40 recalls."""
    started = time.perf_counter()
    with _errors_named():
        pair = read_pair(labels, results, read_ids(ids))
    overlaps = {name: min_overlap if name == "Car" else min_overlap_others for name in CLASSES}
    curves = evaluate(pair, overlaps)
    if as_json:
        typer.echo(json.dumps(as_percent(curves), indent=1))
    else:
        console.print(kitti_table(curves, overlaps))
    for note in kitti_notes(pair, curves):
        notes.print(f"[yellow]{note}[/yellow]")
    notes.print(f"{pair.frames} frames in {time.perf_counter() - started:.1f} s")


@app.command("scenes")
def scenes_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of scenes, or one scene's folder.")],
    pack: PackOption = "edge",
    cameras: Annotated[int | None, typer.Option(min=1, help="Use only the first N; each count if left out.")] = None,
    method: Annotated[Literal["map", "paper"], typer.Option(help="How boxes are lifted and fused.")] = "map",
    hard_mode: Annotated[HardMode, typer.Option(help="Where the pack's depth-guided detector adds boxes.")] = "auto",
    detector_width: WidthOption = None,
    as_json: JsonOption = False,
    plots: Annotated[Path | None, typer.Option(help="Folder for precision-recall curves and RMSE bars as PNG.")] = None,
) -> None:
    """Fused and single-camera boxes on scenes with exact truth: AP, position errors, tracking, by difficulty."""
    with _errors_named():
        settings = replace(settings_of(method), hard_mode=hard_mode, detector_width=detector_width)
        sets = open_scene_sets(dataset)
        counts = _camera_counts(sets, cameras)
        loaded = load_pack(pack)
        with Progress(console=notes, transient=True) as progress:
            task = progress.add_task("scenes", total=len(sets.scenes))
            scores = score_scenes(sets, lambda s: Pipeline(loaded, s), settings, counts, lambda: progress.advance(task))
        figures = summaries(scores)
        for path in write_plots(scores, plots) if plots else []:
            notes.print(f"wrote {path}")
    for name, count in sorted(sets.unknown.items()):
        notes.print(f"[yellow]{count} objects of the unknown class '{escape(name)}' skipped.[/yellow]")
    if as_json:
        about = {"dataset": str(dataset), "scenes": len(sets.scenes), "pack": pack, "method": method, "hard_mode": hard_mode}
        about |= {} if detector_width is None else {"detector_width": detector_width}
        typer.echo(json.dumps({**about, "rules": RULES, "machine": describe_machine(), "difficulties": figures}, indent=1))
        return
    title = f"{dataset.name}: {len(sets.scenes)} scenes, pack {pack}, method {method}, hard mode {hard_mode}"
    console.print(accuracy_table(figures, title))
    for table in (distance_table(figures), tracking_table(figures), paper_table(figures)):
        console.print(table)


@app.command("confidence")
def confidence_command(
    datasets: Annotated[list[Path], typer.Argument(help="Folders of validation scenes, each fitted by itself.")],
    pack: PackOption = "edge",
    as_json: JsonOption = False,
) -> None:
    """Fit the weights of a fused box's score on scenes with exact truth, and try each set's weights on the others."""
    with _errors_named():
        loaded = load_pack(pack)
        fitted = {str(path): candidates(open_scene_sets(path), lambda s: Pipeline(loaded, s)) for path in datasets}
        figures = confidence_figures(fitted)
    if as_json:
        typer.echo(json.dumps({"pack": pack, "machine": describe_machine(), **figures}, indent=1))
        return
    console.print(confidence_table(f"weights of a fused box's score, pack {pack}", figures))


def _camera_counts(sets: SceneSets, cameras: int | None) -> list[int]:
    """Camera counts to score. Raises InputError when no scene has as many as are asked for."""
    if cameras is None:
        return list(range(1, sets.most_cameras + 1))
    if cameras > sets.most_cameras:
        raise InputError(f"no scene has {cameras} cameras.", field="--cameras", remedy=f"The most is {sets.most_cameras}.")
    return [cameras]


@contextmanager
def _errors_named() -> Iterator[None]:
    """Turn the errors that a user can mend into one line and exit code 2."""
    try:
        yield
    except (QuadliftError, ClipError) as error:
        notes.print(f"[red]{escape(str(error))}[/red]")
        raise typer.Exit(2) from None


def _report(name: str, pack: str, score: Any, as_json: bool, settings: PipelineSettings | None = None) -> None:
    with _errors_named():
        result = score(Pipeline(load_pack(pack), settings))
    _print_figures(name, pack, result, as_json)


def _print_figures(name: str, pack: str, result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({name: result, "pack": pack, "machine": describe_machine()}, indent=1))
        return
    table = Table(title=f"{name}, pack {pack}")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key, value in _flat(result):
        table.add_row(key, str(value))
    console.print(table)


def _flat(result: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in result.items():
        rows += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return rows


def main() -> None:
    """Console entry point."""
    app()


if __name__ == "__main__":
    main()
