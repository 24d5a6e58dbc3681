"""What a figure was measured on."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from pathlib import Path

from service.nets.quiet_onnxruntime import ort
from service.settings import usable_cores


def describe_machine() -> dict[str, str | int]:
    """Processor, usable cores, versions, date: what has to stand beside every figure."""
    return {
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "onnxruntime": ort.__version__,
        "date": datetime.now(UTC).date().isoformat(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
