"""Scenes of furnished flats with untextured partitions: four rooms beside a hallway.

    python tools/flats.py FOLDER --seeds 6     writes flat_1.yaml …, for `segfloor simulate`

Where the rooms end, how the doors lie, what stands in the rooms, the grey of the partitions and
the light follow from the seed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml

GREYS = ('plain_dark', 'plain', 'plain_light')
FLOORS = ('tiles', 'wood', 'carpet', 'concrete', 'granite')
HALF_LENGTH_M, HALF_WIDTH_M, HALF_HALL_M = 3.6, 3.1, 0.65
DOOR_M = 0.95

Scene = dict[str, Any]


def make_flat(seed: int) -> Scene:
    """Return the values of a scene file."""
    rng = np.random.default_rng(seed)
    grey = GREYS[seed % 3]
    walls, waypoints = [_outer()], [[-HALF_LENGTH_M + 0.6, 0.0]]
    boxes: list[Scene] = []
    for side in (1, -1):
        split = float(np.round(rng.uniform(-0.5, 0.5), 2))
        walls.append(_wall([[split, side * HALF_HALL_M], [split, side * HALF_WIDTH_M]], grey))
        walls += _hall_wall(side, split, rng, grey, waypoints)
        boxes += _furniture(side, split, rng)
    return {
        'description': f'A flat with partitions of {grey}, seed {seed}.',
        'seed': seed,
        'floor': {'texture': FLOORS[int(rng.integers(len(FLOORS)))]},
        'lighting': {'ambient': 0.5 if seed % 2 else 0.75},
        'walls': walls,
        'boxes': boxes,
        'camera': {'rate_hz': 5.0},
        'path': {'waypoints': waypoints, 'speed_m_s': 0.45},
    }


def _outer() -> Scene:
    x, y = HALF_LENGTH_M, HALF_WIDTH_M
    corners = [[-x, -y], [x, -y], [x, y], [-x, y]]
    return {'points': corners, 'closed': True, 'texture': 'rough_plaster', 'posters': 14}


def _wall(points: list[list[float]], texture: str) -> Scene:
    return {'points': points, 'texture': texture}


def _hall_wall(
    side: int, split: float, rng: np.random.Generator, grey: str, way: list[list[float]]
) -> list[Scene]:
    """Return the pieces of wall between the hall and the two rooms of a side, and add the way
    through both doors to the waypoints.
    """
    y = side * HALF_HALL_M
    ends = ((-HALF_LENGTH_M, split), (split, HALF_LENGTH_M))
    pieces = []
    for first, last in ends if side > 0 else ends[::-1]:
        door = float(np.round(rng.uniform(first + 0.9, last - 0.9), 2))
        left, right = door - DOOR_M / 2, door + DOOR_M / 2
        texture = grey if rng.random() < 0.6 else 'rough_plaster'
        pieces += [_wall([[first, y], [left, y]], texture), _wall([[right, y], [last, y]], texture)]
        turn = door + 0.8 * np.sign((first + last) / 2 - door)
        inside = [[door, y + side * 0.6], [float(turn), y + side * 1.3], [door, y + side * 0.7]]
        way += [[door, 0.0], *inside, [door, 0.0]]
    return pieces


def _furniture(side: int, split: float, rng: np.random.Generator) -> list[Scene]:
    """Return what stands along the outer walls of the rooms of a side."""
    things = []
    for first, last in ((-HALF_LENGTH_M, split), (split, HALF_LENGTH_M)):
        length, height = rng.uniform(0.6, 1.4), rng.uniform(0.35, 1.8)
        x = rng.uniform(first + length, last - length)
        texture = ('books', 'goods', 'wood', 'granite')[int(rng.integers(4))]
        at = [round(float(x), 2), side * (HALF_WIDTH_M - 0.3)]
        size = [round(float(length), 2), 0.4, round(float(height), 2)]
        things.append({'at': at, 'size': size, 'texture': texture})
    return things


def main(folder: Path, seeds: Annotated[int, typer.Option(help='How many flats.')] = 6) -> None:
    """Write the scene files."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(1, seeds + 1):
        text = yaml.safe_dump(make_flat(seed), sort_keys=False)
        (folder / f'flat_{seed}.yaml').write_text(text)


if __name__ == '__main__':
    typer.run(main)
