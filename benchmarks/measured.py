"""What one way of running frame sets gave."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Measured:
    """Counts, latencies and stage times."""

    sets: int = 0
    seconds: float = 0.0
    dropped: int = 0
    latency_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)

    def note(self, latency_ms: float, timing_ms: dict[str, float]) -> None:
        """One finished set."""
        self.sets += 1
        self.latency_ms.append(latency_ms)
        for stage, value in timing_ms.items():
            self.stages_ms.setdefault(stage, []).append(value)

    @property
    def sets_per_second(self) -> float:
        """Throughput."""
        return self.sets / self.seconds if self.seconds else 0.0
