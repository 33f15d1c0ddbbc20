"""The settings of floor segmentation."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.settings import RobotSettings, setting


@dataclass(frozen=True)
class FloorSegmentationSettings(RobotSettings):
    """How far the floor scan goes."""

    scan_range_m: float = setting(
        0.0,
        'Longest range of the floor scan; 0 derives it from focal length and baseline.',
        within=(0.0, 60.0),
    )
