"""What the stages cost: time, memory and throughput on generated data of growing size, also as
multiples of a fixed OpenCV workload.

    python -m tools.benchmark_stages [--json] [--sizes 10,100,1000] [--frames 100]

Each workload is a process of its own, so that its memory is not filled from what others left.

The stages one after the other on one thread, with a map at every keyframe: so the published
figures were measured, and so no stage waits for another one.

The data are of a straight corridor of any length: what it looks like to the labelling and grid
stages, worked out by geometry, and its stereo images, by ray casting in NumPy: they need no
graphics library and look the same everywhere.
"""

from __future__ import annotations

import dataclasses
import platform
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from segfloor_ros import __version__
from segfloor_ros.apps.benchmark import StageChain
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import (
    Json,
    Params,
    Set,
    announcing,
    figure_table,
    number_option,
    print_json,
)
from segfloor_ros.apps.profiling import MemoryLog, ReferenceWorkload
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import (
    FLOOR,
    NO_EVIDENCE,
    NOT_FLOOR,
    FloorScan,
    FrameResult,
    KeyframeFeatures,
    KeyframePath,
    Mount,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.errors import SegfloorError, SettingsError
from segfloor_ros.core.geometry import Array, invert, make_transform, transform_points
from segfloor_ros.core.pipeline import MapInput
from segfloor_ros.core.processes import how_it_ended, start_apart
from segfloor_ros.core.timing import StageTimes, spread_of
from segfloor_ros.nodes.configuration import resolve

CAMERA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.12)
MOUNT = Mount(height_m=0.3, pitch_rad=0.12)

IMAGES = 'images'
JSON_VERSION = 1

Progress = Callable[[int], None]
"""Told how many steps are done."""

EVERY_FRAME = ('tracking', 'moving')

BEFORE_UPDATE = 'mapping'


@dataclass(frozen=True)
class CorridorDrive:
    """A corridor, what is seen of it, and the drive along it.

    stride_m: between two keyframes. points_per_m: a hundred new points per keyframe, as in drives
    through rendered halls. correction_every, correction_rad: every so many keyframes the whole map
    turns by so much, as after the closing of a loop. spare_m: from the last frame to the end wall,
    and from the wall behind to the first one. grey, contrast, noise_grey: of the images, mean and
    standard deviations.
    """

    half_width_m: float = 1.5
    ceiling_m: float = 2.4
    sight_m: float = 6.0
    spare_m: float = 5.0
    points_per_m: int = 400
    point_noise_m: float = 0.01
    scan_step_rad: float = 0.01
    scan_range_max_m: float = 8.0
    stride_m: float = 0.25
    step_m: float = 0.05
    frame_period_ns: int = 100_000_000
    correction_every: int = 100
    correction_rad: float = 0.002
    texels_per_m: int = 100
    texels: int = 1024
    grey: float = 128.0
    contrast: float = 30.0
    noise_grey: float = 1.5

    @property
    def keyframe_period_ns(self) -> int:
        """Time between two keyframes."""
        return round(self.stride_m / self.step_m) * self.frame_period_ns


DRIVE = CorridorDrive()


class Corridor:
    """Keyframes of a drive along a corridor. The same seed gives the same keyframes."""

    def __init__(self, keyframes: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.keyframes = keyframes
        self._points = _points(keyframes * DRIVE.stride_m + DRIVE.sight_m, rng)
        # As they lie in the map before and after a correction: what is handed out takes no memory.
        self._xyz_map = [
            transform_points(turn, self._points).astype(np.float32) for turn in _corrections()
        ]
        self._point_id = np.arange(len(self._points), dtype=np.int32)
        self._mask = floor_mask()
        self._scan_rng = rng

    def drive(self) -> Iterator[MapInput]:
        """Yield the keyframes in order; the cloud and the path grow with each."""
        stamp_ns = np.arange(1, self.keyframes + 1, dtype=np.int64) * DRIVE.keyframe_period_ns
        T_world_base = np.tile(np.eye(4), (self.keyframes, 1, 1))
        T_world_base[:, 0, 3] = np.arange(self.keyframes) * DRIVE.stride_m
        for index in range(self.keyframes):
            turned = index // DRIVE.correction_every % 2
            path = _corrections()[turned] @ T_world_base[: index + 1]
            x_m = index * DRIVE.stride_m
            known = int(np.searchsorted(self._points[:, 0], x_m + DRIVE.sight_m))
            first = int(np.searchsorted(self._points[:, 0], x_m))
            xyz_map = self._xyz_map[turned][:known]
            yield MapInput(
                int(stamp_ns[index]),
                self._features(first, T_world_base[index], xyz_map),
                KeyframePath(stamp_ns[: index + 1], path),
                SparseCloud(self._point_id[:known], xyz_map),
                self._mask,
                self._scan(),
            )

    def _features(
        self, first: int, T_world_base: Array, xyz_map: NDArray[np.float32]
    ) -> KeyframeFeatures:
        """Return the points from `first` on that lie in the image."""
        T_left_world = invert(T_world_base @ MOUNT.T_base_left)
        in_left = transform_points(T_left_world, self._points[first : len(xyz_map)])
        ahead = np.flatnonzero(in_left[:, 2] > 0.2)
        uv = CAMERA.project(in_left[ahead])[:, :2]
        inside = ((uv >= 0) & (uv <= (CAMERA.width - 1, CAMERA.height - 1))).all(axis=1)
        point_id = (first + ahead[inside]).astype(np.int32)
        return KeyframeFeatures(uv[inside].astype(np.float32), point_id, xyz_map[point_id])

    def _scan(self) -> FloorScan:
        """Return how far the floor goes per bearing: to the walls, or as far as sight."""
        half = np.arctan(0.5 * CAMERA.width / CAMERA.fx)
        bearings = np.arange(-half, half, DRIVE.scan_step_rad)
        wall_m = DRIVE.half_width_m / np.maximum(np.abs(np.sin(bearings)), 1e-6)
        wall_m += self._scan_rng.normal(scale=DRIVE.point_noise_m, size=len(bearings))
        in_sight = wall_m < DRIVE.sight_m
        return FloorScan(
            float(bearings[0]),
            DRIVE.scan_step_rad,
            np.minimum(wall_m, DRIVE.sight_m).astype(np.float32),
            np.where(in_sight, wall_m, np.nan).astype(np.float32),
            DRIVE.scan_range_max_m,
        )


def floor_mask() -> NDArray[np.uint8]:
    """Return the floor mask (H, W) uint8 that every keyframe in the corridor has."""
    v, u = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
    rays = CAMERA.back_project(np.stack([u.ravel(), v.ravel()], axis=1), np.ones(u.size))
    directions = rays @ MOUNT.T_base_left[:3, :3].T
    down = np.maximum(-directions[:, 2], 1e-9)
    forward_m, left_m = (directions[:, :2] * (MOUNT.height_m / down)[:, None]).T
    mask = np.where(np.abs(left_m) < DRIVE.half_width_m, FLOOR, NOT_FLOOR).astype(np.uint8)
    mask[(forward_m > DRIVE.sight_m) & (mask == FLOOR)] = NO_EVIDENCE
    return mask.reshape(u.shape)


def _points(length_m: float, rng: np.random.Generator) -> Array:
    """Return map points (N, 3) on floor and walls, in the order in which they come into sight."""
    count = round(length_m * DRIVE.points_per_m)
    x = np.sort(rng.uniform(0.0, length_m, count))
    on_floor = rng.random(count) < 0.5
    side = np.where(rng.random(count) < 0.5, DRIVE.half_width_m, -DRIVE.half_width_m)
    y = np.where(on_floor, rng.uniform(-DRIVE.half_width_m, DRIVE.half_width_m, count), side)
    z = np.where(on_floor, 0.0, rng.uniform(0.05, 1.5, count))
    noise = rng.normal(scale=DRIVE.point_noise_m, size=(count, 2))
    return np.stack([x, y + noise[:, 0], z + noise[:, 1]], axis=1)


def _corrections() -> Array:
    """Return the two ways in which the map lies in turns, (2, 4, 4)."""
    c, s = np.cos(DRIVE.correction_rad), np.sin(DRIVE.correction_rad)
    turn = make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    return np.stack([np.eye(4), turn])


class CorridorImages:
    """Stereo frames of a drive straight ahead between two walls, floor, ceiling and end walls."""

    def __init__(self, frames: int, seed: int) -> None:
        self.frames = frames
        self._rng = np.random.default_rng(seed)
        self._texture = _texture(self._rng)
        low = np.array([-DRIVE.spare_m, -DRIVE.half_width_m, 0.0], np.float32)
        high = np.array(
            [frames * DRIVE.step_m + DRIVE.spare_m, DRIVE.half_width_m, DRIVE.ceiling_m], np.float32
        )
        # Of the six faces, two across each axis.
        self._shifts = self._rng.uniform(0, DRIVE.texels, (2 * len(low), 2))
        # The base drives along x without turning, so the rays and the side they go to stay.
        v, u = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
        uv = np.stack([u.ravel(), v.ravel()], axis=1)
        rays = CAMERA.back_project(uv, np.ones(len(uv))) @ MOUNT.T_base_left[:3, :3].T
        self._rays = rays.T.astype(np.float32)
        self._ends = np.where(self._rays > 0, high[:, None], low[:, None])

    def drive(self) -> Iterator[StereoFrame]:
        """Yield the frames in order."""
        to_right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
        for index in range(self.frames):
            T_world_left = MOUNT.T_base_left.copy()
            T_world_left[0, 3] += index * DRIVE.step_m
            left = self._view(T_world_left[:3, 3])
            right = self._view((T_world_left @ to_right)[:3, 3])
            yield StereoFrame(index, (index + 1) * DRIVE.frame_period_ns, left, right)

    def _view(self, origin: Array) -> NDArray[np.uint8]:
        """Return the grey image (H, W) uint8 seen from a point."""
        start = origin.astype(np.float32)[:, None]
        with np.errstate(divide='ignore'):
            to_faces = (self._ends - start) / self._rays
        nearest = to_faces.min(axis=0)
        x, y, z = start + self._rays * nearest
        axis = to_faces.argmin(axis=0)
        beyond = np.take_along_axis(self._rays, axis[None], axis=0)[0] > 0
        shifts = (self._shifts / DRIVE.texels_per_m).astype(np.float32)[2 * axis + beyond]
        # A face across x shows y and z, one across y shows x and z, one across z x and y.
        first, second = np.where(axis == 0, y, x), np.where(axis == 2, y, z)
        shape = (CAMERA.height, CAMERA.width)
        image = cv2.remap(
            self._texture,
            ((first + shifts[:, 0]) * DRIVE.texels_per_m).reshape(shape),
            ((second + shifts[:, 1]) * DRIVE.texels_per_m).reshape(shape),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        image += DRIVE.noise_grey * self._rng.standard_normal(shape, np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return grey values of fine and coarse blots, the same at opposite edges."""
    layers = []
    for deviation in (2.0, 8.0):
        noise = np.pad(rng.normal(size=(DRIVE.texels, DRIVE.texels)), 64, mode='wrap')
        layer = cv2.GaussianBlur(noise, (0, 0), deviation)[64:-64, 64:-64]
        layers.append(layer / layer.std())
    return (DRIVE.grey + DRIVE.contrast * (layers[0] + layers[1])).astype(np.float32)


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
        run_in_process(
            measure_images, plan, configuration, on_progress=announce('images', plan.frames)
        )
    ]
    for size in plan.sizes:
        report = announce(f'{size} keyframes', size)
        workloads.append(run_in_process(measure_map, plan, size, configuration, on_progress=report))
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


def run_in_process(work: Callable[..., Any], *arguments: Any, on_progress: Progress) -> Any:
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


class MeasuredStages(StageChain):
    """All stages, timed. mount: where the camera sits, None where the settings say or it is to be
    measured.
    """

    def __init__(
        self, camera: StereoCamera, configuration: Configuration, mount: Mount | None = None
    ) -> None:
        self.times = UpdateTimes()
        super().__init__(camera, configuration, self.times, mount)
        self.tracked = 0
        self.points = 0
        self._reference = ReferenceWorkload()
        self._reference.time()
        self._memory = MemoryLog()

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Take in the next frame; returns the tracking results that are ready, oldest first."""
        results = super().process(frame)
        self.tracked += sum(result.tracked for result in results)
        return results

    def update_map(self, keyframe: MapInput) -> None:
        """Take in one keyframe whose floor is segmented, and draw the map."""
        self.stages.update_map(keyframe)
        self.draw(len(keyframe.cloud.point_id))

    def draw(self, points: int) -> None:
        """Draw the map, and close the update. points: of the cloud."""
        super().draw(points)
        self.points = points
        self.times.end_update()
        self._memory.sample()

    def workload(self, name: str) -> Workload:
        """Return the figures under a name."""
        self._reference.time()
        reference_ms = self._reference.median_ms
        stages: dict[str, dict[str, Any]] = self.times.summary()
        for figures in stages.values():
            figures['p50_ratio'] = round(figures['p50_ms'] / reference_ms, 4)
        updates = self.stages.map_updates
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


def stage_table(workloads: list[Workload]) -> Table:
    """Return the time of every stage as a table."""
    table = figure_table('stage', 'calls', 'median ms', 'p95 ms', 'max ms', 'median / reference')
    for workload in workloads:
        table.add_row(Text(workload.name, 'bold'))
        for name, stage in workload.stages.items():
            times = (f'{stage[key]:.2f}' for key in ('p50_ms', 'p95_ms', 'max_ms'))
            ratio = f'{stage["p50_ratio"]:.3f}'
            table.add_row(f'  {name}', str(stage['count']), *times, ratio)
        table.add_row('  reference', '', f'{workload.reference_ms:.2f}', '', '', '1.000')
        table.add_section()
    table.caption = 'reference: ORB and semi-global matching of a fixed 640x480 pair, timed beside'
    return table


def workload_table(workloads: list[Workload]) -> Table:
    """Return throughput, map updates and memory of every workload as a table."""
    table = figure_table(
        'workload', 'items/s', 's/update', 'p95 s', 'max s', 'peak MB', 'MB/update'
    )
    for workload in workloads:
        updates = (f'{workload.update_s.get(key, 0.0):.4f}' for key in ('mean', 'p95', 'max'))
        table.add_row(
            workload.name,
            f'{workload.items_per_s:.1f}',
            *updates,
            f'{workload.memory_mb["peak"]:.0f}',
            f'{workload.memory_mb["slope_per_update"]:.3f}',
        )
    table.caption = (
        'items: frames, or keyframes where there are no images; update: all that is done once per '
        'keyframe, the map included; one thread; memory grows by the slope of the second half'
    )
    return table


def main(
    sizes: Annotated[
        str, typer.Option(help='Keyframes for labelling and grid, one run for each number.')
    ] = '10,100,1000',
    frames: Annotated[int, number_option('Generated image pairs for all stages.', 2)] = 100,
    seed: Annotated[int, number_option('Of the generated data.', 0)] = 0,
    threads: Annotated[int, number_option('Threads of OpenCV; one compares machines best.', 1)] = 1,
    as_json: Json = False,
    params: Params = None,
    assignments: Set = None,
) -> None:
    """Time, memory and throughput of the stages on generated data."""
    plan = BenchmarkPlan(parse_sizes(sizes), frames, seed, threads)
    with announcing() as announce:
        workloads = run_benchmark(plan, resolve(params, assignments or ()), announce)
    if as_json:
        return print_json(as_document(plan, workloads))
    console.print(stage_table(workloads))
    console.print(workload_table(workloads))


if __name__ == '__main__':
    run_command(main)
