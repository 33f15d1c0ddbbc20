"""What stereo SLAM hands to the next stages: one result per frame, one bundle of data per
keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

NO_POINT = -1
"""Id of a feature that has no map point."""


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
class FrameResult:
    """The outcome of one frame. tracked: whether there is a pose. T_odom_base: the base in the
    continuous `odom` frame; T_map_odom: the present correction, so that T_map_odom @
    T_odom_base is the base in `map` (REP-105). Both are the last known ones while lost.
    covariance: (6, 6) of the base pose, order x y z roll pitch yaw (m², rad²), in the odom
    frame. reference_keyframe: stamp of the keyframe the pose is expressed against, for
    correcting it later. state: words for people ('tracking', or why not). blind: whether the pose
    is that of wheels or a gyroscope alone. keyframe: set when
    this frame became one. moving: what moves, where this frame was searched for it. apart: whether
    it was, at first, not known where in the map this is: `tracked` where it was recognised later.
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
    apart: bool = False
