"""A keyframe of the map, and what ties it to others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, invert
from segfloor_ros.measurements import Up
from segfloor_ros.slam.map.residuals import Observations
from segfloor_ros.slam.sensors.body_motion import RelativeMotion
from segfloor_ros.slam.tracking.features import Features


@dataclass(frozen=True)
class Retirement:
    """Where a retired keyframe was seen from the keyframe (by index) that it follows."""

    reference: int
    T_camera_reference: Array


@dataclass(frozen=True)
class LoopEdge:
    """Where keyframe i was when it saw the place of keyframe j again: T_i_j (4, 4), of cameras."""

    i: int
    j: int
    T_i_j: Array


@dataclass(frozen=True)
class Match:
    """A keyframe that sees a place of the map again. place: the keyframe that knows it best, both
    by index. T_camera_world: (4, 4) the keyframe's camera as seen from there. rows, ids: (N,)
    features and the place's points they show, stable_ids: (N,) of these.
    """

    keyframe: int
    place: int
    T_camera_world: Array
    rows: NDArray[np.intp]
    ids: NDArray[np.int32]
    stable_ids: NDArray[np.int32]


@dataclass
class KeyframeRecord:
    """One keyframe of the map.

    The pose moves in bundle adjustment. observations: as measured, the disparity offset of the rig
    not taken off. retired: set when the keyframe has no features any more and only follows another
    one. point_id: (N,) int32, the row of each feature's map point, not its stable id.
    motion: since the keyframe before, as the wheels tell it. up: in the camera, as it was felt.
    links: indices of earlier keyframes that it shared many points with when it was made.
    """

    index: int
    frame_index: int
    stamp_ns: int
    T_camera_world: Array
    features: Features
    observations: Observations
    point_id: NDArray[np.int32]
    motion: RelativeMotion | None = None
    up: Up | None = None
    retired: Retirement | None = None
    links: tuple[int, ...] = ()

    @property
    def T_world_camera(self) -> Array:
        """The camera's pose (4, 4)."""
        return invert(self.T_camera_world)
