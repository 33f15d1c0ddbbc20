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
        0.0,
        'Longest ray that marks free cells; 0 is as far as the camera can tell where floor ends.',
        unit='m',
        minimum=0.0,
        maximum=50.0,
        live=True,
    )
    max_hit_error_m: float = setting(
        0.05,
        'Obstacles whose distance is less certain than this mark no cell.',
        unit='m',
        minimum=0.005,
        maximum=1.0,
        live=True,
    )
    occupied_share: float = setting(
        0.2,
        'A cell into which an obstacle reaches by more than this share of its side is occupied.',
        minimum=0.0,
        maximum=0.5,
    )
    min_thickness_m: float = setting(
        0.03,
        'What stands on the floor is at least this deep behind the face that is seen.',
        unit='m',
        minimum=0.0,
        maximum=0.5,
        live=True,
    )
    use_points: bool = setting(
        True, 'Obstacle points mark cells, and rays to floor points mark free cells.'
    )
    use_scan: bool = setting(True, 'The floor scan marks free cells and what it ended at.')
    hit_log_odds: float = setting(
        0.7,
        'Evidence of one keyframe that sees an obstacle in a cell.',
        minimum=0.05,
        maximum=3.0,
        live=True,
    )
    free_log_odds: float = setting(
        0.4,
        'Evidence of one keyframe that sees floor in a cell.',
        minimum=0.05,
        maximum=3.0,
        live=True,
    )
    max_log_odds: float = setting(
        3.5,
        'Limit of the evidence for occupied: how much it takes to clear what has left.',
        minimum=0.5,
        maximum=6.0,
        live=True,
    )
    min_log_odds: float = setting(
        -2.0,
        'Limit of the evidence for free: how much it takes to mark what has come.',
        minimum=-6.0,
        maximum=-0.5,
        live=True,
    )
    occupied_log_odds: float = setting(
        1.2,
        'Cells with more evidence than this are occupied, and rays end there.',
        minimum=0.0,
        maximum=3.0,
        live=True,
    )
    free_log_odds_needed: float = setting(
        0.4,
        'Cells with as much evidence as this for floor are free.',
        minimum=0.05,
        maximum=3.0,
        live=True,
    )
    footprint_radius_m: float = setting(
        0.15,
        'The base has driven over the floor this far around it; 0 leaves it to what was seen.',
        unit='m',
        minimum=0.0,
        maximum=2.0,
    )
    connected_only: bool = setting(
        True, 'Free cells that no line of free cells joins to the path of the base are unknown.'
    )
    move_fraction: float = setting(
        0.25,
        'The map follows keyframes that moved by more than this share of a cell.',
        minimum=0.05,
        maximum=2.0,
    )
    opening_cells: int = setting(
        0,
        'Post-process: free areas narrower than this become unknown (opening); 0 is off.',
        minimum=0,
        maximum=21,
        live=True,
    )
    probabilistic: bool = setting(
        False, 'Publish 0 to 100 by probability in place of free, occupied and unknown.', live=True
    )
