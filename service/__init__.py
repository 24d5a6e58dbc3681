"""The service: frames in, oriented 3D boxes out."""

import os

__version__ = "0.1.0"

# ONNX Runtime from 1.29 on reports its use, and names of models, to its maker as soon as it is imported. Nothing here may send
# what nobody asked for: whoever wants the reports sets this variable to 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
