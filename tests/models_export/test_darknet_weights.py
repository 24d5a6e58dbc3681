"""Darknet's weight files: published sizes, exact round trips, and what is refused."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.darknet_weights import read_backbone, read_weights, write_weights
from models_export.nets.yolov3 import BACKBONE_CONVOLUTIONS, Yolov3, Yolov3Config, tiny_config
from service.errors import InputError

SMALL = replace(tiny_config(("car", "van")), width=0.125)


def some_net(config: Yolov3Config, seed: int = 1) -> Yolov3:
    """A network whose every value differs from what it starts with."""
    torch.manual_seed(seed)
    net = Yolov3(config)
    with torch.no_grad():
        for tensor in [*net.parameters(), *net.buffers()]:
            if tensor.is_floating_point():
                tensor.uniform_(0.1, 1.0)
    return net


def same(ours: Yolov3, theirs: Yolov3, convolutions: int | None = None) -> bool:
    """Whether the first convolutions hold the same values."""
    pairs = zip(ours.convolutions[:convolutions], theirs.convolutions[:convolutions], strict=True)
    return all(
        torch.equal(a, b)
        for x, y in pairs
        for (name, a), b in zip(x.state_dict().items(), y.state_dict().values(), strict=True)
        if "num_batches" not in name
    )


def test_published_file_sizes_and_a_start_from_the_backbone(tmp_path: Path) -> None:
    net = Yolov3(Yolov3Config(classes=tuple(f"class {number}" for number in range(80))))
    whole, part = tmp_path / "yolov3.weights", tmp_path / "darknet53.conv.74"
    write_weights(net, whole)
    write_weights(net, part, convolutions=BACKBONE_CONVOLUTIONS)
    assert whole.stat().st_size == 248_007_048
    assert part.stat().st_size == 162_482_580
    one_class = Yolov3(Yolov3Config())
    assert read_backbone(one_class, part) == 52
    assert same(one_class, net, 52)
    assert not torch.equal(one_class.convolutions[52].conv.weight, net.convolutions[52].conv.weight)


def test_a_round_trip_is_exact(tmp_path: Path) -> None:
    net, other = some_net(SMALL), some_net(SMALL, seed=2)
    write_weights(net, tmp_path / "a", seen=5_000_000_000)
    assert read_weights(other, tmp_path / "a") == 5_000_000_000
    assert same(other, net)
    write_weights(other, tmp_path / "b", seen=5_000_000_000)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_values_lie_in_darknets_order(tmp_path: Path) -> None:
    net = some_net(SMALL)
    write_weights(net, tmp_path / "a", seen=7)
    data = (tmp_path / "a").read_bytes()
    assert struct.unpack_from("<3iq", data) == (0, 2, 0, 7)
    first = net.convolutions[0]
    norm = first.norm
    assert norm is not None
    order = [norm.bias, norm.weight, norm.running_mean, norm.running_var, first.conv.weight]
    expected = np.concatenate([tensor.detach().numpy().ravel() for tensor in order])  # type: ignore[union-attr]
    np.testing.assert_array_equal(np.frombuffer(data, "<f4", len(expected), 20), expected)
    last = net.convolutions[-1].conv
    tail = np.concatenate([last.bias.detach().numpy(), last.weight.detach().numpy().ravel()])  # type: ignore[union-attr]
    np.testing.assert_array_equal(np.frombuffer(data, "<f4", offset=len(data) - tail.nbytes), tail)


def test_the_header_before_version_two_is_shorter(tmp_path: Path) -> None:
    net, other = some_net(SMALL), some_net(SMALL, seed=2)
    write_weights(net, tmp_path / "new")
    (tmp_path / "old").write_bytes(struct.pack("<4i", 0, 1, 0, 9) + (tmp_path / "new").read_bytes()[20:])
    assert read_weights(other, tmp_path / "old") == 9
    assert same(other, net)


def test_a_file_of_another_length_is_refused_with_sizes(tmp_path: Path) -> None:
    net = some_net(SMALL)
    write_weights(net, tmp_path / "whole")
    data = (tmp_path / "whole").read_bytes()
    for name, wrong in (("cut", data[:-400]), ("long", data + bytes(400))):
        (tmp_path / name).write_bytes(wrong)
        with pytest.raises(
            InputError, match=rf"{len(wrong) - 20:,} bytes after the header, the network has {len(data) - 20:,}\."
        ):
            read_weights(net, tmp_path / name)
        with pytest.raises(InputError, match=r"of them after convolution 1[23] of 13"):
            read_backbone(net, tmp_path / name)


def test_another_number_of_classes_is_named(tmp_path: Path) -> None:
    write_weights(some_net(SMALL), tmp_path / "two")
    with pytest.raises(InputError, match="the file is for 2 classes, not 1"):
        read_weights(Yolov3(replace(SMALL, classes=("car",))), tmp_path / "two")


@pytest.mark.parametrize("data", [b"", bytes(19), bytes(22), b"\xff\xd8\xff\xe0" * 10])
def test_what_is_no_weight_file_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(InputError):
        read_weights(Yolov3(SMALL), tmp_path / "a")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_backbone(Yolov3(SMALL), tmp_path / "none.weights")
