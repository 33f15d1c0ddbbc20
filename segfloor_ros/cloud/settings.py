"""Settings of the labelling stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import RobotSettings, setting


@dataclass(frozen=True)
class CloudLabellingSettings(RobotSettings):
    """Evidence for floor and obstacle."""

    height_sigma_m: float = setting(
        0.02,
        'Error of a point height close to the robot, one sigma.',
        within=(0.001, 0.5),
        live=True,
    )
    max_mask_log_odds: float = setting(
        3.0,
        'Limit of the summed evidence of the mask, so that it can change its mind.',
        within=(0.1, 20.0),
        live=True,
    )
    max_height_log_odds: float = setting(
        2.0,
        'Limit of the evidence of the height.',
        within=(0.0, 20.0),
        live=True,
    )
