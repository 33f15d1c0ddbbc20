"""Ten kinds of buildings, each with a way through it: for drives there and back.

Sizes, furniture, textures and the light follow from the seed. Floors take turns: every texture that
the simulator has for one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from segfloor_ros.core.geometry import Array
from tools.look_alikes import Scene

FLOORS = (
    'marble', 'carpet', 'parquet', 'tiles', 'granite', 'asphalt', 'wood', 'concrete', 'dark_tiles',
    'grass', 'bricks', 'plaster', 'plain',
)  # fmt: skip
WALLS = ('rough_plaster', 'plaster', 'bricks', 'concrete')
GREYS = ('plain', 'plain_light', 'plain_dark')
CLEAR_M = 0.5
"""Between the way and what stands beside it."""

Rng = np.random.Generator
Corners = list[list[float]]
Building = tuple[list[Corners], list[Corners], list[Scene], Corners]
"""Outlines that are furnished, what is to their left is free; walls; things; the way there."""


def _corridor(rng: Rng) -> Building:
    x, y = rng.uniform(13, 16), rng.uniform(0.9, 1.15)
    way = [[0.7, 0.0], [x / 2, rng.uniform(-0.2, 0.2)], [x - 1.3, 0.0]]
    return [_rectangle(0, -y, x, y)], [], [], way


def _bend(rng: Rng) -> Building:
    x, y, w = rng.uniform(8, 10), rng.uniform(7, 9), rng.uniform(1.8, 2.3)
    outline = [[0, -w / 2], [x, -w / 2], [x, y], [x - w, y], [x - w, w / 2], [0, w / 2]]
    return [outline], [], [], [[0.7, 0.0], [x - w / 2, 0.0], [x - w / 2, y - 1.3]]


def _ring(rng: Rng) -> Building:
    w, half = rng.uniform(1.8, 2.2), rng.uniform(3.3, 4.0)
    m, inner = half - w / 2, half - w
    way = [[-0.7 * m, -m], [m, -m], [m, m], [-m, m], [-m, -0.3 * m]]
    outer = _rectangle(-half, -half, half, half)
    return [outer, _rectangle(-inner, -inner, inner, inner)[::-1]], [], [], way


def _flat(rng: Rng) -> Building:
    ends, y = np.cumsum([0.0, *rng.uniform(3.8, 4.6, 4)]), rng.uniform(3.4, 4.0)
    walls, way = [], [[0.9, rng.uniform(1.2, y - 1.2)]]
    for k, x in enumerate(ends[1:4]):
        door = rng.uniform(0.9, 1.3) if k % 2 else y - rng.uniform(0.9, 1.3)
        walls += [[[x, 0], [x, door - 0.5]], [[x, door + 0.5], [x, y]]]
        way += [[x - 0.5, door], [x + 0.5, door]]
    way.append([ends[4] - 1.3, y / 2])
    tables = [_thing('table', (ends[k] + 1.9, y / 2 + s), rng) for k, s in ((1, 1.25), (2, -1.25))]
    return [_rectangle(0, 0, ends[4], y)], walls, tables, way


def _office(rng: Rng) -> Building:
    pitch, depth, hall = rng.uniform(3.4, 4.0), rng.uniform(3.2, 3.8), rng.uniform(0.9, 1.1)
    walls, doors = [], [(k + rng.uniform(0.35, 0.65)) * pitch for k in range(3)]
    for k, door in enumerate(doors):
        walls += [[[k * pitch, hall], [door - 0.5, hall]]]
        walls += [[[door + 0.5, hall], [(k + 1) * pitch, hall]]]
        walls += [[[k * pitch, hall], [k * pitch, hall + depth]]] if k else []
    in_m = hall + depth - 1.3
    way = [[doors[0], in_m], [doors[0], 0.0], [doors[2], 0.0], [doors[2], in_m]]
    return [_rectangle(0, -hall, 3 * pitch, hall + depth)], walls, [], way


def _aisles(rng: Rng) -> Building:
    pitch, length, count = rng.uniform(2.1, 2.6), 5.7, 3
    things = []
    for k in range(count + 1):
        for x in (0.95, 2.85, 4.75):
            look = str(rng.choice(['books', 'goods']))
            things.append(_box((x, (k - 0.5) * pitch), (1.9, 0.5, rng.uniform(1.2, 2)), look))
    way = []
    for k in range(count):
        ends = [[-0.8, k * pitch], [length + 0.8, k * pitch]]
        way += ends if k % 2 == 0 else ends[::-1]
    way[-1][0] -= 1.2
    return [_rectangle(-1.7, -pitch, length + 1.7, count * pitch)], [], things, way


def _hall(rng: Rng) -> Building:
    way = [[1.5, 1.5], [9.0, 1.8], [9.2, 6.2], [4.6, 6.2]]
    things: list[Scene] = []
    while len(things) < 7:
        at, size = rng.uniform((1, 1), (10, 7)), (1.6, 0.5, rng.uniform(0.8, 1.9))
        if _distance_m(way, at) > 1.3:
            look = str(rng.choice(['books', 'goods', 'wood', 'granite']))
            things.append(_box(at, size, look, float(rng.integers(180))))
    return [_rectangle(0, 0, 11, 8)], [], things, way


def _lobby(rng: Rng) -> Building:
    x, y = rng.uniform(15, 18), rng.uniform(7, 9)
    way = [[1.5, y / 2], [x / 2, y / 2 - rng.uniform(0.2, 0.8)], [x - 2.0, y / 2 + 0.4]]
    columns = [
        _box((x * s, y * t), (0.5, 0.5, 2.5), 'granite') for s in (0.3, 0.7) for t in (0.2, 0.8)
    ]
    return [_rectangle(0, 0, x, y)], [], columns, way


def _two_rooms(rng: Rng) -> Building:
    x, y = rng.uniform(4.8, 5.6), rng.uniform(4.6, 5.4)
    door = rng.uniform(2.0, y - 2.0)
    walls = [[[x, 0], [x, door - 0.5]], [[x, door + 0.5], [x, y]]]
    way = [[1.0, 0.9], [x - 1.3, 1.0], [x - 0.7, door], [x + 0.7, door]]
    way += [[x + 1.3, y - 1.0], [2 * x - 1.1, y - 1.1], [2 * x - 1.2, 1.3]]
    return [_rectangle(0, 0, 2 * x, y)], walls, [_thing('table', (1.8, y - 1.4), rng)], way


MAKERS: dict[str, Callable[[Rng], Building]] = {
    'corridor': _corridor,
    'bend': _bend,
    'ring': _ring,
    'flat': _flat,
    'office': _office,
    'aisles': _aisles,
    'hall': _hall,
    'lobby': _lobby,
    'two_rooms': _two_rooms,
    'plain': _corridor,
}
KINDS = tuple(MAKERS)


def make_building(kind: str, seed: int) -> tuple[Scene, Corners]:
    """Return the values of a scene file, and the way (N, 2) there."""
    number, is_plain = KINDS.index(kind), kind == 'plain'
    rng = np.random.default_rng([seed, number, 28])
    outlines, inner, things, way = MAKERS[kind](rng)
    texture = str(rng.choice(GREYS if is_plain else WALLS))
    walls: list[Scene] = [
        {'points': _rounded(line), 'closed': k < len(outlines), 'texture': texture}
        for k, line in enumerate([*outlines, *inner])
    ]
    boxes = [thing for thing in things if 'size' in thing]
    for outline in outlines:
        boxes += _along_walls(outline, way, rng, 3.5 if is_plain else 1.7)
    back = np.array(way[-2::-1]) + rng.uniform(-0.08, 0.08, (len(way) - 1, 2))
    floors = FLOORS[:10] if is_plain else FLOORS
    dims = [[0.0, 1.0], [60.0, float(rng.uniform(0.5, 1.0))]]
    scene = {
        'description': f'There and back: {kind}, seed {seed}.',
        'seed': 100 * number + seed,
        'floor': {'texture': floors[(5 * number + 4 * seed) % len(floors)]},
        'ceiling': {'texture': str(rng.choice(['panels', 'concrete', 'plain_light']))},
        'lighting': {
            'ambient': round(float(rng.uniform(0.4, 0.9)), 2),
            'turn_deg': float(rng.integers(360)),
            'levels': [*dims, [9999.0, dims[1][1]]],
        },
        'walls': walls,
        'boxes': boxes,
        'furniture': [thing for thing in things if 'kind' in thing],
        'camera': {
            'width': 480,
            'height': 360,
            'rate_hz': 5.0,
            'height_m': round(float(rng.uniform(0.22, 0.45)), 3),
            'pitch_deg': round(float(rng.uniform(4, 11)), 1),
        },
        'path': {
            'waypoints': _rounded([*way, *back.tolist()]),
            'speed_m_s': 0.7,
            'turn_rate_deg_s': 50.0,
        },
    }
    return scene, way


def _along_walls(outline: Corners, way: Corners, rng: Rng, every_m: float) -> list[Scene]:
    """Return doors, sheets of paper and cupboards along the inner side of walls."""
    things = []
    for start, end in zip(np.array(outline), np.roll(outline, -1, axis=0), strict=True):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        at = rng.uniform(0.5, every_m)
        while at < length - 0.6:
            size, look, up = _of_a_wall(rng)
            place = start + at * along + (0.06 + size[1] / 2) * np.array([-along[1], along[0]])
            if _distance_m(way, place) > CLEAR_M + size[1] / 2:
                angle = float(np.degrees(np.arctan2(along[1], along[0])))
                things.append(_box(place, size, look, angle, up))
            at += max(size[0] + 0.2, rng.uniform(0.5, 1.5) * every_m)
    return things


def _of_a_wall(rng: Rng) -> tuple[tuple[float, float, float], str, float]:
    what = rng.random()
    if what < 0.25:
        return (0.9, 0.04, 2.0), 'wood', 0.0
    if what < 0.6:
        return (0.6, 0.02, 0.85), 'poster', float(rng.uniform(0.4, 1.3))
    size = rng.uniform((0.4, 0.2, 0.4), (1.2, 0.35, 1.9))
    return tuple(size.tolist()), str(rng.choice(['books', 'goods', 'wood', 'granite'])), 0.0


def _distance_m(way: Corners, at: Array) -> float:
    line = np.array(way)
    points = [np.linspace(a, b, 60) for a, b in itertools.pairwise(line)]
    return float(np.linalg.norm(np.concatenate(points) - at, axis=1).min())


def _rectangle(left: float, low: float, right: float, high: float) -> Corners:
    return [[left, low], [right, low], [right, high], [left, high]]


def _rounded(points: Corners) -> Corners:
    return [[round(float(value), 3) for value in point] for point in points]


def _box(at: Any, size: Any, texture: str, yaw_deg: float = 0.0, up_m: float = 0.0) -> Scene:
    return {
        'at': _rounded([at])[0],
        'size': _rounded([size])[0],
        'texture': texture,
        'yaw_deg': yaw_deg,
        'bottom_m': round(up_m, 3),
    }


def _thing(kind: str, at: Any, rng: Rng) -> Scene:
    return {'kind': kind, 'at': _rounded([at])[0], 'yaw_deg': float(rng.integers(360))}
