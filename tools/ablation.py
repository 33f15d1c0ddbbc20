"""What each mechanism brings: it is left out, and drives are scored without it.

    python -m tools.ablation path DRIVE…               SLAM: the error of the path
    python -m tools.ablation masks DRIVE…              floor segmentation: true masks, true poses
    python -m tools.ablation record CACHE DRIVE…       SLAM once per drive; its keyframes are kept
    python -m tools.ablation map CACHE DRIVE…          floor, labelling and grid on these: the map

`--noise SEED` adds noise of one grey level to the images: how far a figure goes with it is its
spread, and what changes less than that on every drive brings nothing.
"""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.floor import count_pixels, draw_outline, read_outlines
from segfloor_ros.apps.evaluation.map_score import MapScore, score_map
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.cloud import CloudLabelling
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FloorScan, Keyframe, Mount, StereoFrame
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.nodes.configuration import resolve
from tools.driving import noisy
from tools.mechanisms import FLOOR as FLOOR_MECHANISMS
from tools.mechanisms import GRID, NOTHING, RECORDED, SLAM
from tools.slam_drives import track

Drives = Annotated[list[Path], typer.Argument(help='Recordings with a truth.')]
Only = Annotated[list[str] | None, typer.Option(help='Only these mechanisms.')]
Noise = Annotated[int, typer.Option(help='Seed of the noise added; 0: none.')]
app = typer.Typer(help=__doc__)


def chosen(names: Any, only: list[str] | None) -> list[str]:
    """Return the names to leave out, `nothing` always among them."""
    return [name for name in names if not only or name in (NOTHING, *only)]


def print_row(*values: object) -> None:
    """Print a row of a table."""
    texts = (f'{v:.4f}' if isinstance(v, float) else str(v) for v in values)
    print(*texts, sep=' | ', flush=True)


@app.command('path')
def compare_paths(
    drives: Drives,
    end: Annotated[
        str, typer.Option(help='Where the camera ends: X,Y,Z from where it began.')
    ] = '',
    params: Annotated[Path | None, typer.Option()] = None,
    only: Only = None,
    noise: Noise = 0,
) -> None:
    """Print the error of the path without each mechanism of SLAM: RMSE, or with --end that of the
    last pose, in metres; the frames tracked, keyframes and points.
    """
    for drive in drives:
        configuration = resolve(params, (), stereo_camera={'input': str(drive)})
        for name in chosen(SLAM, only):
            mechanism = SLAM[name]
            with mechanism.left_out():
                tracked = track(drive, mechanism.configured(configuration), noise)
            if end:
                error_m = tracked.end_error_m(np.array([float(v) for v in end.split(',')]))
            else:
                error_m = tracked.score(drive).ate_rmse_m
            print_row(drive.name, name, error_m, tracked.frames, tracked.keyframes, tracked.points)


@dataclass(frozen=True)
class TrueMask:
    """A frame, its true mask (H, W) and the base's true pose (4, 4), where known."""

    frame: StereoFrame
    mask: NDArray[np.uint8]
    T_map_base: Array | None


def true_masks(
    drive: Path, mount: Mount, outlines: Path | None, noise: int
) -> tuple[StereoCamera, list[TrueMask]]:
    """Return the frames of a drive of which the floor is known: by `floor/`, or by outlines."""
    source = open_source(resolve(None, (), stereo_camera={'input': str(drive)}).stereo_camera)
    camera, poses = source.camera, None
    if (drive / 'poses.txt').is_file():
        T_first_left = read_trajectory(drive / 'poses.txt')[1]
        poses = mount.T_base_left @ T_first_left @ invert(mount.T_base_left)
    known = read_outlines(outlines) if outlines else {}
    found = []
    for frame in noisy(source.frames(), noise):
        outline, file = known.get(frame.index), drive / 'floor' / f'{frame.index:06d}.png'
        if outline is not None:
            mask = draw_outline(outline, frame.left.shape)
        elif file.is_file():
            mask = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)
        else:
            continue
        found.append(TrueMask(frame, mask, None if poses is None else poses[frame.index]))
    return camera, found


@app.command('masks')
def compare_masks(
    drives: Drives,
    mount: Annotated[str, typer.Option(help='Height m, pitch and roll deg.')] = '0.3,7,0',
    outlines: Annotated[Path | None, typer.Option(help='Polygons of the floor.')] = None,
    only: Only = None,
    noise: Noise = 0,
) -> None:
    """Print precision and recall of the masks, in percent, without each mechanism of the floor."""
    height_m, *angles_deg = (float(value) for value in mount.split(','))
    where = Mount(height_m, *np.radians(angles_deg).tolist())
    for drive in drives:
        for name in chosen([*FLOOR_MECHANISMS, 'deblocking'], only):
            counts = np.zeros(5, np.int64)
            with {**FLOOR_MECHANISMS, **RECORDED}[name].left_out():
                camera, frames = true_masks(drive, where, outlines, noise)
                stage = FloorSegmentation(camera, resolve().floor_segmentation)
                for one in frames:
                    left, right = one.frame.left, one.frame.right
                    found = stage.process(left, right, where, one.T_map_base)
                    counts += count_pixels(found.mask, one.mask)
            hit, false, missed = (float(v) for v in counts[:3])
            print_row(drive.name, name, 100 * hit / (hit + false), 100 * hit / (hit + missed))


def record_keyframes(file: Path, configuration: Configuration, noise: int = 0) -> int:
    """Run SLAM over a drive and pickle the camera and each keyframe with its mount."""
    source = open_source(configuration.stereo_camera)
    slam = make_slam(source.camera, configuration.stereo_slam)
    count = 0
    with file.open('wb') as out:
        pickle.dump(source.camera, out)
        for frame in noisy(source.frames(), noise):
            for result in slam.process(frame):
                if result.keyframe is not None:
                    pickle.dump((slam.mount, result.keyframe), out)
                    count += 1
    slam.close()
    return count


def keyframes_of(file: Path) -> tuple[StereoCamera, Iterator[tuple[Mount, Keyframe]]]:
    """Return the camera and the keyframes of `record_keyframes`."""
    stream = file.open('rb')
    camera = pickle.load(stream)
    size = file.stat().st_size

    def items() -> Iterator[tuple[Mount, Keyframe]]:
        with stream:
            while stream.tell() < size:
                yield pickle.load(stream)

    return camera, items()


@dataclass
class Seen:
    """What floor segmentation made of one keyframe, and the keyframe without its images."""

    key: Keyframe
    mask: NDArray[np.uint8]
    scan: FloorScan


def segment(file: Path, configuration: Configuration, every: int) -> list[Seen]:
    """Return what floor segmentation makes of one in `every` of the kept keyframes."""
    camera, keyframes = keyframes_of(file)
    floor = FloorSegmentation(camera, configuration.floor_segmentation)
    seen = []
    for index, (mount, key) in enumerate(keyframes):
        if index % every == 0:
            found = floor.process(key.left, key.right, mount, key.T_map_base, key.moving)
            empty = np.zeros((0, 0), np.uint8)
            bare = dataclasses.replace(key, left=empty, right=empty)
            seen.append(Seen(bare, found.mask, found.scan))
    return seen


def map_of(seen: list[Seen], configuration: Configuration) -> OccupancyGrid:
    """Return the map of segmented keyframes."""
    labelling = CloudLabelling(configuration.cloud_labelling)
    mapper = OccupancyGridMapper(configuration.occupancy_grid)
    for one in seen:
        key = one.key
        points = labelling.update(key.cloud, key.features, one.mask, key.T_map_base)
        mapper.update(key.stamp_ns, points, key.features, key.path, one.scan)
    return mapper.grid()


def score(grid: OccupancyGrid, drive: Path) -> MapScore:
    """Return the score of a map of a simulated drive."""
    truth = load_truth(drive)
    return score_map(grid, truth)


def figures(score: MapScore) -> list[float]:
    """Return precision and recall of road maps and of free cells, and the share of the outline that
    is marked, in percent.
    """
    cells = score.cells
    values = (score.raw.precision.mean, score.raw.recall.mean, cells.free_precision)
    return [100 * v for v in (*values, cells.free_recall, cells.occupied_recall)]


@app.command()
def record(cache: Path, drives: Drives, noise: Noise = 0) -> None:
    """Run SLAM over drives and keep the keyframes, also of SLAM without what changes its input."""
    cache.mkdir(parents=True, exist_ok=True)
    for drive in drives:
        configuration = resolve(None, (), stereo_camera={'input': str(drive)})
        print(drive.name, record_keyframes(cache / f'{drive.name}.pkl', configuration, noise))
        for name, mechanism in RECORDED.items() if not noise else ():
            with mechanism.left_out():
                record_keyframes(cache / f'{drive.name}-{name}.pkl', configuration)


@app.command('map')
def compare_maps(
    cache: Path,
    drives: Drives,
    every: Annotated[int, typer.Option(help='Use one keyframe in so many.')] = 1,
    only: Only = None,
) -> None:
    """Print precision and recall of road maps and of free cells, and the share of the outline that
    is marked, in percent, without each mechanism.
    """
    configuration = resolve()
    for drive in drives:
        whole = segment(cache / f'{drive.name}.pkl', configuration, every)
        for name in chosen([*FLOOR_MECHANISMS, *GRID, *RECORDED], only):
            mechanism = {**FLOOR_MECHANISMS, **GRID, **RECORDED}[name]
            own = cache / f'{drive.name}-{name}.pkl'
            if name in RECORDED and not own.is_file():
                continue
            with mechanism.left_out():
                seen = whole
                if name in RECORDED or (name in FLOOR_MECHANISMS and name != NOTHING):
                    file = own if name in RECORDED else cache / f'{drive.name}.pkl'
                    seen = segment(file, configuration, every)
                grid = map_of(seen, configuration) if seen else None
            print_row(drive.name, name, *(figures(score(grid, drive)) if grid else ('no map',)))


if __name__ == '__main__':
    app()
