"""The pose of a frame from the one before alone: corners of both that look alike, with the depth
that the first pair shows, and PnP in RANSAC. It knows nothing of the map, of the motion so far or
of records; so it finds its way where these are of no help.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.rig import SAME_PX, Observations, Rig
from segfloor_ros.core.slam.tracking.evidence import is_proof
from segfloor_ros.core.slam.tracking.images import (
    SIGMA_FLOW_PX,
    Features,
    Images,
    is_inside,
    match_unguided,
)
from segfloor_ros.core.slam.tracking.patch_alignment import measure_disparities
from segfloor_ros.core.slam.tracking.pose import (
    ANYWHERE,
    PoseEstimate,
    Searched,
    refine_pose,
    solve_pnp,
)
from segfloor_ros.core.timing import timed
from segfloor_ros.core.twists import compounded, without_drift

FEATURES, ITERATIONS = 2000, 5000
"""Corners of an image, wherever they are, and draws of RANSAC: where one match in seven is right,
nine times in ten four right ones are drawn.
"""


class FrameToFrame:
    """Keeps the last frame with a pose. rig: of the camera."""

    def __init__(self, rig: Rig, fast_threshold: int) -> None:
        self._rig = rig
        self._camera: StereoCamera = rig.camera
        self._orb = cv2.ORB_create(FEATURES, fastThreshold=fast_threshold)
        self._last: tuple[StereoFrame, Images, PoseEstimate] | None = None
        self._seen: tuple[int, Features] | None = None

    @property
    def stamp_ns(self) -> int | None:
        """The stamp of the last frame with a pose."""
        return None if self._last is None else self._last[0].stamp_ns

    def reset(self) -> None:
        """Know no frame before."""
        self._last = None

    def see(self, frame: StereoFrame, images: Images, estimate: PoseEstimate) -> None:
        """Take in a frame and its pose."""
        self._last = frame, images, estimate

    def move_map(self, T_before_after: Array) -> None:
        """Let the last pose move along with the map, by a motion (4, 4) of the world."""
        if self._last is not None:
            frame, images, estimate = self._last
            moved = without_drift(estimate.T_camera_world @ T_before_after)
            self._last = frame, images, replace(estimate, T_camera_world=moved)

    @timed
    def find(self, frame: StereoFrame, images: Images) -> PoseEstimate | None:
        """Return the pose of a frame; None where there is no evidence for one."""
        if self._last is None:
            return None
        before, before_images, before_estimate = self._last
        old, new = self._corners(before, before_images), self._corners(frame, images)
        rows, new_rows = match_unguided(old.descriptor, new.descriptor, max_hamming=256)
        known = self._measured(before, before_images, old.take(rows))
        far = np.isnan(known.uvd_px[:, 2]) | (known.uvd_px[:, 2] <= known.sigma_px[:, 2])
        rows = np.flatnonzero(~far)
        rows = rows[distinct(new.uv_px[new_rows[rows]])]
        known, seen = known.take(rows), self._measured(frame, images, new.take(new_rows[rows]))
        uv_px, depth = known.uvd_px[:, :2], self._camera.disparity_times_depth / known.uvd_px[:, 2]
        points = self._camera.back_project(uv_px, depth)
        start = solve_pnp(self._camera, points, seen.uvd_px[:, :2], ITERATIONS)
        if start is None:
            return None
        seen.sigma_px[:, 2] = np.hypot(seen.sigma_px[:, 2], known.sigma_px[:, 2])
        area_px2 = crowded_area_px2(seen.uvd_px[:, :2], self._camera.width * self._camera.height)
        disparity = seen.uvd_px[seen.has_disparity, 2]
        range_px = max(SAME_PX, float(np.ptp(disparity))) if len(disparity) else None
        # What RANSAC takes for right lies within two standard deviations.
        searched = Searched(area_px2, range_px, largest_factor=SAME_PX / (2 * SIGMA_FLOW_PX))
        asked = self._camera, start[0], points, seen, None, searched, False, start[1]
        # Both images are bent by much the same motion: only the difference is left.
        moved = refine_pose(*asked, replace(self._rig.shutter.expected, twist=np.zeros(6)))
        # Seen from far away all points are in one place, where many a corner is.
        near = PoseEstimate(np.eye(4), moved.inliers, ANYWHERE, 1.0)
        if not is_proof(moved.evidence(near)):
            return None
        T_camera_world, covariance = compounded(
            (before_estimate.T_camera_world, before_estimate.covariance),
            (moved.T_camera_world, moved.covariance),
        )
        return replace(moved, T_camera_world=T_camera_world, covariance=covariance)

    def _corners(self, frame: StereoFrame, images: Images) -> Features:
        """Return the corners of a frame outside of what is excluded; asked for twice of each."""
        if self._seen is not None and self._seen[0] == frame.stamp_ns:
            return self._seen[1]
        features = Features.of(*self._orb.detectAndCompute(frame.left, None))
        features = features.take(np.flatnonzero(~is_inside(images.excluded, features.uv_px)))
        self._seen = frame.stamp_ns, features
        return features

    def _measured(self, frame: StereoFrame, images: Images, features: Features) -> Observations:
        """Return what features (N) measure, freed of the disparity offset."""
        observations = Observations.of_pixels(features.uv_px, SIGMA_FLOW_PX)
        measure_disparities(frame, images, observations, np.arange(len(features)))
        return observations.without_offset(self._rig.offset)


def distinct(uv_px: Array) -> NDArray[np.intp]:
    """Return one row (M,) of pixels (N, 2) for each cell of 6 px: a corner that is found at
    several levels of the pyramid counts once.
    """
    cells = np.floor(uv_px / (1.5 * SAME_PX)).astype(np.intp)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def crowded_area_px2(uv_px: Array, whole_px2: float) -> float:
    """Return the area in which pixels (N, 2) that were spread evenly would lie as close together:
    where features crowd, wrong matches agree more often.
    """
    count = len(uv_px)
    if count < 2:
        return whole_px2
    pairs = len(cKDTree(uv_px).query_pairs(NEAR_PX, output_type='ndarray'))
    near = max(2 * pairs / (count * (count - 1)), 1e-9)
    return min(whole_px2, np.pi * NEAR_PX**2 / near)


NEAR_PX = 4 * SAME_PX
"""Within which features count as close together."""
