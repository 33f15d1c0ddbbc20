"""How long each step takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np


class StageTimes:
    """Collects durations by name; one instance is shared by the stages of a run. clock: in
    seconds; `time.thread_time` counts what the calling thread computes, whatever else goes on.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._durations_s: dict[str, list[float]] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time spent inside the `with` block under `name`."""
        start = self._clock()
        try:
            yield
        finally:
            self.add(name, self._clock() - start)

    def add(self, name: str, duration_s: float) -> None:
        """Add one duration in seconds."""
        self._durations_s.setdefault(name, []).append(duration_s)

    def clear(self) -> None:
        """Forget what was measured so far."""
        self._durations_s.clear()

    @property
    def durations_s(self) -> dict[str, list[float]]:
        """All durations in seconds by name, in the order they were added."""
        return {name: list(durations) for name, durations in self._durations_s.items()}

    def summary(self) -> dict[str, dict[str, float]]:
        """Return count, mean, median, 95th percentile and maximum in milliseconds by name."""
        table = {}
        for name, durations in self._durations_s.items():
            ms = 1e3 * np.array(durations)
            table[name] = {
                'count': len(ms),
                'mean_ms': round(float(ms.mean()), 3),
                'p50_ms': round(float(np.percentile(ms, 50)), 3),
                'p95_ms': round(float(np.percentile(ms, 95)), 3),
                'max_ms': round(float(ms.max()), 3),
            }
        return table


class NoTimes(StageTimes):
    """For stages whose times nobody asks for."""

    def add(self, name: str, duration_s: float) -> None:
        """Forget it."""
