"""Parameters of the node `occupancy_grid`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.grid.occupancy import OccupancyGridSettings
from segfloor_ros.core.settings import setting
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class OccupancyGridNodeSettings(OccupancyGridSettings, NodeSettings):
    """When the map is published and where it is saved."""

    publish_period_s: float = setting(
        1.0,
        'The map is published at most this often; a change is never held back for longer.',
        within=(0.0, 60.0),
        live=True,
    )
    map_file: str = setting(
        'map.yaml',
        'File that the service save_map writes, with the image next to it; .yaml is appended if '
        'missing.',
        live=True,
    )
