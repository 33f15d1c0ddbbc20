"""Memory of this process."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MAX_SAMPLES = 200

_PROC = Path('/proc')


def rss_mb(process_id: int | None = None) -> float:
    """Return the resident memory of this process, or of another one, in MB (10^6 bytes).

    Where there is no /proc, it is the peak of this process so far, and 0 for others.
    """
    statm = _PROC / str(process_id or 'self') / 'statm'
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6
    if process_id is not None:
        return 0.0
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class MemoryLog:
    """Memory at the start and at every map update: of this process, or what `measure` returns."""

    def __init__(self, measure: Callable[[], float] = rss_mb) -> None:
        self._measure = measure
        self.start_mb = measure()
        self._samples_mb: list[float] = []

    def sample(self) -> None:
        """Note the memory at a map update."""
        self._samples_mb.append(self._measure())

    def summary(self) -> dict[str, Any]:
        """Return start, peak and growth per map update (slope of a line over the second half,
        when caches are warm), and at most 200 samples evenly over the updates.
        """
        every = max(1, -(-len(self._samples_mb) // MAX_SAMPLES))
        half = self._samples_mb[len(self._samples_mb) // 2 :]
        slope = float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0
        return {
            'start': round(self.start_mb, 2),
            'peak': round(max([self.start_mb, *self._samples_mb]), 2),
            'slope_per_update': round(slope, 4),
            'samples': [round(sample, 1) for sample in self._samples_mb[::every]],
            'updates_per_sample': every,
        }
