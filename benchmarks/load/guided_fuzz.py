"""Atheris on one parser: inputs that follow the branches of the code. In a process of its own, which libFuzzer ends.

``python -c "from benchmarks.load.guided_fuzz import main; main()" PARSER [libFuzzer's options] CORPUS``
"""

from __future__ import annotations

import base64
import importlib.util
import logging
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.load.mutation import MAX_INPUT, Crash, FuzzResult
from clients.local_service import child_environment

if TYPE_CHECKING:
    # Not when it runs: what is imported before Atheris instruments it is not followed.
    from benchmarks.load.parsers import ParserTarget

_PROGRAM = "from benchmarks.load.guided_fuzz import main; main()"
_DONE = re.compile(rb"Done (\d+) runs in \d+ second")
_COUNT = re.compile(rb"^#(\d+)\s", re.MULTILINE)
_EXCEPTION = re.compile(rb"=== Uncaught Python exception: ===\s+(.+)")
_SLACK_S = 60.0
"""Beside the time of the runs: loading, instrumenting, ending."""
_CRASH_FILES = ("crash-", "timeout-", "oom-")


def has_atheris() -> bool:
    """Whether Atheris is installed."""
    return importlib.util.find_spec("atheris") is not None


def guided_fuzz(target: ParserTarget, runs: int, seconds: float, seed: int) -> FuzzResult:
    """Run one parser under Atheris until its runs are done, the time is over, or it crashes."""
    result = FuzzResult(target.name, "atheris")
    with tempfile.TemporaryDirectory(prefix="quadlift-fuzz-") as folder:
        corpus, found = Path(folder) / "corpus", Path(folder) / "found"
        for made in (corpus, found):
            made.mkdir()
        for number, data in enumerate(target.corpus):
            (corpus / str(number)).write_bytes(data)
        words = Path(folder) / "words"
        words.write_text("".join(_dictionary_line(word) for word in target.words), "ascii")
        command = [
            sys.executable, "-P", "-c", _PROGRAM, target.name, f"-runs={runs}", f"-seed={seed % 2**32}",
            f"-max_len={MAX_INPUT}",
            f"-max_total_time={max(1, round(seconds))}", "-timeout=10", f"-dict={words}", f"-artifact_prefix={found}/",
            str(corpus),
        ]  # fmt: skip
        began = time.perf_counter()
        try:
            limit_s = seconds + _SLACK_S
            ended = subprocess.run(command, capture_output=True, timeout=limit_s, env=child_environment(), check=False)
            words_said = ended.stderr
        except subprocess.TimeoutExpired as late:
            words_said = late.stderr or b""
            result.crashes.append(Crash(f"not done {_SLACK_S:.0f} s after its time", target.name, ""))
        result.seconds = time.perf_counter() - began
        done = _DONE.search(words_said)
        counts = _COUNT.findall(words_said)
        result.runs = int(done[1]) if done else int(counts[-1]) if counts else 0
        for path in sorted(found.iterdir()):
            if path.name.startswith(_CRASH_FILES):
                said = _EXCEPTION.search(words_said)
                error = said[1].decode("utf-8", "replace")[:200] if said else path.name.partition("-")[0]
                result.crashes.append(Crash(error, target.name, base64.b64encode(path.read_bytes()).decode()))
        if not result.runs and not result.crashes:
            result.crashes.append(Crash(words_said[-300:].decode("utf-8", "replace"), "the fuzzer did not run", ""))
    return result


def _dictionary_line(word: bytes) -> str:
    """A word in libFuzzer's form."""
    return '"' + "".join(f"\\x{byte:02x}" for byte in word) + '"\n'


def main() -> None:
    """Entry point of the process: the parser's name, then libFuzzer's arguments."""
    import atheris

    logging.disable(logging.CRITICAL)
    with atheris.instrument_imports(include=["service"]):
        from benchmarks.load.parsers import parser_targets
        from service.errors import QuadliftError
    target = parser_targets()[sys.argv[1]]

    def one(data: bytes) -> None:
        try:
            target.run(data)
        except QuadliftError:
            # Refusing is what a parser is for.
            return

    atheris.Setup([sys.argv[0], *sys.argv[2:]], one)
    atheris.Fuzz()
