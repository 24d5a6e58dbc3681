"""The choice of an execution provider, and that a quiet fallback does not stay quiet."""

from __future__ import annotations

import logging
from typing import Any

import onnxruntime as ort
import pytest

from service.errors import InputError, PackError
from service.nets.pack import load_pack
from service.nets.providers import PROVIDERS, Choice, Provider, choose, is_gpu, offered, session_providers, settled

CPU, CUDA, TENSORRT = (f"{name}ExecutionProvider" for name in ("CPU", "CUDA", "Tensorrt"))
OPENVINO = "openvino"
OTHER = "AzureExecutionProvider"


@pytest.mark.parametrize(
    ("offered", "expected"),
    [
        ([CPU], "cpu"),
        ([OTHER, CPU], "cpu"),
        ([OPENVINO, CPU], "openvino"),
        ([TENSORRT, CUDA, CPU], "cuda"),
        ([TENSORRT, CPU], "cpu"),
        ([OPENVINO, CUDA, CPU], "cuda"),
    ],
)
def test_auto_takes_the_best_there_is(offered: list[str], expected: Provider) -> None:
    assert choose("auto", offered) == Choice(expected, False)


@pytest.mark.parametrize("name", [name for name in PROVIDERS if name != "auto"])
def test_one_asked_for_by_name_is_taken_or_refused(name: Provider) -> None:
    everything = [TENSORRT, CUDA, OPENVINO, CPU]
    assert choose(name, everything) == Choice(name, True)
    with pytest.raises(InputError, match=rf"'{name}' is not installed; there is AzureExecutionProvider.*onnxruntime-gpu"):
        choose(name, [OTHER])


def test_fallbacks_are_those_that_are_offered() -> None:
    def names(provider: Provider, offered: list[str]) -> list[str]:
        return [name for name, _ in session_providers(Choice(provider, True), offered)]

    assert names("tensorrt", [TENSORRT, CUDA, CPU]) == [TENSORRT, CUDA, CPU]
    assert names("tensorrt", [TENSORRT, CPU]) == [TENSORRT, CPU]
    assert names("cuda", [TENSORRT, CUDA, CPU]) == [CUDA, CPU]
    assert names("cpu", [OPENVINO, CPU]) == [CPU]


def test_a_fallback_is_an_error_where_one_was_asked_for_and_a_warning_elsewhere(caplog: pytest.LogCaptureFixture) -> None:
    assert settled(Choice("cuda", True), [CUDA, CPU], "depth") == "cuda"
    with pytest.raises(PackError, match=r"depth: ONNX Runtime fell back from tensorrt to cuda, cpu"):
        settled(Choice("tensorrt", True), [CUDA, CPU], "depth")
    with caplog.at_level(logging.WARNING):
        assert settled(Choice("cuda", False), [CPU], "depth") == "cpu"
    assert "network depth: ONNX Runtime fell back from cuda to cpu" in caplog.text


class LameSession:
    """Stands in for ONNX Runtime built with CUDA on a machine without it: it takes the provider and leaves it out."""

    asked: Any = None

    def __init__(self, model: bytes, options: object, providers: list[tuple[str, dict[str, str]]]) -> None:
        type(self).asked = providers
        self._real = _REAL(model, options, providers=[CPU])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


_REAL = ort.InferenceSession


def test_a_pack_on_a_machine_whose_cuda_does_not_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(ort, "InferenceSession", LameSession)
    with caplog.at_level(logging.INFO):
        pack = load_pack("edge")
    assert [name for name, _ in LameSession.asked] == [CUDA, CPU]
    assert pack.provider == "cpu"
    assert "fell back from cuda to cpu" in caplog.text
    assert "pack edge runs on cpu (asked for: auto)" in caplog.text
    with pytest.raises(PackError, match="fell back from cuda"):
        load_pack("edge", provider="cuda")


def test_a_pack_runs_on_the_cpu_that_is_there() -> None:
    assert load_pack("edge", provider="cpu").provider == "cpu"
    missing = next(name for name in ("tensorrt", "openvino", "cuda") if name not in str(offered()).lower())
    with pytest.raises(InputError, match=f"'{missing}' is not installed"):
        load_pack("edge", provider=missing)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("asked", "offered", "expected"),
    [("auto", [CPU], False), ("auto", [CUDA, CPU], True), ("cpu", [CUDA, CPU], False), ("tensorrt", [TENSORRT, CPU], True)],
)
def test_what_a_setting_would_run_on(asked: Provider, offered: list[str], expected: bool) -> None:
    assert is_gpu(asked, offered) is expected
