"""The session of a drive: which map the camera is in, and when its results are returned.

A drive without a plug-in has one map, its own. One that is loaded, or mapped beside another, is
that of `core.plugins.maps`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from segfloor_ros.core.contracts import (
    BodySensors,
    FrameResult,
    LastPose,
    MovingObjects,
    StereoFrame,
)
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.held_results import HeldResults
from segfloor_ros.core.slam.mapping.back_end import BackEnd
from segfloor_ros.core.slam.mount_search import MountSearch
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.track import Track

BEFORE_RECOGNITION = ', mapped before the map was recognised'
OUTSIDE_LOADED = ', outside the loaded map'


class SessionState(Enum):
    """Which map the camera is in; without a plug-in it is always MAPPING.

    MAPPING: the map of the drive, or a loaded one in which the camera was found. RESUMED: the map
    of a drive that was interrupted, and no measurement since. LOADED: a loaded map in which the
    camera is not found yet. BESIDE: a submap, while every frame is searched for in the loaded map.
    OUTSIDE: a submap, after the camera was not found in the loaded map. LOST: a submap, after the
    camera got lost in the map.
    """

    MAPPING = auto()
    RESUMED = auto()
    LOADED = auto()
    BESIDE = auto()
    OUTSIDE = auto()
    LOST = auto()

    @property
    def is_submap(self) -> bool:
        """Whether the camera maps a submap, and the known map is kept."""
        return self in (SessionState.BESIDE, SessionState.OUTSIDE, SessionState.LOST)

    @property
    def holds_results(self) -> bool:
        """Whether results are held back."""
        return self in (SessionState.BESIDE, SessionState.LOST)

    @property
    def words(self) -> str:
        """What the state of a tracked frame says about the map."""
        words = BEFORE_RECOGNITION if self.holds_results else OUTSIDE_LOADED
        return words if self.is_submap else ''


@dataclass(frozen=True)
class Parts:
    """What a session works with. held: results that are not returned yet."""

    sparse_map: SparseMap
    front_end: FrontEnd
    back_end: BackEnd
    sensors: BodySensors
    moving: MovingObjects
    mount_search: MountSearch
    held: HeldResults


class OneMap:
    """The session of a drive that has no map but its own."""

    def __init__(self, parts: Parts) -> None:
        self.state = SessionState.MAPPING
        self._held, self._mount_search = parts.held, parts.mount_search
        self._front_end = parts.front_end

    @property
    def is_public(self) -> bool:
        """Whether a result can be published before the map has changed."""
        return self._held.is_empty and not self.state.is_submap

    @property
    def provisional(self) -> FrameResult | None:
        """The newest pose while the mount is being measured, by the current estimate of it. None
        before the first frame, and once results are returned.
        """
        mount = self._mount_search.provisional
        return None if mount is None else self._held.newest(mount)

    @property
    def covariance(self) -> Array:
        """The covariance (6, 6) of the latest pose."""
        return self._front_end.motion.covariance

    def take(self, result: FrameResult) -> list[FrameResult]:
        """Take in the result of a frame, and return all results that are ready, oldest first."""
        return self._held.take(result)

    def find_in_loaded(
        self, frame: StereoFrame, images: Images, fault: str
    ) -> tuple[Track | None, dict[int, Track]]:
        """Return a frame if it is found in a loaded map beside the drive's own, and the earlier
        frames that prove it, by stamp.
        """
        return None, {}

    def found(self, proof: dict[int, Track]) -> None:
        """Note that a frame was tracked. proof: earlier frames that saw the same place, by stamp;
        they are returned once more.
        """
        self._held.recognise(proof, self._front_end.motion.T_world_odom)

    def search(self, frame: StereoFrame, images: Images, fault: str) -> None:
        """Note that a frame was not tracked."""

    def search_near(self, T_world_camera: Array, reach: tuple[float, float]) -> None:
        """Search for the camera around a pose (4, 4) in the known map. reach: in m and rad."""
        self._front_end.search_near(T_world_camera, reach)

    def join(self, keyframe: KeyframeRecord, images: Images) -> bool:
        """Return whether a new keyframe shows where the drive's own map lies in a known one; both
        are one map then.
        """
        return False

    def finish(self, may_replace: bool) -> list[FrameResult]:
        """Return the results that are held back after the last frame. may_replace: whether a submap
        that is larger than the known map replaces it.
        """
        return self._held.release()

    def load(self, arrays: Arrays, last: LastPose | None) -> None:
        """Continue with a saved map. last: where its drive was interrupted, which is resumed."""
        raise ValueError('SLAM that keeps no maps cannot go on with one')

    def to_arrays(self) -> Arrays:
        """Return the map for a file."""
        return {}
