"""Which parts of an image move: what now stands where earlier keyframes saw through.

The geometric half of DynaSLAM (Bescos et al., RA-L 2018, section III-C) compares the depth of old
points with the new one, and takes what is nearer for moving; but what stands still hides things too
when the camera moves. Here the test is turned around and made for every pixel: a thing that is
seen now is carried into an earlier keyframe, and moves if that keyframe saw what lies behind it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.camera.pixels import Region, shrunk
from segfloor_ros.core.contracts import Mount, Placed, Searched, StereoFrame
from segfloor_ros.core.geometry import Array, invert, rotation_angle, transform_points
from segfloor_ros.core.plugins.moving.scene_flow import (
    MAX_MOVING_SHARE,
    TOLERANCE_PX,
    Disparity,
    FlowView,
    FlowVotes,
    Look,
    MovingPointMeter,
    SceneFlow,
    SmallCamera,
    static_scale,
)
from segfloor_ros.core.slam.places.views import is_due
from segfloor_ros.core.slam.rig import MIN_DEPTH_M
from segfloor_ros.core.slam.thresholds import CHANCE_SHARE, MAJORITY
from segfloor_ros.core.slam.tracking.pose import FLOOR_M

DISPARITIES = 64
BLOCK_PX = 5
P1, P2, SPECKLE_PX = 100, 400, 40
"""Of semi-global matching (Hirschmueller 2008): penalties for the sum of differences over a block,
and the size up to which a region on its own is noise."""

MAX_PARALLAX_RAD = float(np.radians(30.0))
COMPARED_VIEWS, KEPT_VIEWS = 5, 30
SHIN_M, FOOT_M = 0.3, 0.2
"""Below what moves at less than the first height is a foot, up to the second in each direction."""

FOOT_STEPS_PX = (1.5, 2.5, 4.0, 6.5, 10.0, 16.0, 26.0, 64.0)
"""Disparities between which feet are taken to be of one size."""

REACH_M = 0.4
"""From corners of someone who walks to hands and feet."""

GAINS = 0.5, 2.0
"""Of the right image's contrast against the left one's."""

MISFIT_OF_TEXTURE = 0.7
"""Patches that show different things differ by more than this share of their texture."""

MIN_AREA_PX = BLOCK_PX * BLOCK_PX
"""Less is a single wrong match."""


@dataclass(frozen=True)
class DepthView:
    """What an earlier keyframe saw: the disparity (h, w) in px of the shrunk image, 0 where none
    was found, and the largest and smallest one around each pixel.
    """

    keyframe: Placed
    disparity: Disparity
    nearest: Disparity
    farthest: Disparity

    @staticmethod
    def of(keyframe: Placed, disparity: Disparity) -> DepthView:
        """Prepare the disparity of a keyframe for comparisons."""
        around = np.ones((3, 3), np.uint8)
        known = np.where(disparity > 0, disparity, np.float32(np.inf))
        return DepthView(
            keyframe, disparity, cv2.dilate(disparity, around), cv2.erode(known, around)
        )


class MovingRegions:
    """Finds what moves in keyframes, and in some of the frames between."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera, self._small = camera, SmallCamera(camera)
        self._matcher = cv2.StereoSGBM_create(
            0, DISPARITIES, BLOCK_PX, P1, P2, disp12MaxDiff=1, uniquenessRatio=5,
            speckleWindowSize=SPECKLE_PX, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_HH4,
        )  # fmt: skip
        self.reset()

    def reset(self) -> None:
        """Forget all frames: where the next ones are relative to them is not known."""
        self._flow = SceneFlow(self._small)
        self._pair: tuple[NDArray[np.uint8], NDArray[np.uint8] | None]
        self._views: deque[DepthView] = deque(maxlen=KEPT_VIEWS)
        self._found: NDArray[np.uint8] | None = None
        self._meter = MovingPointMeter()
        self._frames_since, self._searched_ns = 0, 0
        self._exposure = 1.0, 0.0

    def is_due(self, stamp_ns: int, is_keyframe: bool, is_tracked: bool) -> bool:
        """Whether to search a frame."""
        self._frames_since += 1
        is_late = is_due(self._frames_since, stamp_ns - self._searched_ns)
        return is_keyframe or (is_tracked and is_late)

    def search(
        self, frame: StereoFrame, T_camera_world: Array, T_odom_camera: Array, mount: Mount | None
    ) -> Searched:
        """Find what moves in a frame whose pose is known."""
        self._frames_since, self._searched_ns = 0, frame.stamp_ns
        disparity = self.measure(frame.left, frame.right)
        left = self._pair[0]
        view = FlowView(frame.stamp_ns, left, disparity, T_odom_camera)
        found = self.find(disparity, T_camera_world, mount, self._flow.votes(view))
        moving, self._found = self._held(found, disparity), found
        self._flow.remember(replace(view, moving=moving))
        look = Look(frame.stamp_ns, left, _positions(self._small, disparity, T_camera_world))
        points = self._meter.measure(look, moving)
        return Searched(disparity, moving, self._enlarged(moving), points)

    def seen_through(self, disparity: Disparity, points: Array) -> NDArray[np.bool_]:
        """Return at which points (N, 3) of the left optical frame nothing is: the image shows what
        lies behind them, and nothing as near around them.
        """
        expected = self._small.project(points)
        uv, expected_px = expected[:, :2], expected[:, 2]
        around = self._small.at(cv2.dilate(disparity, np.ones((5, 5), np.uint8)), uv)
        behind = around < expected_px - 2 * TOLERANCE_PX
        return np.asarray((expected_px > 0) & behind & (self._small.at(disparity, uv) > 0))

    def measure(self, left: NDArray[np.uint8], right: NDArray[Any]) -> Disparity:
        """Return the disparity (h, w) of the shrunk pair, 0 where there is none."""
        small_left = cv2.resize(left, self._small.size, interpolation=cv2.INTER_AREA)
        if is_disparity(right):
            self._pair = small_left, None
            return shrunk(right.astype(np.float32, copy=False), self._small.size)
        small_right = cv2.resize(right, self._small.size, interpolation=cv2.INTER_AREA)
        # Without a margin the matcher leaves the leftmost columns empty.
        wide = (
            cv2.copyMakeBorder(i, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE)
            for i in (small_left, self._as_bright(small_right))
        )
        found = self._matcher.compute(*wide)[:, DISPARITIES:].astype(np.float32) / 16
        found[found > np.arange(self._small.size[0]) + 1] = 0.0
        self._compare_exposures(small_left, small_right, found)
        self._pair = small_left, self._as_bright(small_right)
        return np.maximum(found, 0.0)

    def _as_bright(self, right: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a right image (h, w) as bright as the left one, as far as is known."""
        gain, offset = self._exposure
        return np.asarray(cv2.addWeighted(right, gain, right, 0.0, offset), np.uint8)

    def _compare_exposures(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], disparity: Disparity
    ) -> None:
        """Note gain and offset between two images (h, w), by what both show."""
        is_matched = (disparity > 0).astype(np.uint8)
        if np.count_nonzero(is_matched) < MIN_AREA_PX:
            return
        (mean_l, spread_l), (mean_r, spread_r) = (
            cv2.meanStdDev(image, mask=is_matched)
            for image in (left, self._small.from_right(right, disparity))
        )
        gain = float(np.clip(spread_l[0, 0] / max(float(spread_r[0, 0]), 1.0), *GAINS))
        self._exposure = gain, float(mean_l[0, 0]) - gain * float(mean_r[0, 0])

    def remember(self, keyframe: Placed, disparity: Disparity) -> None:
        """Take in what a keyframe saw."""
        self._views.append(DepthView.of(keyframe, disparity))

    def find(
        self,
        disparity: Disparity,
        T_camera_world: Array,
        mount: Mount | None,
        votes: FlowVotes | None = None,
    ) -> NDArray[np.uint8]:
        """Return what moves (h, w), 255, in an image with this disparity and pose. votes: of its
        corners.
        """
        rows = np.flatnonzero(disparity > 0)
        if len(rows) == 0:
            return np.zeros(disparity.shape, np.uint8)
        points = self._small.rays[:, rows] * (self._small.disparity_m / disparity.ravel()[rows])
        through, solid, behind = self._compare(points, disparity.ravel()[rows], T_camera_world)
        height_m = np.full(len(rows), np.inf)
        if mount is not None:
            height_m = mount.heights_m(points.T)
        high = height_m > FLOOR_M
        seeds, doubtful = (np.zeros(disparity.size, np.uint8) for _ in range(2))
        seeds[rows] = (through >= solid) & (through > 1) & high
        background = disparity.copy()
        background.ravel()[rows] = behind
        seeds &= self._shown(disparity, background).ravel()
        doubtful[rows] = (solid <= through) & high
        if votes is not None:
            flat = np.zeros(disparity.size, np.uint8)
            flat[rows] = high
            seeds |= self._whole_things(votes, flat.reshape(disparity.shape), disparity).ravel()
            doubtful &= 1 - votes.still.ravel()
        moving = self._regions(
            seeds.reshape(disparity.shape), doubtful.reshape(disparity.shape), disparity
        )
        low = np.zeros(disparity.size, bool)
        low[rows] = height_m < SHIN_M
        return self._with_feet(moving, disparity, low.reshape(disparity.shape))

    def _enlarged(self, region: NDArray[np.uint8]) -> Region | None:
        """Return a region of the shrunk image in that of the camera (H, W), None for none."""
        if not region.any():
            return None
        factor = self._small.factor
        whole = cv2.resize(region, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
        below, right = self._camera.height - whole.shape[0], self._camera.width - whole.shape[1]
        return np.asarray(
            cv2.copyMakeBorder(whole, 0, below, 0, right, cv2.BORDER_REPLICATE), np.uint8
        )

    def _held(self, found: NDArray[np.uint8], disparity: Disparity) -> NDArray[np.uint8]:
        """Return what is found to move (h, w) and was already found in the last search, no farther
        off than a limb reaches: blur, a lag between the eyes or a wrong match last for one image.
        """
        held = np.zeros_like(found)
        if self._found is None:
            return held
        for own, depth_m in self._things(found, disparity):
            reach = self._pixels(REACH_M, depth_m)
            around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
            if self._found[cv2.dilate(own.astype(np.uint8), around) > 0].any():
                held[own] = 255
        return held

    def _compare(
        self, points: NDArray[np.float32], disparity: Disparity, T_camera_world: Array
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Disparity]:
        """Return how many earlier views saw through points (3, N), how many saw them, and the
        disparity of what the latest of the former saw behind.
        """
        through, solid = (np.zeros(points.shape[1], np.uint8) for _ in range(2))
        background = disparity.copy()
        T_world_camera = invert(T_camera_world)
        for view in self._chosen(T_world_camera, float(np.quantile(points[2], MAX_MOVING_SHARE))):
            T = (view.keyframe.T_camera_world @ T_world_camera).astype(np.float32)
            x, y, z = T[:3, :3] @ points + T[:3, 3:]
            depth = np.maximum(z, 0.01)
            u = np.rint(self._small.focal[0] * x / depth + self._small.centre[0])
            v = np.rint(self._small.focal[1] * y / depth + self._small.centre[1])
            inside = (z > MIN_DEPTH_M) & (u >= 0) & (u < self._small.size[0])
            inside &= (v >= 0) & (v < self._small.size[1])
            at = np.where(inside, v * self._small.size[0] + u, 0).astype(np.intp)
            seen_px = view.disparity.take(at)
            inside &= seen_px > 0
            expected = self._small.disparity_m / depth
            tolerance = TOLERANCE_PX * np.sqrt(1 + np.square(np.square(expected / disparity)))
            differs = np.abs(seen_px - expected) / tolerance
            tolerance *= static_scale(differs[inside])
            nearest = view.nearest.take(at)
            behind = nearest < expected - tolerance
            before = view.farthest.take(at) > expected + tolerance
            through += inside & behind
            # Farther along much the same ray by as much as the earlier view says.
            seen = np.flatnonzero(inside & behind)
            background[seen] = disparity[seen] * nearest[seen] / expected[seen]
            solid += inside & ~behind & ~before
        return through, solid, background

    def _shown(self, disparity: Disparity, background: Disparity) -> NDArray[np.uint8]:
        """Return where (h, w) the pair of images itself speaks for a disparity and against what was
        seen behind: a pattern that repeats fits both. A depth camera has no such doubts.
        """
        if self._pair[1] is None:
            return np.ones(disparity.shape, np.uint8)
        left, right = (image.astype(np.float32) for image in self._pair if image is not None)

        def misfit(d: Disparity) -> Disparity:
            difference = cv2.absdiff(left, self._small.from_right(right, d))
            return np.asarray(cv2.blur(difference, (5, 5)), np.float32)

        rival = np.minimum.reduce([misfit(background + step) for step in (-0.5, 0.0, 0.5)])
        texture = cv2.blur(cv2.absdiff(left, cv2.blur(left, (5, 5))), (5, 5))
        own = misfit(disparity)
        limit = MISFIT_OF_TEXTURE * texture + np.median(own[disparity > 0])
        return ((own < limit) & (limit < rival)).astype(np.uint8)

    def _chosen(self, T_world_camera: Array, depth_m: float) -> list[DepthView]:
        """Return a few views that look at what the camera sees from much the same side, spread over
        the time that is remembered. depth_m: how far away that is.
        """
        near = []
        for view in self._views:
            T = view.keyframe.T_camera_world @ T_world_camera
            moved_m, turned = float(np.linalg.norm(T[:3, 3])), rotation_angle(T[:3, :3])
            if turned < MAX_PARALLAX_RAD and moved_m < np.tan(MAX_PARALLAX_RAD) * depth_m:
                near.append(view)
        spread = np.linspace(0, len(near) - 1, min(len(near), COMPARED_VIEWS))
        return [near[i] for i in np.unique(spread.round().astype(int))]

    def _whole_things(
        self, votes: FlowVotes, high: NDArray[np.uint8], disparity: Disparity
    ) -> NDArray[np.uint8]:
        """Return the things (h, w) of which most corners moved, whatever was seen there before, and
        single corners that moved. high: (h, w), 1 where something is higher than the floor.
        """
        found = votes.moving & high
        _, labels = cv2.connectedComponents(np.where(_edges(disparity), 0, high).astype(np.uint8))
        moved, voted = (
            np.bincount(labels.ravel(), weights=of.ravel()) for of in (found, votes.all)
        )
        moves = (moved > MAJORITY * voted) & (moved >= MIN_AREA_PX)
        for label in np.flatnonzero(moves[1:]) + 1:
            seed = ((labels == label) & (found > 0)).astype(np.uint8)
            depth_m = self._small.disparity_m / np.median(disparity[seed > 0])
            reach = self._pixels(REACH_M, depth_m)
            around = cv2.dilate(seed, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
            nearest = self._small.disparity_m / max(depth_m - REACH_M, MIN_DEPTH_M)
            farthest = self._small.disparity_m / (depth_m + REACH_M)
            own = (labels == label) & (disparity > farthest) & (disparity < nearest)
            found[own & (around > 0)] = 1
        return found

    def _regions(
        self, seeds: NDArray[np.uint8], doubtful: NDArray[np.uint8], disparity: Disparity
    ) -> NDArray[np.uint8]:
        """Return the seeds and the connected regions of one depth that consist of them."""
        # Strips no wider than a block are fringes of what stands still.
        block = np.ones((BLOCK_PX, BLOCK_PX), np.uint8)
        seeds = cv2.morphologyEx(seeds, cv2.MORPH_OPEN, block)
        parts = np.where(_edges(disparity), 0, doubtful | seeds).astype(np.uint8)
        _, labels = cv2.connectedComponents(parts)
        area = np.bincount(labels.ravel())
        seeded = np.bincount(labels.ravel(), weights=seeds.ravel())
        whole = (seeded > CHANCE_SHARE * area) & (seeded >= MIN_AREA_PX)
        whole[0] = False
        moving = whole[labels] | ((seeds > 0) & (seeded[labels] >= MIN_AREA_PX))
        # As far as blocks reach beyond the edge of what moves.
        return cv2.dilate(np.where(moving, np.uint8(255), np.uint8(0)), block)

    def _with_feet(
        self, moving: NDArray[np.uint8], disparity: Disparity, low: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Return what moves with the feet below it, which are as low as the floor. low: (h, w)
        where something is no higher than a shin.
        """
        pixel_per_metre = self._small.focal[0] / self._small.disparity_m
        shins, result = (moving > 0) & low, moving.copy()
        for nearer, farther in zip(FOOT_STEPS_PX[1:], FOOT_STEPS_PX[:-1], strict=True):
            here = shins & (disparity >= farther) & (disparity < nearer)
            if here.any():
                reach = round(FOOT_M * pixel_per_metre * farther)
                kernel = np.ones((reach + 1, 2 * (reach // 2) + 1), np.uint8)
                # The anchor at the lower end: only what lies below is reached.
                below = cv2.dilate(here.astype(np.uint8), kernel, anchor=(reach // 2, reach))
                result[below > 0] = 255
        return result

    def _things(
        self, region: NDArray[np.uint8], disparity: Disparity
    ) -> Iterator[tuple[NDArray[np.bool_], float]]:
        """Yield the connected things (h, w) of a region and how far away each is, in metres."""
        count, labels = cv2.connectedComponents(region)
        for label in range(1, count):
            own = labels == label
            known = disparity[own & (disparity > 0)]
            if len(known):
                yield own, self._small.disparity_m / float(np.median(known))

    def _pixels(self, length_m: float, depth_m: float) -> int:
        """Return how many pixels, at least one, a length takes at a distance."""
        return max(1, round(self._small.focal[0] * length_m / depth_m))


def _edges(disparity: Disparity) -> NDArray[np.bool_]:
    """Return where (h, w) something nearer begins."""
    nearest = cv2.dilate(disparity, np.ones((3, 3), np.uint8))
    return np.asarray(nearest - disparity > 2 * TOLERANCE_PX)


def _positions(small: SmallCamera, disparity: Disparity, T_camera_world: Array) -> Array:
    """Return where each pixel is, (h, w, 3) in the world, NaN where there is no disparity."""
    depth_m = np.where(disparity > 0, small.disparity_m / np.maximum(disparity, 1e-3), np.nan)
    points = (small.rays * depth_m.ravel()).T.astype(np.float64)
    return transform_points(invert(T_camera_world), points).reshape(*disparity.shape, 3)
