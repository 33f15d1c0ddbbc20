"""A recording through the five node processes, to the same results as a lockstep run."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.camera.model import SENSORS
from segfloor_ros.cli.replay_nodes import NodeGraph, running_nodes
from segfloor_ros.cli.replay_processes import NodeProcesses, ReplayError
from segfloor_ros.cli.replay_recorder import MaskListener, ReplayRecorder
from segfloor_ros.cloud.labelled_cloud import CloudLabelling, LabelledPoints
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import InputError, MapError, SegfloorError
from segfloor_ros.grid.map_file import OccupancyGrid, load_map
from segfloor_ros.lockstep import NO_MAPS, MapOptions, ProgressListener, no_floor
from segfloor_ros.map_file import MapFile
from segfloor_ros.measurements import DEPTH
from segfloor_ros.messages.diagnostics import Level, Status
from segfloor_ros.messages.maps import grid_of
from segfloor_ros.messages.topics import CAMERA, GRID, NODES, SLAM
from segfloor_ros.processes import Interrupt
from segfloor_ros.results_folder import (
    MAP,
    RunResult,
    RunSummary,
    lost_intervals,
    mount_figures,
    relocalisations,
    submap_intervals,
)
from segfloor_ros.slam.results import KeyframePath
from segfloor_ros.slam.saved_slam import loaded_map, new_keyframes
from segfloor_ros.trajectory import Trajectory, corrected_trajectory

logger = logging.getLogger(__name__)

SAVE_S = 120.0
MAP_FILE = 'map.yaml'

ReplayGraph = NodeGraph[ReplayRecorder]


@dataclass(frozen=True)
class ReplayReport:
    """What there is to say beside the results. failed_keyframes: how many did not reach the map
    because a node failed on them. notices: warnings of the nodes, and what could not be done.
    status: to end with where it broke off, else 0.
    """

    discovery_s: float
    shutdown_s: float
    failed_keyframes: int
    notices: list[str]
    status: int


@dataclass(frozen=True)
class ReplaySession:
    """One replay: starts the nodes in a graph of their own, follows them, and stops them.

    interrupt: ends it early. loaded: the map that `maps` names to go on with.
    """

    configuration: Configuration
    params_file: Path | None
    rate: float
    on_mask: MaskListener | None
    on_progress: ProgressListener
    interrupt: Interrupt
    maps: MapOptions = NO_MAPS
    loaded: MapFile | None = None

    def execute(self) -> tuple[RunResult, ReplayReport]:
        """Run the replay. An interrupt, a node that dies or a recording that breaks off ends it
        early and keeps the map.

        Where no map came of it raises ReplayError naming the node that died or what is stuck,
        InputError when the recording broke off, else MapError.
        """

        def listen(context: Context, processes: NodeProcesses) -> ReplayRecorder:
            return ReplayRecorder(context, processes.rss_mb, self.on_mask)

        with running_nodes(self._parameters, listen, self.params_file) as graph:
            return self._follow(graph)

    def _parameters(self, folder: Path) -> dict[str, Any]:
        """Return the parameters as resolved. What only the nodes have (frames, rates) comes from
        the user's file.
        """
        parameters = self.configuration.as_ros_parameters()
        playing = {
            'rate': float(self.rate),
            'lossless': True,
            'start_paused': True,
            'image_transport': 'raw',
        }
        parameters[CAMERA]['ros__parameters'].update(playing)
        for node in NODES:
            parameters[node]['ros__parameters'].update(resume_within_s=0.0)
        parameters[SLAM]['ros__parameters'].update(
            background=False,
            image_transport='raw',
            tf_wait_s=0.0,
            localize=self.maps.localize,
            use_depth=self.configuration.stereo_camera.depth,
        )
        if self.maps.load is not None:
            parameters[SLAM]['ros__parameters']['load_map'] = str(self.maps.load.absolute())
        parameters[GRID]['ros__parameters'].update(map_file=str(folder / MAP_FILE))
        return parameters

    def _follow(self, graph: ReplayGraph) -> tuple[RunResult, ReplayReport]:
        discovery_s = graph.connect(interrupted=self.interrupt)
        start_s, recorder = time.perf_counter(), graph.recorder
        broken, is_whole = self._play(graph)
        wall_s = time.perf_counter() - start_s
        try:
            self._check_result(recorder, broken)
        except SegfloorError:
            for fault in recorder.input_faults:  # they may be why
                what = '{fault}, {value} {unit}; {remedy}'.format(**fault)
                logger.warning('%s: %s', self.configuration.stereo_camera.input, what)
            raise
        try:
            graph.wait_for_map()
            graph.call(Trigger, 'save_map', Trigger.Request())
            grid = load_map(graph.folder / MAP_FILE)
        except (ReplayError, InputError) as error:
            broken = broken or error
            if recorder.grid is None:
                raise broken from None
            grid = grid_of(recorder.grid)
        result = self._result(recorder, grid, wall_s, is_whole and broken is None)
        notices, status = [], 0 if broken is None else 1 if isinstance(broken, MapError) else 2
        try:
            notices += self._save_map(graph, result.summary.interrupted)
        except MapError as error:
            notices.append(str(error))
            status = status or 1
        stop_s = time.perf_counter()
        graph.processes.stop()
        shutdown_s = time.perf_counter() - stop_s
        if broken is not None:
            notices.append(f'{broken}; the map is of what came before')
        report = ReplayReport(
            discovery_s,
            shutdown_s,
            len(recorder.failed),
            [*graph.processes.notices(), *notices],
            status,
        )
        return result, report

    def _play(self, graph: ReplayGraph) -> tuple[SegfloorError | None, bool]:
        """Play the recording; returns what it broke off with, and whether it came to its end."""
        try:
            graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=False))
            if not graph.play(self.on_progress, self.interrupt):
                graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=True))
                graph.catch_up()
                return None, False
        except ReplayError as error:
            return error, False
        finished = graph.recorder.finished
        if finished is not None and finished.level is Level.ERROR:
            return InputError(finished.message), False
        return None, True

    def _save_map(self, graph: ReplayGraph, interrupted: bool) -> list[str]:
        """Save the map; returns where it is where that is elsewhere, or why it is not saved where
        the one that was loaded stays as it is. Raises MapError.
        """
        if self.maps.save is None:
            return []

        def write(path: Path) -> None:
            name = Parameter('save_map', value=str(path.absolute())).to_parameter_msg()
            request = SetParameters.Request(parameters=[name])
            graph.ask(SetParameters, f'{SLAM}/set_parameters', request)
            graph.call(Trigger, f'{SLAM}/save_map', Trigger.Request(), SAVE_S)

        if self.maps.load is not None and self.maps.save.resolve() == self.maps.load.resolve():
            try:
                write(self.maps.save)
            except ReplayError as error:
                return [str(error)]
            return []
        note = self.maps.write(write, interrupted)
        return [note] if note else []

    def _check_result(self, recorder: ReplayRecorder, broken: SegfloorError | None) -> None:
        name, sent = self.configuration.stereo_camera.input, len(recorder.frame_index)
        if self.loaded is not None:
            if not recorder.tracked:
                raise broken or MapError(self.maps.why_not_found(name, sent))
            return
        if recorder.mount is None:
            raise broken or MapError(no_floor(name, sent))
        if not recorder.updated:
            words = next((s.message for s in recorder.failed.values()), 'none could be tracked')
            raise broken or MapError(f'{name}: no map came of {sent} frames: {words}')

    def _result(
        self, recorder: ReplayRecorder, grid: OccupancyGrid, wall_s: float, is_whole: bool
    ) -> RunResult:
        mount, labelled = recorder.mount, recorder.labelled or self._loaded_cloud()
        assert mount is not None and labelled is not None
        path = recorder.path or KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        path = new_keyframes(path)
        return RunResult(
            grid,
            corrected_trajectory(recorder.tracked, path),
            Trajectory(path.stamp_ns, path.T_map_base),
            labelled,
            mount,
            self._summary(recorder, wall_s, is_whole),
            self.configuration,
        )

    def _loaded_cloud(self) -> LabelledPoints | None:
        """Return the labelled points of the map that was loaded."""
        if self.loaded is None:
            return None
        labelling = CloudLabelling(self.configuration.cloud_labelling)
        labelling.from_arrays(self.loaded.parts['cloud'])
        return labelling.labelled(loaded_map(self.loaded, 0).cloud)

    def _keyframe_count(self, recorder: ReplayRecorder) -> int:
        if recorder.path is not None:
            return len(recorder.path.stamp_ns)
        return 0 if self.loaded is None else len(loaded_map(self.loaded, 0).path.stamp_ns)

    def _summary(self, recorder: ReplayRecorder, wall_s: float, is_whole: bool) -> RunSummary:
        stamps = sorted(recorder.frame_index)
        answers = [recorder.answers.get(stamp) for stamp in stamps]
        tracked = np.array([bool(s and s.values.get('tracked') == '1') for s in answers], bool)
        mount, finished = recorder.mount, recorder.finished
        assert mount is not None
        return RunSummary(
            map=MAP,
            frames=len(stamps),
            tracked_frames=int(tracked.sum()),
            skipped_frames=int(finished.values['skipped']) if finished is not None else 0,
            lost_intervals=lost_intervals([recorder.frame_index[s] for s in stamps], tracked),
            keyframes=self._keyframe_count(recorder),
            loops=recorder.loops,
            relocalisations=relocalisations(stamps, tracked),
            submaps=submap_intervals(
                [recorder.frame_index[s] for s in stamps],
                np.array([bool(s and s.values.get('submap') == '1') for s in answers], bool),
                tracked,
            ),
            map_updates=len(recorder.updated),
            wall_s=round(wall_s, 3),
            frames_per_s=round(len(stamps) / wall_s, 2),
            **mount_figures(mount),
            sensors=_sensors_sent(finished),
            repeated_frames=sum(bool(s and s.values.get('repeated') == '1') for s in answers),
            blind_frames=sum(bool(s and s.values.get('blind') == '1') for s in answers),
            moving_frames=sum(bool(s and int(s.values.get('moving', 0))) for s in answers),
            sensor_remarks=recorder.remarks,
            input_faults=recorder.input_faults,
            failed_frames=sum(_failed(status) for status in answers),
            failed_keyframes=len(recorder.failed),
            interrupted=not is_whole,
            stages=recorder.times.summary(),
            rss_mb=recorder.memory.summary(),
        )


def _failed(status: Status | None) -> bool:
    """Whether SLAM failed at a frame, which is more than not to track it."""
    return status is not None and status.level is Level.ERROR and 'tracked' not in status.values


def _sensors_sent(finished: Status | None) -> dict[str, int]:
    """Return the messages of each sensor besides the images, as the camera says at the end."""
    values = {} if finished is None else finished.values
    return {name: int(values[name]) for name in (*SENSORS, DEPTH) if name in values}
