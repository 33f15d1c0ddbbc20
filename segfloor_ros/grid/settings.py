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
        within=(0.01, 0.2),
    )
    max_range_m: float = setting(
        0.0,
        'Longest ray that marks free cells; 0 is as far as the camera can tell where floor ends.',
        within=(0.0, 50.0),
        live=True,
    )
    occupied_share: float = setting(
        0.2,
        'A cell into which an obstacle reaches by more than this share of its side is occupied.',
        within=(0.0, 0.5),
    )
    use_points: bool = setting(
        True, 'Obstacle points mark cells, and rays to floor points mark free cells.'
    )
    use_scan: bool = setting(True, 'The floor scan marks free cells and what it ended at.')
    footprint_radius_m: float = setting(
        0.15,
        'The base has driven over the floor this far around it; 0 leaves it to what was seen.',
        within=(0.0, 2.0),
    )
    opening_cells: int = setting(
        0,
        'Post-process: free areas narrower than this become unknown (opening); 0 is off.',
        within=(0, 21),
        live=True,
    )
    probabilistic: bool = setting(
        False, 'Publish 0 to 100 by probability in place of free, occupied and unknown.', live=True
    )
