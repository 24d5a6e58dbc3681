"""DPT-hybrid: its published size, that our forward pass is the published one, what it learns, and its export."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.data.samples import Sample
from models_export.export import to_onnx, with_metadata
from models_export.nets.blocks import parameter_count
from models_export.nets.dpt import DptConfig, DptHybrid
from models_export.train.depth import DepthTask
from models_export.verify import require_parity
from service.errors import InputError
from service.nets.depth import DepthNet
from service.nets.pack import open_network

SMALL = DptConfig(
    image_px=64, stem=16, stages=(32, 64, 96), depths=(1, 1, 1), groups=8, width=32, blocks=2, heads=2, mlp=64, taps=(0, 1),
    fusion=32,
)  # fmt: skip


def randomised(config: DptConfig) -> DptHybrid:
    """A net whose position embeddings and normalisations are not at their start values either."""
    torch.manual_seed(0)
    net = DptHybrid(config).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net


def images(rows: int, columns: int, batch: int = 2) -> torch.Tensor:
    return torch.randint(0, 255, (batch, rows, columns, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(rows))


def bottleneck(cin: int, cout: int, *, first: bool) -> int:
    """Three convolutions without bias, each with the two vectors of its group norm, and the shortcut of a first block."""
    middle = cout // 4
    body = cin * middle + 9 * middle**2 + middle * cout + 2 * (2 * middle + cout)
    return body + (cin * cout + 2 * cout if first else 0)


def test_the_published_size_by_arithmetic() -> None:
    """Counts from the description: ResNetV2-50 of (3, 4, 9) blocks, ViT-B/16 of 12, a decoder of 256 channels (DPT, section 3).

    The paper's table says 123 M. That is this sum, 122,377,985, and the 1000-class head that ViT-B keeps in the published
    code and file though nothing reads it: 768 x 1000 + 1000 = 769,000, together 123,146,985.
    """
    resnet = 7 * 7 * 3 * 64 + 2 * 64
    for cin, cout, depth in ((64, 256, 3), (256, 512, 4), (512, 1024, 9)):
        resnet += bottleneck(cin, cout, first=True) + (depth - 1) * bottleneck(cout, cout, first=False)
    w = 768
    block = 4 * (w * w + w) + (w * 4 * w + 4 * w) + (4 * w * w + w) + 4 * w
    vit = (1024 * w + w) + w + (24 * 24 + 1) * w + 12 * block + 2 * w
    reassemble = 2 * (2 * w * w + w) + 2 * (w * w + w) + (9 * w * w + w) + 9 * 256 * (256 + 512 + w + w)
    fusion = 4 * ((256 * 256 + 256) + 4 * (9 * 256 * 256 + 256))
    head = (9 * 256 * 128 + 128) + (9 * 128 * 32 + 32) + (32 + 1)
    total = resnet + vit + reassemble + fusion + head
    assert total == 122_377_985
    assert total + 769_000 == 123_146_985
    with torch.device("meta"):
        net = DptHybrid(DptConfig())
    assert parameter_count(net) == total
    assert net(torch.zeros(1, 192, 672, 3, dtype=torch.uint8, device="meta")).shape == (1, 24, 84)


def test_the_map_is_an_eighth_of_any_canvas() -> None:
    net = randomised(SMALL)
    with torch.inference_mode():
        assert net(images(96, 160)).shape == (2, 12, 20)
        assert net(images(64, 32, 1)).shape == (1, 8, 4)


def test_the_forward_pass_is_the_published_one() -> None:
    net = randomised(replace(SMALL, stride=1))
    square = images(64, 64)
    with torch.inference_mode():
        published = net.model(2 * square.permute(0, 3, 1, 2).float() / 255 - 1).predicted_depth
        ours = net(square)
    assert published.std() > 0
    assert torch.allclose(ours.relu(), published, atol=1e-5 * published.max().item())


def test_cells_are_means_of_their_pixels() -> None:
    fine = randomised(replace(SMALL, stride=1))
    coarse = DptHybrid(SMALL).eval()
    coarse.load_state_dict(fine.state_dict())
    with torch.inference_mode():
        pixels, cells = fine(images(64, 96)), coarse(images(64, 96))
    assert torch.allclose(cells[:, 2, 5], pixels[:, 16:24, 40:48].mean((1, 2)), rtol=1e-4, atol=1e-6)


def test_folding_the_weights_changes_no_output() -> None:
    net = randomised(SMALL)
    with torch.inference_mode():
        expected, folded = net(images(96, 160)), net.with_folded_weights()(images(96, 160))
    assert torch.allclose(folded, expected, atol=1e-4 * expected.std().item())


def test_the_encoder_learns_at_a_tenth(toy_samples: list[Sample]) -> None:
    task = DepthTask(toy_samples, SMALL, build=DptHybrid)
    groups = task.parameter_groups(task.net)
    assert [group.rate for group in groups] == [0.1, 0.1, 1.0, 1.0]
    slow = {id(p) for group in groups if group.rate < 1.0 for p in group.parameters}
    assert slow == {id(p) for p in task.net.model.dpt.parameters()}
    ids = [id(p) for group in groups for p in group.parameters]
    assert sorted(ids) == sorted(id(p) for p in task.net.parameters())


def test_weights_of_a_folder_are_taken_whole(tmp_path: Path) -> None:
    trained = randomised(SMALL)
    trained.model.save_pretrained(tmp_path)
    net = DptHybrid(SMALL)
    net.load_pretrained(tmp_path)
    for ours, theirs in zip(net.state_dict().values(), trained.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_folders_without_this_architecture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        DptHybrid(SMALL).load_pretrained(tmp_path / "none")
    with pytest.raises(InputError, match="cannot be loaded"):
        DptHybrid(SMALL).load_pretrained(tmp_path)
    randomised(SMALL).model.save_pretrained(tmp_path)
    with pytest.raises(InputError, match="cannot be loaded"):
        DptHybrid(replace(SMALL, fusion=24)).load_pretrained(tmp_path)
    with pytest.raises(InputError, match="are missing"):
        DptHybrid(replace(SMALL, blocks=3)).load_pretrained(tmp_path)


def test_eight_frames_are_learned_by_heart_and_served(toy_samples: list[Sample]) -> None:
    samples = [left_part(sample) for sample in toy_samples]
    torch.manual_seed(0)
    task = DepthTask(samples, SMALL, build=DptHybrid)
    net = task.net
    targets = np.stack([sample.inverse_depth for sample in samples])
    canvases = np.stack([sample.canvas for sample in samples])
    batch = {"images": torch.from_numpy(canvases), "targets": torch.from_numpy(targets)}
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 200)
    history = []
    for _ in range(200):
        optimizer.zero_grad()
        losses = task.loss(net, batch)
        losses["total"].backward()
        optimizer.step()
        schedule.step()
        history.append({key: value.item() for key, value in losses.items()})
    assert history[-1]["ssi"] < 0.01
    assert history[-1]["total"] < 0.05 * history[0]["total"]
    model = to_onnx(net.eval().with_folded_weights(), "depth", canvases.shape[1:3], ("inverse_depth",), dynamic_hw=False)
    metadata = {"stride": SMALL.stride, "bias_relative": 0.0, "sigma_relative": 0.1}
    network = open_network("depth", with_metadata(model, metadata))
    assert require_parity(net, network, [canvases, canvases[:1], canvases[:3]]) < 1e-4
    (served,) = DepthNet(network).infer([samples[0].canvas])
    known = targets[0] > 0
    assert np.corrcoef(served.values[known], targets[0][known])[0, 1] > 0.98


def left_part(sample: Sample) -> Sample:
    """The frame about its left vehicle, 64x96 px: the plane of the fixture, the vehicle before it, the top row unknown."""
    inverse_depth = sample.inverse_depth[2:10, :12].copy()
    x0, y0, x1, y1 = ((sample.xyxy_px[0] - (0, 16, 0, 16)) / 8).astype(int)
    inverse_depth[y0 : y1 + 1, x0 : x1 + 1] = 0.15
    inverse_depth[0] = 0.0
    return replace(sample, canvas=sample.canvas[16:80, :96].copy(), image_size=(96, 64), inverse_depth=inverse_depth)


def test_other_networks_do_not_pay_for_transformers() -> None:
    code = "import sys, models_export.train.depth; sys.exit('transformers' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
