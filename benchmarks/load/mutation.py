"""Broken inputs made from whole ones, the same for the same seed, and runs of them through a parser."""

from __future__ import annotations

import base64
import json
import random
import struct
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from service.errors import QuadliftError

MAX_INPUT = 8192
"""Bytes; mutations that repeat slices would grow without end."""
MAX_CRASHES = 10
"""Crashes kept, each at another place of the code."""
_CLOCK_EVERY = 256
"""Runs between two looks at the clock."""
_NUMBERS = (0, 1, 2, 7, 8, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_ODD_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 15, 16, 16385, 2**31, 2**63, 2**64, -(2**63), 10**30, 0.5, -0.0, 1e-320, 1e8, -1e8, 1e9,
    1e308,
    float("nan"), float("inf"), float("-inf"), "", "a", "x" * 300, "\ud800", "\x00", "../../etc/passwd", "é", [], [[]],
    {}, [0.0],
    [0.0, 0.0, 1.0], [[1.0, 0.0, 0.0]] * 3, {"id": "a"},
)  # fmt: skip


class Maker(Protocol):
    """Makes one input after the other."""

    def make(self) -> bytes:
        """The next input."""
        ...


class ByteMutator:
    """Whole inputs with a few bytes changed, cut, repeated or mixed."""

    def __init__(self, corpus: Sequence[bytes], words: Sequence[bytes], seed: int) -> None:
        """corpus: whole inputs, none empty. words: byte strings that mean something to the parser."""
        self._corpus, self._words, self._random = list(corpus), list(words), random.Random(seed)

    def make(self) -> bytes:
        """One of the corpus after one to six changes."""
        draw = self._random
        data = bytearray(draw.choice(self._corpus))
        for _ in range(draw.randint(1, 6)):
            self._change(data)
        return bytes(data[:MAX_INPUT])

    def _change(self, data: bytearray) -> None:
        draw = self._random
        kind = draw.randrange(8)
        # Headers stand at the front: half of the changes are made there.
        reach = len(data) if draw.random() < 0.5 else min(len(data), 64)
        at = draw.randrange(reach + 1)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << draw.randrange(8)
        elif kind == 1 and at < len(data):
            data[at] = draw.randrange(256)
        elif kind == 2:
            form = draw.choice((">H", ">I", "<H", "<I"))
            size = struct.calcsize(form)
            data[at : at + size] = struct.pack(form, draw.choice(_NUMBERS) & (256**size - 1))
        elif kind == 3:
            word = draw.choice(self._words)
            data[at : at + draw.choice((0, len(word)))] = word
        elif kind == 4:
            del data[at : at + draw.randint(1, 32)]
        elif kind == 5:
            piece = data[at : at + draw.randint(1, 64)]
            data[at:at] = piece * draw.randint(1, 4)
        elif kind == 6:
            del data[at:]
        else:
            other = draw.choice(self._corpus)
            data[at:] = other[draw.randrange(len(other) + 1) :]


class JsonMutator:
    """JSON documents with a few of their values replaced, dropped, repeated, or of another kind."""

    def __init__(self, documents: Sequence[Any], seed: int) -> None:
        self._texts, self._random = [json.dumps(document) for document in documents], random.Random(seed)

    def make(self) -> bytes:
        """One of the documents after one to four changes; NaN and infinities as Python writes them."""
        document = json.loads(self._random.choice(self._texts))
        for _ in range(self._random.randint(1, 4)):
            document = self._changed(document, 0.98)
        return json.dumps(document).encode()

    def _changed(self, value: Any, deeper: float = 0.8) -> Any:
        """deeper: how often something within is changed, where there is something, instead of the whole."""
        draw = self._random
        if isinstance(value, dict | list) and value and draw.random() < deeper:
            key = draw.choice(list(value)) if isinstance(value, dict) else draw.randrange(len(value))
            kind = draw.random()
            if kind < 0.08:
                del value[key]
            elif kind < 0.14 and isinstance(value, list):
                value.insert(key, value[draw.randrange(len(value))])
            elif kind < 0.14 and isinstance(value, dict):
                value[str(draw.choice(_ODD_VALUES))] = value[key]
            else:
                value[key] = self._changed(value[key])
            return value
        if isinstance(value, int | float) and not isinstance(value, bool) and draw.random() < 0.4:
            return value * draw.choice((-1, 0, 1 + 1e-6, 1.001, 2, 1e6)) + draw.choice((0, 0, 1, -1))
        return json.loads(json.dumps(draw.choice(_ODD_VALUES)))


@dataclass(frozen=True)
class Crash:
    """What a parser raised that is none of the errors it may raise."""

    error: str
    place: str
    """File and line that raised."""
    input_base64: str


@dataclass
class FuzzResult:
    """What became of the runs of one parser."""

    parser: str
    engine: str
    runs: int = 0
    accepted: int = 0
    refused: int = 0
    """Runs that ended in an error of the documented tree."""
    seconds: float = 0.0
    slowest_ms: float = 0.0
    crashes: list[Crash] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        rate = round(self.runs / self.seconds) if self.seconds else 0
        return vars(self) | {
            "seconds": round(self.seconds, 2), "runs_per_second": rate, "slowest_ms": round(self.slowest_ms, 2),
            "crashes": [vars(crash) for crash in self.crashes],
        }  # fmt: skip


def fuzz(parser: str, target: Callable[[bytes], None], maker: Maker, runs: int, seconds: float) -> FuzzResult:
    """Run a parser on ``runs`` inputs, or as many as fit into the time. What is not a QuadliftError is a crash."""
    result = FuzzResult(parser, "mutation")
    began = time.perf_counter()
    for number in range(runs):
        if number % _CLOCK_EVERY == 0 and time.perf_counter() - began > seconds:
            break
        data = maker.make()
        started = time.perf_counter()
        try:
            target(data)
        except QuadliftError:
            result.refused += 1
        except Exception as error:
            # That is what is looked for: whatever it is, it is kept with its input.
            _keep(result, error, data)
        else:
            result.accepted += 1
        result.runs += 1
        result.slowest_ms = max(result.slowest_ms, 1e3 * (time.perf_counter() - started))
    result.seconds = time.perf_counter() - began
    return result


def _keep(result: FuzzResult, error: Exception, data: bytes) -> None:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    crash = Crash(
        f"{type(error).__name__}: {str(error)[:200]}", f"{frame.filename}:{frame.lineno}", base64.b64encode(data).decode()
    )
    places = {(known.place, known.error.partition(":")[0]) for known in result.crashes}
    if (crash.place, type(error).__name__) not in places and len(result.crashes) < MAX_CRASHES:
        result.crashes.append(crash)
