"""The stereo rig: its camera, its mount, and the error that all its disparities share, estimated
while it moves.

Cheap stereo cameras bend and warm up: a tenth of a milliradian between the two eyes shifts every
disparity by the same fraction of a pixel and stretches far distances. A moving rig shows it: the
parallax between keyframes measures the same points without it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera

EXPECTED_SIGMA_PX = 0.1
"""A tenth of a milliradian at a focal length of a thousand pixels, px; 0: disparities are true."""

LOCAL_KEYFRAMES = 10
"""Keyframes that move in a local adjustment, and adjustments that a keyframe takes part in: what is
solved well within the time between two keyframes."""

NEIGHBOURS = 2 * LOCAL_KEYFRAMES
"""Keyframes around a view: those that move in a local adjustment, and those that hold them."""

WINDOW_SIGMA_PX = 0.03
"""Error of the estimate from one local adjustment that more points do not average out, px."""

MEMORY_SIGMA_PX = 0.01
"""The estimate never counts as better known than this, so that it can follow the rig, px."""

MAX_OFFSET_PX = 0.5
"""More is not an imperfect rectification but a wrong calibration, px."""


@dataclass(frozen=True)
class OffsetEstimate:
    """Value of the offset, measured minus true disparity, and its information in 1/px²."""

    value_px: float
    information: float


NO_OFFSET = OffsetEstimate(0.0, 1e12)
"""Disparities are certainly true."""


class DisparityOffset:
    """Fuses what the local adjustments find of the offset with the expectation that it is 0.

    An information filter on one scalar (Barfoot, State Estimation for Robotics, 2017, section
    3.3). expected_sigma_px: of the offset before anything is seen, 0 when there is none. share: the
    part of an adjustment that is new to the filter; a keyframe takes part in several.
    """

    def __init__(self, expected_sigma_px: float, share: float) -> None:
        self._share = share
        self._estimating = expected_sigma_px > 0
        self.estimate = NO_OFFSET
        if self._estimating:
            self.estimate = OffsetEstimate(0.0, expected_sigma_px**-2)

    @property
    def value_px(self) -> float:
        """The present estimate."""
        return self.estimate.value_px

    def learn(self, adjusted: OffsetEstimate) -> None:
        """Take in the outcome of an adjustment that began with the present estimate."""
        known = self.estimate
        gained = adjusted.information - known.information
        if not self._estimating or gained <= 0:
            return
        total = adjusted.information * adjusted.value_px - known.information * known.value_px
        seen_px = float(np.clip(total / gained, -MAX_OFFSET_PX, MAX_OFFSET_PX))
        weight = self._share / (1.0 / gained + WINDOW_SIGMA_PX**2)
        information = known.information + weight
        value_px = (known.information * known.value_px + weight * seen_px) / information
        self.estimate = OffsetEstimate(value_px, min(information, MEMORY_SIGMA_PX**-2))


@dataclass
class Rig:
    """What all of SLAM knows of the stereo rig. mount: None until it is measured or given."""

    camera: StereoCamera
    mount: Mount | None = None
    offset: DisparityOffset = field(
        default_factory=lambda: DisparityOffset(EXPECTED_SIGMA_PX, 1.0 / LOCAL_KEYFRAMES)
    )
