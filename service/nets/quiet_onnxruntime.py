"""ONNX Runtime, kept from reporting to its maker: nothing else here imports it first.

From 1.29 on it reports its use, and names of models, as soon as it is imported. A service sends nothing that nobody asked it
for: whoever wants the reports sets the variable to 0.
"""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort

__all__ = ["ort"]
