"""What the stages cost: time, memory and throughput on generated data of growing size.

Each workload is a process of its own, so that its memory is not filled from what others left.

The stages one after the other on one thread, with a map at every keyframe: so the published
figures were measured, and so no stage waits for another one.
"""

from __future__ import annotations

import dataclasses
import platform
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from segfloor_ros import __version__
from segfloor_ros.benchmark.corridor import CAMERA, MOUNT, Corridor, CorridorImages
from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import SegfloorError, SettingsError
from segfloor_ros.grid.map_file import OccupancyGrid
from segfloor_ros.pipeline import KeyframeStages, MapInput, make_slam
from segfloor_ros.processes import how_it_ended, start_apart
from segfloor_ros.slam.results import FrameResult, Keyframe
from segfloor_ros.timing import MemoryLog, ReferenceWorkload, StageTimes, spread_of

IMAGES = 'images'
JSON_VERSION = 1

Progress = Callable[[int], None]
"""Told how many steps are done."""

MAP = 'map'
"""The stage of drawing the whole map, which the pipeline does once, at the end."""

EVERY_FRAME = ('tracking', 'moving')

BEFORE_UPDATE = 'mapping'


@dataclasses.dataclass(frozen=True)
class BenchmarkPlan:
    """What to measure. sizes: numbers of keyframes for labelling and grid. frames: image pairs
    for all stages. seed: of the generated data. threads: of OpenCV; one compares best.
    """

    sizes: tuple[int, ...] = (10, 100, 1000)
    frames: int = 100
    seed: int = 0
    threads: int = 1


def parse_sizes(text: str) -> tuple[int, ...]:
    """Return the numbers of keyframes in `10,100,1000`. Raises SettingsError."""
    try:
        sizes = tuple(int(part) for part in text.split(','))
    except ValueError:
        sizes = (0,)
    if min(sizes) < 1:
        raise SettingsError(f'--sizes {text}: expected numbers of keyframes, e.g. 10,100,1000')
    return sizes


def run_benchmark(
    plan: BenchmarkPlan, configuration: Configuration, announce: Callable[[str, int], Progress]
) -> list[Workload]:
    """Measure all stages on images, then labelling and grid at every size, each in a process of
    its own. announce: told the name of a workload and its number of steps; returns whom to tell how
    many are done.
    """
    workloads = [
        run_apart(measure_images, plan, configuration, on_progress=announce('images', plan.frames))
    ]
    for size in plan.sizes:
        report = announce(f'{size} keyframes', size)
        workloads.append(run_apart(measure_map, plan, size, configuration, on_progress=report))
    return workloads


def measure_images(
    plan: BenchmarkPlan, configuration: Configuration, on_progress: Progress
) -> Workload:
    """Measure all stages on generated stereo images."""
    cv2.setNumThreads(plan.threads)
    stages = MeasuredStages(CAMERA, configuration, MOUNT)
    for frame in CorridorImages(plan.frames, plan.seed).drive():
        stages.process(frame)
        on_progress(stages.frames)
    return stages.workload(IMAGES)


def measure_map(
    plan: BenchmarkPlan, keyframes: int, configuration: Configuration, on_progress: Progress
) -> Workload:
    """Measure labelling and grid on a number of generated keyframes."""
    cv2.setNumThreads(plan.threads)
    stages = MeasuredStages(CAMERA, configuration, MOUNT)
    for done, keyframe in enumerate(Corridor(keyframes, plan.seed).drive(), start=1):
        stages.update_map(keyframe)
        on_progress(done)
    return stages.workload(f'{keyframes} keyframes')


def as_document(plan: BenchmarkPlan, workloads: list[Workload]) -> dict[str, Any]:
    """Return plan, machine and figures as plain numbers for a JSON file."""
    return {
        'version': JSON_VERSION,
        'segfloor_ros': __version__,
        'machine': machine(),
        'plan': dataclasses.asdict(plan),
        'workloads': [dataclasses.asdict(workload) for workload in workloads],
    }


def machine() -> dict[str, str]:
    """Return what the figures depend on besides the program."""
    return {
        'system': platform.platform(),
        'processor': platform.processor() or platform.machine(),
        'python': platform.python_version(),
        'numpy': np.__version__,
        'opencv': cv2.__version__,
    }


def run_apart(work: Callable[..., Any], *arguments: Any, on_progress: Progress) -> Any:
    """Return `work(*arguments, on_progress)`, done by a new process.

    work: a function of a module; its arguments and result are pickled. Its known errors are raised
    here. Raises SegfloorError when the process ends early.
    """
    receiver, process = start_apart(_serve, work, arguments)
    try:
        while True:
            kind, value = receiver.recv()
            if kind == 'result':
                return value
            if kind == 'error':
                raise value
            on_progress(value)
    except EOFError:
        process.join()
        raise SegfloorError(
            f'a process of the benchmark ended early ({how_it_ended(process.exitcode or 0)}); '
            'if memory is short, choose smaller --sizes'
        ) from None
    finally:
        process.terminate()
        process.join()


def _serve(sender: Connection, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    try:
        sender.send(('result', work(*arguments, lambda done: sender.send(('progress', done)))))
    except SegfloorError as error:
        sender.send(('error', error))


class MeasuredStages:
    """All stages, timed. mount: where the camera sits, None where the settings say or it is to be
    measured.
    """

    def __init__(
        self, camera: StereoCamera, configuration: Configuration, mount: Mount | None = None
    ) -> None:
        self.times = UpdateTimes()
        self.grid: OccupancyGrid | None = None
        self.frames = 0
        self.tracked = 0
        self.points = 0
        self._slam = make_slam(camera, configuration.stereo_slam, mount, self.times)
        self._stages = KeyframeStages(camera, configuration, self.times)
        self._reference = ReferenceWorkload()
        self._reference.time()
        self._memory = MemoryLog()

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Take in the next frame; returns the tracking results that are ready, oldest first."""
        self.frames += 1
        results = self._slam.process(frame)
        for result in results:
            self.tracked += result.tracked
            if result.keyframe is not None:
                self._take_keyframe(result.keyframe)
        return results

    def close(self) -> None:
        """End what runs beside."""
        self._slam.close()

    def update_map(self, keyframe: MapInput) -> None:
        """Take in one keyframe whose floor is segmented, and draw the map."""
        self._stages.update_map(keyframe)
        self._end_update(len(keyframe.cloud.point_id))

    def workload(self, name: str) -> Workload:
        """Return the figures under a name."""
        self._reference.time()
        reference_ms = self._reference.median_ms
        stages: dict[str, dict[str, Any]] = self.times.summary()
        for figures in stages.values():
            figures['p50_ratio'] = round(figures['p50_ms'] / reference_ms, 4)
        updates = self._stages.map_updates
        items = self.frames or updates
        return Workload(
            name=name,
            items=items,
            tracked=self.tracked if self.frames else updates,
            map_updates=updates,
            points=self.points,
            cells=0 if self.grid is None else self.grid.cells.size,
            stages=stages,
            update_s=self.times.per_update(),
            items_per_s=round(items / self.times.total_s, 2) if self.times.total_s else 0.0,
            memory_mb=self._memory.summary(),
            reference_ms=round(reference_ms, 3),
        )

    def _take_keyframe(self, keyframe: Keyframe) -> None:
        assert self._slam.mount is not None
        self._stages.process(keyframe, self._slam.mount)
        self._end_update(len(keyframe.cloud.point_id))

    def _end_update(self, points: int) -> None:
        # The grid folds new evidence in when the map is asked for.
        with self.times.measure(MAP):
            self.grid = self._stages.grid()
        self.points = points
        self.times.end_update()
        self._memory.sample()


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
        return spread_of(np.array(self.update_s), 6) if self.update_s else {}
