"""Memory of this process."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import numpy as np

_STATM = Path('/proc/self/statm')


def rss_mb() -> float:
    """Return the resident memory of this process in MB (10^6 bytes); the peak so far where
    only that is known.
    """
    if _STATM.exists():
        return int(_STATM.read_text().split()[1]) * resource.getpagesize() / 1e6
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class MemoryLog:
    """Memory at the start and at every map update."""

    def __init__(self) -> None:
        self.start_mb = rss_mb()
        self._samples_mb: list[float] = []

    def sample(self) -> None:
        """Note the memory at a map update."""
        self._samples_mb.append(rss_mb())

    def summary(self) -> dict[str, float]:
        """Return start, peak and growth per map update (slope of a line over the second half,
        when caches are warm).
        """
        half = self._samples_mb[len(self._samples_mb) // 2 :]
        slope = float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0
        return {
            'start': round(self.start_mb, 2),
            'peak': round(max([self.start_mb, *self._samples_mb]), 2),
            'slope_per_update': round(slope, 4),
        }
