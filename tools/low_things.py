"""Ten scenes of low things on the floor: stones, hoses, kerbs and crates of 1 to 8 cm.

    python -m tools.low_things FOLDER     writes stones_level.yaml …, for `segfloor simulate`

Floors are level or bumpy, textured or of one colour. In some scenes the camera rolls and pitches,
the light is low, or the images have noise of 4 grey levels. Sizes and places follow from the seed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
import yaml

from segfloor_ros.core.geometry import Array

HEIGHTS_CM = tuple(range(1, 9))
HALF_WIDTH_M, END_M = 1.5, 6.0
"""Of the lane."""
WAY_M = 1.9
"""The drive ends here; at 0.4 m/s and 10 Hz it has about 60 frames."""
LEVEL_M = 0.5
"""Up to here a bumpy floor is level, so that the map is, too."""
FREE_M = 0.3
"""Nothing stands so close to the way; a step of 3 cm would be in the robot's way."""
TRIES = 4000

Values = dict[str, Any]
Rng = np.random.Generator
Blocks = tuple[list[Values], list[Values]]
"""Boxes and cylinders of a scene file."""


@dataclass(frozen=True)
class Thing:
    """What lies on the floor. at: its middle, m. half_m: half its length and width. height_cm:
    above the floor.
    """

    at: tuple[float, float]
    half_m: tuple[float, float]
    yaw_deg: float
    height_cm: int

    def distance_m(self, points: Array) -> Array:
        """Return how far points (N, 2) are from its footprint, 0 inside."""
        yaw = np.radians(self.yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        outside = np.abs((points - self.at) @ turn) - self.half_m
        return np.asarray(np.hypot(*np.maximum(outside, 0).T))


@dataclass(frozen=True)
class LowScene:
    """kind: of the things, one of `KINDS`. bumps_m: height of the bumps; 0: level. others: values
    of the scene file by group.
    """

    kind: str
    floor: str
    texture: str
    bumps_m: float = 0.0
    others: Values | None = None


SHAKES = {'vibration': {'roll_deg': 3.0, 'pitch_deg': 2.0, 'bounce_m': 0.006, 'frequency_hz': 2.0}}
NOISE = {'noise_sigma': 4.0}
DARK = {'ambient': 0.8, 'levels': [[0.0, 0.3], [999.0, 0.3]]}
SUN = {'ambient': 0.45, 'sun': 0.9}
SCENES = {
    'stones_level': LowScene('stones', 'concrete', 'granite'),
    'stones_bumpy': LowScene('stones', 'asphalt', 'granite', 0.02),
    'stones_alike': LowScene('stones', 'granite', 'granite', 0.015),
    'stones_dark': LowScene('stones', 'carpet', 'concrete', 0.0, {'lighting': DARK}),
    'hoses_level': LowScene('hoses', 'tiles', 'plain_dark'),
    'hoses_noise': LowScene('hoses', 'concrete', 'cloth', 0.02, {'camera': NOISE}),
    'kerbs_sun': LowScene(
        'kerbs', 'asphalt', 'concrete', 0.0, {'lighting': SUN, 'ceiling': {'height_m': 0.0}}
    ),
    'kerbs_rolling': LowScene('kerbs', 'grass', 'concrete', 0.015, {'camera': SHAKES}),
    'crates_plain': LowScene('crates', 'plain', 'wood'),
    'crates_rolling': LowScene(
        'crates', 'parquet', 'goods', 0.02, {'camera': SHAKES, 'lighting': DARK}
    ),
}


def make_scene(name: str) -> tuple[Values, list[Thing]]:
    """Return the values of a scene file, and the things in it."""
    chosen = SCENES[name]
    rng = np.random.default_rng([list(SCENES).index(name), 58])
    knots_m, heights_m = bumps(chosen.bumps_m, rng)
    things = place_things(chosen.kind, rng)
    boxes, cylinders = [*_tall_boxes()], []
    for thing in things:
        ground_m = float(np.interp(thing.at[0], knots_m, heights_m))
        some_boxes, some_cylinders = KINDS[chosen.kind].blocks(thing, ground_m, chosen.texture)
        boxes += some_boxes
        cylinders += some_cylinders
    x, y = END_M, HALF_WIDTH_M
    walls = {'points': [[-1.2, -y], [x, -y], [x, y], [-1.2, y]], 'closed': True}
    scene: Values = {
        'description': f'Low things: {name}.',
        'seed': 580 + list(SCENES).index(name),
        'floor': {'texture': chosen.floor},
        'ceiling': {'height_m': 2.5},
        'walls': [{**walls, 'texture': 'rough_plaster', 'posters': 6}],
        'boxes': boxes,
        'cylinders': cylinders,
        'slopes': _slopes(knots_m, heights_m, chosen.floor) if chosen.bumps_m else [],
        'path': {'waypoints': [[0.0, 0.0], [WAY_M, 0.0]]},
        'camera': {'height_m': 0.3},
    }
    for group, values in (chosen.others or {}).items():
        scene[group] = {**scene.get(group, {}), **values}
    return scene, things


def bumps(height_m: float, rng: Rng) -> tuple[Array, Array]:
    """Return a floor's profile along the lane: places x (N,) and heights there (N,), in metres."""
    count = round((END_M + 1.0) / 0.3) + 1
    knots_m = np.linspace(-1.0, END_M, count)
    knots_m[1:-1] += rng.uniform(-0.08, 0.08, count - 2)
    heights_m = rng.uniform(0.0, height_m, count)
    heights_m[(knots_m < LEVEL_M) | (knots_m == END_M)] = 0.0
    return np.round(knots_m, 3), np.round(heights_m, 4)


def _slopes(knots_m: Array, heights_m: Array, texture: str) -> list[Values]:
    ends = np.stack([knots_m, np.zeros(len(knots_m)), heights_m], axis=1).tolist()
    width_m = 2 * HALF_WIDTH_M
    return [
        {'start': a, 'end': b, 'width_m': width_m, 'texture': texture}
        for a, b in itertools.pairwise(ends)
    ]


def place_things(kind: str, rng: Rng) -> list[Thing]:
    """Return two things of each height that neither touch one another nor stand in the way."""
    things: list[Thing] = []
    for height_cm in (*HEIGHTS_CM[::-1], *HEIGHTS_CM[::-1]):
        for _ in range(TRIES):
            thing = KINDS[kind].place(height_cm, rng)
            if _is_clear(thing, things):
                things.append(thing)
                break
    return things


def _is_clear(thing: Thing, others: list[Thing]) -> bool:
    way = np.stack([np.linspace(-0.2, WAY_M + 0.2, 60), np.zeros(60)], axis=1)
    corners = _outline(thing)
    in_lane = (np.abs(corners[:, 1]) < HALF_WIDTH_M - 0.12).all()
    away = all(other.distance_m(corners).min() > 0.08 for other in others)
    return bool(in_lane and away and thing.distance_m(way).min() > FREE_M)


def _outline(thing: Thing) -> Array:
    """Return points (N, 2) that cover a thing's footprint."""
    yaw = np.radians(thing.yaw_deg)
    along, across = (np.linspace(-half, half, max(2, round(half / 0.04))) for half in thing.half_m)
    grid = np.stack(np.meshgrid(along, across), axis=-1).reshape(-1, 2)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return np.asarray(grid @ turn.T + thing.at)


def _tall_boxes() -> list[Values]:
    """Return what stands beside the lane's end, as in any room."""
    return [
        {'at': [4.9, 1.15], 'size': [0.5, 0.5, 0.9], 'texture': 'goods'},
        {'at': [5.3, -1.1], 'size': [0.4, 0.4, 0.6], 'yaw_deg': 15.0, 'texture': 'wood'},
    ]


def _thing(rng: Rng, size_m: tuple[float, float], yaw_deg: float, height_cm: int) -> Thing:
    """Return a thing somewhere in the lane, more often near the robot."""
    x = float(rng.uniform(0.75, 2.6) if rng.random() < 0.6 else rng.uniform(2.4, 4.2))
    at = round(x, 3), round(float(rng.uniform(-1.25, 1.25)), 3)
    half = round(size_m[0] / 2, 4), round(size_m[1] / 2, 4)
    return Thing(at, half, round(yaw_deg, 1), height_cm)


def _place_stone(height_cm: int, rng: Rng) -> Thing:
    length = height_cm / 100 * float(rng.uniform(1.5, 2.2)) + 0.02
    return _thing(rng, (length, length * float(rng.uniform(0.6, 0.9))), _any(rng), height_cm)


def _stone(thing: Thing, ground_m: float, texture: str) -> Blocks:
    """Return two turned blocks and a round top: no face is large."""
    (a, b), h = thing.half_m, thing.height_cm / 100
    boxes = [
        _block(thing, (2 * a, 2 * b, ground_m + 0.6 * h), texture),
        _block(thing, (1.6 * a, 1.7 * b, ground_m + 0.85 * h), texture, turn_deg=20.0),
    ]
    top = {'at': list(thing.at), 'radius_m': round(0.6 * b, 4), 'height_m': round(ground_m + h, 4)}
    return boxes, [{**top, 'texture': texture}]


def _place_hose(height_cm: int, rng: Rng) -> Thing:
    length = float(rng.uniform(0.5, 1.2))
    return _thing(rng, (length, height_cm / 100), _any(rng), height_cm)


def _hose(thing: Thing, ground_m: float, texture: str) -> Blocks:
    """Return a straight hose or pipe, with an octagon's profile."""
    (a, b), h = thing.half_m, thing.height_cm / 100
    widths_heights = ((2 * b, 0.7 * h), (1.4 * b, h))
    sizes = [(2 * a, width, ground_m + height) for width, height in widths_heights]
    return [_block(thing, size, texture) for size in sizes], []


def _place_kerb(height_cm: int, rng: Rng) -> Thing:
    length = float(rng.uniform(0.6, 1.4))
    yaw = float(rng.choice((0.0, 0.0, 90.0))) + float(rng.uniform(-12, 12))
    return _thing(rng, (length, float(rng.uniform(0.08, 0.16))), yaw, height_cm)


def _place_crate(height_cm: int, rng: Rng) -> Thing:
    size = rng.uniform((0.15, 0.12), (0.4, 0.3))
    return _thing(rng, (float(size[0]), float(size[1])), _any(rng), height_cm)


def _crate(thing: Thing, ground_m: float, texture: str) -> Blocks:
    (a, b), h = thing.half_m, thing.height_cm / 100
    return [_block(thing, (2 * a, 2 * b, ground_m + h), texture)], []


def _block(
    thing: Thing, size: tuple[float, float, float], texture: str, turn_deg: float = 0.0
) -> Values:
    return {
        'at': list(thing.at),
        'size': [round(value, 4) for value in size],
        'yaw_deg': round(thing.yaw_deg + turn_deg, 1),
        'texture': texture,
    }


def _any(rng: Rng) -> float:
    return float(rng.uniform(0, 180))


@dataclass(frozen=True)
class Kind:
    """place: returns a thing of a height somewhere. blocks: returns what it is made of, on ground
    of a height, in a texture.
    """

    place: Callable[[int, Rng], Thing]
    blocks: Callable[[Thing, float, str], Blocks]


KINDS = {
    'stones': Kind(_place_stone, _stone),
    'hoses': Kind(_place_hose, _hose),
    'kerbs': Kind(_place_kerb, _crate),
    'crates': Kind(_place_crate, _crate),
}


def main(folder: Path) -> None:
    """Write the scene files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in SCENES:
        text = yaml.safe_dump(make_scene(name)[0], sort_keys=False)
        (folder / f'{name}.yaml').write_text(text)


if __name__ == '__main__':
    typer.run(main)
