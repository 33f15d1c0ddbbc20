"""Parameters of every node."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.settings import StageSettings, setting

# Parameters of every ROS node: allowed in a parameter file, no concern of the stages.
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


@dataclass(frozen=True)
class NodeSettings(StageSettings):
    """What every node has."""

    autostart: bool = setting(
        True, 'Configure and activate at the start; off: wait for a lifecycle manager.'
    )

    @classmethod
    def stage_name(cls) -> str:
        """Return the node's name: `StereoSlamNodeSettings` → `stereo_slam`."""
        return super().stage_name().removesuffix('_node')
