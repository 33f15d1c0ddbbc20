"""Views of places: which keyframes a camera stands near to and looks the same way as, when its own
view is new, and the floor before it as seen from above, the same from every direction.

A place that is seen again is recognised by them, as long as the path has drifted by no more than
what patches are searched within, and needs few keyframes and no points again: the map follows the
space covered, not the time driven.

When a frame becomes a keyframe: A1, A2 or A3 of the ORB-SLAM2 / OpenVSLAM design. Their condition
B, enough points for a pose, holds for every frame that is tracked.

A corridor driven back shows other sides of things, but the same floor. The image is projected onto
the floor (inverse perspective mapping: Mallot et al., Biol. Cybern. 1991), with corners described
where it is sharp; two views of the same floor differ by a motion in the plane, found by RANSAC.
Floor that looks the same in many places, such as tiles, gives several motions: the best counts as
far as it is better than the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.geometry import (
    Array,
    invert,
    make_transform,
    rotation_angle,
    transform_points,
)
from segfloor_ros.core.slam.places.evidence import of_counts
from segfloor_ros.core.slam.rig import FITTING, NEIGHBOURS, SAME_PX, Rig, in_view
from segfloor_ros.core.slam.sparse_map import (
    NOTHING,
    Covisible,
    GroundView,
    KeyframeRecord,
    SparseMap,
)
from segfloor_ros.core.slam.thresholds import (
    CHANCE_SHARE,
    FOUND_SHARE,
    MAJORITY,
    NEARLY_ALL,
    POINTS_PER_KEYFRAME,
)

NEW_MOTION_RATIO, NEW_TURN_RAD = 0.04, 0.06
"""Motion that makes a view new, as a share of the depth of what is seen, and turn: points move by
some tens of pixels, and their patches still look alike."""

MIN_FRAMES, MIN_NS = 3, 250_000_000
"""Frames, and time, between keyframes while the mapper is idle (condition A2), and between two
searches for what moves where no keyframe asks for one, e.g. while the robot stands: a camera that
sends more images makes hardly more of them than one of 10 Hz."""

REACH = 0.5, 0.5
"""Up to which a keyframe sees much the same: distance, as a share of the depth of what is seen, and
turn in rad."""

ALIKE_SHARE = 0.3
"""Share of what is tracked that a keyframe, or those of an earlier visit together, must have seen
to count as a view of the same."""

SECOND_VISIT = 3.0
"""On a first visit known views lie behind, on a second one on all sides: they may be so many times
as far. What is known may have changed: so far and as far again from the latest keyframe the map is
kept up to date, and twice as far with every visit that made a keyframe."""

COLUMNS, ROWS = 4, 3
"""Parts of an image, in each of which something is asked for."""

DEPTH_FACTORS = (0.5, 1.0, 2.0)

MUCH_NEW = 2.5
"""Novelty at which condition A2 does not count frames any more, as where the smaller part of the
points is found again: the next frame finds fewer still.
"""

CELL, AHEAD = 0.025, 4.5
"""Side of a pixel of the view, and how far ahead of the camera it reaches, in units of the camera's
height: farther away a pixel of the image covers several of the view, along the ray."""


def views_near(
    sparse_map: SparseMap, T_camera_world: Array, depth_m: float, limit: int
) -> NDArray[np.intp]:
    """Return up to `limit` keyframes that a camera which sees things at about `depth_m` stands
    near to and looks the same way as, the nearest first.
    """
    T_views_now = _from_views(sparse_map.keyframes, T_camera_world)
    return _nearest(sparse_map, T_views_now, depth_m)[:limit]


def _nearest(sparse_map: SparseMap, T_views_now: Array, depth_m: float) -> NDArray[np.intp]:
    """Return the keyframes within reach of a camera, by the motions (K, 4, 4) to it."""
    turned_rad = rotation_angle(T_views_now[:, :3, :3])
    moved_m = np.linalg.norm(T_views_now[:, :3, 3], axis=1)
    distance = np.maximum(moved_m / (REACH[0] * depth_m), turned_rad / REACH[1])
    distance[[k.retired is not None for k in sparse_map.keyframes]] = np.inf
    order = np.argsort(distance, kind='stable')
    return order[distance[order] < 1.0]


def view_novelty(
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
    depth_m: float,
    covisible: Covisible | None = None,
) -> float:
    """Return how new the view of a camera is that tracks points `ids` (N,) at about `depth_m`: 1 is
    just new. covisible: what the map has of these points, if that is known.

    It is measured from the nearest of the latest keyframes that saw much of the same. Those of an
    earlier visit count from further away, if together they saw what is tracked and no part of the
    view was out of their sight; they do not count so far away from the latest that the place should
    be looked at again, ever farther with every visit: keyframes of a place grow with the logarithm
    of its visits.
    """
    latest = len(sparse_map.keyframes) - 1
    recent, shared = sparse_map.covisible(ids) if covisible is None else covisible
    recent = recent[(recent > latest - NEIGHBOURS) & (shared >= ALIKE_SHARE * len(ids))]
    just_seen = [sparse_map.keyframes[k] for k in (*recent, latest)]
    nearest = float(novelty(_from_views(just_seen, T_camera_world), depth_m).min())
    if nearest <= 1:
        return nearest
    T_views_now = _from_views(sparse_map.keyframes, T_camera_world)
    new = novelty(T_views_now, depth_m)
    around = _nearest(sparse_map, T_views_now, depth_m)
    earlier = around[(around <= latest - NEIGHBOURS) & (new[around] < SECOND_VISIT)]
    if len(earlier) == 0:
        return nearest
    known = np.isin(ids, sparse_map.points_of(earlier)).mean()
    views = [sparse_map.keyframes[k].T_camera_world for k in earlier]
    covered = covered_share(sparse_map.rig.camera, views, T_camera_world, depth_m)
    if known < ALIKE_SHARE or covered < NEARLY_ALL:
        return nearest
    # The keyframes of one visit follow each other, also those that are retired by now.
    visits = 1 + (np.diff(np.flatnonzero(new < SECOND_VISIT)) > 1).sum()
    again = nearest / (SECOND_VISIT * 2.0**visits)
    return max(float(new[earlier].min()) / SECOND_VISIT, again)


def _from_views(keyframes: Sequence[KeyframeRecord], T_camera_world: Array) -> Array:
    """Return the motions (K, 4, 4) to a camera from keyframes, in their axes."""
    return np.array([k.T_camera_world for k in keyframes]) @ invert(T_camera_world)


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
        covered |= in_view(camera, local)[1]
    return float(covered.mean())


@dataclass(frozen=True)
class View:
    """What the policy looks at.

    frames_since, since_ns: frames and time since the last keyframe. num_tracked: points tracked
    now. num_reliable: points that several keyframes see, of the keyframe that shares most with this
    view. novelty: how far the view is from known ones, in units of what makes it new. mapper_idle:
    whether the mapper could take a keyframe at once. found_share: of the points that were looked
    for.
    """

    frames_since: int
    num_tracked: int
    num_reliable: int
    novelty: float
    mapper_idle: bool = True
    found_share: float = 1.0
    since_ns: int = MIN_NS


def is_due(frames_since: int, since_ns: int) -> bool:
    """Whether enough frames and time have gone by since a frame was looked at closely."""
    return frames_since >= MIN_FRAMES and since_ns >= MIN_NS


def is_keyframe(view: View, max_frames: int) -> bool:
    """Decide by the published conditions; A1 and A2 also ask for a view that is new, so that a
    robot that stands still adds nothing. max_frames: after which one is due (A1).
    """
    new_view = view.novelty > 1
    due = is_due(view.frames_since, view.since_ns)
    due |= view.novelty > MUCH_NEW or view.found_share < MAJORITY
    a1 = view.frames_since >= max_frames and new_view
    a2 = view.mapper_idle and due and new_view
    a3 = view.num_tracked < FOUND_SHARE * view.num_reliable
    return a1 or a2 or a3


def novelty(T_known_now: Array, median_depth_m: float) -> Array:
    """Return the motions (..., 4, 4) from known views in units of what makes a view new, (...).
    median_depth_m: of what is seen.
    """
    moved_m = np.linalg.norm(T_known_now[..., :3, 3], axis=-1)
    turned_rad = rotation_angle(T_known_now[..., :3, :3])
    return np.maximum(moved_m / (NEW_MOTION_RATIO * median_depth_m), turned_rad / NEW_TURN_RAD)


class GroundViews:
    """Takes views of the floor with the camera of a rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._mount: Mount | None = None
        self._orb = cv2.ORB.create(POINTS_PER_KEYFRAME, nlevels=1, fastThreshold=5)
        self._contrast = cv2.createCLAHE(3.0, (4, 4))

    def take(self, left: NDArray[np.uint8]) -> GroundView:
        """Return what a rectified left image (H, W) shows of the floor; nothing while it is not
        known how the camera is mounted.
        """
        if self._rig.mount is None:
            return NOTHING
        if self._mount != self._rig.mount:
            self._mount = self._rig.mount
            self._corner_xy_m, self._maps, self._inside = _projection(self._rig.camera, self._mount)
        view = self._contrast.apply(cv2.remap(left, *self._maps, cv2.INTER_LINEAR))
        corners, descriptor = self._orb.detectAndCompute(view, self._inside)
        if not corners:
            return NOTHING
        column, row = cv2.KeyPoint_convert(corners).T
        cell_m = CELL * self._mount.height_m
        xy_m = self._corner_xy_m + cell_m * np.stack([row, column], axis=1)
        return GroundView(xy_m.astype(np.float16), np.asarray(descriptor, np.uint8))


def _projection(
    camera: StereoCamera, mount: Mount
) -> tuple[Array, tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.uint8]]:
    """Return where on the floor pixel (0, 0) of the view lies, the pixels (u, v) of the image that
    its pixels show, x along rows and y along columns, and where there are such.
    """
    h = mount.height_m
    steps = np.arange(0.0, AHEAD, CELL)
    x, y = np.meshgrid(
        mount.forward_m + h * steps, mount.left_m + h * (steps - AHEAD / 2), indexing='ij'
    )
    floor = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=-1)
    points = floor @ invert(mount.T_base_left)[:3].T
    uvw = points @ camera.K.T
    ahead = points[..., 2] > CELL * h
    depth_m = np.where(ahead, points[..., 2], np.inf)
    u, v = ((uvw[..., k] / depth_m).astype(np.float32) for k in (0, 1))
    inside = ahead & (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9), np.uint8))
    return np.array([x[0, 0], y[0, 0]]), (u, v), inside


def seen_ahead_m(mount: Mount) -> float:
    """Return how far ahead of the base the middle of its view of the floor lies."""
    return mount.forward_m + AHEAD / 2 * mount.height_m


def motion_between(
    view: GroundView, other: GroundView, height_m: float
) -> tuple[Array, float] | None:
    """Return T_base_other (4, 4), where the base stood at another view of the same floor, and how
    much likelier it is than the next best motion, in nats; None where no corners are the same.
    """
    if not len(view.xy_m) or not len(other.xy_m):
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        other.descriptor, view.descriptor
    )
    rows = np.array([(m.queryIdx, m.trainIdx) for m in matches], np.intp).reshape(-1, 2)
    if len(rows) < 2:
        return None
    # Complex numbers are motions in the plane: q = turn * p + shift.
    p, q = (xy @ (1.0, 1j) for xy in (other.xy_m[rows[:, 0]], view.xy_m[rows[:, 1]]))
    tolerance_m = SAME_PX * CELL * height_m
    # So many pairs that a motion is among them which no more corners show than chance allows.
    pairs = int(np.log(1 - FITTING) / np.log(1 - CHANCE_SHARE**2))
    draws = np.random.default_rng(0).integers(len(p), size=(pairs, 2))
    of_p, of_q = np.diff(p[draws])[:, 0], np.diff(q[draws])[:, 0]
    alike = (np.abs(np.abs(of_p) - np.abs(of_q)) < tolerance_m) & (np.abs(of_p) > 2 * tolerance_m)
    draws, turn = draws[alike], of_q[alike] / of_p[alike]
    turn /= np.abs(turn)
    shift = q[draws[:, 0]] - turn * p[draws[:, 0]]
    fits = np.abs(turn[:, None] * p + shift[:, None] - q) < tolerance_m
    count = fits.sum(axis=1)
    if len(count) == 0:
        return None
    best = int(count.argmax())
    middle = p[fits[best]].mean()
    elsewhere = np.abs((turn - turn[best]) * middle + shift - shift[best]) > 2 * tolerance_m
    log_ratio = of_counts(count[best], count[elsewhere].max(initial=0))
    p, q = p[fits[best]], q[fits[best]]
    turn_by = ((q - q.mean()) * (p - p.mean()).conj()).sum()
    turn_by /= np.abs(turn_by)
    shift_by = q.mean() - turn_by * p.mean()
    c, s = turn_by.real, turn_by.imag
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_transform(R, np.array([shift_by.real, shift_by.imag, 0.0])), log_ratio
