"""The stages one after the other on one thread, with a map at every keyframe: so the published
figures were measured, and so no stage waits for another one.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.configuration import Configuration
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.memory import MemoryLog
from segfloor_ros.slam.results import Keyframe, KeyframeFeatures, KeyframePath, SparseCloud
from segfloor_ros.stages import make_slam
from segfloor_ros.timing import StageTimes

EVERY_FRAME = 'tracking'
BEFORE_UPDATE = 'mapping'


@dataclass(frozen=True)
class MapInput:
    """What labelling and grid need of a keyframe. mask: (H, W) uint8, its floor mask."""

    stamp_ns: int
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    mask: NDArray[np.uint8]
    scan: FloorScan


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
        elif name != EVERY_FRAME:
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


class MapChain:
    """Labelling and grid, keyframe by keyframe."""

    def __init__(self, configuration: Configuration) -> None:
        self.times = UpdateTimes()
        self.grid: OccupancyGrid | None = None
        self.points = 0
        self._labelling = CloudLabelling(configuration.cloud_labelling)
        self._mapper = OccupancyGridMapper(configuration.occupancy_grid)
        self._memory = MemoryLog()

    def update(self, keyframe: MapInput) -> None:
        """Take in one keyframe and make the map."""
        with self.times.measure('cloud_labelling'):
            labelled = self._labelling.update(keyframe.cloud, keyframe.features, keyframe.mask)
        with self.times.measure('occupancy_grid'):
            self._mapper.update(
                keyframe.stamp_ns, labelled, keyframe.features, keyframe.path, keyframe.scan
            )
            # The grid folds new evidence in when the map is asked for; that belongs to its time.
            self.grid = self._mapper.grid()
        self.points = len(keyframe.cloud.point_id)
        self.times.end_update()
        self._memory.sample()

    def workload(self, name: str, items: int, tracked: int, reference_ms: float) -> Workload:
        """Return the figures so far under a name."""
        stages: dict[str, dict[str, Any]] = self.times.summary()
        for figures in stages.values():
            figures['p50_ratio'] = round(figures['p50_ms'] / reference_ms, 4)
        return Workload(
            name=name,
            items=items,
            tracked=tracked,
            map_updates=len(self.times.update_s),
            points=self.points,
            cells=0 if self.grid is None else self.grid.cells.size,
            stages=stages,
            update_s=self.times.per_update(),
            items_per_s=round(items / self.times.total_s, 2) if self.times.total_s else 0.0,
            memory_mb=self._memory.summary(),
            reference_ms=round(reference_ms, 3),
        )


class ImageChain(MapChain):
    """All stages, from stereo images to the map."""

    def __init__(
        self, camera: StereoCamera, configuration: Configuration, mount: Mount | None = None
    ) -> None:
        super().__init__(configuration)
        self.frames = 0
        self.tracked = 0
        self._slam = make_slam(camera, configuration.stereo_slam, mount, self.times)
        self._floor = FloorSegmentation(camera, configuration.floor_segmentation)

    def process(self, frame: StereoFrame) -> None:
        """Take in the next frame."""
        self.frames += 1
        for result in self._slam.process(frame):
            self.tracked += result.tracked
            if result.keyframe is not None:
                self._segment(result.keyframe)

    def _segment(self, keyframe: Keyframe) -> None:
        assert self._slam.mount is not None
        with self.times.measure('floor_segmentation'):
            floor = self._floor.process(
                keyframe.left, keyframe.right, self._slam.mount, keyframe.T_map_base
            )
        self.update(
            MapInput(
                keyframe.stamp_ns,
                keyframe.features,
                keyframe.path,
                keyframe.cloud,
                floor.mask,
                floor.scan,
            )
        )
