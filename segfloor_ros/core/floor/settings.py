"""The settings of floor segmentation."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.settings import RobotSettings, setting


@dataclass(frozen=True)
class FloorSegmentationSettings(RobotSettings):
    """Disparity, floor profile, mask and scan."""

    num_disparities: int = setting(
        0,
        'Disparities searched, a multiple of 16; 0 derives it from camera and mount.',
        unit='px',
        within=(0, 512),
    )
    disparity_above_horizon: bool = setting(
        False, 'Match the rows above the horizon too; the floor does not need them.'
    )
    scan_range_m: float = setting(
        0.0,
        'Longest range of the floor scan; 0 derives it from focal length and baseline.',
        within=(0.0, 60.0),
    )
