"""The runtimes of the networks report nothing to their makers."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

WATCHED = """
import sys, threading
seen = []
def watch(event, arguments):
    if event.startswith("socket.") or event in ("subprocess.Popen", "os.mkdir"):
        seen.append((event, str(arguments)))
    if event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+"):
        seen.append((event, str(arguments)))
sys.addaudithook(watch)
import numpy as np
from service.nets.pack import load_pack
load_pack("edge", provider=sys.argv[1]).networks["detector"].run(np.zeros((1, 64, 96, 3), np.uint8))
print(seen, threading.active_count())
"""
QUIET = ("CI", "TF_BUILD", "GITHUB_ACTIONS", "JENKINS_URL", "ORT_DISABLE_TELEMETRY", "ORT_RUNNING_UNIT_TESTS")
"""With these in the environment they keep quiet by themselves."""


def run_watched(program: str, home: Path, *arguments: str) -> str:
    """What a program says in a process of its own, with a home folder of its own."""
    environment = {name: value for name, value in os.environ.items() if name not in QUIET}
    environment |= {"HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_a_network_leaves_no_trace_and_calls_nobody(provider: str, tmp_path: Path) -> None:
    """Both would leave an identifier of the machine in the home folder before they send anything."""
    if provider == "openvino" and find_spec("openvino") is None:
        pytest.skip("quadlift[openvino] is not installed")
    assert run_watched(WATCHED, tmp_path, provider) == "[] 1\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("module", ["models_export.half", "models_export.int8.quantize", "benchmarks.machine"])
def test_whoever_loads_the_runtime_first_keeps_it_quiet(module: str, tmp_path: Path) -> None:
    assert run_watched(f"import sys, {module}; print('onnxruntime' in sys.modules)", tmp_path) == "True\n"
    assert not (tmp_path / ".cache" / "Microsoft").exists()
