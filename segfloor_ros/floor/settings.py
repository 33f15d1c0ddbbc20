"""Settings of the floor segmentation stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import RobotSettings, setting


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
    obstacle_height_m: float = setting(
        0.2,
        'An upright surface of this height is taken out before the profile is fitted.',
        within=(0.02, 2.0),
        live=True,
    )
    fill_gap_m: float = setting(
        0.5,
        'Gaps of this size between floor pixels are filled where nothing speaks against it.',
        within=(0.0, 3.0),
        live=True,
    )
    fill_support: float = setting(
        0.3,
        'Part of the columns of a weakly textured region that must show floor to fill it.',
        within=(0.0, 1.0),
        live=True,
    )
    scan_range_m: float = setting(
        0.0,
        'Longest range of the floor scan; 0 derives it from focal length and baseline.',
        within=(0.0, 60.0),
    )
    scan_gap_m: float = setting(
        0.15,
        'A gap in the floor longer than this ends the scan.',
        within=(0.02, 2.0),
        live=True,
    )
