"""How long each stage took, in memory that does not grow."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

KEPT = 1 << 16
"""Durations kept per stage: at 30 fps the last 36 minutes, 256 KB."""

STAGES = ("read", "seeds", "neural_gas", "improvement", "acquire", "model", "log", "loop")
"""Stages of the loop, in the order in which they are shown."""


@dataclass(frozen=True, slots=True)
class StageSummary:
    """Durations of one stage in milliseconds, and how often it ran."""

    p50_ms: float
    p99_ms: float
    max_ms: float
    count: int


@dataclass
class _Durations:
    """Those of one stage, in milliseconds: the last `KEPT` of them in a ring."""

    ring: npt.NDArray[np.float32] = field(default_factory=lambda: np.full(KEPT, np.nan, np.float32))
    count: int = 0
    highest: float = 0.0

    def add(self, duration_ms: float) -> None:
        """Add one."""
        self.ring[self.count % KEPT] = duration_ms
        self.count += 1
        self.highest = max(self.highest, duration_ms)

    def summary(self) -> StageSummary:
        """Median and 99th percentile of those kept, maximum of all."""
        p50, p99 = np.percentile(self.ring[: self.count], (50, 99))
        return StageSummary(float(p50), float(p99), self.highest, self.count)


class StageTimes:
    """Durations of named stages; safe to use from several threads.

    Percentiles are exact over the last `KEPT` runs of a stage, the maximum over all of them.
    """

    def __init__(self) -> None:
        self._stages: defaultdict[str, _Durations] = defaultdict(_Durations)
        self._lock = threading.Lock()

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._stages.clear()

    @contextmanager
    def stage(self, name: str, own_ms: dict[str, float] | None = None) -> Iterator[None]:
        """Time what happens inside; a stage that raises is not counted.

        The duration goes to `own_ms` as well, under the stage's name: the times of one frame, while
        another's stages may be under way.
        """
        start = time.perf_counter()
        yield
        duration_ms = (time.perf_counter() - start) * 1000
        self.add(name, duration_ms)
        if own_ms is not None:
            own_ms[name] = duration_ms

    def add(self, name: str, duration_ms: float) -> None:
        """Add one duration."""
        with self._lock:
            self._stages[name].add(duration_ms)

    def last_ms(self) -> dict[str, float]:
        """Latest duration of every stage that has run."""
        with self._lock:
            return {name: float(each.ring[(each.count - 1) % KEPT]) for name, each in self._stages.items()}

    def summary(self) -> dict[str, StageSummary]:
        """Median, 99th percentile and maximum of every stage, in their order."""
        with self._lock:
            names = [name for name in STAGES if name in self._stages]
            return {name: self._stages[name].summary() for name in dict.fromkeys([*names, *self._stages])}
