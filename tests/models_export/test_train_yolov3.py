"""YOLOv3 learns eight simulated frames by heart, and starts from a Darknet backbone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.clip_sets import clip_truth
from clients.clip import SHIPPED, open_clip
from models_export.darknet_weights import write_weights
from models_export.data.augment import NO_AUGMENT
from models_export.data.samples import Sample
from models_export.nets.yolov3 import Yolov3, Yolov3Config
from models_export.paper import paper_recipe
from models_export.recipe import resolved_config
from models_export.train.checkpoint import load_averaged
from models_export.train.config import TrainConfig
from models_export.train.loop import fit
from models_export.train.yolov3 import Yolov3Task
from service.frames import decode
from service.geometry.boxes import clip_extents, project_extents
from service.geometry.iou import iou_2d
from service.nets.canvas import to_canvas
from service.nets.decoding import decode_heads
from service.nets.detector_spec import DetectorSpec
from service.nets.error_model import ErrorModel
from service.site import parse_site

SMALL = Yolov3Config(width=0.125, residuals=(1, 1, 1, 1, 1), max_width=320)
STEPS, RATE = 100, 1e-2


@pytest.fixture(scope="module")
def frames() -> list[Sample]:
    """The four cameras' simulated frames of two steps, with the vehicles that nothing hides.

    Of two vehicles with one cell and one anchor YOLOv3 can only learn one; such pairs hide each other.
    """
    clip = open_clip(SHIPPED)
    site, truth = parse_site(clip.site), clip_truth(clip)
    samples = []
    for step in (20, 60):
        for index, camera in enumerate(site.cameras):
            image = decode(clip.frame(camera.id, step), camera, SMALL.max_width)
            scaled = camera.scaled(image.shape[1], image.shape[0])
            extents, in_front = project_extents(scaled, truth[step].center, truth[step].dims_lwh, truth[step].yaw)
            visible = truth[step].visible[:, index]
            seen = in_front & (visible > 0)
            xyxy = clip_extents(scaled, extents[seen])
            count = len(xyxy)
            samples.append(
                Sample(
                    canvas=to_canvas(image),
                    image_size=(image.shape[1], image.shape[0]),
                    camera=scaled,
                    xyxy_px=xyxy,
                    ignore=(visible[seen] < 0.9) | ((xyxy[:, 2:] - xyxy[:, :2]).min(1, initial=np.inf) < 6),
                    cls=np.zeros(count, np.int64),
                    class_known=np.ones(count, dtype=bool),
                    source="simulated",
                    dims_lwh=truth[step].dims_lwh[seen],
                    alpha=np.zeros(count),
                    corners_px=np.zeros((count, 8, 2)),
                    visible=visible[seen],
                    truncated=np.zeros(count),
                    center=truth[step].center[seen],
                    ground=site.ground,
                    inverse_depth=np.zeros((1, 1), np.float32),
                )
            )
    assert sum(int((~s.ignore).sum()) for s in samples) > 20
    return samples


def test_eight_simulated_frames_are_learned_by_heart(frames: list[Sample]) -> None:
    torch.manual_seed(1)
    torch.set_num_threads(1)
    task = Yolov3Task(frames, SMALL, NO_AUGMENT)
    batch = task.batch(np.arange(len(frames)), np.random.default_rng(0))
    optimizer = torch.optim.Adam(task.net.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS)
    history = []
    for _ in range(STEPS):
        losses = task.loss(task.net, batch)
        optimizer.zero_grad()
        losses["total"].backward()
        torch.nn.utils.clip_grad_norm_(task.net.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        history.append(losses["total"].item())
    assert history[-1] < 0.005 * history[0]
    with torch.no_grad():
        heads = task.net(batch["images"])
    wanted = batch["targets"][batch["targets"][:, 6] == 0]
    for row in range(len(frames)):
        found = decode_heads([head[row].numpy() for head in heads], spec_of(task.config), 0.5)
        overlap = iou_2d(found.xyxy_px, wanted[wanted[:, 0] == row, 2:6].numpy())
        assert np.all(overlap.max(0) > 0.9)


def test_a_run_is_described_and_saved(toy_samples: list[Sample], tmp_path: Path) -> None:
    task = Yolov3Task(toy_samples, SMALL)
    config = TrainConfig(steps=2, batch_size=2, warmup_steps=1, amp=False)
    trained = fit(task, config, tmp_path, task.held_out(toy_samples[:2]))
    loaded, state = load_averaged(tmp_path / "detector.pt", Yolov3(task.config))
    assert state["task"]["net"]["anchors_px"] == task.config.anchors_px
    assert task.config.anchors_px != SMALL.anchors_px
    assert resolved_config(paper_recipe(SMALL).network("detector"), state["task"]["net"]) == task.config
    for ours, theirs in zip(loaded.state_dict().values(), trained.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_training_starts_from_a_backbone(toy_samples: list[Sample], tmp_path: Path) -> None:
    torch.manual_seed(5)
    taught = Yolov3(replace(SMALL, classes=("a", "b")))
    backbone = 1 + sum(1 + 2 * blocks for blocks in SMALL.residuals)
    write_weights(taught, tmp_path / "backbone.weights", convolutions=backbone)
    recipe = paper_recipe(SMALL).network("detector")
    net = recipe.task(toy_samples, recipe.config).net
    assert isinstance(net, Yolov3)
    recipe.load_pretrained(net, tmp_path / "backbone.weights")
    pairs = list(zip(net.convolutions, taught.convolutions, strict=True))
    assert all(torch.equal(ours.conv.weight, theirs.conv.weight) for ours, theirs in pairs[:backbone])
    assert not torch.equal(pairs[backbone][0].conv.weight, pairs[backbone][1].conv.weight)


def spec_of(config: Yolov3Config) -> DetectorSpec:
    sigma = ErrorModel(1.0, 0.0, 0.0, 1.0)
    return DetectorSpec(config.classes, config.strides, config.anchors_px, config.max_width, sigma, format="yolov3")
