"""Settings of the occupancy grid stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting


@dataclass(frozen=True)
class OccupancyGridSettings(StageSettings):
    """Cells, ranges and evidence of the map."""

    resolution_m: float = setting(
        0.05,
        'Side of a cell.',
        unit='m',
        minimum=0.01,
        maximum=0.2,
    )
    max_range_m: float = setting(
        5.0,
        'Longest ray that marks free cells.',
        unit='m',
        minimum=0.5,
        maximum=50.0,
        live=True,
    )
