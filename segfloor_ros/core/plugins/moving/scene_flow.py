"""Scene flow: which corners of an image moved since an earlier one, whatever was seen before there.

A corner is followed back by optical flow. If it stands still, it was where its depth and the
camera's own motion say, up to the error of the depth (Vedula et al., Three-Dimensional Scene Flow,
ICCV 1999). Corners are judged together with their neighbours at the same depth.

Points of what moves get their velocity in the same way, from one search to the next.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import MovingPoints
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.plugins.sensors.gyroscope import MOMENT_NS
from segfloor_ros.core.slam.rig import GATE, MIN_DEPTH_M, chi2_limit
from segfloor_ros.core.slam.sparse_map import MAX_PATCH_ZOOM
from segfloor_ros.core.slam.thresholds import MAJORITY, PROOF
from segfloor_ros.core.slam.tracking.images import (
    SIGMA_FLOW_PX,
    SMALL_WIDTH_PX,
    follow_pixels,
    spread,
)

AGES_NS = (300_000_000, 900_000_000)
"""How long ago an image was that corners are followed back to: in the first someone who walks has
moved by a hand, in the second someone who walks just ahead of the camera stands out."""

CORNERS, CELL_PX = 300, 10
"""Corners are spread over the image by cells: cloth in front has the strongest, and a plain wall or
floor, which shows that it stands still, needs its own."""

APART_PX = 3
"""Corners are at least so far from each other, and speak for as much around them."""

MIN_CORNER, SURE_CORNER = 3e-4, 1e-3
"""Smaller eigenvalue of a corner, as OpenCV scales it. Between the two a corner may say that it
stands still, which it hardly does by chance, but not that it moves."""

WINDOW_PX, STEPS = 9, (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
"""Window and end of the search of optical flow: finer than for tracking, as images are small."""

MAX_RETURN_PX = 0.5
"""Distance up to which a corner that is followed back and forth comes to where it was."""

MAX_SHIFT_PX = 20.0
"""What stands still and changes its place in the image by more is not compared."""

NEIGHBOUR_PX = 15.0
"""Corners so near to each other, at the same depth, are on one thing."""

MAX_MOVING_SHARE = 0.8
"""Where more of all corners seem to move the pose is in doubt: what moved before still does. What
is farther than so much of the image stands behind what moves."""

TOLERANCE_PX = 0.6
"""Disparities of the shrunk images that differ by more do not show the same thing."""

MAX_SPEED_M_S = 20.0
"""More is a wrong match."""

Disparity = NDArray[np.float32]
"""Disparities (h, w) in px of the shrunk image, 0 where none was found."""


@dataclass(frozen=True)
class FlowView:
    """An earlier image. left: shrunk (h, w). disparity: (h, w). T_odom_camera: (4, 4). moving: what
    was found to move in it, (h, w), 255; None before the search.
    """

    stamp_ns: int
    left: NDArray[np.uint8]
    disparity: Disparity
    T_odom_camera: Array
    moving: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class FlowVotes:
    """Where (h, w) corners moved, where they stood still, and where any are, also those that were
    not found again: 1, else 0.
    """

    moving: NDArray[np.uint8]
    still: NDArray[np.uint8]
    all: NDArray[np.uint8]


class SceneFlow:
    """Follows corners back to earlier images."""

    def __init__(self, camera: SmallCamera) -> None:
        self._camera = camera
        self._views: deque[FlowView] = deque()

    def remember(self, view: FlowView) -> None:
        """Compare later images with this one, of which is known what moves in it."""
        self._views.append(view)

    def votes(self, view: FlowView) -> FlowVotes:
        """Return what moved in an image."""
        earlier = self._earlier(view.stamp_ns)
        uv, sure = self._corners(view)
        moved, still, moved_before, odd = (np.zeros(len(uv), bool) for _ in range(4))
        for then in earlier if len(uv) else []:
            found, ratio, moved_then = self._compare(view, then, uv)
            differs = ratio > static_scale(ratio[found])
            moved |= found & differs & sure
            still |= found & ~differs
            odd |= found & (ratio > 1) & sure
            moved_before = moved_then
        still &= ~moved
        if odd.sum() > MAX_MOVING_SHARE * (moved | still).sum():
            moved, still = moved_before, still & ~moved_before
        disparity = self._camera.at(view.disparity, uv)
        voters = sure | still
        moved = _outvoting(uv, disparity, moved, voters)
        return FlowVotes(
            *(_discs(view.disparity, uv[of], disparity[of]) for of in (moved, still, voters))
        )

    def _earlier(self, now_ns: int) -> list[FlowView]:
        """Return the images of about the ages wanted; older ones are dropped."""
        while self._views and now_ns - self._views[0].stamp_ns > 1.5 * AGES_NS[-1]:
            self._views.popleft()
        chosen = {
            min(range(len(self._views)), key=lambda i: abs(now_ns - age - self._views[i].stamp_ns))
            for age in AGES_NS
            if self._views
        }
        return [self._views[i] for i in sorted(chosen)]

    def _corners(self, view: FlowView) -> tuple[Array, NDArray[np.bool_]]:
        """Return corners (N, 2) px at which the disparity is known and has no edge, and which of
        them are sure to be found again.
        """
        strength = cv2.cornerMinEigenVal(view.left, 3)
        strongest = cv2.dilate(strength, np.ones((2 * APART_PX - 1, 2 * APART_PX - 1), np.uint8))
        v, u = np.nonzero((strength == strongest) & (strength > MIN_CORNER))
        if len(u) == 0:
            return np.zeros((0, 2)), np.zeros(0, bool)
        uv = np.column_stack([u, v]).astype(np.float64)
        uv = uv[spread(uv.astype(np.float32), strength[v, u], CELL_PX, CORNERS)]
        around = np.ones((5, 5), np.uint8)
        nearest = self._camera.at(cv2.dilate(view.disparity, around), uv)
        farthest = self._camera.at(cv2.erode(view.disparity, around), uv)
        uv = uv[(farthest > 0) & (nearest - farthest < 2 * TOLERANCE_PX)]
        return uv, self._camera.at(strength, uv) > SURE_CORNER

    def _compare(
        self, now: FlowView, then: FlowView, uv: Array
    ) -> tuple[NDArray[np.bool_], Array, NDArray[np.bool_]]:
        """Return which corners (N, 2) are found in an earlier image, how far off they are, in
        tolerances, from where they would be if they stood still, and which moved in that image.
        """
        disparity = self._camera.at(now.disparity, uv)
        T_then_now = invert(then.T_odom_camera) @ now.T_odom_camera
        nominal, farther, nearer = (
            self._camera.carried(uv, np.maximum(disparity + step, 0.1), T_then_now)
            for step in (0.0, -TOLERANCE_PX, TOLERANCE_PX)
        )
        back, there_too = _follow(now.left, then.left, uv, nominal[:, :2])
        returned, again = _follow(then.left, now.left, back, uv)
        followed = there_too & again & (np.hypot(*(returned - uv).T) < MAX_RETURN_PX)
        moved_then = np.zeros(len(uv), bool)
        if then.moving is not None:
            moved_then = followed & (self._camera.at(then.moving, back) > 0)
        found = followed & (nominal[:, 2] > 0)
        found &= self._camera.contains(back) & self._camera.contains(nominal[:, :2])
        found &= np.abs(np.log(np.maximum(nominal[:, 2], 0.01) / disparity)) < np.log(
            MAX_PATCH_ZOOM
        )
        found &= np.hypot(*(nominal[:, :2] - uv).T) < MAX_SHIFT_PX
        there = self._camera.at(then.disparity, back)
        tolerance = TOLERANCE_PX * (1 + (nominal[:, 2] / np.maximum(disparity, 0.1)) ** 2)
        ratio = _distance_to_segment(back, farther[:, :2], nearer[:, :2]) / SIGMA_FLOW_PX
        off = np.where(there > 0, np.abs(there - nominal[:, 2]) / tolerance, 0.0)
        return found, np.maximum(ratio, off), moved_then


def static_scale(ratios: Array) -> float:
    """Return by how much tolerances must grow, at least 1, by what the whole scene differs (N,), in
    tolerances: blur, a rolling shutter, a lag between the eyes and errors of the
    rectification move what stands still, too. At least a quarter of all stands still.
    """
    if len(ratios) == 0:
        return 1.0
    quarter = 0.25
    # As `np.quantile` does, which takes twice as long.
    rank, share = divmod(quarter * (len(ratios) - 1), 1.0)
    first, second = int(rank), min(int(rank) + 1, len(ratios) - 1)
    ordered = np.partition(ratios, (first, second))
    middle = (1 - share) * float(ordered[first]) + share * float(ordered[second])
    sigma = middle / np.sqrt(chi2_limit(1, quarter))
    return max(1.0, sigma * np.sqrt(chi2_limit(1, GATE)))


def _follow(
    now: NDArray[np.uint8], then: NDArray[np.uint8], uv: Array, guess: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return where corners (N, 2) are in another image, and which of them (N,) are found."""
    return follow_pixels(now, then, now.shape[1], uv, guess, WINDOW_PX, STEPS)


def _distance_to_segment(p: Array, a: Array, b: Array) -> Array:
    """Return the distances (N,) of points from the segments between others, (N, 2) each."""
    along = b - a
    t = ((p - a) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)
    return np.asarray(np.hypot(*(p - a - np.clip(t, 0, 1)[:, None] * along).T))


def _outvoting(
    uv: Array, disparity: Array, moved: NDArray[np.bool_], voters: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the corners (N,) that moved and whose neighbours at the same depth mostly did, too. Of
    those who vote, whoever was not found again does not say that it moved.
    """
    result = moved.copy()
    if not moved.any():
        return result
    tree = cKDTree(uv)
    for i in np.flatnonzero(moved):
        near = np.array(tree.query_ball_point(uv[i], NEIGHBOUR_PX))
        near = near[np.abs(disparity[near] - disparity[i]) < 2 * TOLERANCE_PX]
        result[i] = moved[near].sum() >= max(PROOF, MAJORITY * voters[near].sum())
    return result


def _discs(disparity: Disparity, uv: Array, of_corner: Array) -> NDArray[np.uint8]:
    """Return the pixels (h, w) around corners that are at the same depth."""
    height, width = disparity.shape
    mask = np.zeros(disparity.shape, np.uint8)
    reach = np.arange(-APART_PX, APART_PX + 1)
    u, v = np.rint(uv).astype(np.intp).T[:, :, None, None]
    u, v = np.broadcast_arrays(u + reach, v + reach[:, None])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at = np.where(inside, v * width + u, 0)
    alike = np.abs(disparity.take(at) - of_corner[:, None, None]) < 2 * TOLERANCE_PX
    mask.ravel()[at[inside & alike]] = 1
    return mask


class SmallCamera:
    """Projects between the shrunk image and the left optical frame.

    factor: pixels of the camera per pixel here. size: (w, h). focal, centre: (2,) px.
    disparity_m: disparity times depth. rays: (3, h w), the points of all pixels at one metre.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self.factor = factor = max(1, round(2 * camera.width / SMALL_WIDTH_PX))
        self.size = (camera.width // factor, camera.height // factor)
        self.disparity_m = camera.disparity_times_depth / factor
        self.focal = np.array([camera.fx, camera.fy]) / factor
        self.centre = (np.array([camera.cx, camera.cy]) + 0.5) / factor - 0.5
        u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in self.size))
        full_u, full_v = ((axis + 0.5) * factor - 0.5 for axis in (u, v))
        rays = [(full_u - camera.cx) / camera.fx, (full_v - camera.cy) / camera.fy, np.ones_like(u)]
        self.rays = np.stack(rays).reshape(3, -1).astype(np.float32)

    def from_right(self, right: NDArray[Any], disparity: Disparity) -> NDArray[Any]:
        """Return what a right image (h, w) shows of the left one's pixels by a disparity (h, w)."""
        u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in self.size))
        return cv2.remap(right, u - disparity, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def contains(self, uv: Array) -> NDArray[np.bool_]:
        """Return which pixels (N, 2) lie in the image."""
        u, v = np.rint(uv).T
        width, height = self.size
        return np.asarray((u >= 0) & (u < width) & (v >= 0) & (v < height))

    def at(self, image: NDArray[Any], uv: Array) -> Array:
        """Return the values (N,) of an image (h, w) at pixels (N, 2), 0 outside."""
        inside = self.contains(uv)
        u, v = np.where(inside[:, None], np.rint(uv), 0).astype(np.intp).T
        return np.where(inside, image[v, u], 0.0).astype(np.float64)

    def carried(self, uv: Array, disparity: Array, T_then_now: Array) -> Array:
        """Return pixel and disparity (N, 3) that points have in another image; the disparity is 0
        behind the camera.
        """
        depth = self.disparity_m / disparity
        points = np.column_stack([(uv - self.centre) / self.focal * depth[:, None], depth])
        return self.project(transform_points(T_then_now, points))

    def project(self, points: Array) -> Array:
        """Return pixel and disparity (N, 3) of points (N, 3) of the left optical frame; disparity
        0 behind the camera.
        """
        front = points[:, 2] > MIN_DEPTH_M
        z = np.where(front, points[:, 2], 1.0)
        pixel = self.focal * points[:, :2] / z[:, None] + self.centre
        return np.column_stack([pixel, np.where(front, self.disparity_m / z, 0.0)])


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
        step = -(-len(u) // CORNERS) if len(u) else 1
        v, u = v[::step], u[::step]
        xyz = look.xyz_world[v, u]
        velocity = np.full(xyz.shape, np.nan)
        last, self._last = self._last, look
        if last is None or len(u) == 0:
            return MovingPoints(xyz, velocity)
        if not 0 < look.stamp_ns - last.stamp_ns < MOMENT_NS:
            return MovingPoints(xyz, velocity)
        interval_s = (look.stamp_ns - last.stamp_ns) * 1e-9
        own = (xyz - _positions_then(look, last, u, v)) / interval_s
        own[np.linalg.norm(own, axis=1) > MAX_SPEED_M_S] = np.nan
        of = label[v, u]
        for thing in np.unique(of):
            followed = (of == thing) & np.isfinite(own[:, 0])
            if followed.sum() >= PROOF:
                velocity[of == thing] = np.median(own[followed], axis=0)
        return MovingPoints(xyz, velocity)


def _positions_then(look: Look, last: Look, u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
    """Return where pixels (N,) were at the last look, (N, 3); NaN where they are not found."""
    uv = np.stack([u, v], axis=1).astype(np.float64)
    found, followed = _follow(look.left, last.left, uv, uv)
    at = np.rint(found).astype(np.intp)
    height, width = last.left.shape
    inside = followed & (at >= 0).all(axis=1)
    inside &= (at[:, 0] < width) & (at[:, 1] < height)
    then = np.full((len(u), 3), np.nan)
    then[inside] = last.xyz_world[at[inside, 1], at[inside, 0]]
    return then
