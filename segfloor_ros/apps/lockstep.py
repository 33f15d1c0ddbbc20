"""A whole recording through the pipeline, frame by frame, to a results folder."""

from __future__ import annotations

import dataclasses
import logging
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from segfloor_ros.apps import results_folder
from segfloor_ros.apps.profiling import MemoryLog
from segfloor_ros.apps.recordings import StereoSource, prefetched
from segfloor_ros.apps.trajectory import TrackedPose, Trajectory, corrected_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.recording import MeasurementLog
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import (
    UNKNOWN_COVARIANCE,
    FloorObservation,
    FrameResult,
    InputFault,
    Keyframe,
    KeyframePath,
    Mount,
    StereoFrame,
)
from segfloor_ros.core.errors import InputError, MapError, SegfloorError, SettingsError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.results import SAVED_MAP, read_map_file, write_map_file
from segfloor_ros.core.files.writing import check_output
from segfloor_ros.core.floor.pictures import mask_overlay, v_disparity_picture
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.pipeline import KeyframeStages, Pipeline
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.core.plugins.maps.saved_pipeline import load_pipeline, save_pipeline
from segfloor_ros.core.plugins.maps.saved_slam import check_camera, new_keyframes
from segfloor_ros.core.plugins.rig.check import SETTLED_FRAMES
from segfloor_ros.core.plugins.semantics.label_map import Labels
from segfloor_ros.core.plugins.semantics.network import ImageLabeller, Network
from segfloor_ros.core.plugins.semantics.semantic_map import SemanticMap
from segfloor_ros.core.slam.held_results import left_out
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE
from segfloor_ros.core.slam.thresholds import MAJORITY
from segfloor_ros.core.timing import StageTimes

logger = logging.getLogger(__name__)

T = TypeVar('T')

ProgressListener = Callable[[int, str], None]
"""Called after every frame: how many are done, and the state in words."""


LOW_M = 0.1
"""Depth cameras, which see nothing nearer than 0.2 to 0.5 m, are mounted higher."""


class Watcher(Protocol):
    """Watches a run, and changes nothing."""

    def on_frame(
        self, frame: StereoFrame, results: Sequence[FrameResult], pipeline: Pipeline
    ) -> None:
        """A frame is done; these results came with it."""

    def on_keyframe(self, keyframe: Keyframe, floor: FloorObservation, pipeline: Pipeline) -> None:
        """A keyframe is in the map; called on the thread that makes the map."""


class SaveMasks(str, Enum):
    """Of which frames the floor masks are kept."""

    none = 'none'
    keyframes = 'keyframes'
    all = 'all'


@dataclasses.dataclass(frozen=True)
class MapOptions:
    """Maps on disk: to go on with, and to save. localize: the loaded map stays as it is. inputs: of
    the command, none of which is written to.
    """

    load: Path | None = None
    save: Path | None = None
    localize: bool = False
    inputs: tuple[Path | str | None, ...] = ()

    def __post_init__(self) -> None:
        if self.localize and self.load is None:
            raise SettingsError('--localize needs the map to localize in: --load-map FILE')
        if self.localize and self.save is not None:
            raise SettingsError('--localize adds nothing to the map: leave --save-map out')
        if self.save is not None:
            check_output(self.save, SAVED_MAP, (self.load, *self.inputs), '--save-map')

    def read(self, camera: StereoCamera) -> MapFile | None:
        """Return the map to go on with, None where there is none. Raises InputError, also for a map
        of another camera.
        """
        if self.load is None:
            return None
        saved = read_map_file(self.load)
        check_camera(saved, camera, str(self.load))
        return saved

    def write(self, write: Callable[[Path], object], interrupted: bool, has_map: bool) -> str:
        """Have the map saved where it is to be. Returns, in words, that there is none, or where it
        is if elsewhere: what is interrupted does not replace an older map. Raises MapError where it
        cannot be written; it is in the folder for temporary files then, if it can be written there.
        """
        path = self.save
        if path is None:
            return ''
        if not has_map:
            return f'{path}: is not written, since there is no map'
        if interrupted and path.exists():
            path = path.with_name(f'{path.name}.interrupted')
        try:
            write(path)
        except SegfloorError as error:
            elsewhere = Path(tempfile.mkdtemp(prefix='segfloor-map-'))
            try:
                write(elsewhere / path.name)
            except SegfloorError:
                shutil.rmtree(elsewhere, ignore_errors=True)
                raise MapError(str(error)) from None
            raise MapError(f'{error}; the map is in {elsewhere / path.name}') from None
        return '' if path == self.save else f'{self.save}: stays as it was; the map is in {path}'

    def why_no_map(
        self, name: str, frames: int, lost: Iterable[str], has_mount: bool, fault: str
    ) -> str:
        """Return why a recording gave no map. lost: the states of the frames that were not tracked.
        fault: what keyframes failed with on their way to the map, if they did.
        """
        if frames == 0:
            return f'{name}: no frame could be read, so there is no map'
        if self.load is not None:
            return (
                f'{name}: in none of {frames} frames was a place of {self.load} recognised; is it '
                'a map of this building?'
            )
        for state, count in Counter(lost).most_common(1):
            if count > MAJORITY * frames:
                return f'{name}: {count} of {frames} frames {state}; so there is no map'
        if not has_mount:
            return (
                f'{name}: no level floor was recognised in {frames} frames, so there is no map; '
                'give stereo_slam.camera_height_m, camera_pitch_rad and camera_roll_rad, or take '
                '--no-map for the path alone'
            )
        if fault:
            return f'{name}: no keyframe came to the map: {fault}'
        return f'{name}: none of {frames} frames could be tracked, so there is no map'


NO_MAPS = MapOptions()


MOST_AT_BEGIN = 3 * SETTLED_FRAMES
"""Two cameras that are no rig show it by then; later it is a fault like others."""


class LockstepRun:
    """One run of a source through the pipeline, with everything noted that the results folder
    needs. interrupted: ends the drive after the frame at which it is set. path_only: no map is
    made, nor floor masks. watcher: sees the drive while it is under way. network:
    looks at its images.

    note: what there is to say about the map that was to be saved. broken_off: why the recording
    could not be read to its end. no_map: why only a path came of the drive.
    """

    def __init__(
        self,
        source: StereoSource,
        configuration: Configuration,
        folder: results_folder.OutputFolder,
        save_masks: SaveMasks = SaveMasks.keyframes,
        save_debug: bool = False,
        map_options: MapOptions = NO_MAPS,
        interrupted: threading.Event | None = None,
        path_only: bool = False,
        watcher: Watcher | None = None,
        network: Network | None = None,
    ) -> None:
        self._watcher = watcher
        self._source = source
        self._configuration = configuration
        self._folder = folder
        self._save_masks = save_masks
        self._save_debug = save_debug
        self._memory = MemoryLog()
        times = StageTimes()
        self._labeller = None if network is None else ImageLabeller(network, times)
        self._pipeline = make_pipeline(
            source.camera, configuration, self._on_keyframe, path_only, self._labeller, times
        )
        # Other frames are masked by a segmentation of their own, of which the map does not hear.
        self._other_frames = FloorSegmentation(source.camera, configuration.floor_segmentation)
        self.note = self.no_map = ''
        self.broken_off: SegfloorError | None = None
        self._interrupted = interrupted or threading.Event()
        self._map_options = map_options
        loaded = map_options.read(source.camera)
        if loaded is not None:
            load_pipeline(self._pipeline, loaded, str(map_options.load), map_options.localize)
        self._unmasked: dict[int, StereoFrame] = {}
        self._results: list[FrameResult] = []
        self._failed_frames = 0
        self._said: dict[str, str] = {}
        self._faults_said: dict[str, InputFault] = {}
        self._loop_times_s: list[float] = []
        self._frames = 0
        self._path = KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))

    def execute(self, on_progress: ProgressListener | None = None) -> results_folder.RunResult:
        """Process every frame and return the result; an interrupt or a recording that breaks off
        ends the run early and keeps the map.

        Raises MapError when no path came of it, or what the recording broke off with.
        """
        start = time.perf_counter()
        try:
            self._process_frames(on_progress)
            self._say_faults()
            for result in self._attempt(self._frames, self._pipeline.finish_tracking) or []:
                self._note(result)
            self._leave_out_unmapped()
            grid = self._pipeline.finish()
            self._say_faults()
        finally:
            self._pipeline.close()
        wall_s = time.perf_counter() - start
        self._results.sort(key=lambda result: result.index)
        stages = self._pipeline.keyframe_stages
        mount, labelled, poses = self._pipeline.mount, stages.labelled, self._tracked_poses()
        if mount is None or labelled is None or not poses:
            raise self.broken_off or MapError(self._why_no_map())
        path = self._path
        if grid is None:
            self.no_map = self._why_no_map()
        return results_folder.RunResult(
            grid,
            corrected_trajectory(poses, path),
            Trajectory(path.stamp_ns, path.T_map_base),
            labelled,
            mount,
            self._summary(wall_s, grid is not None),
            self._configuration,
            _labels(stages, grid),
        )

    def _leave_out_unmapped(self) -> None:
        """Leave out what was mapped before the map began: a larger submap took its place."""
        if self._map_options.load is None and len(self._path.stamp_ns):
            began = self._path.stamp_ns[0]
            self._results = [
                left_out(r) if r.tracked and r.stamp_ns < began else r for r in self._results
            ]

    @property
    def _known_mount(self) -> Mount | None:
        mount = self._pipeline.mount
        return None if mount is CAMERA_AS_BASE else mount

    @property
    def _is_cut_short(self) -> bool:
        return self._interrupted.is_set() or self.broken_off is not None

    def save_map(self) -> None:
        """Save the map, after `execute`. Raises MapError where it cannot be written there."""
        maps = self._map_options

        def write(path: Path) -> None:
            write_map_file(path, save_pipeline(self._pipeline), (maps.load, *maps.inputs))

        self.note = maps.write(write, self._is_cut_short, not self.no_map)

    def _tracked_poses(self) -> list[TrackedPose]:
        return [
            TrackedPose(
                result.stamp_ns,
                result.T_odom_base,
                result.reference_keyframe_ns,
                result.T_map_odom @ result.T_odom_base,
            )
            for result in self._results
            if result.tracked
        ]

    def _process_frames(self, on_progress: ProgressListener | None) -> None:
        measurements = MeasurementLog(self._source.sensors)
        try:
            for frame in self._masked_frames():
                self._frames += 1
                slam = self._pipeline.slam
                for measurement in measurements.until(frame.stamp_ns + slam.sensors.lag_ns):
                    slam.add(measurement)
                if self._save_masks is SaveMasks.all:
                    self._unmasked[frame.index] = frame
                results = self._attempt(frame.index, partial(self._pipeline.process, frame))
                results = [lost_frame(frame)] if results is None else results
                for result in results:
                    self._note(result)
                new_loops = slam.back_end.loop_count - len(self._loop_times_s)
                self._loop_times_s += [round(1e-9 * frame.stamp_ns, 6)] * new_loops
                if self._watcher is not None:
                    self._watcher.on_frame(frame, results, self._pipeline)
                if self._frames >= SETTLED_FRAMES:
                    self._say_faults()
                if on_progress is not None:
                    state = self._results[-1].state if self._results else 'looking for the floor'
                    on_progress(self._frames, state)
                if self._interrupted.is_set():
                    return
        except SegfloorError as error:
            if not self._frames or 'no_rig' in self._pipeline.slam.rig_check.faults:
                raise
            self.broken_off = error

    def _masked_frames(self) -> Iterator[StereoFrame]:
        """Yield the frames; where there is a network, it looks at them on a thread of its own."""
        labeller = self._labeller
        self._source.takes_colour = labeller is not None and labeller.sees_colours
        frames = self._source.frames()
        return frames if labeller is None else prefetched(labeller.with_masks(frames))

    def _say_faults(self) -> None:
        faults = self._pipeline.slam.rig_check.faults
        is_early = self._frames <= MOST_AT_BEGIN
        if 'no_rig' in faults and is_early:
            name = self._configuration.stereo_camera.input
            raise InputError(f'{name}: {faults["no_rig"].line()}')
        lines = {name: fault.line() for name, fault in faults.items()}
        lines |= self._pipeline.keyframe_stages.floor.remarks
        mount = self._known_mount
        is_given = self._configuration.stereo_slam.has_mount or not self._source.takes_depth
        if mount is not None and mount.height_m < LOW_M and not is_given:
            lines.setdefault(
                'depth_scale',
                f'by its depths the camera is {mount.height_m:.2f} m above the floor; if it is '
                'higher, set stereo_camera.depth_scale to the metres of one unit of depth',
            )
        self._faults_said = faults | self._faults_said
        for name in sorted(lines.keys() - self._said.keys()):
            self._said[name] = lines[name]
            logger.warning('%s: %s', self._configuration.stereo_camera.input, lines[name])

    def _attempt(self, index: int, step: Callable[[], T]) -> T | None:
        """Return what a step returns, None where it fails at what a frame shows: that one is lost,
        the drive goes on.
        """
        try:
            return step()
        except SegfloorError:
            raise
        except Exception as error:
            self._failed_frames += 1
            logger.warning('frame %d failed: %s: %s', index, type(error).__name__, error)
            logger.debug('where it failed:', exc_info=error)
            return None

    def _note(self, result: FrameResult) -> None:
        if self._save_masks is SaveMasks.all:
            frame = self._pipeline.slam.rig_check.corrected(self._unmasked[result.index])
            self._attempt(frame.index, partial(self._mask_frame, frame, result))
            if not self._pipeline.slam.rig.mount_may_change:
                self._unmasked = {
                    i: later for i, later in self._unmasked.items() if i > result.index
                }
        if result.keyframe is not None:
            moving = result.keyframe.moving
            if self._save_masks is not SaveMasks.none and moving is not None and moving.any():
                self._folder.add_picture('moving_masks', f'{result.index:06d}', moving)
            self._path = new_keyframes(result.keyframe.path)
            result = dataclasses.replace(result, keyframe=None)
        if self._results and result.index <= self._results[-1].index:
            self._results = [one for one in self._results if one.index < result.index]
        self._results.append(result)

    def _mask_frame(self, frame: StereoFrame, result: FrameResult) -> None:
        if result.keyframe is not None or self._known_mount is None:
            return
        T_map_base = result.T_map_odom @ result.T_odom_base if result.tracked else None
        labeller = self._labeller
        said = None if labeller is None else labeller.says(frame.stamp_ns, frame.left)
        floor = self._other_frames.process(
            frame.left, frame.right, self._known_mount, T_map_base, said=said
        )
        self._folder.add_picture('floor_masks', f'{frame.index:06d}', floor.mask)

    def _on_keyframe(self, keyframe: Keyframe, floor: FloorObservation) -> None:
        self._memory.sample()
        number = f'{keyframe.frame_index:06d}'
        if self._save_masks is not SaveMasks.none:
            self._folder.add_picture('floor_masks', number, floor.mask)
        if self._save_debug:
            overlay, histogram = mask_overlay(keyframe.left, floor.mask), v_disparity_picture(floor)
            self._folder.add_picture('floor_debug', f'{number}_overlay', overlay)
            self._folder.add_picture('floor_debug', f'{number}_v_disparity', histogram)
        if self._watcher is not None:
            self._watcher.on_keyframe(keyframe, floor, self._pipeline)

    def _why_no_map(self) -> str:
        name = self._configuration.stereo_camera.input
        states = [result.state for result in self._results if not result.tracked]
        return self._map_options.why_no_map(
            name, self._frames, states, self._known_mount is not None, self._pipeline.fault
        )

    def _sensors_used(self) -> dict[str, int]:
        """Return the messages used of each sensor besides the stereo images."""
        counts = self._pipeline.slam.sensors.messages
        return {
            sensor.name: counts.get(sensor.name, self._frames)
            for sensor in self._source.sensors
            if sensor.used
        }

    def _summary(self, wall_s: float, has_map: bool) -> results_folder.RunSummary:
        slam, pipeline, stages = self._pipeline.slam, self._pipeline, self._pipeline.keyframe_stages
        # Figures that have changed since they were printed stay as printed.
        of_floor = [self._said.get(about, words) for about, words in stages.floor.remarks.items()]
        faults = slam.rig_check.faults
        faults.update({name: self._faults_said.get(name, one) for name, one in faults.items()})
        planes = np.reshape(stages.floor.fixture.planes, (-1, 3))
        # Those of a map that was loaded come before all stamps.
        looks = sum(keyframe.stamp_ns >= 0 for keyframe in slam.map.keyframes)
        floor = results_folder.floor_heights(planes[:, 2], looks) if has_map else None
        return results_folder.summarise(
            [results_folder.DriveFrame.of(result) for result in self._results],
            wall_s,
            self._known_mount,
            has_map,
            skipped_frames=self._source.skipped_frames,
            keyframes=len(slam.map.keyframes),
            loop_times_s=self._loop_times_s,
            map_updates=stages.map_updates,
            sensors=self._sensors_used(),
            sensor_remarks=[*slam.sensors.remarks.values(), *stages.semantics.remarks, *of_floor],
            input_faults=slam.rig_check.as_dicts(),
            failed_frames=self._failed_frames,
            failed_keyframes=pipeline.failed_keyframes,
            floor=floor,
            interrupted=self._is_cut_short,
            stages=pipeline.times.summary(),
            rss_mb=self._memory.summary(),
        )


def lost_frame(frame: StereoFrame) -> FrameResult:
    """Return the outcome of a frame that nothing came of."""
    nowhere = np.eye(4)
    unknown = np.eye(6) * UNKNOWN_COVARIANCE
    return FrameResult(
        frame.index, frame.stamp_ns, False, nowhere, nowhere, unknown, 0, 'lost: failed', 0
    )


def _labels(stages: KeyframeStages, grid: OccupancyGrid | None) -> Labels | None:
    """Return the labels of the map, None where no network has looked at it."""
    semantics = stages.semantics
    if not isinstance(semantics, SemanticMap) or stages.labelled is None:
        return None
    return semantics.labels(grid, stages.path, stages.labelled.point_id)
