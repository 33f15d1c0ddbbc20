"""What tracking hands to mapping: a frame with a pose, and what was seen in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.slam.features import Features
from segfloor_ros.slam.pose import PoseEstimate
from segfloor_ros.slam.residuals import Observations

MIN_TRACKED = 20
"""Fewest points that must agree for a pose to be believed; chance gives five or six."""


@dataclass(frozen=True)
class ObservedFeatures:
    """The features (F) of a frame as measured. observations: (F, 3) px, with a disparity where one
    was measured. point_id: (F,) int32, the row of each feature's map point or `NO_POINT`.
    """

    features: Features
    observations: Observations
    point_id: NDArray[np.int32]

    def take(self, rows: NDArray[np.intp]) -> ObservedFeatures:
        """Return the chosen rows."""
        return ObservedFeatures(
            self.features.take(rows), self.observations.take(rows), self.point_id[rows]
        )


@dataclass(frozen=True)
class Track:
    """A frame with a pose.

    point_ids: (N,) the map points that were found and agree, and observations (N) of them as
    measured. visible_ids: those that were looked for. observed: set when the pose was found by
    features.
    """

    estimate: PoseEstimate
    point_ids: NDArray[np.int32]
    observations: Observations
    visible_ids: NDArray[np.int32]
    observed: ObservedFeatures | None = None

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
