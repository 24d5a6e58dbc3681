"""Providers: what computes the networks, chosen by a setting and checked after the fact.

All are ONNX Runtime's execution providers but OpenVINO, which is a runtime of its own. ONNX Runtime lists a provider when it
was built with it, and falls back to the next one without an error when the provider's libraries or its device are missing. So
what a session really got is compared with what was chosen.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, get_args

from service.errors import InputError, PackError

logger = logging.getLogger(__name__)

Provider = Literal["auto", "cpu", "cuda", "tensorrt", "openvino"]
PROVIDERS: tuple[Provider, ...] = get_args(Provider)
_CPU = "CPUExecutionProvider"
_OPENVINO = "openvino"
_RUNTIME_NAMES: dict[Provider, str] = {
    "cpu": _CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": _OPENVINO,
}
_FALLBACKS: dict[Provider, tuple[Provider, ...]] = {"tensorrt": ("cuda", "cpu"), "cuda": ("cpu",)}
"""Who runs what a provider cannot, in this order."""
AUTO_ORDER: tuple[Provider, ...] = ("cuda", "openvino", "cpu")
"""What ``auto`` tries. TensorRT is not among them: it builds its engines for minutes, so it runs only where it is asked for."""


@dataclass(frozen=True)
class Choice:
    """The provider to run on."""

    provider: Provider
    """Never ``auto``."""
    is_required: bool
    """It was asked for by name: another one will not do."""


def offered() -> list[str]:
    """What is installed: the providers that ONNX Runtime was built with, by its names, and OpenVINO."""
    # Imported here: the settings, and with them `--help`, only want the names.
    from service.nets.quiet_onnxruntime import ort

    return [*ort.get_available_providers(), *([_OPENVINO] if find_spec(_OPENVINO) else [])]


def choose(asked: Provider, offered: Sequence[str]) -> Choice:
    """The provider for a setting, among those ``offered``.

    Raises InputError, naming what there is, when one is asked for that is not offered.
    """
    if asked == "auto":
        return Choice(next((name for name in AUTO_ORDER if _RUNTIME_NAMES[name] in offered), "cpu"), False)
    if _RUNTIME_NAMES[asked] not in offered:
        raise InputError(
            f"'{asked}' is not installed; there is {', '.join(_short_names(offered))}.",
            field="provider",
            remedy="Install onnxruntime-gpu in place of onnxruntime, or quadlift[openvino], or set 'auto'.",
        )
    return Choice(asked, True)


def is_gpu(asked: Provider, offered: Sequence[str]) -> bool:
    """Whether the networks would run on CUDA or TensorRT with this setting; takes and raises what :func:`choose` does."""
    return choose(asked, offered).provider in ("cuda", "tensorrt")


def session_providers(choice: Choice, offered: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Providers with options for a session of ONNX Runtime, best first, as it takes them."""
    names = [choice.provider, *_FALLBACKS.get(choice.provider, ())]
    found = [name for name in names if _RUNTIME_NAMES[name] in offered]
    return [(_RUNTIME_NAMES[name], _options(name)) for name in found]


def settled(choice: Choice, running: Sequence[str], network: str) -> Provider:
    """The provider that a session with providers ``running`` (``session.get_providers()``) really computes on.

    Raises PackError when it is not the one that was asked for by name; where ``auto`` chose it, logs a warning.
    """
    if running[0] == _RUNTIME_NAMES[choice.provider]:
        return choice.provider
    names = _short_names(running)
    message = f"ONNX Runtime fell back from {choice.provider} to {', '.join(names)}: its libraries or device are missing."
    if choice.is_required:
        remedy = "Mend the installation (ONNX Runtime's log says what failed), or set 'auto'."
        raise PackError(message, field=network, remedy=remedy)
    logger.warning("network %s: %s", network, message)
    return next(name for name, theirs in _RUNTIME_NAMES.items() if theirs == running[0])


def _options(provider: Provider) -> dict[str, str]:
    if provider == "cuda":
        # The default tries every algorithm anew for each batch size, of which a site with cameras that come and go has many.
        return {"cudnn_conv_algo_search": "HEURISTIC"}
    return {}


def _short_names(runtime_names: Sequence[str]) -> list[str]:
    """Our names where we have one, ONNX Runtime's otherwise."""
    ours = {theirs: name for name, theirs in _RUNTIME_NAMES.items()}
    return [ours.get(name, name) for name in runtime_names]
