"""A rendered scene made into the small clip that ships with the client: ``python -m models_export.scenes.clip SCENE OUT``.

The form of the clip's folder stands in ``clients/clip.py``, which reads it.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from models_export.data.dataset import Scene, open_scene, step_name
from service.errors import InputError, QuadliftError
from service.site import save_site

MAX_QUALITY = 92
"""Above this JPEGs grow and look no better."""
MIN_QUALITY = 20
_PROBED_STEPS = 8


@dataclass(frozen=True)
class ClipPlan:
    """What to take of a scene, and how small it has to be."""

    start: int = 0
    """First step."""
    steps: int = 100
    """Frame sets to take."""
    stride: int = 1
    """Take every ``stride``-th step."""
    site_id: str = "demo"
    """Id that the clip's site gets."""
    budget_bytes: int = 8_000_000
    """What all JPEGs may take together."""

    def source_steps(self) -> range:
        """Steps of the scene, in order."""
        return range(self.start, self.start + self.steps * self.stride, self.stride)


def build_clip(scene: Scene, out: Path, plan: ClipPlan = ClipPlan()) -> int:
    """Write a clip with the highest JPEG quality that fits the budget; gives that quality.

    Whatever stood at ``out`` is replaced, once all is written. Raises InputError when the scene is too short or no quality
    fits.
    """
    if plan.source_steps()[-1] >= scene.steps:
        raise InputError(
            f"the clip needs step {plan.source_steps()[-1]}, the scene has {scene.steps} steps.",
            field=str(scene.path),
            remedy="Render a longer scene.",
        )
    quality = _guess_quality(scene, plan)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as temporary:
        draft = Path(temporary) / "clip"
        # The guess comes from a few steps, so all of them may turn out a little larger.
        while _write_frames(scene, plan, draft, quality) > plan.budget_bytes:
            quality -= 1
            if quality < MIN_QUALITY:
                raise _too_large(scene, plan)
        save_site(replace(scene.site, id=plan.site_id), draft / "site.json")
        (draft / "truth.json").write_text(json.dumps(_truth_document(scene, plan), separators=(",", ":")), "utf-8")
        if out.exists():
            shutil.rmtree(out)
        draft.rename(out)
    return quality


def _guess_quality(scene: Scene, plan: ClipPlan) -> int:
    """The highest quality at which a few steps, scaled up to all of them, fit the budget."""
    steps = plan.source_steps()
    probed = steps[:: max(1, len(steps) // _PROBED_STEPS)]
    pictures = [_picture(scene, camera_id, step) for step in probed for camera_id in scene.camera_ids]
    low, high = MIN_QUALITY - 1, MAX_QUALITY
    while low < high:
        middle = (low + high + 1) // 2
        estimate = sum(len(_encode(picture, middle)) for picture in pictures) * len(steps) / len(probed)
        low, high = (middle, high) if estimate <= plan.budget_bytes else (low, middle - 1)
    if low < MIN_QUALITY:
        raise _too_large(scene, plan)
    return low


def _write_frames(scene: Scene, plan: ClipPlan, out: Path, quality: int) -> int:
    """Write all JPEGs; gives their bytes."""
    total = 0
    for camera_id in scene.camera_ids:
        folder = out / camera_id
        folder.mkdir(parents=True, exist_ok=True)
        for number, step in enumerate(plan.source_steps()):
            data = _encode(_picture(scene, camera_id, step), quality)
            (folder / f"{step_name(number)}.jpg").write_bytes(data)
            total += len(data)
    return total


def _truth_document(scene: Scene, plan: ClipPlan) -> dict[str, object]:
    return {"rate_hz": scene.rate_hz / plan.stride, "steps": list(_boxes(scene, plan.source_steps()))}


def _boxes(scene: Scene, steps: Iterable[int]) -> Iterable[dict[str, object]]:
    for number, step in enumerate(steps):
        document = json.loads((scene.path / "boxes" / f"{step_name(step)}.json").read_text("utf-8"))
        yield document | {"step": number}


def _picture(scene: Scene, camera_id: str, step: int) -> NDArray[np.uint8]:
    picture = cv2.imdecode(np.frombuffer(scene.frame_bytes(camera_id, step), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise InputError(f"the frame of {camera_id} at step {step} is no image.", field=str(scene.path))
    return picture.astype(np.uint8, copy=False)


def _encode(picture: NDArray[np.uint8], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    assert done, "OpenCV encodes any 8-bit picture"
    return data.tobytes()


def _too_large(scene: Scene, plan: ClipPlan) -> InputError:
    return InputError(
        f"even at JPEG quality {MIN_QUALITY} the clip takes more than {plan.budget_bytes} bytes.",
        field=str(scene.path),
        remedy="Take fewer steps or allow more bytes.",
    )


def main(
    scene: Annotated[Path, typer.Argument(help="A rendered scene's folder.")],
    out: Annotated[Path, typer.Argument(help="The clip's folder; replaced when it exists.")],
    start: Annotated[int, typer.Option(min=0, help="First step.")] = ClipPlan.start,
    steps: Annotated[int, typer.Option(min=1, help="Frame sets.")] = ClipPlan.steps,
    stride: Annotated[int, typer.Option(min=1, help="Take every n-th step.")] = ClipPlan.stride,
    megabytes: Annotated[float, typer.Option(min=0.01, help="What all JPEGs may take together.")] = 8.0,
) -> None:
    """Make a clip of a rendered scene."""
    plan = ClipPlan(start, steps, stride, budget_bytes=round(megabytes * 1e6))
    try:
        quality = build_clip(open_scene(scene), out, plan)
    except QuadliftError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from error
    sizes = [path.stat().st_size for path in out.glob("*/*.jpg")]
    typer.echo(
        f"{len(sizes)} JPEGs of quality {quality}, {sum(sizes) / 1e6:.2f} MB, {sum(sizes) / len(sizes) / 1e3:.1f} kB each"
    )


if __name__ == "__main__":
    typer.run(main)
