"""``quadlift tune`` as a command: a table, the settings as environment lines, and the file that they go into."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks import tune
from service.settings import usable_cores
from service.tuning import Candidate, Trial, candidates


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune, "candidates", lambda cores: candidates(cores)[:1])


def test_it_measures_and_writes(tmp_path: Path) -> None:
    file = tmp_path / "service.env"
    file.write_text("QUADLIFT_PORT=8001\n")
    file.chmod(0o600)
    arguments = ["--seconds", "0.5", "--cameras", "1", "--latency-ms", "60000", "--json", "--write", str(file)]
    result = CliRunner().invoke(tune.app, arguments)
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    first = candidates(usable_cores())[0]
    assert figures["settings"] == first.settings() == Candidate(1, 1).settings()
    assert figures["trials"][0]["sets"] >= 8
    assert figures["trials"][0]["sets_per_second"] > 0
    assert figures["keeps_latency"]
    assert file.read_text() == "QUADLIFT_PORT=8001\nQUADLIFT_WORKERS=1\nQUADLIFT_INTRA_OP_THREADS=1\n"
    assert file.stat().st_mode & 0o777 == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["service.env"]


def test_a_limit_that_nothing_keeps_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = [Trial(Candidate(2, 1), 60, 2.0, [66.0] * 60), Trial(Candidate(1, 1), 20, 1.0, [50.0] * 20)]
    monkeypatch.setattr(tune, "measure", lambda *_: trials)
    result = CliRunner().invoke(tune.app, ["--latency-ms", "1"], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert "No way keeps 1 ms" in result.output
    assert result.stdout.endswith("QUADLIFT_WORKERS=1\nQUADLIFT_INTRA_OP_THREADS=1\n")
    assert "30.00" in result.stdout
    result = CliRunner().invoke(tune.app, ["--latency-ms", "66"])
    assert result.stdout.endswith("QUADLIFT_WORKERS=2\nQUADLIFT_INTRA_OP_THREADS=1\n")


def test_an_unknown_pack_ends_in_one_line() -> None:
    result = CliRunner().invoke(tune.app, ["--pack", "nowhere"])
    assert result.exit_code == 1
    assert "nowhere" in result.output
    assert "Traceback" not in result.output
