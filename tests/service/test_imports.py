"""The service must start without the training libraries: they are large and not installed in production."""

import json
import pkgutil
import subprocess
import sys

import pytest

import service

FORBIDDEN = ("torch", "onnx", "moderngl", "matplotlib")

IMPORT_AND_LIST = """
import importlib, json, sys
for name in json.loads(sys.argv[1]):
    importlib.import_module(name)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def service_modules():
    return sorted(module.name for module in pkgutil.walk_packages(service.__path__, "service."))


def loaded_after(imports):
    command = [sys.executable, "-c", IMPORT_AND_LIST, json.dumps(imports)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)


def test_importing_every_module_of_the_service_loads_no_training_library():
    modules = service_modules()
    assert {"service.lifting", "service.fusion", "service.tracking", "service.geometry.iou"} <= set(modules)
    loaded = loaded_after(modules)
    assert "service" in loaded
    assert not set(FORBIDDEN) & set(loaded)


def test_the_check_sees_a_library_that_is_loaded():
    pytest.importorskip("onnx")
    assert "onnx" in loaded_after(["onnx"])
