"""What a report shows, read back from the results folder of a run and its recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.camera.sources import open_source
from segfloor_ros.cloud.labels import LabelledPoints
from segfloor_ros.cloud.ply import read_ply
from segfloor_ros.configuration import resolve
from segfloor_ros.evaluation.run_summary import read_summary
from segfloor_ros.evaluation.trajectory_files import read_trajectory
from segfloor_ros.evaluation.truth import MapTruth, load_truth
from segfloor_ros.files.images import check_same_size, read_mask
from segfloor_ros.files.whole import read_text
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import load_map
from segfloor_ros.grid.occupancy import OccupancyGrid

STRIP_LENGTH = 6


@dataclass(frozen=True)
class MaskedFrame:
    """A keyframe's rectified pair with a mask (H, W) uint8 of what was found in it."""

    frame: StereoFrame
    mask: NDArray[np.uint8]


@dataclass(frozen=True)
class ReportData:
    """A run as its files tell it. trajectory, keyframes: base poses (N, 4, 4) in `map`. strip,
    moving: keyframes with their floor, and with what moves, evenly over the drive. settings_text:
    settings.yaml as it is. truth: None where nobody knows it.
    """

    folder: Path
    name: str
    summary: dict[str, Any]
    settings_text: str
    floor_settings: FloorSegmentationSettings
    camera: StereoCamera
    mount: Mount
    grid: OccupancyGrid
    trajectory: Array
    keyframes: Array
    cloud: LabelledPoints
    strip: list[MaskedFrame]
    moving: list[MaskedFrame]
    truth: MapTruth | None
    truth_folder: Path | None


def read_run(folder: Path, truth: Path | None = None) -> ReportData:
    """Read a results folder, its recording and, where given, the truth.

    Raises InputError naming the file that is missing or malformed.
    """
    summary = read_summary(folder / 'summary.json')
    settings = folder / 'settings.yaml'
    parameters = resolve(settings)
    source = open_source(parameters.stereo_camera)
    return ReportData(
        folder=folder,
        name=Path(source.name).name,
        summary=summary,
        settings_text=read_text(settings),
        floor_settings=parameters.floor_segmentation,
        camera=source.camera,
        mount=Mount(
            summary['camera_height_m'],
            summary['camera_pitch_rad'],
            summary['camera_roll_rad'],
        ),
        grid=load_map(folder / 'map.yaml'),
        trajectory=read_trajectory(folder / 'trajectory.txt')[1],
        keyframes=read_trajectory(folder / 'keyframes.txt')[1],
        cloud=read_ply(folder / 'labelled_cloud.ply'),
        strip=_masked_frames(folder / 'floor_masks', source.frames()),
        moving=_masked_frames(folder / 'moving_masks', source.frames()),
        truth=load_truth(truth) if truth is not None else None,
        truth_folder=truth if truth is not None and truth.is_dir() else None,
    )


def _masked_frames(folder: Path, frames: Iterable[StereoFrame]) -> list[MaskedFrame]:
    """Return some frames that have a mask, evenly over the drive."""
    files = sorted(folder.glob('[0-9]' * 6 + '.png')) if folder.is_dir() else []
    chosen = np.unique(np.linspace(0, len(files) - 1, STRIP_LENGTH).round().astype(int))
    wanted = {int(files[i].stem): files[i] for i in chosen} if files else {}
    strip: list[MaskedFrame] = []
    for frame in frames:
        if len(strip) == len(wanted):
            break
        if frame.index in wanted:
            mask = read_mask(wanted[frame.index])
            check_same_size(mask, frame.left, wanted[frame.index])
            strip.append(MaskedFrame(frame, mask))
    return strip
