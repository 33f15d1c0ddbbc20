"""Measures the mount of the camera while it drives, and says when it is known."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import BodySensors, Mount, StereoFrame, Up
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.slam.held_results import HeldResults
from segfloor_ros.core.slam.rig import Rig

LOOK_NS = 500_000_000
"""While the mount is not known, the floor is measured this often between keyframes."""


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


class MountSearch:
    """Sets the mount of the rig by what a meter measures. meter: None where the mount is given."""

    def __init__(
        self, rig: Rig, meter: MountMeter | None, sensors: BodySensors, held: HeldResults
    ) -> None:
        self._rig, self._meter, self._sensors, self._held = rig, meter, sensors, held
        self._looked_ns = 0

    @property
    def provisional(self) -> Mount | None:
        """The estimate of a mount that is not known yet."""
        if self._meter is None or self._rig.base_mount is not None:
            return None
        return self._meter.provisional

    def use(self, mount: Mount) -> None:
        """Use a given mount."""
        self._rig.mount = mount
        if self._meter is not None:
            self._meter.use(mount)

    def reset(self) -> None:
        """Forget earlier frames: their poses relative to the next are not known."""
        if self._meter is not None:
            self._meter.reset()

    def end(self) -> None:
        """Keep the mount as it is."""
        self._meter, self._rig.mount_may_change = None, False
        self._held.keep(False)

    def look(self, frame: StereoFrame, T_camera_world: Array, is_keyframe: bool) -> None:
        """Measure the floor at a keyframe, and now and then at other frames: a camera that stands
        may see it better than in its first image, or know by now where up is. If the floor shows
        another mount than the one in use, all results are returned once more.
        """
        meter, rig = self._meter, self._rig
        if meter is None or meter.is_final:
            return
        is_late = frame.stamp_ns - self._looked_ns >= LOOK_NS
        if not is_keyframe and (rig.mount is not None or not is_late):
            return
        self._looked_ns = frame.stamp_ns
        up = self._sensors.up_world
        meter.add(frame.left, frame.right, invert(T_camera_world), up, is_keyframe)
        is_new = rig.mount is not None and meter.mount != rig.mount
        rig.mount, rig.mount_may_change = meter.mount, meter.may_change
        if rig.base is not None:
            return
        if is_new:
            self._held.take_back()
        if meter.remark is not None:
            self._sensors.remark({'mount': meter.remark})
        self._held.keep(meter.may_change)
