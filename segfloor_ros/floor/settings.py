"""Settings of the floor segmentation stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting


@dataclass(frozen=True)
class FloorSegmentationSettings(StageSettings):
    """Disparity, floor profile and mask."""

    step_height_m: float = setting(
        0.03,
        'What stands higher than this above the floor is not floor.',
        unit='m',
        minimum=0.005,
        maximum=0.5,
        live=True,
    )
