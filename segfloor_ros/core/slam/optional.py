"""What SLAM can do without: what it asks of it in its own types, and the null objects.

Moving objects, wheels and IMU and the check of the rig have their protocols in `contracts`. The
mount can be measured from the floor, and maps can be kept; without that a given mount is used, and
a camera that gets lost is looked for in the only map there is.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import (
    BodySensors,
    InputFault,
    Measurement,
    Mount,
    MovingObjects,
    Placed,
    RelativeMotion,
    RigCheck,
    Searched,
    StereoFrame,
    Up,
    WheelPose,
)
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.places.place_recognition import PlaceRecognition
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.map_tracking import Pixels
from segfloor_ros.core.slam.tracking.track import Track

logger = logging.getLogger(__name__)


class KnownMap(Protocol):
    """A known map beside the drive's own. of_drive: whether this drive made it, and got lost."""

    of_drive: bool

    @property
    def num_keyframes(self) -> int:
        """How large the known map is."""

    def recognise(self, keyframe: KeyframeRecord, images: Pixels) -> bool:
        """Whether enough keyframes in a row see the known map, this one the last of them."""

    def find(
        self, images: Pixels, features: Features, stamp_ns: int
    ) -> tuple[Track | None, dict[int, Track]]:
        """Return a frame with its pose in the known map, once several in a row were found there,
        and those, by stamp.
        """

    def merge(self, own_words: Arrays) -> Arrays:
        """Merge the drive's own map into the known one. Returns the words of all keyframes."""

    def to_arrays(self) -> Arrays:
        """Return the known map and the words of its keyframes."""

    def restore(self, known: Arrays) -> None:
        """Put the known map in the place of the drive's own."""


class MapKeeper(Protocol):
    """Keeps maps as arrays. can_hold: whether a known map can wait beside a submap."""

    can_hold: bool

    def to_arrays(self, sparse_map: SparseMap) -> Arrays:
        """Return a map as arrays."""

    def fill(self, sparse_map: SparseMap, arrays: Arrays) -> None:
        """Add a map to an empty one. Raises KeyError or ValueError for arrays that are no map."""

    def hold(self, own: SparseMap, places: PlaceRecognition, of_drive: bool) -> KnownMap:
        """Return the present map as a known one, beside which `own` may begin anew."""


class NothingKept:
    """No map is kept: there is none but the drive's own."""

    can_hold = False

    def to_arrays(self, sparse_map: SparseMap) -> Arrays:
        """Return nothing."""
        return {}

    def fill(self, sparse_map: SparseMap, arrays: Arrays) -> None:
        """Refuse every map."""
        raise ValueError('SLAM that keeps no maps cannot go on with one')

    def hold(self, own: SparseMap, places: PlaceRecognition, of_drive: bool) -> KnownMap:
        """Refuse to begin anew beside a map."""
        raise ValueError('SLAM that keeps no maps cannot hold one')


class NothingMoves:
    """All that is seen stands still."""

    def is_due(self, stamp_ns: int, is_keyframe: bool, is_tracked: bool) -> bool:
        """Return False."""
        return False

    def search(
        self, frame: StereoFrame, T_camera_world: Array, T_odom_camera: Array, mount: Mount | None
    ) -> Searched:
        """Refuse: no frame is due."""
        raise ValueError('nothing is searched for what moves')

    def remember(self, keyframe: Placed, disparity: NDArray[np.float32]) -> None:
        """Ignore it."""

    def seen_through(self, disparity: NDArray[np.float32], points: Array) -> NDArray[np.bool_]:
        """Return that every point is still there."""
        return np.zeros(len(points), bool)

    def reset(self) -> None:
        """Have nothing to forget."""


class NoSensors:
    """Neither wheels nor an IMU; what others remark is kept."""

    lag_ns = 0
    up_world: Up | None = None

    def __init__(self) -> None:
        self.T_base_left: Array | None = None
        self.messages: dict[str, int] = {}
        self.remarks: dict[str, str] = {}
        self.latest_wheels: list[WheelPose] = []

    def up_camera(self, T_odom_camera: Array) -> Up | None:
        """Return None."""
        return None

    def add(self, measurement: Measurement) -> None:
        """Ignore it."""

    def remark(self, remarks: Mapping[str, str]) -> None:
        """Say each thing that seems wrong once."""
        for what, remark in remarks.items():
            if what not in self.remarks:
                logger.warning('%s', remark)
            self.remarks[what] = remark

    def turn(self, before_ns: int, now_ns: int) -> tuple[Array, float] | None:
        """Return None."""
        return None

    def between(self, before_ns: int, now_ns: int) -> RelativeMotion | None:
        """Return None."""
        return None

    def by_inertia(
        self, before_ns: int, now_ns: int, T_odom_before: Array, R_world_odom: Array
    ) -> RelativeMotion | None:
        """Return None."""
        return None

    def learn(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Learn nothing."""

    def carry(
        self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array, on_wheels: bool
    ) -> None:
        """Note nothing."""

    def reset(self) -> None:
        """Have nothing to forget."""

    def reset_world(self) -> None:
        """Have nothing to forget."""


class TrustedRig:
    """A rig whose images are as its calibration says."""

    def __init__(self) -> None:
        self.faults: dict[str, InputFault] = {}

    def watch(self, frame: StereoFrame, turn_rad: float) -> None:
        """Look at nothing."""

    def corrected(self, frame: StereoFrame) -> StereoFrame:
        """Return the frame as it is."""
        return frame

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return nothing."""
        return []


@dataclass
class Plugins:
    """What is plugged into SLAM; by default nothing is."""

    moving: MovingObjects = field(default_factory=NothingMoves)
    sensors: BodySensors = field(default_factory=NoSensors)
    rig_check: RigCheck = field(default_factory=TrustedRig)
    keeper: MapKeeper = field(default_factory=NothingKept)


class MountMeter(Protocol):
    """Measures the camera's mount from the floor it sees."""

    def add(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        T_world_left: Array,
        up_world: Up | None,
        is_new_view: bool,
    ) -> None:
        """Take in one frame: rectified images (H, W), camera pose (4, 4) in the first one's frame,
        and where an accelerometer has up in that frame. is_new_view: whether it is a keyframe;
        others show what the last one does, and take its place.
        """

    def reset(self) -> None:
        """Forget all frames: where the next ones are relative to them is not known."""

    @property
    def mount(self) -> Mount | None:
        """The mount at the first frame, once it is known; later looks may show another."""

    @property
    def is_final(self) -> bool:
        """Whether the mount is known, and looked at often enough."""

    @property
    def may_change(self) -> bool:
        """Whether later looks may show another mount."""

    def use(self, mount: Mount) -> None:
        """Take a mount for given: it is compared with what is seen, and stays as it is."""

    @property
    def remark(self) -> str | None:
        """How the mount that was in use differs from the one that the floor shows, in words."""

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, whatever little is known."""
