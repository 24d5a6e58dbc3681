"""Half-precision copies of exported networks, for GPUs."""

from __future__ import annotations

import warnings

import onnx

import service.nets.quiet_onnxruntime as _  # noqa: F401

# isort: split
from onnxruntime.transformers.float16 import convert_float_to_float16


def to_half(model: bytes) -> bytes:
    """An fp16 copy of a model: weights and arithmetic in float16, inputs and outputs as they were (uint8, float32)."""
    with warnings.catch_warnings():
        # Numbers next to zero become the smallest that float16 has; the parity gate judges the outcome.
        warnings.filterwarnings("ignore", message="the float32 number")
        half = convert_float_to_float16(onnx.load_from_string(model), keep_io_types=True)
    return bytes(half.SerializeToString())
