"""Scenes of buildings that repeat themselves: where closing a loop at first sight goes wrong.

    python -m tools.look_alikes FOLDER     writes ring_1.yaml …, rooms_1.yaml …, aisles_1.yaml …

`ring`: four corridors around a block, each with the same doors, posters and shelves at the same
places. `rooms`: equal rooms beside a corridor, furnished alike. `aisles`: parallel aisles between
equal shelves. Measures, looks and the light follow from the seed. With an even seed rooms and
aisles repeat at the period of every texture: floor, walls and ceiling are the same to the pixel.
Every drive comes back to where it has been, and a second one, `_back`, then drives all of it back.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import typer
import yaml

SEEDS = {'ring': 4, 'rooms': 3, 'aisles': 3}
SMALL = {'width': 320, 'height': 240}

Scene = dict[str, Any]


def _box(x: float, y: float, size: tuple[float, float, float], texture: str, up: float) -> Scene:
    place = {'at': [round(x, 3), round(y, 3)], 'size': list(size), 'texture': texture}
    return place | ({'bottom_m': up} if up else {})


def _turned(box: Scene, quarters: int) -> Scene:
    """Return a box turned about the origin."""
    angle = quarters * np.pi / 2
    c, s = np.cos(angle), np.sin(angle)
    x, y = box['at']
    at = [round(float(c * x - s * y), 3), round(float(s * x + c * y), 3)]
    return box | {'at': at, 'yaw_deg': 90.0 * quarters}


def _scene(
    seed: int, look: tuple[str, str], walls: list[Scene], boxes: list[Scene], way: Any
) -> Scene:
    return {
        'description': f'A building that repeats itself, seed {seed}.',
        'seed': seed,
        'floor': {'texture': look[0]},
        'ceiling': {'texture': look[1]},
        'lighting': {'ambient': 0.9 if seed % 3 else 0.7},
        'walls': walls,
        'boxes': boxes,
        'camera': {'rate_hz': 5.0} | (SMALL if seed > 1 else {}),
        'path': {
            'waypoints': [[round(float(x), 3), round(float(y), 3)] for x, y in way],
            'speed_m_s': 0.8,
            'turn_rate_deg_s': 50.0,
        },
    }


def make_ring(seed: int) -> Scene:
    """Return four equal corridors around a block, driven one and a third times."""
    rng = np.random.default_rng([seed, 1])
    floor = ('carpet', 'tiles')[seed % 2]
    half, width = 6.0 + 0.5 * (seed % 3), 1.9
    inner = half - width
    side = [_box(x, -half + 0.06, (0.9, 0.06, 2.0), 'wood', 0.0) for x in (-2.5, 1.5)]
    side += [
        _box(x, -half + 0.06, (0.6, 0.02, 0.85), 'poster', 0.7)
        for x in rng.uniform(-half + 1, half - 1, 5)
    ]
    side += [
        _box(float(rng.uniform(-2, 2)), -inner - 0.2, (1.6, 0.3, 1.8), 'books', 0.0),
        _box(float(rng.uniform(2.6, 3.2)), -inner - 0.06, (0.6, 0.02, 0.85), 'poster', 0.6),
    ]
    boxes = [_turned(box, k) for k in range(4) for box in side]
    walls = [
        {
            'points': [[-h, -h], [h, -h], [h, h], [-h, h]],
            'closed': True,
            'texture': 'rough_plaster' if seed % 2 else 'plaster',
        }
        for h in (half, inner)
    ]
    m = (half + inner) / 2
    lap = [[-0.6 * m, -m], [m, -m], [m, m], [-m, m], [-m, -m]]
    return _scene(seed, (floor, 'panels'), walls, boxes, [*lap, [m, -m], [m, -0.2 * m]])


def make_rooms(seed: int) -> Scene:
    """Return equal rooms on one side of a corridor, each visited, then the first one again."""
    rng = np.random.default_rng([seed, 2])
    same = seed % 2 == 0
    pitch, shelf, texture = (6.0, 'goods', 'concrete') if same else (3.6, 'books', 'rough_plaster')
    count, depth, hall = 3 if same else 4, 3.6, 1.0
    end = count * pitch
    things = [
        _box(0.25, 2.2, (0.4, 1.4, 1.7), shelf, 0.0),
        _box(float(rng.uniform(1.2, pitch - 0.8)), depth - 0.3, (0.9, 0.4, 1.1), 'goods', 0.0),
        _box(pitch - 0.3, float(rng.uniform(1.6, 2.6)), (0.4, 0.8, 0.7), 'wood', 0.0),
        _box(pitch / 2, depth - 0.06, (0.6, 0.02, 0.85), 'poster', 1.2),
        _box(0.7, -hall - 0.94, (0.6, 0.02, 0.85), 'poster', 0.6),
        _box(pitch - 0.6, -hall - 0.94, (0.9, 0.06, 2.0), 'wood', 0.0),
    ]
    boxes = [
        thing | {'at': [round(thing['at'][0] + k * pitch, 3), thing['at'][1]]}
        for k in range(count)
        for thing in things
    ]
    outline = [[0, -hall - 1], [end, -hall - 1], [end, depth], [0, depth]]
    walls: list[Scene] = [{'points': outline, 'closed': True, 'texture': texture}]
    way = [[0.6, -hall]]
    for k in range(count):
        left, door = k * pitch, (k + 0.5) * pitch
        if k:
            walls.append({'points': [[left, 0], [left, depth]], 'texture': texture})
        walls.append({'points': [[left, 0], [door - 0.5, 0]], 'texture': texture})
        walls.append({'points': [[door + 0.5, 0], [left + pitch, 0]], 'texture': texture})
        way += _visit(door, hall)
    way += [[end - 0.6, -hall], [end - 0.9, -hall - 0.3], [pitch, -hall], *_visit(pitch / 2, hall)]
    return _scene(seed, ('carpet', 'concrete' if same else 'panels'), walls, boxes, way)


def _visit(door: float, hall: float) -> list[list[float]]:
    """Return the way from the corridor into a room, around in it, and out again."""
    inside = [[door, 0.9], [door + 0.5, 1.7], [door - 0.3, 2.0], [door, 0.9]]
    return [[door - 0.2, -hall], *inside, [door, -hall + 0.2]]


def make_aisles(seed: int) -> Scene:
    """Return parallel aisles between equal shelves, driven to and fro, then the first one again."""
    same = seed % 2 == 0
    pitch = 3.0 if same else 2.3
    count, length, margin = 4, 7.0, 1.6
    shelf = 'books' if seed % 3 else 'goods'
    boxes = [
        _box(x, (k - 0.5) * pitch, (1.9, 0.5, 1.9), shelf, 0.0)
        for k in range(count + 1)
        for x in (1.0, 3.5, 6.0)
    ]
    top = count * pitch
    outline = [[-margin, -pitch], [length + margin, -pitch], [length + margin, top], [-margin, top]]
    walls = [{'points': outline, 'closed': True, 'texture': 'concrete'}]
    way = []
    for k in range(count):
        ends = [[-0.8, k * pitch], [length + 0.8, k * pitch]]
        way += ends if k % 2 == 0 else ends[::-1]
    back = [[-0.8, (count - 1) * pitch - 0.4], [-0.9, 0.5]] if count % 2 == 0 else []
    look = ('carpet', 'concrete') if same else ('tiles', 'panels')
    return _scene(seed, look, walls, boxes, [*way, *back, [-0.4, 0.0], [length - 1, 0.05]])


def driven_back(scene: Scene, seed: int) -> Scene:
    """Return a scene whose camera turns at the end of its way, and drives it back."""
    way = np.array(scene['path']['waypoints'])
    back = way[-2::-1] + np.random.default_rng([seed, 4]).uniform(-0.06, 0.06, (len(way) - 1, 2))
    waypoints = [*way.tolist(), *back.round(3).tolist()]
    return scene | {'path': scene['path'] | {'waypoints': waypoints}}


MAKERS = {'ring': make_ring, 'rooms': make_rooms, 'aisles': make_aisles}


def main(folder: Path) -> None:
    """Write the scene files."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, count in SEEDS.items():
        for seed in range(1, count + 1):
            scene = MAKERS[kind](seed)
            for name, drive in (('', scene), ('_back', driven_back(scene, seed))):
                text = yaml.safe_dump(drive, sort_keys=False)
                (folder / f'{kind}_{seed}{name}.yaml').write_text(text)


if __name__ == '__main__':
    typer.run(main)
