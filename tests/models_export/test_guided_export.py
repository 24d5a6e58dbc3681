"""The exported depth-guided detector computes what was trained, and runs in the pipeline as part of a pack."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.data.guided_frames import guided_frames
from models_export.data.samples import Sample
from models_export.edge import edge_recipe
from models_export.export import Exported, with_metadata
from models_export.guided import add_to_pack, fit_of, guided_onnx, real_inputs
from models_export.guided_scores import measure
from models_export.nets.guided import PAPER, EdgeGuided, GuidedConfig, ResNetGuided
from models_export.paper import paper_recipe
from models_export.train.guided_targets import AssignConfig, fit_spec
from models_export.verify import require_parity
from service.errors import PackError
from service.frames import EncodedFrame, FrameSet
from service.nets.canvas import PADDED, InputFit
from service.nets.depth import DepthNet
from service.nets.guided import GuidedDetector
from service.nets.pack import load_pack, open_network
from service.pipeline import Pipeline, PipelineSettings
from service.site import AccuracyModel, parse_site

CLIP = Path(__file__).resolve().parents[2] / "clients" / "clip"
SMALL = GuidedConfig(channels=(8, 8, 16, 16, 16), neck=16)
ASSIGN = AssignConfig(best_iou=0.2)


@pytest.fixture(scope="module")
def model(toy_samples: list[Sample]) -> bytes:
    """An untrained detector that finds vehicles everywhere: its background logit is low."""
    torch.manual_seed(0)
    net = EdgeGuided(SMALL).eval()
    with torch.no_grad():
        net.heads.heads[0].bias.view(-1, 2)[:, 0] = 0.1
    frames = guided_frames(toy_samples, DepthNet(load_pack("edge").networks["depth"]))
    spec = fit_spec(frames, SMALL, ASSIGN)
    model = with_metadata(guided_onnx(net, SMALL, (96, 160)), spec.to_metadata())
    inputs = [real_inputs(spec, frames[:3]), real_inputs(spec, frames[:1], cut=True)]
    assert require_parity(net, open_network("guided", model), inputs) < 1e-3
    return model


@pytest.fixture(scope="module")
def pack_folder(model: bytes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    add_to_pack(load_pack("edge"), folder, Exported("guided", model, "fp32", 1), {"steps": 0}, {"note": 0})
    return folder


def frame_set() -> FrameSet:
    site = parse_site(json.loads((CLIP / "site.json").read_text()))
    frames = tuple(EncodedFrame(c.id, (CLIP / c.id / "000040.jpg").read_bytes(), None) for c in site.cameras)
    return FrameSet(site, frames, 10**18, 1)


def test_another_network_does_not_pass_the_gate(model: bytes, toy_samples: list[Sample]) -> None:
    frames = guided_frames(toy_samples[:2], DepthNet(load_pack("edge").networks["depth"]))
    spec = fit_spec(frames, SMALL, ASSIGN)
    with pytest.raises(PackError, match="differ by"):
        require_parity(EdgeGuided(SMALL).eval(), open_network("guided", model), [real_inputs(spec, frames)])


def test_the_pack_keeps_its_other_networks(pack_folder: Path) -> None:
    pack = load_pack(str(pack_folder))
    assert set(pack.networks) == {"detector", "multibin", "depth", "guided"}
    assert pack.manifest.training["networks"]["guided"] == {"steps": 0}


@pytest.mark.parametrize("method", ["map", "paper"])
def test_always_adds_boxes_and_never_changes_none(pack_folder: Path, method: str) -> None:
    pack = load_pack(str(pack_folder))
    settings = PipelineSettings(method=method, hard_mode="always")  # type: ignore[arg-type]
    guided, plain = (
        Pipeline(pack, settings).run(frame_set()),
        Pipeline(pack, replace(settings, hard_mode="never")).run(frame_set()),
    )
    without = Pipeline(load_pack("edge"), replace(settings, hard_mode="auto")).run(frame_set())
    assert guided.hard == frozenset(guided.camera_ids)
    assert plain.hard == without.hard == frozenset()
    assert guided.timing_ms["guided"] > 0
    assert "guided" not in plain.timing_ms
    np.testing.assert_array_equal(plain.boxes.center, without.boxes.center)
    for own, before in zip(guided.per_camera, plain.per_camera, strict=True):
        assert np.isfinite(own.center).all()
        assert (np.linalg.eigvalsh(own.covariance) > 0).all()
        assert len(own) > 0
        if method == "map":
            assert len(own) >= len(before)
    assert sum(guided.detections.values()) == sum(len(own) for own in guided.per_camera)


def test_guided_boxes_stand_as_exactly_on_the_road_as_the_site_says(pack_folder: Path) -> None:
    pipeline = Pipeline(load_pack(str(pack_folder)), PipelineSettings(hard_mode="always"))
    exact, vague = frame_set(), frame_set()
    vague = replace(vague, site=replace(vague.site, accuracy=AccuracyModel(ground_m=2.0)))
    exact = replace(exact, site=replace(exact.site, accuracy=AccuracyModel(ground_m=0.01, ground_per_m=0.0)))
    heights = [
        np.median(np.concatenate([np.sqrt(own.covariance[:, 2, 2]) for own in pipeline.run(frames).per_camera]))
        for frames in (exact, vague)
    ]
    assert heights[0] < 0.5 * heights[1]


def test_always_without_the_network_is_refused() -> None:
    with pytest.raises(PackError, match=r"no network 'guided'.*hard_mode auto or never"):
        Pipeline(load_pack("edge"), PipelineSettings(hard_mode="always"))


def test_scores_are_measured_by_the_services_code(model: bytes, toy_samples: list[Sample]) -> None:
    detector = GuidedDetector(open_network("guided", model))
    frames = guided_frames(toy_samples, DepthNet(load_pack("edge").networks["depth"]))
    errors = measure(detector, toy_samples, frames)
    assert errors.sigma_scale.shape == (7,)
    assert np.isfinite(errors.sigma_scale).all()
    assert errors.scores["vehicles"] == 16


def test_the_papers_recipe_is_as_published() -> None:
    paper = paper_recipe().guided
    assert (paper.training.optimizer, paper.training.learning_rate, paper.training.weight_decay) == ("sgd", 0.01, 5e-4)
    assert (paper.loss.gamma, paper.loss.focal_on, paper.loss.corner) == (1.0, "class", 0.0)
    assert (paper.assign.foreground_iou, paper.assign.best_iou) == (0.5, 0.35)
    assert not paper.net.learned_sigma
    assert edge_recipe().guided.net.learned_sigma


def test_the_published_size_says_which_canvas_it_takes(toy_samples: list[Sample]) -> None:
    frames = guided_frames(toy_samples[:1], DepthNet(load_pack("edge").networks["depth"]))
    assert fit_of(EdgeGuided(SMALL), frames) == PADDED
    with torch.device("meta"):
        assert fit_of(ResNetGuided(PAPER), frames) == InputFit((160, 96))


def test_maps_follow_the_guides_cells_not_the_depth_nets(toy_samples: list[Sample]) -> None:
    sample = toy_samples[0]
    coarse = replace(sample, inverse_depth=sample.inverse_depth[::2, ::2])
    depth = DepthNet(load_pack("edge").networks["depth"])
    fine, half = guided_frames([sample, coarse], depth)
    assert half.metric.shape == half.ground.shape == (6, 10)
    np.testing.assert_allclose(half.metric, fine.metric.reshape(6, 2, 10, 2).mean((1, 3)), atol=0.02)
