"""What places, loops and the adjustment of the whole map cost, by the number of keyframes.

    python -m tools.map_costs --keyframes 100 --keyframes 1000 --keyframes 2000

The map is made up: a path around a ring, each keyframe with 300 points of which most neighbours see
some, and one loop. Times of the calling thread in ms. `tracking waits` is the longest of what is
done between two frames: a plan is copied out of the map, and what was solved is brought back.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.plugins.maps.map_arrays import fill_map
from segfloor_ros.core.slam.mapping.bundle_adjustment import (
    apply_global,
    copy_map,
    move_keyframes,
    solve_global,
)
from segfloor_ros.core.slam.places.loop_closing import optimise, plan_closing
from segfloor_ros.core.slam.places.loops import path_lengths
from segfloor_ros.core.slam.places.place_recognition import NUM_WORDS, PlaceRecognition, Vocabulary
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.sparse_map import Match, SparseMap
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.patch_alignment import SIDE_PX
from segfloor_ros.core.twists import se3_exp

CAMERA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.12)
STEP_M, SEEN_BY, POINTS = 0.1, 6, 50
FEATURES = 1000
REPEATS = 5


def ring(count: int) -> Array:
    """Return cameras T_camera_world (K, 4, 4) on a ring, looking outwards."""
    angle = 2 * np.pi * np.arange(count) / count
    radius = STEP_M * count / (2 * np.pi)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 0], T[:, 0, 2] = np.cos(angle), np.sin(angle)
    T[:, 2, 0], T[:, 2, 2] = -np.sin(angle), np.cos(angle)
    T[:, 0, 3], T[:, 2, 3] = radius * np.sin(angle), radius * np.cos(angle)
    return invert(T)


def made_up_map(count: int, rng: np.random.Generator) -> Arrays:
    """Return a map of `count` keyframes, each of which makes POINTS points that the SEEN_BY around
    it see.
    """
    poses = ring(count)
    owner = np.repeat(np.arange(count), POINTS)
    local = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 6.0), (len(owner), 3))
    T_world = invert(poses)[owner]
    xyz = np.einsum('nij,nj->ni', T_world[:, :3, :3], local) + T_world[:, :3, 3]
    keyframe = (owner[:, None] + np.arange(SEEN_BY)) % count
    point = np.repeat(np.arange(len(owner)), SEEN_BY)
    order = np.lexsort((point, keyframe.ravel()))
    keyframe, point = keyframe.ravel()[order], point[order]
    seen = np.einsum('nij,nj->ni', poses[keyframe][:, :3, :3], xyz[point])
    seen += poses[keyframe][:, :3, 3]
    uvr = CAMERA.project(seen)
    uvd = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]]) + rng.normal(0, 0.3, seen.shape)
    return _arrays(poses, xyz, owner, point, np.bincount(keyframe), uvd)


def _arrays(poses: Array, xyz: Array, owner: Any, point: Any, length: Any, uvd: Array) -> Arrays:
    count, points = len(poses), len(xyz)
    links = [np.arange(max(0, k - SEEN_BY), k) for k in range(count)]
    of_points: dict[str, Any] = {
        'xyz_world': xyz,
        'stable_id': np.arange(points),
        'descriptor': np.zeros((points, 32), np.uint8),
        'patch': np.zeros((points, SIDE_PX, SIDE_PX), np.uint8),
        'viewing_direction': np.tile([0.0, 0.0, 1.0], (points, 1)),
        'born': owner,
        'seen_last': owner,
    }
    for name in ('patch_distance_m', 'viewing_distance_m', 'visible_count', 'found_count'):
        of_points[name] = np.ones(points)
    for name in ('viewing_octave', 'seen_through_count'):
        of_points[name] = np.zeros(points)
    return {f'point_{name}': column for name, column in of_points.items()} | {
        'num_ever': np.array([points]),
        'keyframe_frame_index': np.arange(count),
        'keyframe_stamp_ns': np.arange(count) * 200_000_000,
        'keyframe_T_camera_world': poses,
        'keyframe_features': length,
        'keyframe_link_count': np.array([len(link) for link in links]),
        'keyframe_links': np.concatenate(links),
        'keyframe_follows': np.full(count, -1),
        'keyframe_T_camera_followed': np.tile(np.eye(4), (count, 1, 1)),
        'feature_uvd_px': uvd,
        'feature_sigma_px': np.full(uvd.shape, 0.5),
        'feature_octave': np.zeros(len(uvd), np.uint8),
        'feature_point': point.astype(np.int32),
        'loop_ends': np.zeros((0, 2), np.int32),
        'loop_T_i_j': np.zeros((0, 4, 4)),
    }


def measure(count: int) -> dict[str, float]:
    """Return the times in ms for a map of so many keyframes."""
    rng = np.random.default_rng(count)
    sparse_map = SparseMap(Rig(CAMERA))
    fill_map(sparse_map, made_up_map(count, rng))
    places = PlaceRecognition(sparse_map)
    words = rng.integers(0, NUM_WORDS, count * FEATURES)
    places.from_arrays({'words': words, 'word_count': np.full(count, FEATURES)})
    features = Features(
        np.zeros((FEATURES, 2), np.float32),
        np.zeros(FEATURES, np.uint8),
        rng.integers(0, 256, (FEATURES, 32)).astype(np.uint8),
    )
    vocabulary = Vocabulary.load()
    own = {'words': median_ms(lambda: vocabulary.words(features.descriptor))}
    own['query'] = median_ms(lambda: places.groups(places.score(features), 2))
    own['ways'] = median_ms(lambda: path_lengths(sparse_map, count - 1))
    bend(sparse_map)
    match = _loop(sparse_map, count)
    own['plan'], closing = once_ms(lambda: plan_closing(sparse_map, [match]))
    own['pose graph'], (poses, _) = once_ms(lambda: optimise(closing.graph))
    own['move'], _ = once_ms(lambda: move_keyframes(sparse_map, poses))
    own['copy'], adjustment = once_ms(lambda: copy_map(sparse_map, None))
    own['global'], result = once_ms(lambda: solve_global(CAMERA, adjustment, lambda: True))
    own['apply'], _ = once_ms(lambda: apply_global(sparse_map, result))
    return own


def bend(sparse_map: SparseMap) -> None:
    """Let the path drift."""
    poses = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    share = np.arange(len(poses))[:, None] / len(poses)
    move_keyframes(sparse_map, poses @ se3_exp(share * [0.2, 0.0, 0.2, 0.0, 0.02, 0.0]))


def _loop(sparse_map: SparseMap, count: int) -> Match:
    T_last_first = ring(count)[-1] @ invert(ring(count)[0])
    pose = T_last_first @ sparse_map.keyframes[0].T_camera_world
    none = np.zeros(0, np.int32)
    return Match(count - 1, 0, pose, none.astype(np.intp), none, none)


def median_ms(work: Callable[[], Any]) -> float:
    """Return the median time of a few calls."""
    return float(np.median([once_ms(work)[0] for _ in range(REPEATS)]))


def once_ms(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the time of one call and what it returns."""
    start_s = time.thread_time()
    result = work()
    return 1e3 * (time.thread_time() - start_s), result


def main(keyframes: Annotated[list[int], typer.Option(help='Sizes of the map.')]) -> None:
    """Print the table."""
    rows = {count: measure(count) for count in keyframes}
    table = Table('keyframes', *next(iter(rows.values())))
    for count, row in rows.items():
        table.add_row(str(count), *(f'{value:.1f}' for value in row.values()))
    Console(width=140).print(table)


if __name__ == '__main__':
    typer.run(main)
