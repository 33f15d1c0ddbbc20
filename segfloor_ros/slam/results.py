"""What stereo SLAM hands to the next stages: one result per frame, one bundle of data per
keyframe.

What tracking hands to mapping: a frame with a pose, and what was seen in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.geometry import Array
from segfloor_ros.measurements import WheelPose

if TYPE_CHECKING:  # the nodes behind SLAM do without SciPy
    from segfloor_ros.slam.map.residuals import Observations
    from segfloor_ros.slam.tracking.features import Features
    from segfloor_ros.slam.tracking.pose import PoseEstimate

UNKNOWN_COVARIANCE = 1e6
NO_POINT = -1
"""Id of a feature that has no map point."""

MIN_SHARED = 15
"""Fewest points that two keyframes must share, or agree on; fewer may be chance."""

MIN_TRACKED = 20
"""Fewest points that must agree for a pose to be believed; chance gives five or six."""


@dataclass(frozen=True)
class KeyframeFeatures:
    """The features of one keyframe. uv_px: (N, 2) float32, position in the rectified left
    image. point_id: (N,) int32, stable for the life of the map, `NO_POINT` where the feature
    has no map point. xyz_map: (N, 3) float32 in metres, NaN where unknown.
    """

    uv_px: NDArray[np.float32]
    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class SparseCloud:
    """The whole sparse map: ids (N,) int32 ascending, positions (N, 3) float32 in frame `map`,
    metres.
    """

    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class KeyframePath:
    """All keyframes as now optimised: stamps (K,) int64 ascending and base poses (K, 4, 4) in
    frame `map`.
    """

    stamp_ns: NDArray[np.int64]
    T_map_base: Array


@dataclass(frozen=True)
class MovingPoints:
    """Points of what moves: positions (N, 3) in frame `map`, m, and velocities (N, 3), m/s, NaN
    where they are not known.
    """

    xyz_map: NDArray[np.floating]
    velocity_m_s: NDArray[np.floating]


@dataclass(frozen=True)
class Keyframe:
    """Everything published about one keyframe. All parts share its stamp. moving: mask (H, W)
    uint8 of the left image, 255 where something moves.
    """

    stamp_ns: int
    frame_index: int
    T_map_base: Array
    left: NDArray[np.uint8]
    right: NDArray[Any]
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    moving: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class LastPose:
    """Where a drive was broken off: the last pose T_camera_world (4, 4) with its covariance (6, 6)
    and velocity (6,), the correction of the odometry T_world_odom (4, 4), and what wheels measured.
    """

    stamp_ns: int
    T_camera_world: Array
    T_world_odom: Array
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    wheels: tuple[WheelPose, ...] = ()


@dataclass(frozen=True)
class FrameResult:
    """The outcome of one frame. tracked: whether there is a pose. T_odom_base: the base in the
    continuous `odom` frame; T_map_odom: the present correction, so that T_map_odom @
    T_odom_base is the base in `map` (REP-105). Both are the last known ones while lost.
    covariance: (6, 6) of the base pose, order x y z roll pitch yaw (m², rad²), in the odom
    frame. reference_keyframe: stamp of the keyframe the pose is expressed against, for
    correcting it later. state: words for people ('tracking', or why not). blind: whether the pose
    is that of wheels or a gyroscope alone. keyframe: set when
    this frame became one. moving: what moves, where this frame was searched for it. in_submap:
    whether it was mapped in a submap beside the map: `tracked` where it was merged later. repeated:
    whether the left image is the one before, bit for bit.
    """

    index: int
    stamp_ns: int
    tracked: bool
    T_odom_base: Array
    T_map_odom: Array
    covariance: Array
    num_matches: int
    state: str
    reference_keyframe_ns: int
    keyframe: Keyframe | None = None
    moving: MovingPoints | None = None
    blind: bool = False
    in_submap: bool = False
    repeated: bool = False


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
    features. is_poor: whether few points of many support the pose. sigma_m: how uncertain the image
    leaves the place on the axis where it is most, 0 where it shows plenty. prior: the pose that
    wheels measured, where the image does not contradict it; is_prior_better: in some direction.
    """

    estimate: PoseEstimate
    point_ids: NDArray[np.int32]
    observations: Observations
    visible_ids: NDArray[np.int32]
    observed: ObservedFeatures | None = None
    is_poor: bool = False
    sigma_m: float = 0.0
    prior: PoseEstimate | None = None
    is_prior_better: bool = False

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


def lost_frame(frame: StereoFrame) -> FrameResult:
    """Return the outcome of a frame that nothing came of."""
    nowhere = np.eye(4)
    unknown = np.eye(6) * UNKNOWN_COVARIANCE
    return FrameResult(
        frame.index, frame.stamp_ns, False, nowhere, nowhere, unknown, 0, 'lost: failed', 0
    )
