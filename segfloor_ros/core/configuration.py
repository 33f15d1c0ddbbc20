"""The settings of all stages together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.cloud import CloudLabellingSettings
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings
from segfloor_ros.core.settings import StageSettings
from segfloor_ros.core.slam.settings import StereoSlamSettings


@dataclasses.dataclass(frozen=True)
class Configuration:
    """The settings of the five stages, each under its node's name."""

    stereo_camera: StereoCameraSettings
    stereo_slam: StereoSlamSettings
    floor_segmentation: FloorSegmentationSettings
    cloud_labelling: CloudLabellingSettings
    occupancy_grid: OccupancyGridSettings

    def stages(self) -> dict[str, StageSettings]:
        """Return the settings by stage name, in the order of the data flow."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def as_ros_parameters(self, **nodes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the nested mapping of a ROS 2 parameter file with every value as resolved, and
        further ones, or others, of nodes by name.
        """
        values = {name: dataclasses.asdict(stage) for name, stage in self.stages().items()}
        merge(values, nodes)
        return {name: {'ros__parameters': parameters} for name, parameters in values.items()}


def merge(values: dict[str, dict[str, Any]], changes: Mapping[str, Mapping[str, Any]]) -> None:
    """Put values by stage and name over others."""
    for stage, parameters in changes.items():
        values.setdefault(stage, {}).update(parameters)
