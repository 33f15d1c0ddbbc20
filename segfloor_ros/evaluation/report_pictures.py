"""The pictures of a report, as PNG or JPEG bytes.

What a report shows, read back from the results folder of a run and its recording.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.camera.sources import open_source
from segfloor_ros.cloud.labelled_cloud import FLOOR as FLOOR_POINT
from segfloor_ros.cloud.labelled_cloud import OBSTACLE, LabelledPoints, read_ply
from segfloor_ros.configuration import resolve
from segfloor_ros.evaluation.maps import MapTruth, load_truth, states
from segfloor_ros.files.images import check_same_size, read_mask
from segfloor_ros.files.whole import read_text
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE, FloorSegmentationSettings
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import (
    FREE,
    FREE_PIXEL,
    OCCUPIED,
    OCCUPIED_PIXEL,
    UNKNOWN_PIXEL,
    OccupancyGrid,
    load_map,
)
from segfloor_ros.results_folder import MOUNT_FIGURES, read_summary
from segfloor_ros.trajectory import read_trajectory

FLOOR_TINT, NO_EVIDENCE_TINT, MOVING_TINT = (80, 190, 60), (60, 200, 240), (60, 60, 230)
MOVING = 255
STRIP_WIDTH_PX = 480
MAX_DRAWN_POINTS = 60000
MARGIN_CELLS = 5
PATH_CELL_M = 0.05

STRIP_LENGTH = 6


def map_picture(data: ReportData) -> bytes:
    """Draw the map with the path of the base and its keyframes."""
    figure, axes = _figure(data.grid)
    _show_grid(axes, data.grid)
    axes.plot(*data.trajectory[:, :2, 3].T, color='tab:blue', linewidth=1.6, label='path')
    axes.plot(*data.keyframes[:, :2, 3].T, '.', color='tab:orange', markersize=4, label='keyframes')
    axes.plot(*data.trajectory[0, :2, 3], 'o', color='tab:green', label='start')
    axes.legend(loc='upper right', fontsize=8, framealpha=0.9)
    return _png(figure)


def cloud_picture(data: ReportData) -> bytes:
    """Draw the labelled cloud from above: floor green, obstacles by height."""
    figure, axes = _figure(data.grid)
    floor, obstacles = (_some(data.cloud, label) for label in (FLOOR_POINT, OBSTACLE))
    axes.scatter(floor[:, 0], floor[:, 1], s=1.0, color='#3aa655', label='floor', linewidths=0)
    drawn = axes.scatter(
        obstacles[:, 0], obstacles[:, 1], s=1.6, c=obstacles[:, 2], cmap='plasma',
        vmin=0, vmax=2, linewidths=0, label='obstacle',
    )  # fmt: skip
    axes.plot(*data.trajectory[:, :2, 3].T, color='black', linewidth=0.8)
    figure.colorbar(drawn, ax=axes, label='height [m]', shrink=0.7, pad=0.02)
    axes.set_facecolor('#f4f4f4')
    return _png(figure)


def floor_pictures(data: ReportData) -> list[tuple[str, bytes]]:
    """Return keyframes with their floor tinted, each with a caption."""
    tints = {FLOOR: FLOOR_TINT, NO_EVIDENCE: NO_EVIDENCE_TINT}
    return [(f'frame {item.frame.index}', _tinted(item, tints)) for item in data.strip]


def moving_pictures(data: ReportData) -> list[tuple[str, bytes]]:
    """Return keyframes with what moves tinted, each with a caption."""
    tints = {MOVING: MOVING_TINT}
    return [(f'frame {item.frame.index}', _tinted(item, tints)) for item in data.moving]


def v_disparity_picture(data: ReportData) -> bytes | None:
    """Draw the v-disparity of a keyframe, without obstacles, with the profile that was fitted to
    it; None where no keyframe was kept.
    """
    if not data.strip:
        return None
    frame = data.strip[len(data.strip) // 2].frame
    stage = FloorSegmentation(data.camera, data.floor_settings)
    floor = stage.process(frame.left, frame.right, data.mount)
    counted = floor.v_disparity
    rows, bins = counted.counts.shape
    extent = (0, bins / counted.bins_per_px, counted.first_row + rows, counted.first_row)
    figure = Figure(figsize=(10, 4.4), layout='constrained')
    axes = figure.subplots()
    axes.imshow(
        np.ma.masked_equal(counted.counts, 0), extent=extent, aspect='auto',
        norm=LogNorm(1, max(2, counted.counts.max())), cmap='inferno', interpolation='nearest',
    )  # fmt: skip
    axes.plot(floor.profile_px, np.arange(data.camera.height), color='#00e5ff', linewidth=0.7)
    axes.set(xlabel='disparity [px]', ylabel='image row', title=f'frame {frame.index}')
    axes.set_facecolor('black')
    return _png(figure)


def memory_picture(memory: dict[str, Any]) -> bytes | None:
    """Return a PNG of the memory over the map updates, or None where it was not noted."""
    samples = memory.get('samples', [])
    if len(samples) < 2:
        return None
    figure = Figure(figsize=(10, 2.4), layout='constrained')
    axes = figure.subplots()
    updates = np.arange(len(samples)) * memory.get('updates_per_sample', 1)
    axes.plot(updates, samples)
    axes.set_ylim(bottom=0)
    axes.set_xlabel('map update')
    axes.set_ylabel('MB')
    axes.grid(alpha=0.3)
    return _png(figure)


def _tinted(item: MaskedFrame, tints: dict[int, tuple[int, int, int]]) -> bytes:
    picture = cv2.cvtColor(item.frame.left, cv2.COLOR_GRAY2BGR).astype(np.float32)
    for value, tint in tints.items():
        pixels = item.mask == value
        picture[pixels] = 0.62 * picture[pixels] + 0.38 * np.array(tint, np.float32)
    scale = STRIP_WIDTH_PX / picture.shape[1]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode('.jpg', small.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return bytes(encoded)


def _figure(grid: OccupancyGrid) -> tuple[Figure, Axes]:
    """Return a figure whose axes show the known part of a grid with equal scales."""
    known = np.argwhere(grid.cells >= 0)
    low, high = np.zeros(2), np.array(grid.cells.shape)
    if len(known):
        low, high = known.min(axis=0) - MARGIN_CELLS, known.max(axis=0) + 1 + MARGIN_CELLS
    rows, columns = high - low
    figure = Figure(figsize=(8, float(np.clip(8 * rows / columns, 2.5, 10)) + 0.8))
    axes = figure.subplots()
    x, y = grid.origin_xy_m
    axes.set(
        xlabel='x [m]',
        ylabel='y [m]',
        xlim=(x + low[1] * grid.resolution_m, x + high[1] * grid.resolution_m),
        ylim=(y + low[0] * grid.resolution_m, y + high[0] * grid.resolution_m),
    )
    axes.set_aspect('equal')
    return figure, axes


def _show_grid(axes: Axes, grid: OccupancyGrid) -> None:
    state = states(grid)
    shades = [FREE_PIXEL, OCCUPIED_PIXEL]
    grey = np.select([state == FREE, state == OCCUPIED], shades, UNKNOWN_PIXEL)
    rows, columns = state.shape
    x, y = grid.origin_xy_m
    extent = (x, x + columns * grid.resolution_m, y, y + rows * grid.resolution_m)
    axes.imshow(
        grey, extent=extent, origin='lower', cmap='gray', vmin=0, vmax=255, interpolation='nearest'
    )


def _some(cloud: LabelledPoints, label: int) -> NDArray[np.float32]:
    """Return the points (N, 3) of a label, thinned evenly where there are many."""
    points = cloud.xyz_map[cloud.label == label]
    return points[:: max(1, len(points) // MAX_DRAWN_POINTS)]


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=120, bbox_inches='tight', metadata={'Software': None})
    return buffer.getvalue()


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
    trajectory = read_trajectory(folder / 'trajectory.txt')[1]
    return ReportData(
        folder=folder,
        name=Path(source.name).name,
        summary=summary,
        settings_text=read_text(settings),
        floor_settings=parameters.floor_segmentation,
        camera=source.camera,
        mount=Mount(*(summary[name] or 0.0 for name in MOUNT_FIGURES)),
        grid=_grid(folder / 'map.yaml', trajectory),
        trajectory=trajectory,
        keyframes=read_trajectory(folder / 'keyframes.txt')[1],
        cloud=read_ply(folder / 'labelled_cloud.ply'),
        strip=_masked_frames(folder / 'floor_masks', source.frames()),
        moving=_masked_frames(folder / 'moving_masks', source.frames()),
        truth=load_truth(truth) if truth is not None else None,
        truth_folder=truth if truth is not None and truth.is_dir() else None,
    )


def _grid(path: Path, trajectory: Array) -> OccupancyGrid:
    """Return the map; where a drive has none, cells of which nothing is known around its path."""
    if path.exists():
        return load_map(path)
    lowest, highest = (trajectory[:, :2, 3].min(0) - 1.0, trajectory[:, :2, 3].max(0) + 1.0)
    columns, rows = np.ceil((highest - lowest) / PATH_CELL_M).astype(int)
    unknown = np.full((rows, columns), -1, np.int8)
    return OccupancyGrid(unknown, PATH_CELL_M, (float(lowest[0]), float(lowest[1])))


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
