"""Parameters of the node `cloud_labelling`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.cloud import CloudLabellingSettings
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class CloudLabellingNodeSettings(CloudLabellingSettings, NodeSettings):
    """Nothing beyond what every node has."""
