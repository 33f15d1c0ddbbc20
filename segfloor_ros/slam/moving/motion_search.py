"""The search for what moves, frame after frame: its region, its points and what it left behind.

Where the points of what moves are, and how fast: scene flow from one look to the next.

Pixels are followed by optical flow, depths come from both disparities, and the camera's own motion
is taken off (Vedula et al., Three-Dimensional Scene Flow, ICCV 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.map.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.slam.moving.moving_regions import MovingRegions
from segfloor_ros.slam.moving.scene_flow import Disparity
from segfloor_ros.slam.results import MovingPoints
from segfloor_ros.slam.tracking.images import Region

SEARCH_EVERY = 3
"""Frames between two searches where no keyframe asks for one, e.g. while the robot stands."""

MAX_POINTS = 300
MAX_INTERVAL_S = 1.0
MAX_SPEED_M_S = 20.0
WINDOW_PX = 9
LEVELS = 3
MIN_FOLLOWED = 5
"""Points of a thing that must be followed for its velocity to be known."""


@dataclass(frozen=True)
class Searched:
    """What a search found. disparity: (h, w) of the shrunk image. region: what moves, None for
    nothing. points: of what moves, in the world.
    """

    disparity: Disparity
    region: Region | None
    points: MovingPoints


class MotionSearch:
    """Searches keyframes, and some of the frames between, for what moves."""

    def __init__(self, camera: StereoCamera) -> None:
        self._regions = MovingRegions(camera)
        self._meter = MovingPointMeter()
        self._frames_since = 0

    def is_due(self, is_keyframe: bool, is_tracked: bool) -> bool:
        """Whether to search a frame."""
        self._frames_since += 1
        return is_keyframe or (is_tracked and self._frames_since >= SEARCH_EVERY)

    def search(
        self,
        frame: StereoFrame,
        T_camera_world: Array,
        T_odom_camera: Array,
        mount: Mount | None,
    ) -> Searched:
        """Find what moves in a frame whose pose is known."""
        self._frames_since = 0
        scene = self._regions.search(frame, T_camera_world, T_odom_camera, mount)
        xyz_world = self._regions.positions(scene.disparity, T_camera_world)
        points = self._meter.measure(Look(frame.stamp_ns, scene.left, xyz_world), scene.moving)
        return Searched(scene.disparity, self._regions.enlarged(scene.moving), points)

    def remember(self, keyframe: KeyframeRecord, searched: Searched) -> None:
        """Compare later frames with this keyframe."""
        self._regions.remember(keyframe, searched.disparity)

    def seen_through(
        self,
        searched: Searched,
        sparse_map: SparseMap,
        ids: NDArray[np.int32],
        keyframe: KeyframeRecord,
    ) -> NDArray[np.int32]:
        """Return those of the points (N,) that a keyframe does not observe but sees through."""
        ids = np.setdiff1d(ids, keyframe.point_id)
        points = transform_points(keyframe.T_camera_world, sparse_map.xyz_world[ids])
        return ids[self._regions.seen_through(searched.disparity, points)]


@dataclass(frozen=True)
class Look:
    """One look at the scene. left: shrunk image (h, w) uint8. xyz_world: (h, w, 3) m, NaN where
    there is no disparity.
    """

    stamp_ns: int
    left: NDArray[np.uint8]
    xyz_world: Array


class MovingPointMeter:
    """Measures the points of what moves."""

    def __init__(self) -> None:
        self._last: Look | None = None

    def measure(self, look: Look, moving: NDArray[np.uint8]) -> MovingPoints:
        """Return the points of a moving region (h, w), 255, and their velocities, in world axes.
        The points of one connected thing share the median velocity.
        """
        known = (moving > 0) & np.isfinite(look.xyz_world[..., 0])
        _, label = cv2.connectedComponents(moving)
        v, u = np.nonzero(known)
        step = -(-len(u) // MAX_POINTS) if len(u) else 1
        v, u = v[::step], u[::step]
        xyz = look.xyz_world[v, u]
        velocity = np.full(xyz.shape, np.nan)
        last, self._last = self._last, look
        if last is None or len(u) == 0:
            return MovingPoints(xyz, velocity)
        interval_s = (look.stamp_ns - last.stamp_ns) * 1e-9
        if not 0 < interval_s < MAX_INTERVAL_S:
            return MovingPoints(xyz, velocity)
        own = (xyz - _positions_then(look, last, u, v)) / interval_s
        own[np.linalg.norm(own, axis=1) > MAX_SPEED_M_S] = np.nan
        of = label[v, u]
        for thing in np.unique(of):
            followed = (of == thing) & np.isfinite(own[:, 0])
            if followed.sum() >= MIN_FOLLOWED:
                velocity[of == thing] = np.median(own[followed], axis=0)
        return MovingPoints(xyz, velocity)


def _positions_then(look: Look, last: Look, u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
    """Return where pixels (N,) were at the last look, (N, 3); NaN where they are not found."""
    start = np.stack([u, v], axis=1).astype(np.float32).reshape(-1, 1, 2)
    window = (WINDOW_PX, WINDOW_PX)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        look.left, last.left, start, np.empty_like(start), winSize=window, maxLevel=LEVELS
    )
    at = np.rint(np.asarray(found).reshape(-1, 2)).astype(np.intp)
    height, width = last.left.shape
    inside = (np.asarray(status).ravel() > 0) & (at >= 0).all(axis=1)
    inside &= (at[:, 0] < width) & (at[:, 1] < height)
    then = np.full((len(u), 3), np.nan)
    then[inside] = last.xyz_world[at[inside, 1], at[inside, 0]]
    return then


def turned(points: MovingPoints, T: Array) -> MovingPoints:
    """Return points and velocities in another frame, T (4, 4)."""
    return MovingPoints(
        transform_points(T, points.xyz_map).astype(np.float32),
        (points.velocity_m_s @ T[:3, :3].T).astype(np.float32),
    )
