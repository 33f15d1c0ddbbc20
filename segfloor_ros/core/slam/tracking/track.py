"""What tracking hands to mapping."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.rig import Observations, Rig, in_view, moved_on
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.pose import PoseEstimate, differ

FAR_PX = 0.1
"""Disparity of what is too far away for it to be measured."""


@dataclass(frozen=True)
class ObservedFeatures:
    """The features (F) of a frame as measured. observations: (F, 3) px, with a disparity where one
    was measured. point_id: (F,) int32, the row of each feature's map point or `NO_POINT`. twist:
    (6,) of the camera during the readout.
    """

    features: Features
    observations: Observations
    point_id: NDArray[np.int32]
    twist: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def known_share(self) -> float:
        """The share of the points that the frame shows which the map knew before: what is new lies
        where the camera has it, and shares its error.
        """
        known = self.point_id != NO_POINT
        return float(known.sum() / max(1, (known | self.observations.has_disparity).sum()))

    def take(self, rows: NDArray[np.intp]) -> ObservedFeatures:
        """Return the chosen rows."""
        return ObservedFeatures(
            self.features.take(rows), self.observations.take(rows), self.point_id[rows], self.twist
        )

    def at_once(self, rig: Rig) -> Observations:
        """Return what a camera measures that reads all rows out at once; what has no disparity is
        taken to be far away.
        """
        seen, camera = self.observations, rig.camera
        disparity = np.nan_to_num(seen.uvd_px[:, 2] - rig.offset.at(seen.uvd_px))
        depth = camera.disparity_times_depth / np.maximum(disparity, FAR_PX)
        points = camera.back_project(seen.uvd_px[:, :2], depth)
        share = (seen.uvd_px[:, 1] - camera.cy) / camera.height
        at_once = moved_on(points.T, -share, self.twist).T
        moved = in_view(camera, at_once)[0] - in_view(camera, points)[0]
        return Observations(seen.uvd_px + np.nan_to_num(moved), seen.sigma_px)


@dataclass(frozen=True)
class Track:
    """A frame with a pose.

    point_ids: (N,) the map points that were found and agree, and observations (N) of them as
    measured. visible_ids: those that were looked for. observed: set when the pose was found by
    features. sigma_m: how uncertain the image
    leaves the place on the axis where it is most, 0 where it shows plenty. prior: the pose that
    wheels measured, where the image does not contradict it.
    """

    estimate: PoseEstimate
    point_ids: NDArray[np.int32]
    observations: Observations
    visible_ids: NDArray[np.int32]
    observed: ObservedFeatures | None = None
    sigma_m: float = 0.0
    prior: PoseEstimate | None = None

    @property
    def T_camera_world(self) -> Array:
        """The pose (4, 4)."""
        return self.estimate.T_camera_world

    @property
    def uv_px(self) -> Array:
        """Where the points are in the image, (N, 2)."""
        return self.observations.uvd_px[:, :2]

    @property
    def covariance(self) -> Array:
        """The covariance (6, 6) of the pose's twist."""
        return self.estimate.covariance

    def fits(self, expected: PoseEstimate | None) -> bool:
        """Whether the camera is where it was expected."""
        return expected is None or not differ(self.estimate, expected)
