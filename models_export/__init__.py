"""Data, training and export of packs."""

# First of all imports, for it keeps ONNX Runtime from reporting to its maker.
import service as service
