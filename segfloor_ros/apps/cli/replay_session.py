"""A recording through the five node processes: to the same results as a lockstep run, or to what
the processes cost and how long an image takes to the map.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from segfloor_ros.apps.cli.replay_nodes import (
    STALL_S,
    NodeGraph,
    NodeProcesses,
    ReplayError,
    running_nodes,
)
from segfloor_ros.apps.cli.replay_recorder import POINTS, MaskListener, ReplayRecorder, ViewNode
from segfloor_ros.apps.cli.view import View
from segfloor_ros.apps.label_files import labels_of
from segfloor_ros.apps.lockstep import NO_MAPS, MapOptions, ProgressListener
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.results_folder import RunResult, summarise
from segfloor_ros.apps.trajectory import Trajectory, corrected_trajectory
from segfloor_ros.core.camera.recording import DEPTH
from segfloor_ros.core.camera.settings import SENSORS
from segfloor_ros.core.cloud import CloudLabelling
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import KeyframePath, LabelledPoints
from segfloor_ros.core.errors import InputError, MapError, SegfloorError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.memory import rss_mb
from segfloor_ros.core.plugins.maps.saved_slam import loaded_map, new_keyframes
from segfloor_ros.core.processes import Interrupt
from segfloor_ros.nodes.messages.diagnostics import HEALTH_PERIOD_S, Level, Status
from segfloor_ros.nodes.messages.grids import grid_of
from segfloor_ros.nodes.messages.points import labelled_arrays, sparse_cloud_arrays
from segfloor_ros.nodes.messages.topics import CAMERA, GRID, MASKS, NODES, SLAM
from segfloor_ros.nodes.network_files import read_network_settings

logger = logging.getLogger(__name__)

MAP_FILE = 'map.yaml'

TICKS_PER_S = os.sysconf('SC_CLK_TCK')


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

    interrupt: ends it early. loaded: the map that `maps` names to go on with. path_only: no map is
    made, nor floor masks. network: of `segfloor_masks`, if that runs, too.
    """

    configuration: Configuration
    params_file: Path | None
    rate: float
    on_mask: MaskListener | None
    on_progress: ProgressListener
    interrupt: Interrupt
    maps: MapOptions = NO_MAPS
    loaded: MapFile | None = None
    path_only: bool = False
    view: View | None = None
    network: Path | None = None

    def execute(self) -> tuple[RunResult, ReplayReport]:
        """Run the replay. An interrupt, a node that dies or a recording that breaks off ends it
        early and keeps the map.

        Where no map came of it raises ReplayError naming the node that died or what is stuck,
        InputError when the recording broke off, else MapError.
        """
        nodes = (CAMERA, SLAM) if self.path_only else NODES
        nodes = nodes if self.network is None else (*nodes, MASKS)
        with running_nodes(self._parameters, self.params_file, self.on_mask, nodes) as graph:
            if self.view is not None:
                graph.add(ViewNode(graph.recorder.context, self.view))
            return self._follow(graph)

    def _parameters(self, folder: Path) -> dict[str, Any]:
        """Return the parameters as resolved. What only the nodes have (frames, rates) comes from
        the user's file.
        """
        nodes: dict[str, dict[str, Any]] = {node: {'resume_within_s': 0.0} for node in NODES}
        nodes[CAMERA] |= {
            'rate': float(self.rate),
            'lossless': True,
            'start_paused': True,
            'image_transport': 'raw',
        }
        nodes[SLAM] |= {
            'background': False,
            'image_transport': 'raw',
            'tf_wait_s': 0.0,
            'localize': self.maps.localize,
            'use_depth': self.configuration.stereo_camera.depth,
            'path_only': self.path_only,
        }
        if self.maps.load is not None:
            nodes[SLAM]['load_map'] = str(self.maps.load.absolute())
        nodes[GRID]['map_file'] = str(folder / MAP_FILE)
        if self.network is not None:
            nodes[MASKS] = {'network': str(self.network.absolute()), 'resume_within_s': 0.0}
        return self.configuration.as_ros_parameters(**nodes)

    def _follow(self, graph: NodeGraph) -> tuple[RunResult, ReplayReport]:
        discovery_s = graph.connect(interrupted=self.interrupt)
        start_s, recorder = time.perf_counter(), graph.recorder
        broken, is_whole = self._play(graph)
        wall_s = time.perf_counter() - start_s
        try:
            self._check_result(recorder, broken)
        except SegfloorError:
            for fault in recorder.notes.input_faults:  # they may be why
                what = '{fault}, {value} {unit}; {remedy}'.format(**fault)
                logger.warning('%s: %s', self.configuration.stereo_camera.input, what)
            raise
        grid = None
        if not self.path_only:
            try:
                graph.wait_for_map()
                graph.call(Trigger, 'save_map', Trigger.Request())
                grid = load_map(graph.folder / MAP_FILE)
            except (ReplayError, InputError) as error:
                broken = broken or error
                if 'map' not in recorder.latest:
                    raise broken from None
                grid = grid_of(recorder.latest['map'])
        result = self._result(recorder, grid, wall_s, is_whole and broken is None)
        if self.network is not None and grid is not None:
            numbers = graph.wait_for_labels()
            if numbers is not None and numbers.cells.shape == grid.cells.shape:
                classes = read_network_settings(self.network.with_suffix('.yaml')).classes
                result = dataclasses.replace(result, labels=labels_of(numbers, classes))
        notices, status = [], 0 if broken is None else 1 if isinstance(broken, MapError) else 2
        try:
            notes = self._save_map(graph, result.summary.interrupted)
        except MapError as error:
            notes, status = str(error), status or 1
        shutdown_s = graph.processes.stop()
        if broken is not None:
            notices.append(f'{broken}; the {"map" if grid else "path"} is of what came before')
        report = ReplayReport(
            discovery_s,
            shutdown_s,
            len(recorder.notes.failed),
            [*graph.processes.notices(), *([notes] if notes else []), *notices],
            status,
        )
        return result, report

    def _play(self, graph: NodeGraph) -> tuple[SegfloorError | None, bool]:
        """Play the recording; returns what it broke off with, and whether it came to its end."""
        try:
            graph.pause(CAMERA, False)
            if not graph.play(self.on_progress, self.interrupt):
                graph.pause(CAMERA, True)
                graph.catch_up()
                return None, False
        except ReplayError as error:
            return error, False
        finished = graph.recorder.notes.finished
        if finished is not None and finished.level is Level.ERROR:
            return InputError(finished.message), False
        return None, True

    def _save_map(self, graph: NodeGraph, interrupted: bool) -> str:
        """Save the map; returns where it is where that is elsewhere, or why it is not saved, else
        ''. Raises MapError.
        """

        def write(path: Path) -> None:
            name = Parameter('save_map', value=str(path.absolute())).to_parameter_msg()
            request = SetParameters.Request(parameters=[name])
            graph.ask(SetParameters, f'{SLAM}/set_parameters', request)
            graph.call(Trigger, f'{SLAM}/save_map', Trigger.Request(), STALL_S)

        return self.maps.write(write, interrupted, not self.path_only)

    def _check_result(self, recorder: ReplayRecorder, broken: SegfloorError | None) -> None:
        notes = recorder.notes
        found = notes.flagged('tracked') if self.path_only else notes.updated
        if recorder.tracked if self.loaded is not None else recorder.mount and found:
            return
        has_mount = self.configuration.stereo_slam.has_mount or recorder.mount is not None
        name, frames = self.configuration.stereo_camera.input, len(notes.frame_index)
        answers, failed = notes.answers.values(), notes.failed.values()
        lost = [status.message for status in answers if status.values.get('tracked') == '0']
        fault = next((status.message for status in failed), '')
        raise broken or MapError(self.maps.why_no_map(name, frames, lost, has_mount, fault))

    def _result(
        self, recorder: ReplayRecorder, grid: OccupancyGrid | None, wall_s: float, is_whole: bool
    ) -> RunResult:
        mount, notes = recorder.mount, recorder.notes
        assert mount is not None
        path = recorder.path or KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        count = len(path.stamp_ns)
        if recorder.path is None and self.loaded is not None:
            count = len(loaded_map(self.loaded, 0).path.stamp_ns)
        path = new_keyframes(path)
        is_known = not self.path_only or self.configuration.stereo_slam.has_mount
        summary = summarise(
            notes.frames(),
            wall_s,
            mount if is_known else None,
            grid is not None,
            skipped_frames=int(notes.finished.values['skipped']) if notes.finished else 0,
            keyframes=count,
            loop_times_s=notes.loop_times_s,
            map_updates=len(notes.updated),
            sensors=_sensors_sent(notes.finished),
            sensor_remarks=notes.remarks,
            input_faults=notes.input_faults,
            failed_frames=notes.failed_frames,
            failed_keyframes=len(notes.failed),
            floor=None,  # the nodes do not publish the planes of keyframes
            interrupted=not is_whole,
            stages=notes.times.summary(),
            rss_mb=notes.memory.summary(),
        )
        return RunResult(
            grid,
            corrected_trajectory(recorder.tracked, path),
            Trajectory(path.stamp_ns, path.T_map_base),
            self._labelled(recorder),
            mount,
            summary,
            self.configuration,
        )

    def _labelled(self, recorder: ReplayRecorder) -> LabelledPoints:
        """Return the points of the map with what is known of their labels."""
        if 'labelled_points' in recorder.latest:
            return labelled_arrays(recorder.latest['labelled_points'], 'labelled_points')
        labelling = CloudLabelling(self.configuration.cloud_labelling)
        if self.loaded is not None:
            labelling.from_arrays(self.loaded.parts['cloud'])
        if POINTS in recorder.latest:
            return labelling.labelled(sparse_cloud_arrays(recorder.latest[POINTS], POINTS))
        assert self.loaded is not None
        return labelling.labelled(loaded_map(self.loaded, 0).cloud)


def _sensors_sent(finished: Status | None) -> dict[str, int]:
    """Return the messages of each sensor besides the images, as the camera says at the end."""
    values = {} if finished is None else finished.values
    return {name: int(values[name]) for name in (*SENSORS, DEPTH) if name in values}


@dataclass(frozen=True)
class NodeFigures:
    """latency_s: (K,) from a keyframe's images to the map that holds it, in the order of the
    keyframes; odometry_s: (N,) from a frame's images to its odometry. steps_s: (K,) the part of the
    former until a node had done its work, since the node before had, by node. cpu_share: seconds of
    CPU per second, by node. memory_mb: (T, 1 + nodes), the number of frames so far and the resident
    memory of every node, over time.
    """

    frames_sent: int
    frames_processed: int
    frames_skipped: int
    keyframes: int
    mapped: int
    wall_s: float
    latency_s: NDArray[np.float64]
    odometry_s: NDArray[np.float64]
    steps_s: dict[str, NDArray[np.float64]]
    cpu_share: dict[str, float]
    memory_mb: NDArray[np.float64]
    shutdown_s: float


def measure_nodes(
    configuration: Configuration, rate: float, lossless: bool, on_progress: ProgressListener
) -> NodeFigures:
    """Play the recording of the configuration through the nodes. Raises ReplayError."""
    with connected_nodes(configuration, rate, lossless) as graph:
        return _follow(graph, on_progress)


@contextlib.contextmanager
def connected_nodes(
    configuration: Configuration, rate: float, lossless: bool
) -> Iterator[NodeGraph]:
    """The five nodes in a graph of their own, connected, with the camera paused. Raises
    ReplayError.
    """
    playing = {'rate': rate, 'lossless': lossless, 'start_paused': True}
    # Else it is this period that is measured.
    at_once = {'publish_period_s': 0.0}
    parameters = configuration.as_ros_parameters(**{CAMERA: playing, GRID: at_once})
    with running_nodes(lambda _folder: parameters) as graph:
        # A camera that keeps to the clock does not listen to the nodes.
        graph.connect(is_paced=lossless)
        yield graph


def _follow(graph: NodeGraph, on_progress: ProgressListener) -> NodeFigures:
    recorder, notes = graph.recorder, graph.recorder.notes
    memory: list[list[float]] = []

    def follow(done: int, words: str) -> None:
        if time.monotonic() > start_s + (1 + len(memory)) * HEALTH_PERIOD_S:
            mb = [rss_mb(process_id) for process_id in graph.processes.process_ids.values()]
            memory.append([done, *mb])
        on_progress(done, words)

    start_s, before_s = time.monotonic(), cpu_s(graph.processes)
    graph.pause(CAMERA, False)
    try:
        graph.play(follow, threading.Event())
    except ReplayError:
        # Frames that were lost never come; that is a figure, unless a node has died.
        graph.processes.check()
    wall_s = time.monotonic() - start_s
    spent_s = {node: s - before_s[node] for node, s in cpu_s(graph.processes).items()}
    graph.spin(2 * HEALTH_PERIOD_S)
    shutdown_s = graph.processes.stop()
    arrived_s, sent_s = recorder.arrived_s, notes.done_s[CAMERA]
    mapped = sorted(set(arrived_s['map']).intersection(*notes.done_s.values()))
    done_s = np.array([[notes.done_s[node][stamp] for stamp in mapped] for node in NODES])
    path = recorder.path
    return NodeFigures(
        frames_sent=int(notes.finished.values['frames']) if notes.finished is not None else 0,
        frames_processed=notes.count(SLAM, 'processed'),
        frames_skipped=notes.count(SLAM, 'skipped'),
        keyframes=len(path.stamp_ns) if path is not None else 0,
        mapped=notes.count(GRID, 'processed'),
        wall_s=wall_s,
        latency_s=_between_s(sent_s, arrived_s['map']),
        odometry_s=_between_s(sent_s, arrived_s['odometry']),
        steps_s=dict(zip(NODES[1:], np.diff(done_s, axis=0), strict=True)),
        cpu_share={node: seconds / wall_s for node, seconds in spent_s.items()},
        memory_mb=np.array(memory),
        shutdown_s=shutdown_s,
    )


def _between_s(sent_s: Mapping[int, float], arrived_s: Mapping[int, float]) -> NDArray[np.float64]:
    """Return how long each stamp that has come took, in order."""
    both = sorted(sent_s.keys() & arrived_s.keys())
    return np.array([arrived_s[stamp] - sent_s[stamp] for stamp in both])


def cpu_s(processes: NodeProcesses) -> dict[str, float]:
    """Return the CPU time every node has used, all threads, user and system (proc(5))."""
    used = {}
    for node, process_id in processes.process_ids.items():
        fields = Path(f'/proc/{process_id}/stat').read_text().rpartition(')')[2].split()
        used[node] = (int(fields[11]) + int(fields[12])) / TICKS_PER_S
    return used


def figure_rows(figures: NodeFigures) -> list[tuple[str, str]]:
    """Return names and values of the figures, with units; of a course, its second and its last
    quarter.
    """
    rows = [
        ('frames sent, processed', f'{figures.frames_sent}, {figures.frames_processed}'),
        ('frames skipped to stay up to date', f'{figures.frames_skipped}'),
        ('keyframes, in the map', f'{figures.keyframes}, {figures.mapped}'),
        ('frames per second', f'{figures.frames_processed / figures.wall_s:.1f}'),
        ('interrupt to all ended', f'{figures.shutdown_s:.2f} s'),
    ]
    spreads = {'image to odometry': figures.odometry_s, 'image to map': figures.latency_s}
    spreads |= {f'until {node} had done': steps_s for node, steps_s in figures.steps_s.items()}
    for name, duration_s in spreads.items():
        if len(duration_s):
            middle, high = 1e3 * np.percentile(duration_s, (50, 95))
            rows.append((f'{name}, median and p95', f'{middle:.0f} ms, {high:.0f} ms'))
    if len(figures.latency_s):
        early, late = (
            1e3 * np.median(part) for part in _second_and_last_quarter(figures.latency_s)
        )
        rows.append(('image to map, 2nd and last quarter', f'{early:.0f} ms, {late:.0f} ms'))
    for column, (node, share) in enumerate(figures.cpu_share.items(), 1):
        rows.append((f'{node}: CPU', f'{100 * share:.0f} % of a core'))
        if len(figures.memory_mb):
            parts = _second_and_last_quarter(figures.memory_mb[:, column])
            early, late = (np.median(part) for part in parts)
            rows.append((f'{node}: memory, 2nd and last quarter', f'{early:.1f} MB, {late:.1f} MB'))
    return rows


def _second_and_last_quarter(course: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two parts of a course (N,) to compare; in the first quarter caches fill."""
    quarter = max(len(course) // 4, 1)
    return course[quarter : 2 * quarter] if len(course) > 1 else course, course[-quarter:]
