"""The robot: what it drives over and under. Declared once for all stages that judge heights."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting


@dataclass(frozen=True)
class RobotSettings(StageSettings):
    """Base of the settings of the stages that must know the robot, the same one in all of them."""

    robot_height_m: float = setting(
        1.0,
        'The robot passes under what hangs higher than this above the floor.',
        within=(0.05, 10.0),
        live=True,
    )
    step_height_m: float = setting(
        0.03,
        'The robot drives over what is lower than this; what stands higher is an obstacle.',
        within=(0.005, 0.5),
        live=True,
    )
    drop_height_m: float = setting(
        0.04,
        'What lies deeper than this below the floor is not floor.',
        within=(0.005, 0.5),
        live=True,
    )

    @property
    def robot(self) -> dict[str, float]:
        """The robot alone: height, step and drop in metres by name."""
        return {spec.name: getattr(self, spec.name) for spec in RobotSettings.specs()}
