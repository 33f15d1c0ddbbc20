"""The five stages in lockstep, without ROS: every frame is processed, and the same input gives
the same bytes. What it can do without is plugged in by `plugins.assembly`.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.cloud import CloudLabelling
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import (
    MAX_KEYFRAMES_UNDER_WAY,
    FloorObservation,
    FloorScan,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    LabelledPoints,
    LoadedMap,
    Mount,
    Semantics,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.grid.mapper import make_mapper
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE, StereoSlam
from segfloor_ros.core.timing import StageTimes

logger = logging.getLogger(__name__)


KeyframeListener = Callable[[Keyframe, FloorObservation], None]


@dataclass(frozen=True)
class MapInput:
    """What labelling and grid need of a keyframe. mask: (H, W) uint8, its floor mask."""

    stamp_ns: int
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    mask: NDArray[np.uint8]
    scan: FloorScan


class NoSemantics:
    """No network looks at the images."""

    is_late = False

    def __init__(self) -> None:
        self.remarks: list[str] = []

    def moving(self, frame: StereoFrame) -> NDArray[np.uint8]:
        """Return that nothing moves."""
        return np.zeros(frame.left.shape, np.uint8)

    def says(self, keyframe: Keyframe) -> NDArray[np.uint8] | None:
        """Return None."""
        return None

    def add(self, keyframe: Keyframe, floor: FloorObservation, mount: Mount) -> None:
        """Ignore it."""

    def to_parts(self) -> dict[str, Arrays]:
        """Return nothing."""
        return {}

    def from_parts(self, parts: dict[str, Arrays], shift_ns: int) -> None:
        """Ignore the labels of a saved map."""


class KeyframeStages:
    """The three stages behind SLAM, keyframe by keyframe: the one place that knows their order."""

    def __init__(
        self,
        camera: StereoCamera,
        configuration: Configuration,
        times: StageTimes,
        semantics: Semantics | None = None,
    ) -> None:
        self.labelled: LabelledPoints | None = None
        self.map_updates = 0
        self.path = KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        self.semantics = semantics or NoSemantics()
        self._is_loaded = False
        self._times = times
        self.floor = FloorSegmentation(camera, configuration.floor_segmentation)
        self._labelling = CloudLabelling(configuration.cloud_labelling)
        self._mapper = make_mapper(configuration.occupancy_grid)

    def process(self, keyframe: Keyframe, mount: Mount) -> FloorObservation:
        """Take in one keyframe."""
        said = self.semantics.says(keyframe)
        with self._times.measure('floor_segmentation'):
            floor = self.floor.process(
                keyframe.left, keyframe.right, mount, keyframe.T_map_base, keyframe.moving, said
            )
        self.semantics.add(keyframe, floor, mount)
        self.path, cloud = keyframe.path, keyframe.cloud
        self.update_map(
            MapInput(keyframe.stamp_ns, keyframe.features, self.path, cloud, floor.mask, floor.scan)
        )
        return floor

    def update_map(self, keyframe: MapInput) -> None:
        """Take in one keyframe whose floor is segmented."""
        with self._times.measure('cloud_labelling'):
            self.labelled = self._labelling.update(
                keyframe.cloud, keyframe.features, keyframe.mask, keyframe.path.T_map_base[-1]
            )
        with self._times.measure('occupancy_grid'):
            self._mapper.update(
                keyframe.stamp_ns, self.labelled, keyframe.features, keyframe.path, keyframe.scan
            )
        self.map_updates += 1

    @property
    def remarks(self) -> list[str]:
        """What is wrong with what the network sees, and with the mount, in words."""
        return [*self.semantics.remarks, *self.floor.remarks.values()]

    def note_points(self, cloud: SparseCloud) -> None:
        """Take in the points of a keyframe whose floor is not segmented."""
        self.labelled = self._labelling.labelled(cloud)

    def to_arrays(self) -> dict[str, Arrays]:
        """Return what is known of points, grid and classes, for a file."""
        parts = {'cloud': self._labelling.to_arrays(), 'grid': self._mapper.to_arrays()}
        return parts | self.semantics.to_parts()

    def load(self, parts: dict[str, Arrays], loaded: LoadedMap) -> None:
        """Go on with a map that SLAM has loaded. Raises KeyError, IndexError, TypeError or
        ValueError for parts that are damaged.
        """
        self._labelling.from_arrays(parts['cloud'])
        self.labelled = self._labelling.labelled(loaded.cloud)
        self._mapper.from_arrays(parts['grid'], parts['grid']['stamp_ns'] + loaded.shift_ns)
        self.path = loaded.path
        self.semantics.from_parts(parts, loaded.shift_ns)
        self._is_loaded = True

    def grid(self) -> OccupancyGrid | None:
        """Return the map so far, None before the first keyframe."""
        return self._mapper.grid() if self.map_updates or self._is_loaded else None


class Pipeline:
    """SLAM on the calling thread, the other stages on one worker, in the order of the keyframes.

    Nothing flows back from the worker to SLAM, so the result does not depend on timing. A keyframe
    at which a stage fails does not reach the map, the others do. failed_keyframes: how many did
    not; fault: of the last of them, in words. path_only: whether SLAM runs alone, also where no
    floor shows the mount; the camera is then taken for the base, and there is no map. make_stages:
    makes the stages behind SLAM for a new map.
    """

    def __init__(
        self,
        slam: StereoSlam,
        make_stages: Callable[[], KeyframeStages],
        times: StageTimes,
        on_keyframe: KeyframeListener | None = None,
        path_only: bool = False,
    ) -> None:
        self.times = times
        self.slam = slam
        self.path_only = path_only
        self._make_stages = make_stages
        self.keyframe_stages, self._mapped_with = make_stages(), self.mount
        self.failed_keyframes, self.fault = 0, ''
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
        if self.mount != self._mapped_with:
            self._begin_map()
        if self.keyframe_stages.semantics.is_late:
            self._add_late_mask(frame)
        self._take_in(results)
        return results

    def finish_tracking(self) -> list[FrameResult]:
        """Return what is still held back after the last frame, as a path alone where the mount is
        not known.
        """
        if self.mount is None:
            self.path_only, self.slam.rig.base = True, CAMERA_AS_BASE
        results = self.slam.finish()
        self._take_in(results)
        return results

    def _take_in(self, results: Sequence[FrameResult]) -> None:
        for result in results:
            if result.keyframe is not None and self.path_only:
                self.keyframe_stages.note_points(result.keyframe.cloud)
            elif result.keyframe is not None:
                self._submit(result.keyframe)

    def finish(self) -> OccupancyGrid | None:
        """Wait for the last keyframe and return the map, or None when there was no keyframe."""
        self._wait()
        self._worker.shutdown()
        return self.keyframe_stages.grid()

    def load(self, parts: dict[str, Arrays], loaded: LoadedMap) -> None:
        """Go on with a map that SLAM has loaded, before the first frame."""
        self._mapped_with = self.mount
        self.keyframe_stages.load(parts, loaded)

    def close(self) -> None:
        """Drop what is pending, e.g. after an error."""
        self._worker.shutdown(cancel_futures=True)

    def _add_late_mask(self, frame: StereoFrame) -> None:
        """Let the network look at a frame that has become a keyframe."""
        keyframes = self.slam.map.keyframes
        if keyframes and keyframes[-1].stamp_ns == frame.stamp_ns:
            mask = self.keyframe_stages.semantics.moving(frame)
            self.slam.late_masks.add(frame.stamp_ns, mask)

    def _begin_map(self) -> None:
        """Begin the map anew: all results come once more where the mount has changed."""
        if self._mapped_with is not None:
            self._wait()
            self.keyframe_stages = self._make_stages()
        self._mapped_with = self.mount

    def _wait(self) -> None:
        while self._pending:
            self._pending.popleft().result()

    def _submit(self, keyframe: Keyframe) -> None:
        while len(self._pending) >= MAX_KEYFRAMES_UNDER_WAY:
            self._pending.popleft().result()
        self._pending.append(self._worker.submit(self._process_keyframe, keyframe))

    def _process_keyframe(self, keyframe: Keyframe) -> None:
        assert self._mapped_with is not None
        try:
            floor = self.keyframe_stages.process(keyframe, self._mapped_with)
            if self._on_keyframe is not None:
                self._on_keyframe(keyframe, floor)
        except Exception as error:
            self.failed_keyframes += 1
            self.fault = f'{type(error).__name__}: {error}'
            logger.warning('keyframe %d failed: %s', keyframe.frame_index, self.fault)
            logger.debug('where it failed:', exc_info=error)
