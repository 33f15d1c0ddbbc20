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
from matplotlib.patches import Patch
from numpy.typing import NDArray

from segfloor_ros.apps.calibration import CalibrationResult, eight_bit, rectified_pixels
from segfloor_ros.apps.evaluation.maps import MapTruth, load_truth, thinned
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.ply import read_ply
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.results_folder import MOUNT_FIGURES, read_summary
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.contracts import (
    CELL_M,
    POINT_FLOOR,
    POINT_OBSTACLE,
    POINT_UNKNOWN,
    LabelledPoints,
    Mount,
    StereoFrame,
)
from segfloor_ros.core.files.images import check_same_size, jpeg_bytes, read_grey, read_mask
from segfloor_ros.core.files.whole import read_text
from segfloor_ros.core.floor.pictures import mask_overlay
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import (
    FREE_PIXEL,
    OCCUPIED_PIXEL,
    UNKNOWN_PIXEL,
    OccupancyGrid,
)
from segfloor_ros.nodes.configuration import resolve

FLOOR, NO_EVIDENCE = '#3aa655', f'{UNKNOWN_PIXEL / 255}'
"""Of points; what nothing is known of has the grey that it has in a map."""

CORNER_TINT, CORNER_PX = (40, 140, 250), 4

MARGIN_CELLS = 5

STRIP_LENGTH, STRIP_WIDTH_PX = 6, 480
"""Keyframes that are shown, and the width of each."""


def map_picture(data: ReportData) -> bytes:
    """Draw the map with the path of the base, its keyframes and the loops that were closed."""
    figure, axes = _figure(data.grid)
    _show_grid(axes, data.grid)
    axes.plot(*data.trajectory[:, :2, 3].T, color='tab:blue', linewidth=1.6, label='path')
    axes.plot(*data.keyframes[:, :2, 3].T, '.', color='tab:orange', markersize=4, label='keyframes')
    if len(data.loops_xy):
        axes.plot(*data.loops_xy.T, 'o', color='tab:red', markersize=7, label='loop closed')
    _show_ends(axes, data)
    grey = {'free': FREE_PIXEL, 'occupied': OCCUPIED_PIXEL, 'no evidence': UNKNOWN_PIXEL}
    _legend(axes, {name: f'{level / 255}' for name, level in grey.items()})
    return _png(figure)


def cloud_picture(data: ReportData) -> bytes:
    """Draw the labelled cloud from above: floor green, obstacles by height."""
    figure, axes = _figure(data.grid)
    axes.set_facecolor('#f4f4f4')
    for label, colour in ((POINT_UNKNOWN, NO_EVIDENCE), (POINT_FLOOR, FLOOR)):
        points = thinned(data.cloud.xyz_map[data.cloud.label == label])
        axes.scatter(points[:, 0], points[:, 1], s=1.0, color=colour, linewidths=0)
    points = thinned(data.cloud.xyz_map[data.cloud.label == POINT_OBSTACLE])
    drawn = axes.scatter(
        points[:, 0], points[:, 1], s=1.6, c=points[:, 2], cmap='plasma', vmin=0, vmax=2,
        linewidths=0,
    )  # fmt: skip
    axes.plot(*data.trajectory[:, :2, 3].T, color='tab:blue', linewidth=0.8, label='path')
    _show_ends(axes, data)
    figure.colorbar(drawn, ax=axes, label='height of obstacles [m]', shrink=0.7, pad=0.02)
    _legend(axes, {'floor': FLOOR, 'no evidence': NO_EVIDENCE})
    return _png(figure)


def keyframe_pictures(data: ReportData) -> list[tuple[str, bytes]]:
    """Return keyframes tinted by their floor and by what moves, each with a caption."""
    return [(f'frame {item.frame.index}', _tinted(item)) for item in data.strip]


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


def _tinted(item: MaskedFrame) -> bytes:
    picture = mask_overlay(item.frame.left, item.mask, item.moving)
    scale = STRIP_WIDTH_PX / picture.shape[1]
    return jpeg_bytes(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _show_ends(axes: Axes, data: ReportData) -> None:
    """Mark where the drive starts and ends, and how long the way from tick to tick is."""
    start, end = data.trajectory[[0, -1], :2, 3]
    axes.plot(*start, 'o', color='tab:green', label='start')
    axes.plot(*end, 's', color='tab:purple', label='end')
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    length = float(np.diff(axes.get_xticks()[:2])[0])
    x, y = left + (right - left) / 40, bottom + (top - bottom) / 40
    axes.plot([x, x + length], [y, y], color='black', linewidth=3, solid_capstyle='butt')
    axes.annotate(f'{length:g} m', (x + length / 2, y), (0, 4), textcoords='offset points',
                  ha='center', fontsize=8)  # fmt: skip


def _legend(axes: Axes, colours: dict[str, str]) -> None:
    """Name every colour, below the axes: of lines by their labels, and of areas."""
    areas = [Patch(facecolor=c, edgecolor='grey', label=name) for name, c in colours.items()]
    lines = axes.get_legend_handles_labels()[0]
    axes.legend(
        handles=[*lines, *areas],
        loc='upper center',
        bbox_to_anchor=(0.5, 0.0),
        borderaxespad=4.5,
        ncols=4,
        fontsize=9,
        frameon=False,
    )


def coverage_picture(result: CalibrationResult) -> bytes:
    """Draw where both eyes saw corners of the board, their hull, and those of the worst pair."""
    eye, worst = result.calibration.left, result.views[0]
    figure = Figure(figsize=(10, 0.4 + 4.6 * eye.height / eye.width), layout='constrained')
    for side, axes in enumerate(figure.subplots(1, 2)):
        corners = np.concatenate([view.corners[side] for view in result.views])
        axes.fill(*cv2.convexHull(corners)[:, 0].T, color='tab:blue', alpha=0.12, linewidth=0)
        axes.plot(*corners[:, 0].T, '.', color='tab:blue', markersize=2.5)
        axes.plot(*worst.corners[side][:, 0].T, '.', color='tab:orange', markersize=4)
        title = f'{("left", "right")[side]}: {result.seen_share(side):.0%} of the image'
        axes.set(title=title, xlim=(0, eye.width), ylim=(eye.height, 0), aspect='equal')
    return _png(figure)


def pair_picture(result: CalibrationResult) -> bytes:
    """Draw the worst pair as it is rectified, with its corners, and lines on which both eyes should
    have them.
    """
    calibration, view = result.calibration, result.views[0]
    left, right = (eight_bit(read_grey(path)) for path in view.paths)
    pair = np.hstack(StereoRectifier(calibration).rectify(left, right))
    drawn = cv2.cvtColor(pair, cv2.COLOR_GRAY2BGR)
    left_px = rectified_pixels(calibration.left, view.corners[0])
    right_px = rectified_pixels(calibration.right, view.corners[1])
    right_px[:, 0] += left.shape[1]
    for u, v in np.rint(np.concatenate([left_px, right_px])).astype(int).tolist():
        cv2.circle(drawn, (u, v), CORNER_PX, CORNER_TINT, 1, cv2.LINE_AA)
    by_row = left_px[np.argsort(left_px[:, 1])]
    for _, v in np.rint(by_row[:: result.board.columns]).astype(int).tolist():
        cv2.line(drawn, (0, v), (pair.shape[1] - 1, v), CORNER_TINT, 1)
    return jpeg_bytes(drawn)


def _figure(grid: OccupancyGrid) -> tuple[Figure, Axes]:
    """Return a figure whose axes show the known part of a grid with equal scales."""
    known = np.argwhere(grid.cells >= 0)
    low, high = np.zeros(2), np.array(grid.cells.shape)
    if len(known):
        low, high = known.min(axis=0) - MARGIN_CELLS, known.max(axis=0) + 1 + MARGIN_CELLS
    rows, columns = high - low
    figure = Figure(figsize=(8, float(np.clip(8 * rows / columns, 2.5, 10)) + 0.8))
    axes = figure.subplots()
    shown = np.array(grid.origin_xy_m) + np.stack([low, high])[:, ::-1] * grid.resolution_m
    axes.set(xlabel='x [m]', ylabel='y [m]', xlim=shown[:, 0], ylim=shown[:, 1], aspect='equal')
    return figure, axes


def _show_grid(axes: Axes, grid: OccupancyGrid) -> None:
    axes.imshow(
        grid.picture, extent=grid.extent_m, cmap='gray', vmin=0, vmax=255, interpolation='nearest'
    )


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=120, bbox_inches='tight', metadata={'Software': None})
    return buffer.getvalue()


@dataclass(frozen=True)
class MaskedFrame:
    """A keyframe's rectified pair with masks (H, W) uint8 of its floor, and of what moves."""

    frame: StereoFrame
    mask: NDArray[np.uint8]
    moving: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class ReportData:
    """A run as its files tell it. times_s: (N,) stamps of the trajectory. trajectory, keyframes:
    base poses (N, 4, 4) in `map`. loops_xy: (L, 2) where loops were closed. strip: keyframes with
    their floor, evenly over the drive, and those in which something moves, likewise. settings_text:
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
    times_s: Array
    trajectory: Array
    keyframes: Array
    loops_xy: Array
    cloud: LabelledPoints
    strip: list[MaskedFrame]
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
    times_s, trajectory = read_trajectory(folder / 'trajectory.txt')
    keyframe_s, keyframes = read_trajectory(folder / 'keyframes.txt', may_be_empty=True)
    closed = np.searchsorted(keyframe_s, summary.get('loop_times_s', []))
    return ReportData(
        folder=folder,
        name=Path(source.name).name,
        summary=summary,
        settings_text=read_text(settings),
        floor_settings=parameters.floor_segmentation,
        camera=source.camera,
        mount=Mount(*(summary[name] or 0.0 for name in MOUNT_FIGURES)),
        grid=_grid(folder / 'map.yaml', trajectory),
        times_s=times_s,
        trajectory=trajectory,
        keyframes=keyframes,
        loops_xy=keyframes[closed.clip(max=len(keyframes) - 1).astype(int), :2, 3],
        cloud=read_ply(folder / 'labelled_cloud.ply'),
        strip=_masked_frames(folder, source.frames()),
        truth=load_truth(truth) if truth is not None else None,
        truth_folder=truth if truth is not None and truth.is_dir() else None,
    )


def _grid(path: Path, trajectory: Array) -> OccupancyGrid:
    """Return the map; where a drive has none, cells of which nothing is known around its path."""
    if path.exists():
        return load_map(path)
    lowest, highest = (trajectory[:, :2, 3].min(0) - 1.0, trajectory[:, :2, 3].max(0) + 1.0)
    columns, rows = np.ceil((highest - lowest) / CELL_M).astype(int)
    unknown = np.full((rows, columns), -1, np.int8)
    return OccupancyGrid(unknown, CELL_M, (float(lowest[0]), float(lowest[1])))


def _masked_frames(folder: Path, frames: Iterable[StereoFrame]) -> list[MaskedFrame]:
    """Return some keyframes evenly over the drive, and some of those in which something moves."""
    floors, moving = (_masks(folder / name) for name in ('floor_masks', 'moving_masks'))
    both = {index: path for index, path in floors.items() if index in moving}
    wanted = _evenly(floors) | _evenly(both)
    strip: list[MaskedFrame] = []
    for frame in frames:
        if len(strip) == len(wanted):
            break
        if frame.index in wanted:
            paths = [masks[frame.index] for masks in (floors, moving) if frame.index in masks]
            found = [read_mask(path) for path in paths]
            for mask, path in zip(found, paths, strict=True):
                check_same_size(mask, frame.left.shape, path)
            strip.append(MaskedFrame(frame, *found))
    return strip


def _masks(folder: Path) -> dict[int, Path]:
    """Return the masks of a folder by the index of their frame."""
    return {int(path.stem): path for path in sorted(folder.glob('[0-9]' * 6 + '.png'))}


def _evenly(masks: dict[int, Path]) -> set[int]:
    """Return a few of the frames, evenly over the drive."""
    frames = list(masks)
    rows = np.linspace(0, len(frames) - 1, STRIP_LENGTH).round().astype(int)
    return {frames[row] for row in rows} if frames else set()
