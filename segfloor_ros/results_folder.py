"""The results folder of a run: maps, trajectories, cloud, masks, summary and settings.

Everything is written to a hidden folder beside the target and moved in at the end, so that a
run that fails leaves nothing half-written.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount
from segfloor_ros.cloud.labels import LabelledPoints, write_ply
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import InputError, os_errors
from segfloor_ros.grid.map_file import OccupancyGrid, save_map
from segfloor_ros.trajectory import Trajectory, write_tum

OUTPUT_NAMES = (
    'map.pgm',
    'map.yaml',
    'trajectory.txt',
    'keyframes.txt',
    'camera_trajectory.txt',
    'labelled_cloud.ply',
    'floor_masks',
    'moving_masks',
    'floor_debug',
    'summary.json',
    'settings.yaml',
)


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """The figures of a run, as written to summary.json.

    lost_intervals: first and last frame number of every stretch without a pose. relocalisations:
    the times in seconds at which tracking was lost and found again, lost_s and found_s. apart: the
    first_frame and last_frame of every stretch that was mapped without knowing where in the map it
    is, and whether it was `joined` later; what was not is in no map and no trajectory. sensors:
    messages used, by name. blind_frames: with a pose of wheels or gyroscope alone. moving_frames:
    in which something was found that moves. sensor_remarks: what seems wrong with sensors, in
    words. stages: by name count, mean_ms, p50_ms, p95_ms, max_ms. rss_mb: start, peak and
    slope_per_update in MB, and samples over the updates.
    """

    frames: int
    tracked_frames: int
    skipped_frames: int
    lost_intervals: list[tuple[int, int]]
    keyframes: int
    loops: int
    relocalisations: list[dict[str, float]]
    apart: list[dict[str, int | bool]]
    map_updates: int
    wall_s: float
    frames_per_s: float
    camera_height_m: float
    camera_pitch_rad: float
    camera_roll_rad: float
    sensors: dict[str, int]
    blind_frames: int
    moving_frames: int
    sensor_remarks: list[str]
    stages: dict[str, dict[str, float]]
    rss_mb: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run leaves behind. trajectory, keyframes: `base_link` in `map`."""

    grid: OccupancyGrid
    trajectory: Trajectory
    keyframes: Trajectory
    labelled: LabelledPoints
    mount: Mount
    summary: RunSummary
    configuration: Configuration


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


def apart_intervals(
    frame_indices: Sequence[int], apart: NDArray[np.bool_], tracked: NDArray[np.bool_]
) -> list[dict[str, int | bool]]:
    """Return what was mapped apart, as in `RunSummary`; all inputs are (N,)."""
    return [
        {
            'first_frame': int(frame_indices[start]),
            'last_frame': int(frame_indices[end]),
            'joined': bool(tracked[start : end + 1].any()),
        }
        for start, end in lost_intervals(range(len(apart)), ~apart)
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
    was called.
    """

    def __init__(self, target: Path) -> None:
        if target.exists() and not target.is_dir():
            raise InputError(f'{target}: exists and is no folder; choose another --out')
        self._target = target

    def __enter__(self) -> OutputFolder:
        parent = self._target.absolute().parent
        with os_errors(f'{parent}: cannot write there', '; choose another --out'):
            parent.mkdir(parents=True, exist_ok=True)
            self._staging = Path(tempfile.mkdtemp(prefix='.segfloor-', dir=parent))
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self._staging, ignore_errors=True)

    def add_picture(self, folder: str, name: str, picture: NDArray[np.uint8]) -> None:
        """Keep a mask (H, W), or a picture (H, W, 3) BGR, in one of the folders of pictures."""
        target = self._staging / folder
        target.mkdir(exist_ok=True)
        cv2.imwrite(str(target / f'{name}.png'), picture)

    def write(self, result: RunResult) -> None:
        """Write every file and move them into place, replacing the files of an earlier run."""
        staging = self._staging
        save_map(result.grid, staging / 'map.yaml')
        write_tum(staging / 'trajectory.txt', result.trajectory)
        write_tum(staging / 'keyframes.txt', result.keyframes)
        camera = result.trajectory.seen_from(result.mount.T_base_left)
        write_tum(staging / 'camera_trajectory.txt', camera)
        write_ply(staging / 'labelled_cloud.ply', result.labelled)
        summary = json.dumps(dataclasses.asdict(result.summary), indent=2)
        (staging / 'summary.json').write_text(summary + '\n')
        settings = yaml.safe_dump(result.configuration.as_ros_parameters(), sort_keys=False)
        (staging / 'settings.yaml').write_text(settings)
        self._move_into_place(staging)

    def _move_into_place(self, staging: Path) -> None:
        self._target.mkdir(exist_ok=True)
        for name in OUTPUT_NAMES:
            old = self._target / name
            if old.is_dir():
                shutil.rmtree(old)
            if (staging / name).exists():
                os.replace(staging / name, old)


def summary_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the summary as (what, value with unit) for people."""
    tracked = f'{summary.tracked_frames} of {summary.frames}'
    lost = ', '.join(f'{a}-{b}' for a, b in summary.lost_intervals) or 'none'
    used = ', '.join(f'{name} ({count})' for name, count in summary.sensors.items())
    rows: list[tuple[str, Any]] = [
        *([('sensors used (messages)', used)] if used else []),
        ('frames tracked', tracked),
        *([('of them on sensors alone', summary.blind_frames)] if used else []),
        ('frames lost', lost),
        *(('frames mapped apart', _apart_words(part)) for part in summary.apart),
        *(('remark', remark) for remark in summary.sensor_remarks),
        ('frames skipped (unreadable)', summary.skipped_frames),
        ('frames with something that moves', summary.moving_frames),
        ('keyframes', summary.keyframes),
        ('map updates', summary.map_updates),
        ('camera height', f'{summary.camera_height_m:.3f} m'),
        ('camera pitch', f'{np.degrees(summary.camera_pitch_rad):.2f} deg'),
        ('time', f'{summary.wall_s:.1f} s ({summary.frames_per_s:.1f} frames/s)'),
        ('memory, peak', f'{summary.rss_mb["peak"]:.0f} MB'),
        ('memory per map update', f'{summary.rss_mb["slope_per_update"]:.3f} MB'),
    ]
    return [(what, str(value)) for what, value in rows]


def _apart_words(part: Mapping[str, int | bool]) -> str:
    outcome = 'joined later' if part['joined'] else 'no place of the map recognised, left out'
    return f'{part["first_frame"]}-{part["last_frame"]}, {outcome}'
