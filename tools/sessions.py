"""A building that is driven through day after day: does its map grow, and does it stay right?

    python -m tools.sessions FOLDER --sessions 12 --light     renders, drives and prints a table

Two rooms with a door between. From day to day about half of the furniture is moved, and with
`--light` it is day, evening or lamplight. Each drive goes on with the map of the one before. It is
rendered once; `--every-map` keeps the map of each day, `--prune` prunes it.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from segfloor_ros.apps.evaluation.maps import load_truth, resample
from segfloor_ros.apps.simulation.scene_file import scene_from_mapping
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.results import read_map_file, write_map_file
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid
from segfloor_ros.core.pipeline import Pipeline
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.core.plugins.maps.map_arrays import fill_map
from segfloor_ros.core.plugins.maps.pruning import prune
from segfloor_ros.core.plugins.maps.saved_pipeline import load_pipeline, save_pipeline
from segfloor_ros.core.slam.places.place_recognition import PlaceRecognition
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.session import SessionState
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.nodes.configuration import resolve
from tools.driving import open_recording

WAY = [
    (-2.6, -1.5), (-1.0, -1.5), (-0.5, 0.0), (0.6, 0.0), (1.4, -1.2), (2.6, -0.9), (2.4, 1.2),
    (1.1, 1.2), (0.4, 0.0), (-0.6, 0.0), (-1.2, 1.3), (-2.5, 1.2), (-2.5, -0.4), (-1.4, -1.4),
]  # fmt: skip
HALF = (3.4, 2.3)
THINGS = ('chair', 'chair', 'chair', 'stool', 'table', 'plant')
BOXES = ('goods', 'wood', 'granite', 'cloth')
CLEARANCE_M, OF_TABLE_M = 0.62, 0.9
LIGHTS: dict[str, Any] = {
    'day': {'lighting': {'ambient': 0.65}},
    'evening': {
        'lighting': {'ambient': 0.5, 'turn_deg': 140.0, 'levels': [[0, 0.6], [99, 0.6]]},
        'camera': {'gamma': 0.8},
    },
    'lamp': {
        'lighting': {'ambient': 0.35, 'turn_deg': 250.0, 'levels': [[0, 0.5], [99, 0.5]]},
        'camera': {'gamma': 1.2},
    },
}
CAMERA = {'width': 320, 'height': 240, 'rate_hz': 4.0, 'auto_exposure': 0.7}
GHOST_M = 0.2
"""An occupied cell so far from all that stands is a ghost."""

Scene = dict[str, Any]


def make_sessions(count: int, light: bool, seed: int) -> list[Scene]:
    """Return scenes of the same building, day by day."""
    rng = np.random.default_rng([seed, 28])
    things = [_placed(kind, rng) for kind in (*THINGS, *BOXES)]
    scenes = []
    for day in range(count):
        lit = LIGHTS[list(LIGHTS)[day % len(LIGHTS) if light else 0]]
        if day:
            things = [_placed(t['name'], rng) if rng.random() < 0.5 else t for t in things]
        way = np.array(WAY)
        way[2:] += rng.uniform(-0.08, 0.08, way[2:].shape)
        x, y = HALF
        walls = [
            {
                'points': [[-x, -y], [x, -y], [x, y], [-x, y]], 'closed': True,
                'texture': 'rough_plaster', 'posters': 10,
            },
            {'points': [[0.0, -y], [0.0, -0.6]], 'texture': 'bricks'},
            {'points': [[0.0, 0.6], [0.0, y]], 'texture': 'bricks'},
        ]  # fmt: skip
        scenes.append(
            {
                'description': f'A building, day {day + 1}.',
                'seed': seed,
                'floor': {'texture': 'wood'},
                'walls': walls,
                'boxes': [t['scene'] for t in things if t['name'] in BOXES],
                'furniture': [t['scene'] for t in things if t['name'] in THINGS],
                'lighting': lit['lighting'],
                'camera': {'width': 320, 'height': 240, 'rate_hz': 4.0, 'auto_exposure': 0.7}
                | lit.get('camera', {}),
                'path': {'waypoints': np.round(way, 3).tolist(), 'speed_m_s': 0.6},
            }
        )
    return scenes


def _placed(name: str, rng: np.random.Generator) -> Scene:
    """Return a thing at a place beside the way."""
    way = np.concatenate([np.linspace(a, b, 30) for a, b in itertools.pairwise(WAY)])
    clearance_m = OF_TABLE_M if name == 'table' else CLEARANCE_M
    while True:
        at = rng.uniform(-1, 1, 2) * (np.array(HALF) - 0.35)
        if np.linalg.norm(way - at, axis=1).min() > clearance_m and abs(at[0]) > 0.4:
            break
    place: Scene = {'at': np.round(at, 2).tolist(), 'yaw_deg': float(rng.integers(360))}
    if name in BOXES:
        size = np.round(rng.uniform((0.3, 0.25, 0.2), (0.5, 0.4, 1.2)), 2).tolist()
        return {'name': name, 'scene': place | {'size': size, 'texture': name}}
    return {'name': name, 'scene': place | {'kind': name}}


def drive_session(drive: Path, saved: MapFile | None, first: Path) -> tuple[MapFile, str]:
    """Drive through one day with the map of the day before; returns the map, and a row of the
    table.
    """
    configuration = resolve(None, ())
    source = open_recording(drive, configuration)
    pipeline, query_ms = make_pipeline(source.camera, configuration), float('nan')
    results: list[FrameResult] = []
    with contextlib.closing(pipeline):
        if saved is not None:
            load_pipeline(pipeline, saved, 'map', False)
        frames = list(source.frames())
        if saved is not None:
            query_ms = _query_ms(pipeline, saved, frames)
        for frame in frames:
            results += pipeline.process(frame)
        results += pipeline.finish_tracking()
        grid = pipeline.finish()
        is_known = pipeline.slam.session.state is not SessionState.OUTSIDE
        after = save_pipeline(pipeline) if is_known or saved is None else saved
    assert grid is not None
    errors = _errors_m(results, drive, first)
    tracked = np.isfinite(errors)
    slam = after.parts['slam']
    return after, (
        f'{drive.name} | {len(slam["keyframe_stamp_ns"])} | '
        f'{(slam["keyframe_features"] > 0).sum()} | {len(slam["point_stable_id"])} | '
        f'{len(after.parts["grid"]["stamp_ns"])} | {query_ms:.1f} | '
        f'{tracked.sum()}/{len(errors)} from {int(np.argmax(tracked))} | '
        f'{np.nanmedian(errors):.4f} | {np.nanpercentile(errors, 95):.4f} | '
        f'{_ghosts(grid, drive, first)}'
    )


def _query_ms(pipeline: Pipeline, saved: MapFile, frames: list[Any]) -> float:
    """Return how long a place is looked for, in the median of some frames."""
    sparse_map = SparseMap(Rig(pipeline.slam.rig.camera, None))
    fill_map(sparse_map, saved.parts['slam'])
    places = PlaceRecognition(sparse_map)
    places.from_arrays(saved.parts['slam'])
    took = []
    for frame in frames[:: len(frames) // 8]:
        features = pipeline.slam.front_end.extractor.extract(frame.left, None)
        start_s = time.thread_time()
        places.groups(places.score(features), 8)
        took.append(time.thread_time() - start_s)
    return 1e3 * float(np.median(took))


def _errors_m(results: list[FrameResult], drive: Path, first: Path) -> Array:
    start, truth = load_truth(first).start, load_truth(drive).base_poses
    assert truth is not None
    errors = np.full(len(truth), np.nan)
    c, s = np.cos(start[2]), np.sin(start[2])
    for result in results:
        if result.tracked and not result.outside:
            x, y = (result.T_map_odom @ result.T_odom_base)[:2, 3]
            at = start[0] + c * x - s * y, start[1] + s * x + c * y
            errors[result.index] = np.hypot(*(at - truth[result.index, :2]))
    return errors


def _ghosts(grid: OccupancyGrid, drive: Path, first: Path) -> int:
    """Return how many cells are occupied where nothing is any more."""
    truth = load_truth(drive).grid
    start = load_truth(first).start
    estimate = resample(grid, truth, start)
    near = cv2.distanceTransform((truth.cells == FREE).astype(np.uint8), cv2.DIST_L2, 5)
    return int(((estimate == OCCUPIED) & (near * truth.resolution_m > GHOST_M)).sum())


def main(
    folder: Path,
    sessions: Annotated[int, typer.Option(help='How many days.')] = 12,
    light: Annotated[bool, typer.Option(help='It is day, evening or lamplight.')] = False,
    seed: Annotated[int, typer.Option(help='Of the furniture.')] = 1,
    every_map: Annotated[bool, typer.Option(help='Keep the map of each day.')] = False,
    pruned: Annotated[bool, typer.Option('--prune', help='Prune the map after each day.')] = False,
) -> None:
    """Render, drive and print a table."""
    folder.mkdir(parents=True, exist_ok=True)
    saved, path = None, folder / 'building.map'
    print(
        'day | keyframes | with features | points | in the grid | query, ms | tracked | '
        'median m | 95 % m | ghosts | MB'
    )
    for number, scene in enumerate(make_sessions(sessions, light, seed), 1):
        drive = folder / f'day_{number:02}'
        render_once(scene_from_mapping(scene, drive.name), drive)
        saved, row = drive_session(drive, saved, folder / 'day_01')
        if every_map:
            path = folder / f'day_{number:02}.map'
        write_map_file(path, prune(saved) if pruned else saved)
        saved = read_map_file(path)
        print(f'{row} | {path.stat().st_size / 1e6:.2f}', flush=True)


if __name__ == '__main__':
    typer.run(main)
