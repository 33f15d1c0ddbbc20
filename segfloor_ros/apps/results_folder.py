"""The results folder of a run: maps, trajectories, cloud, masks, summary and settings.

Everything is written to a temporary folder in the target and moved into place at the end, so that
a run that fails leaves nothing half-written; a result that cannot be written there goes elsewhere.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros.apps.label_files import draw_labels, save_labels
from segfloor_ros.apps.ply import write_ply
from segfloor_ros.apps.trajectory import Trajectory, write_tum
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FrameResult, LabelledPoints, Mount
from segfloor_ros.core.errors import InputError, SegfloorError
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.files.writing import (
    check_target,
    folder_in_the_making,
    move_into_place,
    own_files,
)
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.semantics.label_map import Labels
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED
from segfloor_ros.nodes.map_files import save_map

MAP, REPORT = 'map.yaml', 'report.html'
SEMANTIC = 'map_semantic.png'
POINT_LABELS = 'point_labels.csv'
LABEL_FILES = (SEMANTIC, 'map_labels.yaml', 'map_labels.pgm', POINT_LABELS)
PICTURES = ('floor_masks', 'moving_masks', 'floor_debug')
OUTPUT_NAMES = (
    *PICTURES,
    'map.pgm',
    MAP,
    *LABEL_FILES,
    'trajectory.txt',
    'keyframes.txt',
    'camera_trajectory.txt',
    'labelled_cloud.ply',
    'summary.json',
    'settings.yaml',
    'overlay.png',
    REPORT,
)

FIGURES = (
    'frames', 'tracked_frames', 'keyframes', 'loops', 'map_updates', 'wall_s', 'frames_per_s',
)  # fmt: skip
MOUNT_FIGURES = ('camera_height_m', 'camera_pitch_rad', 'camera_roll_rad')
STAGE_FIGURES = ('count', 'p50_ms', 'p95_ms', 'max_ms')
STAGE_COLUMNS = ('stage', 'calls', 'median ms', 'p95 ms', 'max ms')


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """The figures of a run, as written to summary.json.

    map: the file, None where only a path came of the drive; camera_height_m, camera_pitch_rad and
    camera_roll_rad are None where the mount is not known. lost_intervals: first and last frame
    number of every stretch without a pose. loop_times_s: when loops were closed, and
    relocalisations: when tracking was lost and found again, lost_s and found_s, in seconds.
    submaps: the first_frame and last_frame of every stretch that was mapped without knowing where
    in the map it is, and whether it was `merged` later; what was not is in no map and no
    trajectory. left_out_frames: how many frames that are. sensors: messages used, by name.
    repeated_frames: tracked although the camera delivered the image before again, bit for bit.
    blind_frames: with a pose of wheels or gyroscope alone. moving_frames: in which something was
    found that moves. sensor_remarks: what seems wrong with sensors, in words. input_faults: what is
    wrong with the images: fault, value, unit and remedy. failed_frames, failed_keyframes: at which
    a stage failed; they are lost or not in the map. floor: how high the camera is above the planes
    of single keyframes (`floor_heights`), None where that is not known. interrupted: whether the
    drive was cut short. stages: by name count, mean_ms, p50_ms, p95_ms, max_ms. rss_mb: start, peak
    and slope_per_update in MB, and samples over the updates.
    """

    map: str | None
    frames: int
    tracked_frames: int
    skipped_frames: int
    lost_intervals: list[tuple[int, int]]
    keyframes: int
    loops: int
    loop_times_s: list[float]
    relocalisations: list[dict[str, float]]
    submaps: list[dict[str, int | bool]]
    left_out_frames: int
    map_updates: int
    wall_s: float
    frames_per_s: float
    camera_height_m: float | None
    camera_pitch_rad: float | None
    camera_roll_rad: float | None
    sensors: dict[str, int]
    repeated_frames: int
    blind_frames: int
    moving_frames: int
    sensor_remarks: list[str]
    input_faults: list[dict[str, Any]]
    failed_frames: int
    failed_keyframes: int
    floor: dict[str, float] | None
    interrupted: bool
    stages: dict[str, dict[str, float]]
    rss_mb: dict[str, Any]

    @property
    def left_out(self) -> list[str]:
        """The frames of each submap that is in no map and no trajectory, e.g. 4-9."""
        return [_range_words(submap) for submap in self.submaps if not submap['merged']]


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run leaves behind. grid: None where only a path came of it. trajectory, keyframes:
    `base_link` in `map`. labels: of a network, where there was one.
    """

    grid: OccupancyGrid | None
    trajectory: Trajectory
    keyframes: Trajectory
    labelled: LabelledPoints
    mount: Mount
    summary: RunSummary
    configuration: Configuration
    labels: Labels | None = None


@dataclasses.dataclass(frozen=True)
class DriveFrame:
    """What became of a frame, as `RunSummary` counts it."""

    stamp_ns: int
    index: int
    tracked: bool
    in_submap: bool
    repeated: bool
    blind: bool
    shows_motion: bool

    @staticmethod
    def of(result: FrameResult) -> DriveFrame:
        """Return what became of a frame that SLAM has answered."""
        return DriveFrame(
            result.stamp_ns,
            result.index,
            result.tracked,
            result.in_submap,
            result.repeated and result.tracked,
            result.blind,
            result.moving is not None and len(result.moving.xyz_map) > 0,
        )


def summarise(
    frames: Sequence[DriveFrame],
    wall_s: float,
    mount: Mount | None,
    has_map: bool,
    loop_times_s: list[float],
    **others: Any,
) -> RunSummary:
    """Return the summary of a drive, whoever drove it. frames: in order of their stamps. others:
    what does not follow from them.
    """
    tracked = np.array([frame.tracked for frame in frames], bool)
    in_submap = np.array([frame.in_submap for frame in frames], bool)
    indices, stamps = [f.index for f in frames], [f.stamp_ns for f in frames]
    submaps = submap_intervals(indices, in_submap, tracked)
    left_out = [
        submap['first_frame'] <= index <= submap['last_frame']
        for submap in submaps
        if not submap['merged']
        for index in indices
    ]
    return RunSummary(
        map=MAP if has_map else None,
        frames=len(frames),
        tracked_frames=int(tracked.sum()),
        lost_intervals=lost_intervals(indices, tracked),
        loops=len(loop_times_s),
        loop_times_s=loop_times_s,
        relocalisations=relocalisations(stamps, tracked),
        submaps=submaps,
        left_out_frames=sum(left_out),
        wall_s=round(wall_s, 3),
        frames_per_s=round(len(frames) / wall_s, 2),
        camera_height_m=round(mount.height_m, 4) if mount else None,
        camera_pitch_rad=round(mount.pitch_rad, 5) if mount else None,
        camera_roll_rad=round(mount.roll_rad, 5) if mount else None,
        repeated_frames=sum(frame.repeated for frame in frames),
        blind_frames=sum(frame.blind for frame in frames),
        moving_frames=sum(frame.shows_motion for frame in frames),
        **others,
    )


def lost_intervals(
    frame_indices: Sequence[int], tracked: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Return the first and last frame number of every stretch without a pose; both inputs are
    (N,).
    """
    lost = np.concatenate([[False], ~np.asarray(tracked, bool), [False]])
    edges = np.flatnonzero(np.diff(lost.astype(np.int8)))
    return [
        (int(frame_indices[start]), int(frame_indices[end - 1]))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def submap_intervals(
    frame_indices: Sequence[int], in_submap: NDArray[np.bool_], tracked: NDArray[np.bool_]
) -> list[dict[str, int | bool]]:
    """Return the frames mapped in submaps, as in `RunSummary`; all inputs are (N,)."""
    return [
        {
            'first_frame': int(frame_indices[start]),
            'last_frame': int(frame_indices[end]),
            'merged': bool(tracked[start : end + 1].any()),
        }
        for start, end in lost_intervals(range(len(in_submap)), ~in_submap)
    ]


def relocalisations(stamp_ns: Sequence[int], tracked: NDArray[np.bool_]) -> list[dict[str, float]]:
    """Return when tracking was lost (the first stamp without a pose) and found again, for every
    stretch without a pose that ended; both inputs are (N,).
    """
    times = []
    for start, end in lost_intervals(range(len(stamp_ns)), tracked):
        if start > 0 and end + 1 < len(stamp_ns):
            lost_s, found_s = (round(1e-9 * stamp_ns[at], 6) for at in (start, end + 1))
            times.append({'lost_s': lost_s, 'found_s': found_s})
    return times


class OutputFolder:
    """A results folder in the making; used as a context manager, it appears only when `write`
    was called. inputs: files and folders that are read. Raises InputError where nothing can be
    written, or something of others is in the way.

    path: where the results are. problems: what could not be written, in words.
    """

    def __init__(self, target: Path, inputs: Iterable[Path | str | None] = ()) -> None:
        check_target(target, OUTPUT_NAMES, inputs)
        self.path = target
        self.problems: list[str] = []

    def __enter__(self) -> OutputFolder:
        self._stack = ExitStack()
        self._made = self._stack.enter_context(folder_in_the_making(self.path))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def add_picture(self, folder: str, name: str, picture: NDArray[np.uint8]) -> None:
        """Keep a mask (H, W), or a picture (H, W, 3) BGR, in one of the folders of pictures. One
        that cannot be written is missing, and said to be.
        """
        target = self._made / folder / f'{name}.png'
        try:
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(png_bytes(picture))
        except OSError as error:
            target.unlink(missing_ok=True)
            if not self.problems:
                words = f'{folder}/{name}.png cannot be written ({error.strerror})'
                self.problems.append(f'{words}; it and perhaps others are missing')

    def write(self, result: RunResult) -> None:
        """Write every file and move them into place, replacing the files of an earlier run; what is
        interrupted does not replace a whole result. Where that cannot be, as many files as possible
        are written elsewhere. Raises InputError where not even that can be.
        """
        if result.summary.interrupted and _is_whole(self.path):
            self.path = self.path.with_name(f'{self.path.name}.interrupted')
        failed = _write_files(self._made, result)
        try:
            if not failed:
                check_target(self.path, OUTPUT_NAMES)
                return move_into_place(self._made, self.path)
            why = ', '.join(dict.fromkeys(failed.values()))
        except (OSError, InputError) as error:
            why = str(error)
        self._write_elsewhere(result, why)

    def _write_elsewhere(self, result: RunResult, why: str) -> None:
        """Write what can be written to the folder for temporary files, or else the present one."""
        words = f'{self.path}: cannot be written ({why})'
        for parent in (tempfile.gettempdir(), '.'):
            with suppress(OSError):
                self.path = Path(tempfile.mkdtemp(prefix='segfloor-result-', dir=parent))
                break
        else:
            raise InputError(f'{words}; nor can it be elsewhere')
        failed = _write_files(self.path, result)
        if len(failed) == len(_writers(result)):
            self.path.rmdir()
            raise InputError(f'{words}; nor can it be in {self.path}')
        for name in PICTURES:
            with suppress(OSError):
                shutil.copytree(self._made / name, self.path / name)
        missing = f' without {", ".join(failed)}' if failed else ''
        self.problems.append(f'{words}; the result is in {self.path}{missing}')


def _is_whole(folder: Path) -> bool:
    """Whether a folder holds a result of a drive that was not interrupted."""
    if 'summary.json' not in own_files(folder):
        return False
    try:
        return not read_json(folder / 'summary.json', 'a summary').get('interrupted')
    except InputError:
        return False


def _writers(result: RunResult) -> dict[str, Callable[[Path], object]]:
    """Return what writes each file of a result."""
    camera = result.trajectory.seen_from(result.mount.T_base_left)
    summary = json.dumps(dataclasses.asdict(result.summary), indent=2)
    settings = yaml.safe_dump(result.configuration.as_ros_parameters(), sort_keys=False)
    grid = result.grid
    of_map = {} if grid is None else {MAP: lambda path: save_map(grid, path)}
    return (
        of_map
        | _label_writers(result)
        | {
            'trajectory.txt': lambda path: write_tum(
                path, result.trajectory, map(_left_out_words, result.summary.left_out)
            ),
            'keyframes.txt': lambda path: write_tum(path, result.keyframes),
            'camera_trajectory.txt': lambda path: write_tum(path, camera),
            'labelled_cloud.ply': lambda path: write_ply(path, result.labelled),
            'summary.json': lambda path: path.write_text(summary + '\n'),
            'settings.yaml': lambda path: path.write_text(settings),
        }
    )


def _label_writers(result: RunResult) -> dict[str, Callable[[Path], object]]:
    """Return what writes the files of labels, where there are any."""
    labels, grid, cloud = result.labels, result.grid, result.labelled
    if labels is None:
        return {}
    of_points: dict[str, Callable[[Path], object]] = {}
    if labels.points is not None:
        names = [*labels.classes, *[''] * (UNLABELLED + 1 - len(labels.classes))]
        rows = [f'{i},{names[k]}' for i, k in zip(cloud.point_id, labels.points, strict=True)]
        points = '\n'.join(['id,class', *rows]) + '\n'
        of_points[POINT_LABELS] = lambda path: path.write_text(points)
    if grid is None or labels.cells is None:
        return of_points
    return of_points | {
        'map_labels.yaml': lambda path: save_labels(path, grid, labels),
        SEMANTIC: lambda path: path.write_bytes(png_bytes(draw_labels(grid, labels))),
    }


def _write_files(folder: Path, result: RunResult) -> dict[str, str]:
    """Write every file that can be written; returns why the others cannot, by name."""
    why = {name: _try_to(write, folder / name) for name, write in _writers(result).items()}
    return {name: words for name, words in why.items() if words}


def _try_to(write: Callable[[Path], object], path: Path) -> str:
    """Write a file; returns why that cannot be, '' where it can."""
    try:
        write(path)
    except (OSError, SegfloorError) as error:
        path.unlink(missing_ok=True)
        return getattr(error.__cause__ or error, 'strerror', None) or str(error)
    return ''


def stage_rows(stages: Mapping[str, Mapping[str, float]]) -> list[list[str]]:
    """Return name, calls, and median, 95th percentile and maximum in ms of stages, for people."""
    return [
        [
            name,
            str(stage['count']),
            *(f'{stage[key]:.1f}' for key in ('p50_ms', 'p95_ms', 'max_ms')),
        ]
        for name, stage in stages.items()
    ]


def summary_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the summary as (what, value with unit) for people."""
    used = ', '.join(f'{name} ({count})' for name, count in summary.sensors.items())
    merged = [_range_words(submap) for submap in summary.submaps if submap['merged']]
    left_out = (
        f'{summary.left_out_frames} ({", ".join(summary.left_out)}): mapped in submaps that were '
        'not recognised in the map'
    )
    # What does not apply is None.
    rows: list[tuple[str, Any]] = [
        ('sensors used (messages)', used or None),
        ('frames tracked', f'{summary.tracked_frames} of {summary.frames}'),
        ('of them on sensors alone', summary.blind_frames if used else None),
        ('frames repeated by the camera', summary.repeated_frames or None),
        ('frames lost', ', '.join(f'{a}-{b}' for a, b in summary.lost_intervals) or 'none'),
        ('frames mapped in submaps that were merged', ', '.join(merged) or None),
        ('frames left out', left_out if summary.left_out else None),
        *(('remark', remark) for remark in summary.sensor_remarks),
        *(
            ('fault of the images', f'{fault["fault"]}, {fault["value"]} {fault["unit"]}')
            for fault in summary.input_faults
        ),
        ('frames skipped (unreadable)', summary.skipped_frames),
        ('frames that failed', summary.failed_frames or None),
        ('keyframes that failed', summary.failed_keyframes or None),
        ('interrupted', 'yes' if summary.interrupted else None),
        ('frames with something that moves', summary.moving_frames),
        ('keyframes', summary.keyframes),
        ('map updates', summary.map_updates),
        *_mount_rows(summary.camera_height_m, summary.camera_pitch_rad),
        ('camera height by single keyframes', _floor_words(summary.floor)),
        ('time', f'{summary.wall_s:.1f} s ({summary.frames_per_s:.1f} frames/s)'),
        ('memory, peak', f'{summary.rss_mb["peak"]:.0f} MB'),
        ('memory per map update', memory_growth(summary.rss_mb)),
    ]
    return [(what, str(value)) for what, value in rows if value is not None]


def memory_growth(rss_mb: Mapping[str, Any]) -> str:
    """Return by how much the memory grows with each map update, in words; a slope below zero is
    memory that was freed.
    """
    words = f'{max(rss_mb["slope_per_update"], 0):.3f} MB'
    return 'none' if words == '0.000 MB' else words


def _mount_rows(height_m: float | None, pitch_rad: float | None) -> list[tuple[str, str]]:
    if height_m is None or pitch_rad is None:
        return [('camera height and pitch', 'unknown')]
    return [
        ('camera height', f'{height_m:.3f} m'),
        ('camera pitch', f'{np.degrees(pitch_rad):.2f} deg'),
    ]


def floor_heights(heights_m: NDArray[np.floating], looks: int) -> dict[str, float]:
    """Return how many keyframes show a plane (`planes`), by the heights (N,) of the camera above
    these, and of how many of this drive (`looks`). If there are any, also the medians of all
    (`median_m`), of the first (`first_m`) and of the last third (`last_m`) of the drive.
    """
    count = len(heights_m)
    if not count:
        return {'planes': 0, 'looks': looks}
    third = -(-count // 3)
    parts = {'median_m': heights_m, 'first_m': heights_m[:third], 'last_m': heights_m[-third:]}
    medians = {name: round(float(np.median(part)), 4) for name, part in parts.items()}
    return {'planes': count, 'looks': looks, **medians}


def _floor_words(floor: Mapping[str, float] | None) -> str | None:
    if floor is None:
        return None
    if not floor['planes']:
        return 'no keyframe shows the plane of the floor'
    return (
        f'{floor["median_m"]:.3f} m ({floor["planes"]} planes; first third '
        f'{floor["first_m"]:.3f} m, last third {floor["last_m"]:.3f} m)'
    )


def _range_words(submap: Mapping[str, int | bool]) -> str:
    return f'{submap["first_frame"]}-{submap["last_frame"]}'


def _left_out_words(frames: str) -> str:
    return f'frames {frames} are left out: mapped in a submap that was not recognised in the map'


def read_summary(path: Path) -> dict[str, Any]:
    """Return what a summary says; `camera_roll_rad` is 0 where it says none, and all three of the
    mount are None where it is not known. Raises InputError for a file that is no summary of a run.
    """
    summary = {'camera_roll_rad': 0.0, **read_json(path, 'the summary of a run')}
    try:
        memory, stages = summary['rss_mb'], summary['stages']
        figures = [summary[name] for name in FIGURES]
        mount = [summary[name] for name in MOUNT_FIGURES]
        figures += mount if any(value is not None for value in mount) else []
        figures += [stage[name] for stage in stages.values() for name in STAGE_FIGURES]
        figures += [memory['start'], memory['peak'], memory['slope_per_update']]
        figures += [*memory.get('samples', []), memory.get('updates_per_sample', 1)]
        figures.append(len(summary['lost_intervals']))
    except (KeyError, TypeError, AttributeError):
        raise InputError(f'{path}: not the summary of a run') from None
    for figure in figures:
        if type(figure) not in (int, float) or not math.isfinite(figure) or abs(figure) > 1e12:
            raise InputError(f'{path}: not the summary of a run: {str(figure)[:40]} is no figure')
    return summary
