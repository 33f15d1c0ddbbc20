"""Keyframes by place: those that a camera stands near to and looks the same way as, whether or
not it has seen their points lately.

A place that is seen again is recognised by them, as long as the path has drifted by no more than
what patches are searched within, and needs few keyframes and no points again: the map follows the
space covered, not the time driven.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, invert, transform_points
from segfloor_ros.slam.map.residuals import MIN_DEPTH_M
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.keyframe_policy import novelty
from segfloor_ros.slam.settings import StereoSlamSettings

REACH_RATIO = 0.5
"""Distance, as a share of the depth of what is seen, up to which a keyframe sees much the same."""

REACH_RAD = 0.5

RECENT = 20
"""The latest keyframes, which a path leaves behind it; earlier ones were made on another visit."""

ALIKE_SHARE = 0.3
"""Share of what is tracked that a keyframe must have seen to count as a view of the same."""

KNOWN_SHARE = 0.3
"""Share of what is tracked that the views of an earlier visit must have seen together."""

SECOND_VISIT = 3.0
"""On a first visit known views lie behind, on a second one on all sides: they may be so many times
as far."""

LOOK_AGAIN = 6.0
"""What is known may have changed: keyframes so many times as far apart as new ones keep the map of
it up to date.
"""

COVERED_SHARE = 0.95
COLUMNS, ROWS = 8, 6
DEPTH_FACTORS = (0.5, 1.0, 2.0)


def views_near(
    sparse_map: SparseMap, T_camera_world: Array, depth_m: float, limit: int
) -> NDArray[np.intp]:
    """Return up to `limit` keyframes that a camera which sees things at about `depth_m` stands
    near to and looks the same way as, the nearest first.
    """
    active = [k for k in sparse_map.keyframes if k.retired is None]
    relative = np.stack([k.T_camera_world for k in active]) @ invert(T_camera_world)
    cosine = (np.trace(relative[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    turned_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    moved_m = np.linalg.norm(relative[:, :3, 3], axis=1)
    apart = np.maximum(moved_m / (REACH_RATIO * depth_m), turned_rad / REACH_RAD)
    order = np.argsort(apart, kind='stable')
    near = order[apart[order] < 1.0][:limit]
    return np.array([active[k].index for k in near], np.intp)


def view_novelty(
    camera: StereoCamera,
    settings: StereoSlamSettings,
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
    depth_m: float,
) -> float:
    """Return how new the view of a camera is that tracks points `ids` (N,) at about `depth_m`: 1 is
    just new.

    It is measured from the nearest of the latest keyframes that saw much of the same. Those of an
    earlier visit count from further away, if together they saw what is tracked and no part of the
    view was out of their sight; they do not count so far away from the latest that the place should
    be looked at again.
    """
    latest = len(sparse_map.keyframes) - 1
    recent, shared = sparse_map.covisible(ids)
    recent = recent[(recent > latest - RECENT) & (shared >= ALIKE_SHARE * len(ids))]
    around = views_near(sparse_map, T_camera_world, depth_m, len(sparse_map.keyframes))
    earlier = around[around <= latest - RECENT]
    new = {
        int(k): novelty(
            sparse_map.keyframes[k].T_camera_world @ invert(T_camera_world), depth_m, settings
        )
        for k in (latest, *recent, *earlier)
    }
    nearest = min(value for k, value in new.items() if k > latest - RECENT)
    earlier = earlier[[new[int(k)] < SECOND_VISIT for k in earlier]]
    if nearest <= 1 or len(earlier) == 0:
        return nearest
    known = np.isin(ids, sparse_map.points_of(earlier)).mean()
    views = [sparse_map.keyframes[k].T_camera_world for k in earlier]
    if known < KNOWN_SHARE or (
        covered_share(camera, views, T_camera_world, depth_m) < COVERED_SHARE
    ):
        return nearest
    known_view = min(new[int(k)] for k in earlier) / SECOND_VISIT
    return min(nearest, max(known_view, nearest / LOOK_AGAIN))


def covered_share(
    camera: StereoCamera, views: Sequence[Array], T_camera_world: Array, depth_m: float
) -> float:
    """Return the share of what a camera may see, at about `depth_m`, that lies in the field of view
    of others, T_camera_world each.
    """
    u, v, z = (
        grid.ravel()
        for grid in np.meshgrid(
            (np.arange(COLUMNS) + 0.5) * camera.width / COLUMNS,
            (np.arange(ROWS) + 0.5) * camera.height / ROWS,
            depth_m * np.array(DEPTH_FACTORS),
        )
    )
    points = camera.back_project(np.column_stack([u, v]), z)
    covered = np.zeros(len(points), bool)
    for T_view_world in views:
        local = transform_points(T_view_world @ invert(T_camera_world), points)
        front = local[:, 2] > MIN_DEPTH_M
        uv = camera.project(np.where(front[:, None], local, (0.0, 0.0, 1.0)))[:, :2]
        covered |= front & ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)
    return float(covered.mean())
