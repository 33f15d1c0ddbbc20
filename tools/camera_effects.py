"""What each effect of a real camera costs: `python -m tools.camera_effects`.

One drive rendered through an ideal camera, through one with a single effect of some kind of camera,
for each of its effects, and through the whole of it; mapped and held against the truth.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated, Optional

import typer

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import announcing, figure_table
from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.apps.suite.job import ProgramError, run_segfloor
from segfloor_ros.apps.suite.measures import measure_run, number, start_pose_of
from segfloor_ros.nodes.yaml_files import read_yaml

DRIVE = (
    'path.waypoints=[[-0.3,0.0],[2.2,0.05],[3.4,-0.3],[4.75,0.0]]',
    'camera.width=480',
    'camera.height=360',
)
"""One way along corridor1, small enough to be rendered twenty times."""

IDEAL = ('camera.noise_sigma=0',)
IDEAL_DEPTH = tuple(
    f'sensors.depth.{word}'
    for word in ('max_m=5', 'baseline_m=0.075', 'noise_px=1e-3', 'step_px=1e-3', 'hole_share=0')
)
MEASURES = ('tracked_percent', 'path_error_m', 'precision_percent', 'recall_percent')
TIMEOUT_S = 1800.0


def camera_effects(
    kind: Annotated[str, typer.Option(help='Camera whose effects are taken.')] = 'webcam',
    depth: Annotated[bool, typer.Option('--depth', help='The effects of its depth.')] = False,
    workdir: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option(help='Keep renderings and results here; what is there is used again.'),
    ] = None,
) -> None:
    """Print a row for the ideal camera, each effect alone, and all of them."""
    table = figure_table('effect', 'tracked %', 'path m', 'precision %', 'recall %')
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary, announcing() as announce:
        for name, assignments in effects_of(kind, depth).items():
            recording = (workdir or Path(temporary)) / f'{kind} {name}'.replace(' ', '_')
            scene = open_scene('corridor1', (*DRIVE, *assignments))
            on_start = partial(announce, f'rendering {name}')
            render_once(scene, recording, RecordingOptions(floor_every=0), on_start)
            table.add_row(name, *_figures(recording, depth))
    console.print(table)


def effects_of(kind: str, depth: bool) -> dict[str, tuple[str, ...]]:
    """Return what is set in the scene, by the name of the row."""
    values = read_yaml(shipped('cameras')[kind], 'a camera')
    ideal: tuple[str, ...] = (*IDEAL, *IDEAL_DEPTH) if depth else IDEAL
    group = 'sensors.depth' if depth else 'camera'
    found = values['sensors']['depth'] if depth else values['camera']
    words = {name: f'{group}.{name}={value}' for name, value in found.items()}
    for name in ('max_m', 'baseline_m'):
        words.pop(name, None)
    together = [words.pop('drift_s')] if 'drift_s' in words else []
    alone = {name: (*ideal, *together, word) for name, word in words.items()}
    return {'none': ideal, **alone, 'all': (*ideal, *together, *words.values())}


def _figures(recording: Path, depth: bool) -> list[str]:
    """Map a recording and return its figures."""
    out = recording.with_name(f'{recording.name}_result')
    words = ['run', str(recording), '--out', str(out), *(['--depth'] if depth else [])]
    try:
        run_segfloor(words, recording.with_name(f'{recording.name}.txt'), TIMEOUT_S)
    except ProgramError as error:
        return [str(error)]
    measured = measure_run(out, recording, None, start_pose_of(recording))
    return [number(measured[name]) if name in measured else '-' for name in MEASURES]


if __name__ == '__main__':
    run_command(camera_effects)
