"""Scenes with people: furnished rooms and corridors in which one to four of them walk.

    python -m tools.people_scenes FOLDER --seeds 3     writes room-2-1.yaml …

The plan, what stands in it, the robot's way and where people walk follow from the seed. Nobody
comes nearer to the robot than 0.8 m.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml

from segfloor_ros.apps.simulation.motion import Drive, plan_drive
from segfloor_ros.apps.simulation.scene import Person, Route
from segfloor_ros.apps.simulation.solids import place
from segfloor_ros.core.geometry import Array

NEAREST_M = 0.8
"""Distance from the robot that people keep."""

SPEED_M_S = 0.45
TRIES = 2000
FLOORS = ('tiles', 'wood', 'carpet', 'marble', 'granite')
WALLS = ('rough_plaster', 'plaster', 'bricks')

Scene = dict[str, Any]
Points = list[list[float]]


def make_room(seed: int, people: int) -> Scene:
    """Return a furnished room with people who walk to and fro."""
    scene, drive, rng = _room(seed)
    walks = [_wandering(scene, drive, rng) for _ in range(people)]
    return scene | {'people': walks, 'description': f'{people} people walk in a room, {seed}.'}


def make_crossing(seed: int, people: int) -> Scene:
    """Return a room in which people cross the robot's way 1 to 4 m before it."""
    scene, drive, rng = _room(seed)
    starts_s = np.linspace(0.2, 0.75, people) * drive.times_s[-1]
    walks = [_crossing(scene, drive, rng, float(start_s)) for start_s in starts_s]
    return scene | {'people': walks, 'description': f'{people} people cross, {seed}.'}


def make_leaving(seed: int, people: int) -> Scene:
    """Return a room in which people stand beside the robot's way until it comes, then leave."""
    scene, drive, rng = _room(seed)
    walks = [_wandering(scene, drive, rng, float(rng.uniform(8, 16)), False) for _ in range(people)]
    return scene | {'people': walks, 'description': f'{people} people stand, then leave, {seed}.'}


def make_corridor(seed: int, people: int) -> Scene:
    """Return a corridor in which people come towards the robot, pass it and come back."""
    scene, drive, rng = _corridor(seed)
    walks = [_wandering(scene, drive, rng) for _ in range(people)]
    return scene | {'people': walks, 'description': f'{people} people in a corridor, {seed}.'}


def make_ahead(seed: int, people: int) -> Scene:
    """Return a corridor in which people walk ahead of the robot at its speed."""
    scene, drive, rng = _corridor(seed)
    end = drive.xy_yaw[-1, 0] + 1.8
    walks = []
    for rank in range(people):
        behind, y = 0.7 * (rank // 2), rng.uniform(0.2, 0.4) * (1 if rank % 2 else -1)
        walk = _person(rng, _rounded([[1.4 + behind, y], [end - behind, y]]), SPEED_M_S, 0.7)
        walks.append(walk | {'returns': False})
    return scene | {'people': walks, 'description': f'{people} people walk ahead, {seed}.'}


def make_over(seed: int, people: int) -> Scene:
    """Return two rooms; people step over the robot while it turns into the second, which it has
    not seen. It comes back to the first.
    """
    rng = np.random.default_rng(2000 + seed)
    x, depth, half = rng.uniform(3.0, 3.6), rng.uniform(4.2, 5.0), rng.uniform(2.3, 2.8)
    door, y = rng.uniform(-0.4, 0.4), -rng.uniform(0.9, 1.2)
    way = [[-x + 0.9, y], [door, y], [door, 2.2], [door + 1.2, depth - 1.3], [door, depth - 0.8]]
    way += [[door - 1.2, depth - 1.3], [door, 2.0], [door, 0.1], [-x + 1.3, -0.2]]
    scene = _scene(rng, seed, _rounded([*way, [-x + 1.0, y], [1.0, y]]))
    outlines = [
        [[-x, 1.0], [-x, -2.2], [x, -2.2], [x, 1.0]],
        [[-half, 1.0], [-half, depth + 0.6], [half, depth + 0.6], [half, 1.0]],
        [[-x, 1.0], [door - 0.6, 1.0]],
        [[door + 0.6, 1.0], [x, 1.0]],
    ]
    look = {'texture': str(rng.choice(WALLS)), 'posters': int(rng.integers(3, 6))}
    scene['walls'] = [{'points': _rounded(points)} | look for points in outlines]
    scene['boxes'] = [
        {'at': _rounded(at), 'size': _rounded(rng.uniform((0.5, 0.3, 0.4), (1.0, 0.5, 1.6)))}
        | {'texture': str(rng.choice(('books', 'goods', 'wood', 'granite')))}
        for at in ([x - 0.5, -0.2], [x - 0.6, -1.8], [half - 0.5, depth], [-half + 0.6, depth])
    ]
    drive = _drive(scene)
    first = drive.xy_yaw[: len(drive.times_s) // 3, :2]
    turns_s = drive.times_s[np.hypot(*(first - (door, y)).T).argmin()]
    scene['furniture'] = []
    walks = [_over(drive, rng, float(turns_s) + 1.0 * k) for k in range(people)]
    return scene | {'people': walks, 'description': f'{people} people step over the robot, {seed}.'}


def _over(drive: Drive, rng: np.random.Generator, meeting_s: float) -> Scene:
    """Return someone who walks slowly towards a robot and over it."""
    x, y, yaw = drive.at(np.array([meeting_s]))[0]
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    walk = _person(rng, _rounded([(x, y) + 1.2 * ahead, (x, y) - 1.0 * ahead]), 0.35, 0.0)
    return walk | {'start_s': round(max(0.0, meeting_s - 1.0 / 0.35), 1), 'returns': False}


KINDS: dict[str, Callable[[int, int], Scene]] = {
    'room': make_room,
    'crossing': make_crossing,
    'leaving': make_leaving,
    'corridor': make_corridor,
    'ahead': make_ahead,
    'over': make_over,
}


def _room(seed: int) -> tuple[Scene, Drive, np.random.Generator]:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(2.9, 3.9), rng.uniform(2.4, 3.1)
    corners = [[-x, -y], [x, -y], [x, y], [-x, y]]
    texture, posters = str(rng.choice(WALLS)), int(rng.integers(6, 12))
    boxes = [_against_wall(rng, x, y, side) for side in range(4)]
    island = {
        'kind': 'table',
        'at': _rounded(rng.uniform(-0.3, 0.3, 2)),
        'yaw_deg': int(rng.integers(90)),
    }
    way = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -0.2]]) * (x - 1.25, y - 1.1)
    if rng.random() < 0.5:
        way = way * (-1, 1)
    way += rng.uniform(-0.15, 0.15, way.shape)
    scene = _scene(rng, seed, _rounded(way))
    scene['walls'] = [
        {'points': _rounded(corners), 'closed': True, 'texture': texture, 'posters': posters}
    ]
    scene['boxes'], scene['furniture'] = boxes, [island]
    return scene, _drive(scene), rng


def _against_wall(rng: np.random.Generator, x: float, y: float, side: int) -> Scene:
    """Return a box in a quarter of the room, against the long wall there."""
    size = rng.uniform((0.5, 0.3, 0.4), (1.2, 0.5, 1.9))
    along = rng.uniform(0.3, x - 0.9) * (1 if side % 2 else -1)
    across = (y - size[1] / 2 - 0.06) * (1 if side // 2 else -1)
    texture = str(rng.choice(('books', 'goods', 'wood', 'granite')))
    return {'at': _rounded([along, across]), 'size': _rounded(size), 'texture': texture}


def _corridor(seed: int) -> tuple[Scene, Drive, np.random.Generator]:
    rng = np.random.default_rng(1000 + seed)
    length, half = rng.uniform(8, 10), rng.uniform(1.3, 1.5)
    corners = [[-1.0, -half], [length, -half], [length, half], [-1.0, half]]
    way = [[0.0, 0.0], [length - 2.3, 0.0]]
    scene = _scene(rng, seed, way)
    scene['walls'] = [
        {
            'points': _rounded(corners),
            'closed': True,
            'texture': str(rng.choice(WALLS)),
            'posters': int(rng.integers(8, 14)),
        }
    ]
    side = half - 0.25
    scene['boxes'] = [
        {
            'at': _rounded([at, side * rng.choice((-1, 1))]),
            'size': [0.9, 0.35, _between(rng, 0.4, 1.8)],
            'texture': str(rng.choice(('books', 'goods', 'wood'))),
        }
        for at in rng.uniform((1.5, length - 2.5), (3.5, length - 0.8))
    ]
    scene['furniture'] = []
    return scene, _drive(scene), rng


def _scene(rng: np.random.Generator, seed: int, way: Points) -> Scene:
    return {
        'seed': seed,
        'floor': {'texture': str(rng.choice(FLOORS))},
        'camera': {'height_m': _between(rng, 0.22, 0.45), 'pitch_deg': float(rng.integers(3, 10))},
        'path': {'waypoints': way, 'speed_m_s': SPEED_M_S},
    }


def _drive(scene: Scene) -> Drive:
    waypoints = tuple(tuple(point) for point in scene['path']['waypoints'])
    return plan_drive(Route(waypoints, speed_m_s=scene['path']['speed_m_s']), 10.0)


def _person(rng: np.random.Generator, points: Points, speed_m_s: float, start_s: float) -> Scene:
    return {
        'points': points,
        'speed_m_s': round(speed_m_s, 2),
        'start_s': round(start_s, 1),
        'height_m': _between(rng, 1.55, 1.9),
        'texture': f'cloth:{rng.integers(1, 7)}',
    }


def _wandering(
    scene: Scene, drive: Drive, rng: np.random.Generator, start_s: float = 0.0, returns: bool = True
) -> Scene:
    """Return someone who walks between places of the room and keeps away from the robot."""
    (left, low), (right, high) = _bounds(scene)
    for _ in range(TRIES):
        places = rng.uniform((left, low), (right, high), (int(rng.integers(2, 5)), 2))
        walk = _person(rng, _rounded(places), _between(rng, 0.4, 1.2), start_s)
        walk['returns'] = returns
        if _is_free(scene, places) and _keeps_away(walk, drive):
            return walk
    raise RuntimeError(f'{scene["seed"]}: no way for a person')


def _crossing(scene: Scene, drive: Drive, rng: np.random.Generator, time_s: float) -> Scene:
    """Return someone who crosses the robot's way ahead of where it is at a time."""
    lower, upper = _bounds(scene)
    for _ in range(TRIES):
        meeting_s = max(2.0, time_s + rng.uniform(-5, 5))
        x, y, yaw = drive.at(np.array([meeting_s]))[0]
        ahead, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        middle = (x, y) + rng.uniform(1.0, 4.0) * ahead
        places = np.clip([middle + s * across for s in rng.permutation((-1.6, 1.6))], lower, upper)
        speed = _between(rng, 0.6, 1.2)
        walk = _person(rng, _rounded(places), speed, max(0.0, meeting_s - 1.6 / speed))
        walk = walk | {'returns': False}
        apart = np.hypot(*(places[1] - places[0]))
        if apart > 1.5 and _is_free(scene, places) and _keeps_away(walk, drive):
            return walk
    raise RuntimeError(f'{scene["seed"]}: no way for a person')


def _bounds(scene: Scene) -> tuple[Array, Array]:
    corners = np.array(scene['walls'][0]['points'])
    return corners.min(axis=0) + 0.35, corners.max(axis=0) - 0.35


def _is_free(scene: Scene, places: Array) -> bool:
    """Whether the straight lines between places miss what stands in the room."""
    steps = np.linspace(0, 1, 30)[:, None]
    line = np.concatenate([a + steps * (b - a) for a, b in itertools.pairwise(places)])
    things = [(box['at'], np.hypot(*box['size'][:2]) / 2) for box in scene['boxes']]
    things += [(thing['at'], 0.6) for thing in scene['furniture']]
    return all(np.hypot(*(line - at).T).min() > radius + 0.3 for at, radius in things)


def _keeps_away(walk: Scene, drive: Drive) -> bool:
    points = tuple(tuple(point) for point in walk['points'])
    person = Person(points, walk['speed_m_s'], walk['start_s'], walk.get('returns', True))
    xy = np.array([place(person, t)[:2] for t in drive.times_s])
    away_m = np.hypot(*(xy - drive.xy_yaw[:, :2]).T)
    return bool(away_m.min() > NEAREST_M)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 2)


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, np.float64), 2).tolist()


def main(
    folder: Path, seeds: Annotated[int, typer.Option(help='How many of each kind.')] = 3
) -> None:
    """Write the scene files, with one to four people by seed."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, make in KINDS.items():
        for seed in range(1, seeds + 1):
            people = 1 + (seed + len(kind)) % 4
            text = yaml.safe_dump(make(seed, people), sort_keys=False)
            (folder / f'{kind}-{people}-{seed}.yaml').write_text(text)


if __name__ == '__main__':
    typer.run(main)
