"""Masks of keyframes that come once they are keyframes, as those of a slow network."""

from __future__ import annotations

from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.slam.optional import NoLateMasks
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import dilate, is_inside


class LateMasks(NoLateMasks):
    """Takes back the points of keyframes where masks that come later show what moves."""

    def __init__(self, front_end: FrontEnd, sparse_map: SparseMap) -> None:
        self._front_end, self._map = front_end, sparse_map
        self._masks: list[tuple[KeyframeRecord, Region]] = []

    def add(self, stamp_ns: int, mask: Region) -> None:
        """Take in a mask (H, W) of the left image of a keyframe, 255 where something moves, for
        the next frame. Stamps that belong to no keyframe are ignored.
        """
        recent = self._map.keyframes[-LOCAL_KEYFRAMES:]  # others hardly change any more
        keyframe = next((k for k in recent if k.stamp_ns == stamp_ns), None)
        if keyframe is not None and not self._front_end.is_fixed:
            self._masks.append((keyframe, dilate(mask)))

    def take_points_back(self) -> None:
        """Remove the points; while nothing is being adjusted."""
        for keyframe, mask in self._masks:
            if keyframe.index >= len(self._map.keyframes):
                continue
            if self._map.keyframes[keyframe.index] is not keyframe:
                continue  # of a submap that was given up or merged
            ids = keyframe.point_id[is_inside(mask, keyframe.observations.uvd_px[:, :2])]
            ids = ids[ids != NO_POINT]
            self._map.remove_points(ids[self._map.points['born'][ids] >= keyframe.index])
        if self._masks:
            self._masks.clear()
            self._front_end.drop_dead()
