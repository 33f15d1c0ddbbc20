"""Parameters of the node `floor_segmentation`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class FloorSegmentationNodeSettings(FloorSegmentationSettings, NodeSettings):
    """Nothing beyond what every node has."""
