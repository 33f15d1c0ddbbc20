"""The five stages in lockstep, without ROS: every frame is processed, and the same input gives
the same bytes. The nodes build SLAM here, too.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.cloud import CloudLabelling
from segfloor_ros.core.configuration import MAX_KEYFRAMES_UNDER_WAY, Configuration
from segfloor_ros.core.contracts import (
    FloorObservation,
    FloorScan,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    LabelledPoints,
    Mount,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.files.results import Arrays, MapFile, read_map_file, take, write_map_file
from segfloor_ros.core.floor.plane.mount import MountEstimator
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.grid.keyframe_evidence import LENGTHS
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.saved_slam import PART as SLAM
from segfloor_ros.core.plugins.saved_slam import (
    LoadedMap,
    load_slam,
    parts_that_fit,
    prune_slam,
    save_slam,
)
from segfloor_ros.core.plugins.semantics.label_map import LABELS, SEEN_LENGTHS, LabelMap, Labels
from segfloor_ros.core.plugins.semantics.network import ImageLabeller, Network
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.core.timing import StageTimes

logger = logging.getLogger(__name__)

CAMERA_AS_BASE = Mount(0.0, 0.0, 0.0)
"""Where nothing is known of the mount: the camera in the axes of a base."""

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


class KeyframeStages:
    """The three stages behind SLAM, keyframe by keyframe: the one place that knows their order."""

    def __init__(
        self,
        camera: StereoCamera,
        configuration: Configuration,
        times: StageTimes,
        labeller: ImageLabeller | None = None,
    ) -> None:
        self.labelled: LabelledPoints | None = None
        self.map_updates = 0
        self._is_loaded = False
        self._times = times
        self._labeller, self._label_map = labeller, LabelMap(camera)
        self._path = KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        if labeller is not None:
            height_m, own = configuration.floor_segmentation.robot_height_m, labeller.network
            classes, moves = own.settings.classes, own.settings.moves
            self._label_map = LabelMap(camera, classes, height_m, moves)
        self.floor = FloorSegmentation(camera, configuration.floor_segmentation)
        self._labelling = CloudLabelling(configuration.cloud_labelling)
        self._mapper = OccupancyGridMapper(configuration.occupancy_grid)

    def process(self, keyframe: Keyframe, mount: Mount) -> FloorObservation:
        """Take in one keyframe."""
        said = None
        if self._labeller is not None:
            said = self._labeller.says(keyframe.stamp_ns, keyframe.left)
        with self._times.measure('floor_segmentation'):
            floor = self.floor.process(
                keyframe.left, keyframe.right, mount, keyframe.T_map_base, keyframe.moving, said
            )
        if self._labeller is not None:
            labels = self._labeller.labels(keyframe.stamp_ns, keyframe.left)
            self._label_map.add(
                keyframe.stamp_ns,
                labels,
                floor.mask,
                floor.disparity_px,
                mount,
                keyframe.features,
                floor.scan.range_max_m,
            )
        self._path, cloud = keyframe.path, keyframe.cloud
        self.update_map(
            MapInput(
                keyframe.stamp_ns, keyframe.features, self._path, cloud, floor.mask, floor.scan
            )
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
        of_network = self._labeller.remarks if self._labeller is not None else []
        return [*of_network, *self.floor.remarks.values()]

    def labels(self, grid: OccupancyGrid | None) -> Labels | None:
        """Return the labels of the map, with its keyframes where they lie now; None where no
        network has looked at them.
        """
        if self.labelled is None:
            return None
        return self._label_map.labels(grid, self._path, self.labelled.point_id)

    def note_points(self, cloud: SparseCloud) -> None:
        """Take in the points of a keyframe whose floor is not segmented."""
        self.labelled = self._labelling.labelled(cloud)

    def to_arrays(self) -> dict[str, Arrays]:
        """Return what is known of points, grid and classes, for a file."""
        parts = {'cloud': self._labelling.to_arrays(), 'grid': self._mapper.to_arrays()}
        return parts | ({LABELS: self._label_map.to_arrays()} if self._label_map.classes else {})

    def load(self, parts: dict[str, Arrays], loaded: LoadedMap, name: str) -> None:
        """Go on with a map that SLAM has loaded. Raises InputError, by the file's name, for parts
        that are damaged.
        """
        with parts_that_fit(name):
            self._labelling.from_arrays(parts['cloud'])
            self.labelled = self._labelling.labelled(loaded.cloud)
            self._mapper.from_arrays(parts['grid'], parts['grid']['stamp_ns'] + loaded.shift_ns)
            self._path = loaded.path
            if LABELS in parts:
                self._label_map.from_arrays(parts[LABELS], loaded.shift_ns)
        self._is_loaded = True

    def grid(self) -> OccupancyGrid | None:
        """Return the map so far, None before the first keyframe."""
        return self._mapper.grid() if self.map_updates or self._is_loaded else None


def prune(saved: MapFile) -> MapFile:
    """Return a saved map without the views that later ones show again: what its parts know of the
    keyframes and points that go, goes with them. Raises KeyError, IndexError or ValueError for a
    map that is damaged.
    """
    slam, latest_ns = prune_slam(saved.parts[SLAM])
    parts = saved.parts | {SLAM: slam}
    cloud, latest_ns = saved.parts['cloud'], np.intersect1d(latest_ns, slam['keyframe_stamp_ns'])
    parts['cloud'] = take(cloud, np.isin(cloud['point_id'], slam['point_stable_id']), {})
    for name, lengths in (('grid', LENGTHS), (LABELS, SEEN_LENGTHS)):
        arrays = saved.parts.get(name, {})
        of_keyframes = {column: array for column, array in arrays.items() if column != 'names'}
        if arrays:
            stays = np.isin(arrays['stamp_ns'], latest_ns)
            parts[name] = arrays | take(of_keyframes, stays, lengths)
    return MapFile(saved.header, parts)


def prune_file(path: Path) -> str:
    """Prune the map in a file; returns its name and size in words. Raises InputError."""
    saved = read_map_file(path)
    with parts_that_fit(str(path)):
        pruned = prune(saved)
    write_map_file(path, pruned)
    before, after = (len(file.parts[SLAM]['keyframe_stamp_ns']) for file in (saved, pruned))
    return f'{path}, {before} keyframes before, {after} now'


class Pipeline:
    """SLAM on the calling thread, the other stages on one worker, in the order of the keyframes.

    Nothing flows back from the worker to SLAM, so the result does not depend on timing. A keyframe
    at which a stage fails does not reach the map, the others do. failed_keyframes: how many did
    not; fault: of the last of them, in words. path_only: whether SLAM runs alone, also where no
    floor shows the mount; the camera is then taken for the base, and there is no map. network:
    looks at the frames, if there is one.
    """

    def __init__(
        self,
        camera: StereoCamera,
        configuration: Configuration,
        on_keyframe: KeyframeListener | None = None,
        path_only: bool = False,
        network: Network | None = None,
    ) -> None:
        self.times = StageTimes()
        self.camera = camera
        self.path_only = path_only
        mount = CAMERA_AS_BASE if path_only and not configuration.stereo_slam.has_mount else None
        self.slam = make_slam(camera, configuration.stereo_slam, mount, self.times)
        self.labeller = None if network is None else ImageLabeller(network, self.times)
        self._make_stages = partial(
            KeyframeStages, camera, configuration, self.times, self.labeller
        )
        self.keyframe_stages, self._mapped_with = self._make_stages(), self.mount
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
        if self.labeller is not None and self.labeller.is_late:
            self._add_late_mask(frame)
        self._take_in(results)
        return results

    def finish_tracking(self) -> list[FrameResult]:
        """Return what is still held back after the last frame, as a path alone where the mount is
        not known.
        """
        if self.mount is None:
            self.path_only, self.slam.rig.mount = True, CAMERA_AS_BASE
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

    def save(self) -> MapFile:
        """Return the whole map, once all keyframes are finished. Raises MapError before there is
        one.
        """
        saved = save_slam(self.slam, self.camera)
        saved.parts |= self.keyframe_stages.to_arrays()
        return saved

    def load(self, saved: MapFile, name: str, localize: bool) -> None:
        """Go on with a saved map, before the first frame. localize: it stays as it is. Raises
        InputError, by the file's name, for one that is damaged or of another camera.
        """
        loaded = load_slam(self.slam, self.camera, saved, name, localize)
        self._mapped_with = self.mount
        self.keyframe_stages.load(saved.parts, loaded, name)

    def close(self) -> None:
        """Drop what is pending, e.g. after an error."""
        self._worker.shutdown(cancel_futures=True)

    def _add_late_mask(self, frame: StereoFrame) -> None:
        """Let the network look at a frame that has become a keyframe."""
        assert self.labeller is not None
        keyframes = self.slam.map.keyframes
        if keyframes and keyframes[-1].stamp_ns == frame.stamp_ns:
            mask = self.labeller.moving(frame.stamp_ns, frame.left)
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


def make_slam(
    camera: StereoCamera,
    settings: StereoSlamSettings,
    mount: Mount | None = None,
    times: StageTimes | None = None,
    background: bool = False,
) -> StereoSlam:
    """Build stereo SLAM with the camera's mount: `mount` when it is known (from tf), else from
    the settings, and whatever the settings leave open is measured from the floor the camera
    sees. background: adjust the map beside tracking.
    """
    height_m, pitch_rad, roll_rad = (
        settings.camera_height_m,
        settings.camera_pitch_rad,
        settings.camera_roll_rad,
    )
    if mount is None and settings.has_mount:
        mount = Mount(
            height_m, pitch_rad, roll_rad, settings.camera_forward_m, settings.camera_left_m
        )
    meter = None
    if mount is None:
        meter = MountEstimator(
            camera,
            height_m,
            pitch_rad,
            roll_rad,
            forward_m=settings.camera_forward_m,
            left_m=settings.camera_left_m,
        )
    elif mount is not CAMERA_AS_BASE:
        meter = MountEstimator(camera, forward_m=mount.forward_m, left_m=mount.left_m, given=mount)
    return StereoSlam(camera, settings, mount, meter, times, background)
