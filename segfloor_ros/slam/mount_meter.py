"""What SLAM asks of whoever measures the camera's mount."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount
from segfloor_ros.geometry import Array
from segfloor_ros.measurements import Up


class MountMeter(Protocol):
    """Measures the camera's mount from the floor it sees."""

    def add(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        T_world_left: Array,
        up_world: Up | None,
    ) -> None:
        """Take in one keyframe: rectified images (H, W), camera pose (4, 4) in the first one's
        frame, and where an accelerometer has up in that frame.
        """

    def start_over(self) -> None:
        """Forget all keyframes: where the next ones are relative to them is not known."""

    @property
    def mount(self) -> Mount | None:
        """The mount at the first frame, once it is known."""

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, whatever little is known."""
