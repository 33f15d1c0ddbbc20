"""Settings of the labelling stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting


@dataclass(frozen=True)
class CloudLabellingSettings(StageSettings):
    """Evidence for floor and obstacle."""

    robot_height_m: float = setting(
        1.0,
        'Points higher than this above the floor do not concern the robot.',
        unit='m',
        minimum=0.05,
        maximum=10.0,
        live=True,
    )
