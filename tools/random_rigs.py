"""Drives that nobody has tried: `python -m tools.random_rigs FOLDER`.

Each seed draws a place (a furnished room, also with people, a yard without a roof, a corridor) and
a rig: kind of camera, size of the image, lens, baseline, mount, rate, speed, vibration, floor. It
is rendered, mapped as somebody would who says nothing of the rig, and held against the truth. What
is rendered is used again; what is mapped is not.
"""

from __future__ import annotations

import dataclasses
import json
import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
import typer
import yaml

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import PlainConsole, console
from segfloor_ros.apps.cli.terminal import announcing, figure_table
from segfloor_ros.apps.results_folder import read_summary
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.apps.suite.job import ProgramError, run_segfloor
from segfloor_ros.apps.suite.measures import measure_run, number, start_pose_of
from segfloor_ros.core.files.whole import read_json
from tools import people_scenes, rooms
from tools.plain_pnp import WIDTH, arrow

KINDS = ('oak', 'realsense', 'zed', 'webcam', 'kinect', '')
SIZES = ((320, 240), (424, 240), (480, 360), (640, 360), (640, 480))
FLOORS = ('tiles', 'wood', 'carpet', 'concrete', 'granite', 'marble', 'parquet', 'plaster', 'plain')
GROUNDS = ('asphalt', 'grass', 'concrete', 'granite')
PLACES = ('room', 'yard', 'corridor', 'people')
TIMEOUT_S = 1800.0

MEASURES = {
    'tracked_percent': 'tracked %',
    'path_error_m': 'path m',
    'camera_height_m': 'height m',
    'pitch_deg': 'pitch °',
    'free_precision_percent': 'free cells: precision %',
    'free_recall_percent': 'recall %',
}

Scene = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Rig:
    """A scene's values, whether its depth is mapped, and what a row is called."""

    scene: Scene
    depth: bool
    name: str


def make_rig(seed: int) -> Rig:
    """Return a place and a rig."""
    rng = np.random.default_rng([seed, 2026])
    place = str(rng.choice(PLACES))
    scene = _scene_of(place, 9000 + seed, rng)
    kind = str(rng.choice(KINDS))
    depth = kind == 'kinect' or (kind == 'realsense' and rng.random() < 0.4)
    size = SIZES[int(rng.integers(len(SIZES)))]
    camera: Scene = {'kind': kind} if kind else {}
    camera |= {
        'width': size[0],
        'height': size[1],
        'fov_x_deg': _drawn(rng, 60, 100),
        'baseline_m': _drawn(rng, 0.05, 0.16),
        'height_m': _drawn(rng, 0.15, 0.9, np.log),
        'pitch_deg': _drawn(rng, 0, 22),
        'roll_deg': _drawn(rng, -2, 2),
        'rate_hz': _drawn(rng, 4, 12),
    }
    if rng.random() < 0.3:
        camera['vibration'] = {'roll_deg': 0.4, 'pitch_deg': 0.4, 'bounce_m': 0.004}
    if depth:
        scene['sensors'] = {'depth': {'max_m': 5.0}}
    elif rng.random() < 0.3:
        camera |= {'distortion': [-0.2, 0.05, 0.0, 0.0, 0.0], 'misalignment_deg': 0.4}
    scene['camera'] = camera
    scene['path']['speed_m_s'] = _drawn(rng, 0.3, 0.8)
    scene['path']['turn_rate_deg_s'] = _drawn(rng, 25, 80)
    words = [str(seed), place, kind or 'ideal', *(['depth'] * depth), f'{size[0]}x{size[1]}',
             f'{camera["height_m"]:.2f} m {camera["pitch_deg"]:.1f}°']  # fmt: skip
    return Rig(scene, depth, ' '.join(words))


def _scene_of(place: str, seed: int, rng: np.random.Generator) -> Scene:
    """Return a place; its floor and light are drawn again, also plain ones."""
    if place == 'corridor':
        scene = people_scenes.make_corridor(seed, int(rng.integers(0, 3)))
    elif place == 'people':
        scene = people_scenes.make_room(seed, int(rng.integers(1, 4)))
    else:
        scene = rooms.make_room(seed)
    is_yard = place == 'yard'
    floor: Scene = {'texture': str(rng.choice(GROUNDS if is_yard else FLOORS))}
    if rng.random() < 0.2:
        floor['reflectance'] = 0.15
    scene |= {'floor': floor, 'lighting': {'ambient': _drawn(rng, 0.35, 0.8)}}
    if is_yard:
        scene['ceiling'] = {'height_m': 0.0}
        scene['lighting'] |= {'sun': 0.6}
    return scene


def _drawn(rng: np.random.Generator, low: float, high: float, scale: Any = None) -> float:
    """Return a number between; scale np.log: evenly in its logarithm."""
    if scale is np.log:
        return round(math.exp(rng.uniform(math.log(low), math.log(high))), 2)
    return round(float(rng.uniform(low, high)), 2)


def random_rigs(
    folder: Annotated[Path, typer.Argument(help='For scenes, renderings and results.')],
    seeds: Annotated[int, typer.Option(min=1, help='How many rigs.')] = 30,
    first: Annotated[int, typer.Option(min=0, help='Seed of the first.')] = 1,
    json_file: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option('--json', help='File for the figures.'),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Figures of an earlier --json: they stand before the arrows.'),
    ] = None,
) -> None:
    """Print a row for each rig; for one that has no map also why, as the program says it."""
    before = read_json(compare, 'figures of tools.random_rigs') if compare else {}
    folder.mkdir(parents=True, exist_ok=True)
    table = figure_table('rig', *MEASURES.values())
    figures: dict[str, dict[str, str]] = {}
    with announcing() as announce:
        for seed in range(first, first + seeds):
            rig = make_rig(seed)
            scene_file = folder / f'{seed}.yaml'
            scene_file.write_text(yaml.safe_dump(rig.scene, sort_keys=False))
            recording = folder / str(seed)
            on_start = partial(announce, f'rendering {seed}')
            render_once(open_scene(str(scene_file)), recording, RecordingOptions(), on_start)
            announce(f'mapping {rig.name}', 0)
            figures[rig.name] = now = _figures(recording, rig.depth)
            then = before.get(rig.name, {})
            table.add_row(rig.name, *(arrow(then.get(key, ''), now[key]) for key in MEASURES))
            if json_file:
                json_file.write_text(json.dumps(figures, indent=1))
    PlainConsole(width=max(console.width, WIDTH)).print(table)


def _figures(recording: Path, depth: bool) -> dict[str, str]:
    """Map a recording and return its figures as they are printed, by name."""
    out = recording.with_name(f'{recording.name}_result')
    words = ['run', str(recording), '--out', str(out), *(['--depth'] * depth)]
    try:
        run_segfloor(words, recording.with_name(f'{recording.name}.txt'), TIMEOUT_S)
    except ProgramError as error:
        console.print(f'{recording}: {error}', highlight=False)
        return dict.fromkeys(MEASURES, '-')
    measured = measure_run(out, recording, None, start_pose_of(recording))
    measured['pitch_deg'] = math.degrees(read_summary(out / 'summary.json')['camera_pitch_rad'])
    return {name: number(measured[name]) for name in MEASURES}


if __name__ == '__main__':
    run_command(random_rigs)
