"""What each mechanism of floor segmentation, labelling and grid brings: it is left out, and the
maps of drives are scored without it.

    python -m tools.ablation record CACHE DRIVE…     SLAM once per drive; its keyframes are kept
    python -m tools.ablation compare CACHE DRIVE…    one row for each mechanism left out

Only floor, cloud and grid run again, on the same keyframes: differences are not those of SLAM.
"""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.camera.sources import open_source
from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.evaluation.map_score import MapScore, score_map
from segfloor_ros.evaluation.truth import load_truth
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.slam.results import Keyframe
from segfloor_ros.stages import make_slam

ROOM = 'segfloor_ros.'
Patch = tuple[str, Any]
app = typer.Typer(help=__doc__)


def _nothing(*_: object, **__: object) -> None:
    return None


def _first(value: Any, *_: object, **__: object) -> Any:
    return value


def _second(_: object, value: Any, *__: object) -> Any:
    return value


VARIANTS: dict[str, list[Patch]] = {
    'nothing': [],
    'memory': [('floor.remembered_floor.FloorMemory.fill', lambda self, view, mask, *_: mask)],
    'slope ahead': [('floor.segmentation.FloorSegmentation._slope', _nothing)],
    'level expectation': [
        (
            'floor.segmentation.FloorSegmentation._expectations',
            lambda self, mount, _: np.array([[mount.pitch_rad, mount.roll_rad, mount.height_m]]),
        )
    ],
    'guard at the right border': [('floor.segmentation._BORDER_BLOCKS', 0)],
    'floor up to contacts': [
        (
            'floor.filling.fill_to_contact',
            lambda view, mask, alike, *_: np.zeros(alike.shape, np.bool_),
        )
    ],
    'filling of regions': [('floor.segmentation.fill_regions', lambda view, mask, *_: mask)],
    'filling of gaps': [('floor.segmentation.fill_gaps', lambda view, profile, mask, *_: mask)],
    'islands dropped': [('floor.segmentation.drop_islands', _first)],
    'end of texture': [
        ('floor.segmentation.beyond_texture', lambda mask, _: np.zeros(mask.shape, np.bool_))
    ],
    'what stands beside the left border': [
        ('floor.segmentation.beside_something', lambda _, mask: np.zeros(mask.shape, np.bool_))
    ],
    'trimming to edges': [('floor.segmentation.trim_to_edges', _first)],
    'ray limit Q3 + 1.5 IQR': [('grid.keyframe_evidence.ray_length_limit', lambda _: np.inf)],
    'rays shortened': [('grid.keyframe_evidence._certain', _first)],
    'partly free edges': [
        ('grid.fan.Fan.edges', lambda self: np.zeros(len(self.lengths), np.bool_))
    ],
    'dilation of hits': [('grid.fold._AROUND', np.ones((1, 1), np.uint8))],
    'slant': [('grid.keyframe_evidence.slant', lambda range_m, _: np.ones(len(range_m)))],
    'shadows of what stands': [('grid.fan.Fan.shadow', _nothing)],
}
"""By name, what is patched to leave a mechanism out."""


def left_out(name: str) -> ExitStack:
    """Return a context in which a mechanism is left out."""
    stack = ExitStack()
    for target, value in VARIANTS[name]:
        stack.enter_context(mock.patch(ROOM + target, value))
    return stack


def record_keyframes(file: Path, configuration: Configuration) -> int:
    """Run SLAM over a drive and pickle the camera and each keyframe with its mount."""
    source = open_source(configuration.stereo_camera)
    slam = make_slam(source.camera, configuration.stereo_slam)
    count = 0
    with file.open('wb') as out:
        pickle.dump(source.camera, out)
        for frame in source.frames():
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
            found = floor.process(key.left, key.right, mount, key.T_map_base)
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
    return score_map(grid, truth, truth.start_pose or (0.0, 0.0, 0.0))


def figures(score: MapScore) -> list[float]:
    """Return precision and recall of road maps and of free cells, and the share of the outline that
    is marked, in percent.
    """
    cells = score.cells
    values = (score.raw.precision.mean, score.raw.recall.mean, cells.free_precision)
    return [100 * v for v in (*values, cells.free_recall, cells.occupied_recall)]


@app.command()
def record(
    cache: Path, drives: list[Path], params: Annotated[Path | None, typer.Option()] = None
) -> None:
    """Run SLAM over drives and keep the keyframes."""
    cache.mkdir(parents=True, exist_ok=True)
    for drive in drives:
        configuration = resolve(params, (), stereo_camera={'input': str(drive)})
        count = record_keyframes(cache / f'{drive.name}.pkl', configuration)
        print(drive.name, count, flush=True)


@app.command('compare')
def compare_variants(
    cache: Path,
    drives: list[Path],
    every: Annotated[int, typer.Option(help='Use one keyframe in so many.')] = 1,
    only: Annotated[list[str] | None, typer.Option(help='Only these mechanisms.')] = None,
) -> None:
    """Print a row of figures for each mechanism left out of the map of each drive."""
    configuration = resolve()
    for drive in drives:
        file = cache / f'{drive.name}.pkl'
        whole = segment(file, configuration, every)
        for name, patches in VARIANTS.items():
            if only and name not in ('nothing', *only):
                continue
            with left_out(name):
                in_grid = all(target.startswith('grid.') for target, _ in patches)
                seen = (
                    whole if in_grid else segment(cache / f'{drive.name}.pkl', configuration, every)
                )
                row = figures(score(map_of(seen, configuration), drive))
            print(drive.name, name, *(f'{value:.2f}' for value in row), sep=' | ', flush=True)


if __name__ == '__main__':
    app()
