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
from segfloor_ros.geometry import invert
from segfloor_ros.measurements import Up
from segfloor_ros.slam.bundle_adjustment import BundleProblem, BundleResult, adjust
from segfloor_ros.slam.disparity_offset import OffsetEstimate
from segfloor_ros.slam.level_ground import LevelGround
from segfloor_ros.slam.loop_closing import move_keyframes
from segfloor_ros.slam.motion_links import factors_of
from segfloor_ros.slam.residuals import Observations
from segfloor_ros.slam.sparse_map import SparseMap

POINTS_PER_KEYFRAME = 80
"""Points of a keyframe that most others see: they hold the map together, the rest moves along."""

MIN_POINTS = 15
"""A keyframe that shares fewer moves along with the one before it."""

STEPS = 6
KNOWN_OFFSET = 1e12
"""Information of a disparity offset that stays as it is."""


@dataclass(frozen=True)
class GlobalAdjustment:
    """A copy of what holds the map together. chosen: (K,) indices of its keyframes, those that move
    first. ids, stable_ids: (P,) of its points.
    """

    problem: BundleProblem
    chosen: NDArray[np.intp]
    ids: NDArray[np.integer]
    stable_ids: NDArray[np.int32]


def plan_global(
    sparse_map: SparseMap,
    offset: OffsetEstimate,
    up_world: Up | None,
    ground: LevelGround | None,
) -> GlobalAdjustment | None:
    """Copy the keyframes and their best known points out of the map; None for a map of one view."""
    point, keyframe, row = sparse_map.edges()
    keyframe, point, row = _known_best(sparse_map, keyframe, point, row)
    enough = np.bincount(keyframe, minlength=len(sparse_map.keyframes)) >= MIN_POINTS
    enough[0] = True
    kept = enough[keyframe]
    kept &= np.bincount(point[kept], minlength=len(sparse_map.alive))[point] > 1
    keyframe, point, row = keyframe[kept], point[kept], row[kept]
    ids = np.unique(point)
    free = np.flatnonzero(enough[1:]) + 1
    if len(ids) == 0 or len(free) == 0:
        return None
    chosen = np.append(free, 0)
    slot = np.full(len(enough), -1)
    slot[chosen] = np.arange(len(chosen))
    problem = BundleProblem(
        np.stack([sparse_map.keyframes[k].T_camera_world for k in chosen]),
        len(free),
        sparse_map.xyz_world[ids],
        slot[keyframe],
        np.searchsorted(ids, point),
        _gather(sparse_map, keyframe, row),
        OffsetEstimate(offset.value_px, KNOWN_OFFSET),
        factors_of(sparse_map.keyframes, slot, up_world),
        ground,
    )
    return GlobalAdjustment(problem, chosen, ids, sparse_map.stable_id[ids].copy())


def _known_best(
    sparse_map: SparseMap,
    keyframe: NDArray[np.int32],
    point: NDArray[np.int32],
    row: NDArray[np.int32],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return the observations, keyframe by keyframe, of points that are among those of some
    keyframe that most others see.
    """
    order = np.lexsort((point, -sparse_map.observer_count[point], keyframe))
    keyframe, point, row = keyframe[order], point[order], row[order]
    rank = np.arange(len(keyframe)) - np.searchsorted(keyframe, keyframe)
    known = np.zeros(len(sparse_map.alive), bool)
    known[point[rank < POINTS_PER_KEYFRAME]] = True
    known &= sparse_map.observer_count > 1
    chosen = known[point]
    return keyframe[chosen], point[chosen], row[chosen]


def _gather(
    sparse_map: SparseMap, keyframe: NDArray[np.int32], row: NDArray[np.int32]
) -> Observations:
    """Return the observations (N,) of features `row` of keyframes in ascending order."""
    starts = np.flatnonzero(np.diff(keyframe, prepend=-1))
    taken = [
        sparse_map.keyframes[keyframe[start]].observations.take(rows)
        for start, rows in zip(starts, np.split(row, starts[1:]), strict=True)
    ]
    return Observations(
        np.concatenate([t.uvd_px for t in taken]), np.concatenate([t.sigma_px for t in taken])
    )


def solve_global(
    camera: StereoCamera, adjustment: GlobalAdjustment, is_wanted: Callable[[], bool]
) -> BundleResult:
    """Adjust the copy; safe on another thread. It ends early when it is no longer wanted."""
    return adjust(camera, adjustment.problem, STEPS, is_wanted)


def apply_global(sparse_map: SparseMap, adjustment: GlobalAdjustment, result: BundleResult) -> None:
    """Bring an adjusted copy into the map, which may have grown and been adjusted since."""
    if not result.cost_after < result.cost_before:
        return
    planned, ids = adjustment.problem, adjustment.ids
    correction = invert(planned.T_camera_world) @ result.T_camera_world
    order = np.argsort(adjustment.chosen)
    holder = np.searchsorted(
        adjustment.chosen[order], np.arange(len(sparse_map.keyframes)), side='right'
    )
    now = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    same = sparse_map.alive[ids] & (sparse_map.stable_id[ids] == adjustment.stable_ids)
    same &= (sparse_map.xyz_world[ids] == planned.points_world).all(axis=1)
    move_keyframes(sparse_map, now @ correction[order[holder - 1]])
    sparse_map.xyz_world[ids[same]] = result.points_world[same]
