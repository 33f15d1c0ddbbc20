"""A recording through the five node processes, to the same results as a lockstep run."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.camera.settings import SENSORS
from segfloor_ros.camera.sources.sensor_files import DEPTH
from segfloor_ros.cli.interrupts import first_interrupt_noted
from segfloor_ros.cli.replay_graph import isolated_environment, unconnected
from segfloor_ros.cli.replay_processes import NodeProcesses, ReplayError
from segfloor_ros.cli.replay_recorder import MaskListener, ReplayRecorder
from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.cloud.labels import LabelledPoints
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import InputError, MapError
from segfloor_ros.grid.map_file import load_map
from segfloor_ros.lockstep import NO_MAPS, MapOptions
from segfloor_ros.map_file import MapFile
from segfloor_ros.messages.diagnostics import Level, Status
from segfloor_ros.messages.topics import CAMERA, GRID, NODES, SLAM
from segfloor_ros.results_folder import RunResult, RunSummary, lost_intervals, relocalisations
from segfloor_ros.slam.results import KeyframePath
from segfloor_ros.slam.saved_slam import loaded_map, new_keyframes
from segfloor_ros.trajectory import Trajectory, corrected_trajectory

DISCOVERY_S = 30.0
STALL_S = 60.0
DRAIN_S = 10.0
SERVICE_S = 10.0
SAVE_S = 120.0
SPIN_S = 0.1

ProgressListener = Callable[[int, str], None]
"""Told every now and then: how many frames are done, and the state in words."""


@dataclass(frozen=True)
class ReplayReport:
    """What there is to say beside the results. failed_keyframes: how many did not reach the map
    because a node failed on them. notices: warnings of the nodes.
    """

    discovery_s: float
    shutdown_s: float
    failed_keyframes: int
    notices: list[str]


class ReplaySession:
    """One replay: starts the nodes in a graph of their own, follows them, and stops them."""

    def __init__(
        self,
        configuration: Configuration,
        params_file: Path | None,
        rate: float,
        on_mask: MaskListener | None,
        on_progress: ProgressListener,
        maps: MapOptions = NO_MAPS,
        loaded: MapFile | None = None,
    ) -> None:
        self._maps = maps
        self._loaded = loaded
        self._configuration = configuration
        self._params_file = params_file
        self._rate = rate
        self._on_mask = on_mask
        self._on_progress = on_progress

    def execute(self) -> tuple[RunResult, ReplayReport]:
        """Run the replay; an interrupt (Ctrl-C) ends it early and keeps the map.

        Raises ReplayError naming the node that died or what is stuck, MapError when no map came of
        it, InputError when the recording breaks off.
        """
        environment = isolated_environment()
        # This process takes part in the same graph.
        os.environ.update(environment)
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            with tempfile.TemporaryDirectory(prefix='segfloor-replay-') as folder:
                arguments = self._node_arguments(Path(folder))
                processes = NodeProcesses(NODES, arguments, environment, Path(folder))
                with processes:
                    recorder = ReplayRecorder(context, processes.rss_mb, self._on_mask)
                    recorder.listen_to_map()
                    return self._follow(ReplayGraph(recorder, processes), Path(folder))
        finally:
            rclpy.try_shutdown(context=context)

    def _node_arguments(self, folder: Path) -> list[str]:
        """Write the parameters as resolved and return the arguments of every node. What only the
        nodes have (frames, rates) comes from the user's file.
        """
        parameters = self._configuration.as_ros_parameters()
        playing = {
            'rate': float(self._rate),
            'lossless': True,
            'start_paused': True,
            'image_transport': 'raw',
        }
        parameters[CAMERA]['ros__parameters'].update(playing)
        for node in NODES:
            parameters[node]['ros__parameters'].update(resume_within_s=0.0)
        parameters[SLAM]['ros__parameters'].update(
            background=False, image_transport='raw', tf_wait_s=0.0
        )
        parameters[SLAM]['ros__parameters']['use_depth'] = self._configuration.stereo_camera.depth
        for name, file in (('load_map', self._maps.load), ('save_map', self._maps.save)):
            if file is not None:
                parameters[SLAM]['ros__parameters'][name] = str(file.absolute())
        parameters[SLAM]['ros__parameters'].update(
            localize=self._maps.localize, use_depth=self._configuration.stereo_camera.depth
        )
        parameters[GRID]['ros__parameters'].update(map_file=str(folder / 'map.yaml'))
        resolved = folder / 'parameters.yaml'
        resolved.write_text(yaml.safe_dump(parameters))
        files = [str(file) for file in (self._params_file, resolved) if file is not None]
        options = [word for file in files for word in ('--params-file', file)]
        return ['--ros-args', '--disable-external-lib-logs', *options]

    def _follow(self, graph: ReplayGraph, folder: Path) -> tuple[RunResult, ReplayReport]:
        discovery_s = graph.connect()
        start_s = time.perf_counter()
        graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=False))
        with first_interrupt_noted() as interrupted:
            if not graph.play(self._on_progress, interrupted):
                graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=True))
                graph.catch_up()
        wall_s = time.perf_counter() - start_s
        self._check_result(graph.recorder)
        graph.wait_for_map()
        graph.call(Trigger, 'save_map', Trigger.Request())
        kept_map = self._save_map(graph)
        result = self._result(graph.recorder, folder / 'map.yaml', wall_s)
        stop_s = time.perf_counter()
        graph.processes.stop()
        report = ReplayReport(
            discovery_s,
            time.perf_counter() - stop_s,
            len(graph.recorder.failed),
            [*graph.processes.notices(), *kept_map],
        )
        return result, report

    def _save_map(self, graph: ReplayGraph) -> list[str]:
        """Save the map; returns why it was not, where the one that was loaded stays as it is."""
        if self._maps.save is None:
            return []
        try:
            graph.call(Trigger, f'{SLAM}/save_map', Trigger.Request(), SAVE_S)
        except ReplayError as error:
            if self._maps.load is None or self._maps.save.resolve() != self._maps.load.resolve():
                raise
            return [str(error)]
        return []

    def _check_result(self, recorder: ReplayRecorder) -> None:
        name, sent = self._configuration.stereo_camera.input, len(recorder.frame_index)
        finished = recorder.finished
        if finished is not None and finished.level is Level.ERROR:
            raise InputError(finished.message)
        if self._loaded is not None:
            if not recorder.tracked:
                raise MapError(self._maps.why_not_found(name, sent))
            return
        if recorder.mount is None:
            raise MapError(
                f'{name}: no level floor was recognised in {sent} frames, so the height of the '
                'camera is unknown; give stereo_slam.camera_height_m, camera_pitch_rad and '
                'camera_roll_rad'
            )
        if not recorder.updated:
            words = next((s.message for s in recorder.failed.values()), 'none could be tracked')
            raise MapError(f'{name}: no map came of {sent} frames: {words}')

    def _result(self, recorder: ReplayRecorder, map_file: Path, wall_s: float) -> RunResult:
        mount, labelled = recorder.mount, recorder.labelled or self._loaded_cloud()
        assert mount is not None and labelled is not None
        path = recorder.path or KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        path = new_keyframes(path)
        return RunResult(
            load_map(map_file),
            corrected_trajectory(recorder.tracked, path),
            Trajectory(path.stamp_ns, path.T_map_base),
            labelled,
            mount,
            self._summary(recorder, wall_s),
            self._configuration,
        )

    def _loaded_cloud(self) -> LabelledPoints | None:
        """Return the labelled points of the map that was loaded."""
        if self._loaded is None:
            return None
        labelling = CloudLabelling(self._configuration.cloud_labelling)
        labelling.from_arrays(self._loaded.parts['cloud'])
        return labelling.labelled(loaded_map(self._loaded, 0).cloud)

    def _keyframe_count(self, recorder: ReplayRecorder) -> int:
        if recorder.path is not None:
            return len(recorder.path.stamp_ns)
        return 0 if self._loaded is None else len(loaded_map(self._loaded, 0).path.stamp_ns)

    def _summary(self, recorder: ReplayRecorder, wall_s: float) -> RunSummary:
        stamps = sorted(recorder.frame_index)
        answers = [recorder.answers.get(stamp) for stamp in stamps]
        tracked = np.array([bool(s and s.values.get('tracked') == '1') for s in answers], bool)
        mount, finished = recorder.mount, recorder.finished
        assert mount is not None
        return RunSummary(
            frames=len(stamps),
            tracked_frames=int(tracked.sum()),
            skipped_frames=int(finished.values['skipped']) if finished is not None else 0,
            lost_intervals=lost_intervals([recorder.frame_index[s] for s in stamps], tracked),
            keyframes=self._keyframe_count(recorder),
            loops=recorder.loops,
            relocalisations=relocalisations(stamps, tracked),
            map_updates=len(recorder.updated),
            wall_s=round(wall_s, 3),
            frames_per_s=round(len(stamps) / wall_s, 2),
            camera_height_m=round(mount.height_m, 4),
            camera_pitch_rad=round(mount.pitch_rad, 5),
            camera_roll_rad=round(mount.roll_rad, 5),
            sensors=_sensors_sent(finished),
            blind_frames=sum(bool(s and s.values.get('blind') == '1') for s in answers),
            moving_frames=sum(bool(s and int(s.values.get('moving', 0))) for s in answers),
            sensor_remarks=recorder.remarks,
            stages=recorder.times.summary(),
            rss_mb=recorder.memory.summary(),
        )


def _sensors_sent(finished: Status | None) -> dict[str, int]:
    """Return the messages of each sensor besides the images, as the camera says at the end."""
    values = {} if finished is None else finished.values
    return {name: int(values[name]) for name in (*SENSORS, DEPTH) if name in values}


class ReplayGraph:
    """The running nodes and the one that listens to them."""

    def __init__(self, recorder: ReplayRecorder, processes: NodeProcesses) -> None:
        self.recorder = recorder
        self.processes = processes
        self._executor = SingleThreadedExecutor(context=recorder.context)
        self._executor.add_node(recorder)

    def connect(self, is_paced: bool = True) -> float:
        """Wait until every topic has its subscribers; returns the seconds it took."""
        start_s = time.monotonic()
        while missing := unconnected(self.recorder.connections, is_paced):
            if time.monotonic() - start_s > DISCOVERY_S:
                raise ReplayError(
                    f'after {DISCOVERY_S:g} s these are not connected: {", ".join(missing)}; is '
                    'the loopback interface up, and does a firewall block UDP?'
                )
            self.spin()
        return time.monotonic() - start_s

    def wait_for_map(self) -> None:
        """Wait until there is a map: one that is loaded takes its time."""
        deadline_s = time.monotonic() + DRAIN_S
        while not self.recorder.has_map and time.monotonic() < deadline_s:
            self.spin()

    def call(self, kind: Any, name: str, request: Any, patience_s: float = SERVICE_S) -> None:
        """Call a service. Raises ReplayError with its answer when it fails."""
        client = self.recorder.create_client(kind, name)
        deadline_s = time.monotonic() + patience_s
        while not client.service_is_ready() and time.monotonic() < deadline_s:
            self.spin()
        future = client.call_async(request)
        while not future.done() and time.monotonic() < deadline_s:
            self.spin()
        if not future.done():
            raise ReplayError(f'the service {name} does not answer')
        response = future.result()
        if not response.success:
            raise ReplayError(f'{name}: {response.message}')

    def play(self, on_progress: ProgressListener, interrupted: threading.Event) -> bool:
        """Follow the nodes until the recording has ended and everything sent has arrived; False
        when an interrupt came before.
        """
        recorder = self.recorder
        recorder.last_sign_s = time.monotonic()
        while not recorder.is_drained():
            if interrupted.is_set():
                return False
            self.spin()
            last = recorder.answers.get(max(recorder.answers, default=0))
            on_progress(len(recorder.answers), last.message if last else '')
            quiet_s = time.monotonic() - recorder.last_sign_s
            if quiet_s > (DRAIN_S if recorder.finished is not None else STALL_S):
                raise ReplayError(
                    f'nothing has happened for {quiet_s:.0f} s; {len(recorder.unanswered())} '
                    f'frames are not tracked and {len(recorder.unmapped())} keyframes not mapped'
                )
        return True

    def catch_up(self) -> None:
        """Wait until what was sent has arrived, or nothing more comes."""
        recorder = self.recorder
        recorder.last_sign_s = time.monotonic()
        while not recorder.has_caught_up():
            self.spin()
            if time.monotonic() - recorder.last_sign_s > DRAIN_S:
                return

    def spin(self, duration_s: float = SPIN_S) -> None:
        """Handle what arrives within a moment, then see that all nodes live."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)
        self.processes.check()
