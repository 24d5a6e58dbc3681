"""The depth-guided detector learns eight simulated frames by heart, and the service reads what it learned."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.data.augment import NO_AUGMENT
from models_export.data.dataset import parse_truth
from models_export.data.guided_frames import NO_GUIDE_NOISE, GuidedFrame, GuideNoise
from models_export.guided_losses import GuidedLossConfig, corner_loss
from models_export.nets.guided import EdgeGuided, GuidedConfig, ResNetGuided
from models_export.paper import paper_recipe
from models_export.train.guided import GuidedTask, guided_loss
from models_export.train.guided_corners import corners
from models_export.train.guided_targets import AssignConfig
from service.depth_scale import ground_inverse_depth
from service.frames import decode
from service.geometry.boxes import box_corners, clip_extents, project_extents
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.iou import iou_2d
from service.geometry.transforms import wrap_angle
from service.nets.canvas import to_canvas
from service.nets.guided import decode_guided
from service.site import load_site

CLIP = Path(__file__).resolve().parents[2] / "clients" / "clip"
STILL = NO_AUGMENT
SMALL = GuidedConfig(
    channels=(8, 16, 24, 32, 32), neck=32, anchor_heights_px=(8.0, 14.0, 24.0), learned_sigma=False, focal_px=200.0
)


@pytest.fixture(scope="module")
def frames() -> list[GuidedFrame]:
    """Eight frames of the shipped clip at a quarter of its size, with the road as their map."""
    site = load_site(CLIP / "site.json")
    steps = json.loads((CLIP / "truth.json").read_text())["steps"]
    return [_frame(camera, row, site.ground, steps[step]) for step in (0, 60) for row, camera in enumerate(site.cameras)]


def _frame(camera: Camera, row: int, ground: object, document: dict[str, object]) -> GuidedFrame:
    ids = tuple(c.id for c in load_site(CLIP / "site.json").cameras)
    truth = parse_truth(document, ids)
    image = decode((CLIP / camera.id / f"{document['step']:06d}.jpg").read_bytes(), camera, 336)
    scaled = camera.scaled(image.shape[1], image.shape[0])
    seen = truth.visible[:, row] > 0.2
    center, dims, yaw = truth.center[seen], truth.dims_lwh[seen], truth.yaw[seen]
    pixels, depth = scaled.project(center)
    xyxy = clip_extents(scaled, project_extents(scaled, center, dims, yaw)[0])
    canvas = to_canvas(image)
    road = np.zeros((canvas.shape[0] // 8, canvas.shape[1] // 8), np.float32)
    shape = image.shape[0] // 8, image.shape[1] // 8
    road[: shape[0], : shape[1]] = np.nan_to_num(ground_inverse_depth(scaled, ground, shape, 8))  # type: ignore[arg-type]
    small = (xyxy[:, 2:] - xyxy[:, :2]).min(1) < 6
    return GuidedFrame(
        canvas, {"camera": camera.id}, (image.shape[1], image.shape[0]), scaled.K, scaled.R_cam_world, xyxy, small,
        np.zeros(len(xyxy), np.int64), pixels, depth, dims, wrap_angle(yaw - ray_azimuth(scaled, pixels)), road, road, road,
    )  # fmt: skip


def task_of(frames: list[GuidedFrame], config: GuidedConfig = SMALL, loss: GuidedLossConfig | None = None) -> GuidedTask:
    return GuidedTask(
        frames, EdgeGuided(config), assign=AssignConfig(best_iou=0.2, background_iou=0.4),
        loss=loss or GuidedLossConfig(gamma=2.0), augment=STILL, noise=NO_GUIDE_NOISE,
    )  # fmt: skip


def test_eight_simulated_frames_are_learned_by_heart(frames: list[GuidedFrame]) -> None:
    torch.manual_seed(0)
    # As the training loop does: threads of a machine that has other work wait for each other at these sizes.
    torch.set_num_threads(1)
    task = task_of(frames)
    batch = task.batch(np.arange(8), np.random.default_rng(0))
    net = task.net.to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)
    steps = 80
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-2, steps)
    first = None
    for _ in range(steps):
        losses = task.loss(net, batch)
        first = first or losses["total"].item()
        optimizer.zero_grad()
        losses["total"].backward()
        optimizer.step()
        schedule.step()
    assert losses["total"].item() < 0.03 * first
    with torch.no_grad():
        heads = [head.numpy() for head in net(batch["images"], batch["guides"])]
    found, wanted = 0, 0
    for row, frame in enumerate(frames):
        boxes = decode_guided([head[row] for head in heads], task.spec, abs(frame.K[1, 1]), 0.5)
        asked = np.flatnonzero(~frame.ignore)
        best = iou_2d(frame.xyxy_px[asked], boxes.xyxy_px).argmax(1)
        relative = np.abs(boxes.depth_m[best] / frame.depth_m[asked] - 1)
        turn = np.abs(wrap_angle(boxes.alpha[best] - frame.alpha[asked]))
        found += int(((relative < 0.05) & (turn < 0.2)).sum())
        wanted += len(asked)
    assert found >= 0.9 * wanted


def test_what_is_not_blamed_does_not_matter(frames: list[GuidedFrame]) -> None:
    task = task_of(frames[:2])
    batch = task.batch(np.arange(2), np.random.default_rng(0))
    grid = batch["blamed"].shape
    heads = [torch.randn(2, 6 * n, *grid[2:]) for n in (2, 4, 6, 6)]
    asked = batch["blamed"].clone()
    asked[tuple(batch["place"].T)] = True
    changed = [head.clone() for head in heads]
    changed[0].view(2, 6, 2, *grid[2:]).permute(0, 1, 3, 4, 2)[~asked] += 5.0
    for ours, theirs in zip(heads, changed, strict=True):
        assert ours is not theirs
    before = guided_loss(heads, batch, task.spec, task.weights)
    after = guided_loss(changed, batch, task.spec, task.weights)
    assert (changed[0] != heads[0]).any()
    assert before["total"].item() == after["total"].item()


@pytest.mark.parametrize("bins", [(0.0, np.pi), ()])
def test_the_loss_is_least_at_the_truth(frames: list[GuidedFrame], bins: tuple[float, ...]) -> None:
    config = replace(SMALL, bin_centers_rad=bins)
    task = task_of(frames[:2], config, GuidedLossConfig(gamma=2.0, corner=1.0))
    batch = task.batch(np.arange(2), np.random.default_rng(0))
    heads = true_heads(task, batch)
    losses = guided_loss(heads, batch, task.spec, task.weights)
    assert losses["total"].item() == pytest.approx(0.0, abs=2e-3)
    for part in (1, 2):
        worse = [head.clone() for head in heads]
        worse[part] += 0.5
        assert guided_loss(worse, batch, task.spec, task.weights)["total"].item() > 0.1


def true_heads(task: GuidedTask, batch: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    """Heads that say exactly what the batch asks for."""
    images, anchors, rows, columns = batch["blamed"].shape
    place = tuple(batch["place"].T)
    alpha, targets = batch["alpha"], batch["targets"]
    heading = targets[:, 10:]
    if len(task.spec.bin_centers_rad):
        delta = alpha[:, None] - torch.tensor(task.spec.bin_centers_rad, dtype=torch.float32)
        heading = torch.cat([delta.cos(), delta.sin(), 40 * delta.cos()], 1)
    scores = torch.zeros(images, anchors, rows, columns, 2)
    scores[..., 0] = 20.0
    scores[place] = torch.tensor([-20.0, 20.0])
    grids = [scores]
    for values in (targets[:, :4], targets[:, 4:10], heading):
        grid = torch.zeros(images, anchors, rows, columns, values.shape[1])
        grid[place] = values
        grids.append(grid)
    return [grid.permute(0, 1, 4, 2, 3).flatten(1, 2) for grid in grids]


def test_corners_of_encoded_boxes_are_the_true_ones(frames: list[GuidedFrame]) -> None:
    mirror = replace(STILL, flip=1.0)
    for augment in (STILL, mirror):
        task = task_of(frames[:1])
        task.augment = augment
        batch = task.batch(np.array([0]), np.random.default_rng(0))
        ours = corners(task.spec, batch["view"], batch["targets"][:, 4:10], batch["alpha"])
        frame = frames[0]
        rays = np.linalg.solve(frame.K, np.c_[frame.center_px, np.ones(len(frame.alpha))].T).T @ frame.R_cam_world
        yaw = frame.alpha + np.arctan2(rays[:, 1], rays[:, 0])
        truth = torch.from_numpy(box_corners(rays * frame.depth_m[:, None], frame.dims_lwh, yaw)).float()
        distance = torch.stack([corner_loss(ours, t.expand_as(ours)) for t in truth], 1)
        assert distance.min(1).values.max() < 1e-4


def test_a_disturbed_map_is_another_map(frames: list[GuidedFrame]) -> None:
    task = task_of(frames[:1])
    still = task.batch(np.array([0]), np.random.default_rng(0))["guides"]
    task.noise = GuideNoise(truth=1.0)
    moved = task.batch(np.array([0]), np.random.default_rng(0))["guides"]
    assert torch.equal(still[:, 1], moved[:, 1])
    assert not torch.allclose(still[:, 0], moved[:, 0])
    assert moved.min() >= 0


def test_the_published_size_learns_in_both_branches(frames: list[GuidedFrame]) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    recipe = paper_recipe().guided
    assert recipe is not None
    task = GuidedTask(
        frames[:2], ResNetGuided(recipe.net), assign=AssignConfig(best_iou=0.1), loss=recipe.loss, augment=STILL,
        noise=recipe.noise,
    )  # fmt: skip
    losses = task.loss(task.net, task.batch(np.arange(2), np.random.default_rng(0)))
    losses["total"].backward()
    assert torch.isfinite(losses["total"])
    assert losses["box_3d"].item() > 0
    for branch in (task.net.image, task.net.depth):
        assert branch.conv1.weight.grad.abs().max() > 0
