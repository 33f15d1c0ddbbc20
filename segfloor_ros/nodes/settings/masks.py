"""Parameters of the node `segfloor_masks`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.settings import RobotSettings, setting
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class SegfloorMasksNodeSettings(RobotSettings, NodeSettings):
    """Which network looks at the images, and what concerns the robot."""

    network: str = setting(
        '', 'Segmentation network, FILE.onnx; FILE.yaml next to it describes it.'
    )
