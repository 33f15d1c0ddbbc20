"""Scenes of furnished rooms, each another plan: to measure maps on drives nobody has seen.

    python -m tools.rooms FOLDER --seeds 12     writes room_1.yaml …, for `segfloor simulate`

Outline, niches, things, textures, light and camera follow from the seed; the way is planned.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml

from segfloor_ros.apps.simulation.scene_file import scene_from_mapping
from segfloor_ros.apps.simulation.solids import floors, obstacles, true_map
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE

FLOORS = ('tiles', 'wood', 'carpet', 'concrete', 'granite', 'marble')
WALLS = ('rough_plaster', 'bricks', 'concrete', 'plaster')
THINGS = ('books', 'goods', 'wood', 'granite', 'metal', 'cloth')
KINDS = ('chair', 'table', 'stool', 'plant')
MIDDLE_M = 1.2
"""In the middle of the room, so far around it, nothing stands: the drive begins there."""
CLEARANCE_M, LEG_M, WAY_M = 0.38, 1.0, 9.0
"""Of the way: room beside it, shortest straight piece, least length."""

Scene = dict[str, Any]


def make_room(seed: int) -> Scene:
    """Return the values of a scene file."""
    rng = np.random.default_rng([seed, 77])
    half = np.round(rng.uniform((2.2, 1.9), (3.6, 2.8)), 2)
    scene: Scene = {
        'description': f'A furnished room, seed {seed}.',
        'seed': seed,
        'floor': {'texture': _one(FLOORS, rng)},
        'lighting': {'ambient': round(float(rng.uniform(0.5, 0.8)), 2)},
        'walls': _walls(half, rng),
        'boxes': [_box(half, rng) for _ in range(int(rng.integers(3, 7)))],
        'furniture': [_furniture(half, rng) for _ in range(int(rng.integers(1, 4)))],
        'camera': {
            'height_m': round(float(rng.uniform(0.2, 0.45)), 2),
            'pitch_deg': round(float(rng.uniform(4, 11)), 1),
            'rate_hz': 6.0,
        },
        'path': {'waypoints': [[0.0, 0.0], [0.1, 0.0]], 'speed_m_s': 0.45},
    }
    scene['path']['waypoints'] = _way(scene, rng)
    return scene


def _one(names: tuple[str, ...], rng: np.random.Generator) -> str:
    return names[int(rng.integers(len(names)))]


def _walls(half: Array, rng: np.random.Generator) -> list[Scene]:
    """Return the outer walls, with one corner cut out, and a partition that reaches into it."""
    x, y = half.tolist()
    cut = np.round(rng.uniform(0.2, 0.45, 2) * half, 2).tolist()
    corners = [[-x, -y], [x, -y], [x, y - cut[1]], [x - cut[0], y - cut[1]], [x - cut[0], y]]
    outer = {'points': [*corners, [-x, y]], 'closed': True, 'texture': _one(WALLS, rng)}
    at, reach = round(float(rng.uniform(-0.5, 0.5)) * x, 2), round(float(rng.uniform(0.5, 0.9)), 2)
    side = float(rng.choice((-1, 1)))
    stub = {'points': [[at, side * y], [at, side * (y - reach)]], 'texture': _one(WALLS, rng)}
    return [{**outer, 'posters': int(rng.integers(4, 12))}, stub]


def _box(half: Array, rng: np.random.Generator) -> Scene:
    """Return a box that stands along a wall or, turned, in the room."""
    size = np.round(rng.uniform((0.3, 0.25, 0.12), (1.3, 0.6, 1.8)), 2)
    if rng.random() < 0.3:
        at, yaw = _place(half, rng), float(np.round(rng.uniform(0, 180)))
        size[:2] = np.minimum(size[:2], 0.5)
    else:
        along = rng.uniform(-0.8, 0.8) * (half - size[0] / 2)
        side, near = rng.choice((-1, 1)), half - size[1] / 2 - 0.06
        is_long = rng.random() < 0.5
        at = np.array([along[0], side * near[1]] if is_long else [side * near[0], along[1]])
        yaw = 0.0 if is_long else 90.0
    where = np.round(at, 2).tolist()
    return {'at': where, 'size': size.tolist(), 'yaw_deg': yaw, 'texture': _one(THINGS, rng)}


def _furniture(half: Array, rng: np.random.Generator) -> Scene:
    at = np.round(_place(half, rng), 2).tolist()
    return {'kind': _one(KINDS, rng), 'at': at, 'yaw_deg': float(np.round(rng.uniform(0, 360)))}


def _place(half: Array, rng: np.random.Generator) -> Array:
    """Return a place in the room, not in its middle."""
    while True:
        at: Array = rng.uniform(-0.85, 0.85, 2) * half
        if np.hypot(*at) > MIDDLE_M:
            return at


def _way(scene: Scene, rng: np.random.Generator) -> list[list[float]]:
    """Return waypoints through the room as it is furnished: straight on to places chosen at random,
    with room enough on the way.
    """
    made = scene_from_mapping(scene, 'room')
    truth = true_map(made, obstacles(made), floors(made), np.zeros(2))
    room_m = truth.away_m(truth.cells != FREE)
    places = np.argwhere(room_m > CLEARANCE_M)
    way: list[Array] = [np.zeros(2)]
    length_m = 0.0
    while length_m < WAY_M:
        cell = places[int(rng.integers(len(places)))]
        there = truth.centres_of(cell)
        step_m = float(np.hypot(*(there - way[-1])))
        line = truth.cells_of(np.linspace(way[-1], there, 50))
        if step_m > LEG_M and (room_m[tuple(line.T)] > CLEARANCE_M).all():
            way.append(there)
            length_m += step_m
    return [np.round(place, 2).tolist() for place in way]


def main(
    folder: Path,
    seeds: Annotated[int, typer.Option(help='How many rooms.')] = 12,
    first: Annotated[int, typer.Option(help='Seed of the first.')] = 1,
) -> None:
    """Write the scene files."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(first, first + seeds):
        text = yaml.safe_dump(make_room(seed), sort_keys=False)
        (folder / f'room_{seed}.yaml').write_text(text)


if __name__ == '__main__':
    typer.run(main)
