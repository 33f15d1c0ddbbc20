"""Going on with a map whose SLAM has ended without warning: from its last keyframe.

A new SLAM starts at that keyframe's images. What it finds is brought into the old map's frames
and beside the old map's keyframes and points, which stay as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, invert, transform_points
from segfloor_ros.slam.results import (
    NO_POINT,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
)


@dataclass(frozen=True)
class LastState:
    """What a later SLAM needs: the camera and its mount, the last keyframe, which holds path and
    cloud of the whole map, and the correction T_map_odom at that time.
    """

    camera: StereoCamera
    mount: Mount
    keyframe: Keyframe
    T_map_odom: Array

    @property
    def frame(self) -> StereoFrame:
        """The images that the new SLAM must be given first; its result is not for publishing."""
        last = self.keyframe
        return StereoFrame(last.frame_index, last.stamp_ns, last.left, last.right)


class Continuation:
    """Brings results of a SLAM that began at `LastState.frame` into the old map."""

    def __init__(self, last: LastState) -> None:
        keyframe = last.keyframe
        self._T_map_new: Array = keyframe.T_map_base
        self._T_map_odom: Array = last.T_map_odom
        path, cloud = keyframe.path, keyframe.cloud
        earlier = path.stamp_ns < keyframe.stamp_ns
        self._path = KeyframePath(path.stamp_ns[earlier], path.T_map_base[earlier])
        # The new SLAM maps what the last keyframe sees once more.
        only_old = ~np.isin(cloud.point_id, keyframe.features.point_id)
        self._cloud = SparseCloud(cloud.point_id[only_old], cloud.xyz_map[only_old])
        self._first_id = int(cloud.point_id.max(initial=NO_POINT)) + 1

    def join(self, result: FrameResult) -> FrameResult:
        """Return a result of the new SLAM as one of the old map. `odom` stays where it was."""
        T_odom_new = invert(self._T_map_odom) @ self._T_map_new
        axes = np.kron(np.eye(2), T_odom_new[:3, :3])
        return replace(
            result,
            T_odom_base=T_odom_new @ result.T_odom_base,
            T_map_odom=self._T_map_new @ result.T_map_odom @ invert(T_odom_new),
            covariance=axes @ result.covariance @ axes.T,
            keyframe=None if result.keyframe is None else self._join_keyframe(result.keyframe),
        )

    def _join_keyframe(self, new: Keyframe) -> Keyframe:
        return replace(
            new,
            T_map_base=self._T_map_new @ new.T_map_base,
            features=self._join_features(new.features),
            path=KeyframePath(
                np.concatenate([self._path.stamp_ns, new.path.stamp_ns]),
                np.concatenate([self._path.T_map_base, self._T_map_new @ new.path.T_map_base]),
            ),
            cloud=SparseCloud(
                np.concatenate([self._cloud.point_id, new.cloud.point_id + self._first_id]),
                np.concatenate([self._cloud.xyz_map, self._in_map(new.cloud.xyz_map)]),
            ),
        )

    def _join_features(self, new: KeyframeFeatures) -> KeyframeFeatures:
        known = new.point_id != NO_POINT
        point_id = np.where(known, new.point_id + self._first_id, NO_POINT).astype(np.int32)
        return KeyframeFeatures(new.uv_px, point_id, self._in_map(new.xyz_map))

    def _in_map(self, xyz_new: np.ndarray) -> np.ndarray:
        return transform_points(self._T_map_new, xyz_new.astype(np.float64)).astype(np.float32)
