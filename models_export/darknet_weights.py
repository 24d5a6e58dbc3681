"""Darknet's ``.weights`` files: read whole or in part, and written.

A file is three int32 (major, minor, revision), the number of images seen (int64 from version 0.2 on, int32 before), then the
convolutions in the order of the network's layers: bias, for a batch-normalised one scale, mean and variance, then weights
output by input by height by width; all little-endian float32. Nothing in a file names its network, so sizes alone tell.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models_export.nets.yolov3 import ConvBlock, Predict, Yolov3
from service.errors import InputError

_VERSION = (0, 2, 0)
_VALUE_BYTES = 4


def read_weights(net: Yolov3, path: Path) -> int:
    """Fill all of a network from a file; returns how many images the weights have seen.

    Raises InputError naming sizes when the file is cut, goes on after the last convolution, or is for other classes.
    """
    seen, values = _read(path)
    expected = sum(_sizes(net))
    if len(values) != expected:
        raise InputError(
            f"{_size(values)} after the header, the network has {expected * _VALUE_BYTES:,}{_other_classes(net, values)}.",
            field=str(path),
            remedy="Give the network's own weight file, whole, and the classes that it was trained on.",
        )
    _fill(net.convolutions, values)
    return seen


def read_backbone(net: Yolov3, path: Path) -> int:
    """Fill the first convolutions of a network from a partial file such as ``darknet53.conv.74``; returns how many.

    Raises InputError when the file ends within a convolution, or goes on after the last one.
    """
    _, values = _read(path)
    ends = np.cumsum(_sizes(net))
    count = int(np.searchsorted(ends, len(values), side="right"))
    reached = int(ends[count - 1]) if count else 0
    if reached != len(values) or not count:
        where = f"{(len(values) - reached) * _VALUE_BYTES:,} of them after convolution {count} of {len(ends)}"
        raise InputError(
            f"{_size(values)} after the header, {where}, which are not a whole convolution.",
            field=str(path),
            remedy="Give a file that was cut after a layer, from the same architecture.",
        )
    _fill(net.convolutions[:count], values)
    return count


def write_weights(net: Yolov3, path: Path, *, convolutions: int | None = None, seen: int = 0) -> None:
    """Write a network, or its first ``convolutions``, as Darknet would."""
    with path.open("wb") as stream:
        stream.write(struct.pack("<3iq", *_VERSION, seen))
        for block in net.convolutions[:convolutions]:
            for tensor in _tensors(block):
                stream.write(tensor.detach().cpu().numpy().astype("<f4").tobytes())


def _read(path: Path) -> tuple[int, NDArray[np.float32]]:
    """Images seen, and all values after the header."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error}.", field=str(path), remedy="Give a Darknet .weights file.") from error
    version = struct.unpack_from("<2i", data) if len(data) >= 8 else (0, 0)
    header = struct.Struct("<3iq" if version[0] * 10 + version[1] >= 2 else "<3ii")
    if len(data) < header.size or (len(data) - header.size) % _VALUE_BYTES or not 0 <= version[0] < 1000:
        raise InputError(
            f"{len(data):,} bytes that are no header of {header.size} and 32-bit numbers.",
            field=str(path),
            remedy="Give a Darknet .weights file; this one is truncated, or something else.",
        )
    return int(header.unpack_from(data)[3]), np.frombuffer(data, "<f4", offset=header.size)


def _fill(blocks: list[ConvBlock], values: NDArray[np.float32]) -> None:
    start = 0
    with torch.no_grad():
        for block in blocks:
            for tensor in _tensors(block):
                part = values[start : start + tensor.numel()]
                tensor.copy_(torch.from_numpy(part.copy()).reshape(tensor.shape))
                start += tensor.numel()


def _tensors(block: ConvBlock) -> list[Tensor]:
    """A convolution's values in the file's order."""
    norm = block.norm
    if norm is None:
        assert block.conv.bias is not None, "a convolution without batch norm has a bias"
        return [block.conv.bias, block.conv.weight]
    assert norm.running_mean is not None, "statistics are kept"
    assert norm.running_var is not None, "statistics are kept"
    return [norm.bias, norm.weight, norm.running_mean, norm.running_var, block.conv.weight]


def _sizes(net: Yolov3) -> list[int]:
    """How many values each convolution has."""
    return [sum(tensor.numel() for tensor in _tensors(block)) for block in net.convolutions]


def _other_classes(net: Yolov3, values: NDArray[np.float32]) -> str:
    """That the file is this network for another number of classes, if it is."""
    heads = [b for b, layer in zip(net.steps, net.config.layers, strict=True) if isinstance(layer, Predict)]
    anchors = len(net.config.anchors_px[0])
    a_class = sum(anchors * (block.conv.in_channels + 1) for block in heads)  # type: ignore[union-attr]
    more, rest = divmod(len(values) - sum(_sizes(net)), a_class)
    classes = len(net.config.classes) + more
    return f": the file is for {classes} classes, not {len(net.config.classes)}" if not rest and classes > 0 else ""


def _size(values: NDArray[np.float32]) -> str:
    return f"{values.nbytes:,} bytes"
