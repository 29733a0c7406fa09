"""How long each stage took, in memory that does not grow."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

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


class StageTimes:
    """Durations of named stages; safe to use from several threads.

    Percentiles are exact over the last `KEPT` runs of a stage, the maximum over all of them.
    """

    def __init__(self) -> None:
        self._rings: dict[str, np.ndarray] = {}
        self._counts: dict[str, int] = {}
        self._highest: dict[str, float] = {}
        self._last: dict[str, float] = {}
        self._lock = threading.Lock()

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            for each in (self._rings, self._counts, self._highest, self._last):
                each.clear()

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
            if name not in self._rings:
                self._rings[name] = np.full(KEPT, np.nan, np.float32)
                self._counts[name] = 0
                self._highest[name] = 0.0
            self._rings[name][self._counts[name] % KEPT] = duration_ms
            self._counts[name] += 1
            self._highest[name] = max(self._highest[name], duration_ms)
            self._last[name] = duration_ms

    def last_ms(self) -> dict[str, float]:
        """Latest duration of each of the `STAGES`; NaN of one that has not run."""
        with self._lock:
            return {name: self._last.get(name, math.nan) for name in STAGES}

    def summary(self) -> dict[str, StageSummary]:
        """Median, 99th percentile and maximum of every stage, in their order."""
        with self._lock:
            names = [name for name in STAGES if name in self._rings]
            names += [name for name in self._rings if name not in STAGES]
            return {name: self._summarise(name) for name in names}

    def _summarise(self, name: str) -> StageSummary:
        durations = self._rings[name][: self._counts[name]]
        p50, p99 = np.percentile(durations, (50, 99))
        return StageSummary(float(p50), float(p99), self._highest[name], self._counts[name])
