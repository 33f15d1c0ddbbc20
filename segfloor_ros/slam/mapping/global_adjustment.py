"""Bundle adjustment of the whole map, after a loop was closed.

It is solved on a copy while tracking and mapping go on; what is mapped meanwhile moves along with
the keyframes it hangs on (Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017, section III-C).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, invert
from segfloor_ros.measurements import Up
from segfloor_ros.slam.map.keyframe_record import KeyframeRecord
from segfloor_ros.slam.map.residuals import Observations
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.bundle_adjustment import BundleProblem, BundleResult, adjust
from segfloor_ros.slam.mapping.disparity_offset import OffsetEstimate
from segfloor_ros.slam.mapping.level_ground import LevelGround
from segfloor_ros.slam.places.loop_closing import move_keyframes
from segfloor_ros.slam.sensors.motion_links import factors_of

POINTS_PER_KEYFRAME = 300
"""Points of a keyframe that most others see: they hold the map together, the rest moves along."""

MIN_POINTS = 15
"""A keyframe that shares fewer moves along with the one before it."""

STEPS = 6
KNOWN_OFFSET = 1e12
"""Information of a disparity offset that stays as it is."""


@dataclass(frozen=True)
class MapCopy:
    """The map as it was. T_camera_world: (K, 4, 4). xyz_world, stable_ids: (P,). point, keyframe,
    row: (N,) observations. features: (K,) of the keyframes as measured.
    """

    T_camera_world: Array
    xyz_world: Array
    stable_ids: NDArray[np.int32]
    observer_count: NDArray[np.int32]
    point: NDArray[np.int32]
    keyframe: NDArray[np.int32]
    row: NDArray[np.int32]
    features: list[Observations]
    records: list[KeyframeRecord]
    offset: OffsetEstimate
    up_world: Up | None
    ground: LevelGround | None


@dataclass(frozen=True)
class GlobalResult:
    """An adjusted copy. chosen: (K,) indices of its keyframes, those that move first. ids,
    stable_ids: (P,) of its points.
    """

    planned: BundleProblem
    adjusted: BundleResult
    chosen: NDArray[np.intp]
    ids: NDArray[np.integer]
    stable_ids: NDArray[np.int32]


def copy_map(
    sparse_map: SparseMap,
    offset: OffsetEstimate,
    up_world: Up | None,
    ground: LevelGround | None,
) -> MapCopy:
    """Copy what an adjustment needs out of the map: little time between two frames."""
    keyframes = list(sparse_map.keyframes)
    point, keyframe, row = (edges.copy() for edges in sparse_map.edges())
    return MapCopy(
        np.stack([k.T_camera_world for k in keyframes]),
        sparse_map.xyz_world.copy(),
        sparse_map.stable_id.copy(),
        sparse_map.observer_count.copy(),
        point,
        keyframe,
        row,
        [k.observations for k in keyframes],
        keyframes,
        offset,
        up_world,
        ground,
    )


def solve_global(
    camera: StereoCamera, copied: MapCopy, is_wanted: Callable[[], bool]
) -> GlobalResult | None:
    """Adjust the copy; safe on another thread. It ends early when it is no longer wanted. None for
    a map of one view.
    """
    keyframe, point, row = _known_best(copied)
    enough = np.bincount(keyframe, minlength=len(copied.records)) >= MIN_POINTS
    enough[0] = True
    kept = enough[keyframe]
    kept &= np.bincount(point[kept], minlength=len(copied.stable_ids))[point] > 1
    keyframe, point, row = keyframe[kept], point[kept], row[kept]
    ids = np.unique(point)
    free = np.flatnonzero(enough[1:]) + 1
    if len(ids) == 0 or len(free) == 0:
        return None
    chosen = np.append(free, 0)
    slot = np.full(len(enough), -1)
    slot[chosen] = np.arange(len(chosen))
    problem = BundleProblem(
        copied.T_camera_world[chosen],
        len(free),
        copied.xyz_world[ids],
        slot[keyframe],
        np.searchsorted(ids, point),
        _gather(copied, keyframe, row),
        OffsetEstimate(copied.offset.value_px, KNOWN_OFFSET),
        factors_of(copied.records, slot, copied.up_world),
        copied.ground,
    )
    adjusted = adjust(camera, problem, STEPS, is_wanted)
    return GlobalResult(problem, adjusted, chosen, ids, copied.stable_ids[ids])


def _known_best(
    copied: MapCopy,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return the observations, keyframe by keyframe, of points that are among those of some
    keyframe that most others see.
    """
    order = np.lexsort((copied.point, -copied.observer_count[copied.point], copied.keyframe))
    keyframe, point, row = copied.keyframe[order], copied.point[order], copied.row[order]
    rank = np.arange(len(keyframe)) - np.searchsorted(keyframe, keyframe)
    known = np.zeros(len(copied.stable_ids), bool)
    known[point[rank < POINTS_PER_KEYFRAME]] = True
    chosen = (known & (copied.observer_count > 1))[point]
    return keyframe[chosen], point[chosen], row[chosen]


def _gather(copied: MapCopy, keyframe: NDArray[np.int32], row: NDArray[np.int32]) -> Observations:
    """Return the observations (N,) of features `row` of keyframes in ascending order."""
    starts = np.flatnonzero(np.diff(keyframe, prepend=-1))
    taken = [
        copied.features[keyframe[start]].take(rows)
        for start, rows in zip(starts, np.split(row, starts[1:]), strict=True)
    ]
    return Observations(
        np.concatenate([t.uvd_px for t in taken]), np.concatenate([t.sigma_px for t in taken])
    )


def apply_global(sparse_map: SparseMap, result: GlobalResult | None) -> None:
    """Bring an adjusted copy into the map, which may have grown and been adjusted since."""
    if result is None or not result.adjusted.cost_after < result.adjusted.cost_before:
        return
    planned, adjusted, ids = result.planned, result.adjusted, result.ids
    correction = invert(planned.T_camera_world) @ adjusted.T_camera_world
    order = np.argsort(result.chosen)
    holder = np.searchsorted(
        result.chosen[order], np.arange(len(sparse_map.keyframes)), side='right'
    )
    now = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    same = sparse_map.alive[ids] & (sparse_map.stable_id[ids] == result.stable_ids)
    same &= (sparse_map.xyz_world[ids] == planned.points_world).all(axis=1)
    move_keyframes(sparse_map, now @ correction[order[holder - 1]])
    sparse_map.xyz_world[ids[same]] = adjusted.points_world[same]
