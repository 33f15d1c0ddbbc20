"""What SLAM can do without: the null objects.

Moving objects, wheels and IMU and the check of the rig have their protocols in `contracts`. Maps
are loaded, saved and mapped beside one another by a session that does more than `OneMap`, which
searches for a lost camera in the map of the drive alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.contracts import (
    BodySensors,
    InputFault,
    Mount,
    MovingObjects,
    Placed,
    RigCheck,
    Searched,
    StereoFrame,
    WheelPose,
)
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.session import OneMap, Parts
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd

logger = logging.getLogger(__name__)


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


class NoLateMasks:
    """No masks come once a keyframe is made."""

    def __init__(self, front_end: FrontEnd, sparse_map: SparseMap) -> None:
        """Need none of it."""

    def add(self, stamp_ns: int, mask: Region) -> None:
        """Ignore a mask (H, W) of a keyframe."""

    def take_points_back(self) -> None:
        """Have none to remove."""


class NoSensors(BodySensors):
    """Neither wheels nor an IMU: what the protocol does by itself, nothing. What others remark is
    kept.
    """

    lag_ns = 0
    latest_wheels: Sequence[WheelPose] = ()

    def __init__(self) -> None:
        self.T_base_left = None
        self.messages: dict[str, int] = {}
        self.remarks: dict[str, str] = {}

    def remark(self, remarks: Mapping[str, str]) -> None:
        """Say each thing that seems wrong once."""
        for what, remark in remarks.items():
            if what not in self.remarks:
                logger.warning('%s', remark)
            self.remarks[what] = remark


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


class SoundImages:
    """All images can be tracked. is_repeated: whether the last one is the one before. is_carried:
    whether it should have moved since, so that it shows nothing of this moment.
    """

    is_repeated = is_carried = False

    def fault(self, frame: StereoFrame, expected_shift: Callable[[], float]) -> str:
        """Return why a frame cannot be tracked, ''. expected_shift: of the picture since the frame
        before, in image widths.
        """
        return ''


@dataclass
class Plugins:
    """What is plugged into SLAM; by default nothing is."""

    moving: MovingObjects = field(default_factory=NothingMoves)
    sensors: BodySensors = field(default_factory=NoSensors)
    rig_check: RigCheck = field(default_factory=TrustedRig)
    image_check: SoundImages = field(default_factory=SoundImages)
    session: Callable[[Parts], OneMap] = OneMap
    late_masks: Callable[[FrontEnd, SparseMap], NoLateMasks] = NoLateMasks
