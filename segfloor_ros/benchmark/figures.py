"""What a workload cost, and the times it is worked out from."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from segfloor_ros.timing import StageTimes

EVERY_FRAME = ('tracking', 'moving')
BEFORE_UPDATE = 'mapping'


@dataclass(frozen=True)
class Workload:
    """What one workload cost. items: frames, or keyframes where there were no images. points:
    in the map at the end. cells: of the map at the end. stages: by name count, mean_ms, p50_ms,
    p95_ms, max_ms and p50_ratio (of the reference's median). update_s: per map update, everything
    that is done once per keyframe. items_per_s: throughput. memory_mb: start, peak,
    slope_per_update. reference_ms: median of the reference, timed before and after.
    """

    name: str
    items: int
    tracked: int
    map_updates: int
    points: int
    cells: int
    stages: dict[str, dict[str, float]]
    update_s: dict[str, float]
    items_per_s: float
    memory_mb: dict[str, Any]
    reference_ms: float


class UpdateTimes(StageTimes):
    """Times by stage, and the time of each map update: all that is done once per keyframe."""

    def __init__(self) -> None:
        super().__init__()
        self.total_s = 0.0
        self.update_s: list[float] = []
        self._pending_s = 0.0
        self._mapping_s: deque[float] = deque()

    def add(self, name: str, duration_s: float) -> None:
        """Add one duration in seconds."""
        super().add(name, duration_s)
        self.total_s += duration_s
        if name == BEFORE_UPDATE:
            # SLAM may hold keyframes back: each takes its own mapping time along.
            self._mapping_s.append(duration_s)
        elif name not in EVERY_FRAME:
            self._pending_s += duration_s

    def end_update(self) -> None:
        """Close the map update that the durations since the last one belong to."""
        mapping_s = self._mapping_s.popleft() if self._mapping_s else 0.0
        self.update_s.append(self._pending_s + mapping_s)
        self._pending_s = 0.0

    def per_update(self) -> dict[str, float]:
        """Return mean, median, 95th percentile and maximum of the map updates in seconds."""
        if not self.update_s:
            return {}
        seconds = np.array(self.update_s)
        values = {
            'mean': seconds.mean(),
            'p50': np.percentile(seconds, 50),
            'p95': np.percentile(seconds, 95),
            'max': seconds.max(),
        }
        return {name: round(float(value), 6) for name, value in values.items()}
