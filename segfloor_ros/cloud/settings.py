"""Settings of the labelling stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import RobotSettings


@dataclass(frozen=True)
class CloudLabellingSettings(RobotSettings):
    """The robot that floor and obstacles are judged for."""
