"""The stages one after the other on one thread, with a map at every keyframe: so the published
figures were measured, and so no stage waits for another one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.configuration import Configuration
from segfloor_ros.evaluation.benchmark_figures import UpdateTimes, Workload
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.memory import MemoryLog
from segfloor_ros.slam.results import Keyframe, KeyframeFeatures, KeyframePath, SparseCloud
from segfloor_ros.stages import make_slam


@dataclass(frozen=True)
class MapInput:
    """What labelling and grid need of a keyframe. mask: (H, W) uint8, its floor mask."""

    stamp_ns: int
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    mask: NDArray[np.uint8]
    scan: FloorScan


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
            labelled = self._labelling.update(
                keyframe.cloud, keyframe.features, keyframe.mask, keyframe.path.T_map_base[-1]
            )
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
