"""The five stages in lockstep, without ROS: every frame is processed, and the same input gives
the same bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.cloud.labels import LabelledPoints
from segfloor_ros.configuration import Configuration
from segfloor_ros.floor.observation import FloorObservation
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.slam.results import FrameResult, Keyframe
from segfloor_ros.stages import make_slam
from segfloor_ros.timing import StageTimes

MAX_PENDING_KEYFRAMES = 4

KeyframeListener = Callable[[Keyframe, FloorObservation], None]


class Pipeline:
    """SLAM on the calling thread; segmentation, labelling and grid on one worker, in the order of
    the keyframes.

    Nothing flows back from the worker to SLAM, so the result does not depend on timing.
    """

    def __init__(
        self,
        camera: StereoCamera,
        configuration: Configuration,
        on_keyframe: KeyframeListener | None = None,
    ) -> None:
        self.times = StageTimes()
        self.map_updates = 0
        self.labelled: LabelledPoints | None = None
        self.slam = make_slam(camera, configuration.stereo_slam, times=self.times)
        self._floor = FloorSegmentation(camera, configuration.floor_segmentation)
        self._labelling = CloudLabelling(configuration.cloud_labelling)
        self._mapper = OccupancyGridMapper(configuration.occupancy_grid)
        self._on_keyframe = on_keyframe
        self._worker = ThreadPoolExecutor(1, 'keyframes')
        self._pending: deque[Future[None]] = deque()

    @property
    def mount(self) -> Mount | None:
        """Where the camera sits on the base, once it is known."""
        return self.slam.mount

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Take in the next frame; returns the tracking results that are ready, oldest first."""
        results = self.slam.process(frame)
        for result in results:
            if result.keyframe is not None:
                self._submit(result.keyframe)
        return results

    def finish(self) -> OccupancyGrid | None:
        """Wait for the last keyframe and return the map, or None when there was no keyframe."""
        while self._pending:
            self._pending.popleft().result()
        self._worker.shutdown()
        return self._mapper.grid() if self.map_updates else None

    def close(self) -> None:
        """Drop what is pending, e.g. after an error."""
        self._worker.shutdown(cancel_futures=True)

    def _submit(self, keyframe: Keyframe) -> None:
        while len(self._pending) >= MAX_PENDING_KEYFRAMES:
            self._pending.popleft().result()
        self._pending.append(self._worker.submit(self._process_keyframe, keyframe))

    def _process_keyframe(self, keyframe: Keyframe) -> None:
        assert self.mount is not None
        with self.times.measure('floor_segmentation'):
            floor = self._floor.process(
                keyframe.left, keyframe.right, self.mount, keyframe.T_map_base
            )
        with self.times.measure('cloud_labelling'):
            self.labelled = self._labelling.update(
                keyframe.cloud, keyframe.features, floor.mask, keyframe.T_map_base
            )
        with self.times.measure('occupancy_grid'):
            self._mapper.update(
                keyframe.stamp_ns, self.labelled, keyframe.features, keyframe.path, floor.scan
            )
        self.map_updates += 1
        if self._on_keyframe is not None:
            self._on_keyframe(keyframe, floor)
