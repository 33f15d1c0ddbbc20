"""People who walk through a scene."""

from __future__ import annotations

import numpy as np

from segfloor_ros.geometry import Array
from segfloor_ros.simulation.scene import Person
from segfloor_ros.simulation.solids import Prism, block, cylinder

STRIDE_M = 0.28
STEPS_PER_M = 1.3
PARTS = ('body', 'left_leg', 'right_leg')


def part_solids(person: Person, part: str) -> list[Prism]:
    """Return the solids of a part of a person who stands at the origin and faces along x."""
    scale = person.height_m / 1.75
    if part == 'body':
        return [
            block(
                (0.0, 0.0), (0.24 * scale, 0.44 * scale, 0.64 * scale), 'cloth', 0.0, 0.82 * scale
            ),
            cylinder((0.0, 0.0), 0.1 * scale, 0.25 * scale, 'rough_plaster', 1.5 * scale),
        ]
    side = 0.11 * scale * (1 if part == 'left_leg' else -1)
    return [
        cylinder((0.0, side), 0.075 * scale, 0.85 * scale, 'cloth', 0.02),
        block((0.06, side), (0.27 * scale, 0.1 * scale, 0.08), 'granite'),
    ]


def part_poses(person: Person, time_s: float) -> Array:
    """Return x, y, yaw (3, 3) of each of `PARTS` at a time. Legs swing while the person walks."""
    points = np.array(person.points)
    lengths = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    walked = max(0.0, time_s - person.start_s) * person.speed_m_s
    round_trip = walked % (2 * along[-1])
    back = round_trip > along[-1]
    place = 2 * along[-1] - round_trip if back else round_trip
    stretch = int(np.clip(np.searchsorted(along, place, side='right') - 1, 0, len(lengths) - 1))
    direction = (points[stretch + 1] - points[stretch]) / lengths[stretch]
    xy = points[stretch] + direction * (place - along[stretch])
    heading = -direction if back else direction
    swing = STRIDE_M * np.sin(2 * np.pi * STEPS_PER_M * walked) if walked else 0.0
    yaw = np.arctan2(heading[1], heading[0])
    return np.array([[*(xy + heading * offset), yaw] for offset in (0.0, swing, -swing)])
