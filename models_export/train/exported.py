"""Start from an exported network: the weights of an ONNX file of ours, int8 or float, put back into torch.

An exported convolution has its batch norm folded into it. Training needs the norm back, and a norm's statistics are those of
data: it gets them from one batch, and the scale and shift under which it gives what the folded convolution gave.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from torch import Tensor, nn

from models_export.graphs import constants
from models_export.train.config import take_priors
from models_export.train.task import Batch, Task
from service.errors import InputError
from service.geometry.transforms import Array
from service.nets.pack import METADATA_KEY, Manifest, read_manifest

SUFFIX = ".onnx"
_CALIBRATION_ITEMS = 64
_FRESH_GAIN = 0.2
"""Of the norm behind a convolution that starts anew: its block is felt, and what follows still understands its input."""


def load_exported(task: Task, path: Path) -> None:
    """Put the weights of an exported network into ``task.net``, and its priors (anchors, mean sizes) into the configuration.

    In eval mode the network then gives what the file gives, up to the file's own rounding of activations. A convolution of
    which nothing but zeros is left never learned and would never learn; it keeps its new random weights. Raises InputError when
    the file is no ONNX network or not one of this kind.
    """
    model = read_model(path)
    try:
        start_from(task, _values(model.graph))
    except (KeyError, ValueError) as error:
        raise InputError(
            f"holds no weights of this network: {error}", field=str(path), remedy="Give the file of its role in a pack."
        ) from error
    take_priors(task, _metadata(model))


def start_from(task: Task, values: Mapping[str, Array], new: Container[str] = ()) -> None:
    """Put weights, and the biases that are their norms' folded shifts, into ``task.net``, whose norms get their statistics from
    a batch of the task.

    values: by parameter; the shift of a convolution with a norm under ``<weight>_bias``. new: layers that keep their new
    weights. Raises KeyError for a parameter that is not there, ValueError for one of another shape.
    """
    folded = _fill(task.net, values, new)
    indices = np.linspace(0, len(task) - 1, min(len(task), _CALIBRATION_ITEMS)).astype(np.int64)
    _unfold(task, folded, task.batch(indices, np.random.default_rng(0)))


def is_ours(path: Path) -> bool:
    """Whether an ONNX file is a network of a pack. Raises InputError when it cannot be read."""
    return bool(_metadata(read_model(path)))


def provenance(path: Path) -> dict[str, Any] | None:
    """What the manifest beside a pack's network says of its training; None without one. Raises PackError for a bad one."""
    file = path.parent / "manifest.json"
    if not file.is_file():
        return None
    manifest = read_manifest(file)
    names = [name for name, entry in manifest.networks.items() if entry.file == path.name]
    return training_of(manifest, names[0]) if names else None


def training_of(manifest: Manifest, name: str) -> dict[str, Any]:
    """How a pack's network came about, for the manifest of another pack that goes on from it or takes it over."""
    return {
        "taken_from": f"{manifest.name} {manifest.version}",
        "data": manifest.training.get("data"),
        **manifest.training.get("networks", {}).get(name, {}),
    }


def read_model(path: Path) -> onnx.ModelProto:
    """An ONNX file. Raises InputError when there is none."""
    try:
        return onnx.load(path)
    except OSError as error:
        raise InputError(f"cannot be read: {error}", field=str(path), remedy="Give a network of a pack.") from error
    except DecodeError as error:
        raise InputError(f"is not ONNX: {error}", field=str(path), remedy="Give a network of a pack.") from error


def _metadata(model: onnx.ModelProto) -> dict[str, Any]:
    """What an exported file says of itself; nothing where it is not ours."""
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            metadata: dict[str, Any] = json.loads(entry.value)
            return metadata
    return {}


def _values(graph: onnx.GraphProto) -> dict[str, Array]:
    """Constants by the torch parameter they came from; quantized ones are back in their units."""
    stored = constants(graph)
    values: dict[str, Array] = {}
    for name, array in stored.items():
        if not name.endswith("_quantized"):
            values[name] = array.astype(np.float64)
            continue
        parameter = name.removesuffix("_quantized")
        # Biases keep their scale under their own quantized name.
        scale = stored.get(f"{parameter}_scale", stored.get(f"{name}_scale"))
        if scale is not None:
            values[parameter] = array.astype(np.float64) * scale.reshape(-1, *(1,) * (array.ndim - 1))
    return values


@torch.no_grad()
def _fill(net: nn.Module, values: Mapping[str, Array], new: Container[str]) -> dict[nn.BatchNorm2d, Tensor | None]:
    """Weights of convolutions and linear layers; returns each norm's folded shift, None behind one that starts anew."""
    norms = _norms(net)
    folded: dict[nn.BatchNorm2d, Tensor | None] = {}
    for name, module in net.named_modules():
        if name in new or not isinstance(module, nn.Conv2d | nn.Linear):
            continue
        weight = _tensor(values, f"{name}.weight", module.weight)
        norm = norms.get(name)
        if norm is None:
            module.weight.copy_(weight)
            if module.bias is not None:
                module.bias.copy_(_tensor(values, f"{name}.bias", module.bias))
        elif not weight.any():
            folded[norm] = None
        else:
            module.weight.copy_(weight)
            folded[norm] = _tensor(values, f"{name}.weight_bias", norm.bias)
    return folded


def _norms(net: nn.Module) -> dict[str, nn.BatchNorm2d]:
    """The norm right behind each convolution that has one, by the convolution's name."""
    found = {}
    for name, module in net.named_modules():
        if isinstance(module, nn.Sequential):
            for (child, first), second in zip(module.named_children(), list(module)[1:], strict=False):
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    found[f"{name}.{child}" if name else child] = second
    return found


def _tensor(values: Mapping[str, Array], name: str, like: Tensor) -> Tensor:
    value = torch.tensor(values[name], dtype=like.dtype)
    if value.shape != like.shape:
        raise ValueError(f"{name} is {tuple(value.shape)}, not {tuple(like.shape)}")
    return value


@torch.no_grad()
def _unfold(task: Task, folded: dict[nn.BatchNorm2d, Tensor | None], batch: Batch) -> None:
    """Give norms the statistics of a batch, and the scale and shift that leave the network what it was."""

    def settle(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        assert isinstance(norm, nn.BatchNorm2d)
        variance, mean = torch.var_mean(inputs[0].float(), dim=(0, 2, 3), correction=0)
        norm.running_mean, norm.running_var = mean, variance
        shift = folded[norm]
        gain = (variance + norm.eps).sqrt() if shift is not None else torch.full_like(mean, _FRESH_GAIN)
        norm.weight.copy_(gain)
        norm.bias.copy_(shift + mean if shift is not None else torch.zeros_like(mean))

    hooks = [norm.register_forward_pre_hook(settle) for norm in folded]
    task.net.eval()
    task.loss(task.net, batch)
    task.net.train()
    for hook in hooks:
        hook.remove()
