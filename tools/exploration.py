"""How well a simulated robot explores: scenes and floor plans, each with several seeds.

    python -m tools.exploration WORK [SCENE…] [--maps FOLDER] [--seeds 3] [--goals 7]

Every drive is a `segfloor explore` into WORK/SCENE_SEED, first the scenes with one seed, then with
the next; what is there already is not driven again. After each, WORK/table.md is written anew.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from segfloor_ros.apps.cli.printing import console
from segfloor_ros.core.files.whole import read_json

CAMERA = ('kind=realsense', 'width=480', 'height=360', 'rate_hz=3')


@dataclass(frozen=True)
class Job:
    """What is explored by which robot, at most for some minutes of its time."""

    scene: str
    robot: str = 'turtlebot3_burger'
    minutes: float = 15.0

    def command(self, seed: int, goals: int, maps: Path, out: Path) -> list[str]:
        """Return the command line, of the package that is measured."""
        scene = str(maps / self.scene) if self.scene.endswith('.yaml') else self.scene
        values = [word for value in CAMERA for word in ('--set', f'camera.{value}')]
        numbers = {'goals': goals, 'seed': seed, 'minutes': self.minutes, 'robot': self.robot}
        options = [word for name, value in numbers.items() for word in (f'--{name}', str(value))]
        program = [sys.executable, '-m', 'segfloor_ros.apps.cli.main']
        return [*program, 'explore', scene, '--out', str(out), *options, *values]


JOBS = {
    'corridor2': Job('corridor2'),
    'yard': Job('yard', 'husky'),
    'doors': Job('doors'),
    'people': Job('people', 'husky', 20),
    'corridor1': Job('corridor1'),
    'complex_room': Job('complex_room', minutes=20),
    'house_map': Job('house_map.yaml', 'husky', 30),
    'depot': Job('depot.yaml', 'husky', 60),
}

HEAD = (
    '| scene | robot | seed | floor mapped | bumps | goals | path error [m] | free cells P / R [%] '
    '| way [m] | time [s] | of real time |\n|---|---|---|---|---|---|---|---|---|---|---|\n'
)


def row(name: str, found: dict[str, Any]) -> str:
    """Return the row of a table that a summary.json comes to."""
    precision, recall = (100 * found[f'free_{kind}'] for kind in ('precision', 'recall'))
    return (
        f'| {name} | {found["robot"]} | {found["seed"]} | {100 * found["mapped_share"]:.1f} % '
        f'| {found["bumps"]} | {found["goals_reached"]} of {found["goals_total"]} '
        f'| {found["path_rmse_m"]} | {precision:.1f} / {recall:.1f} | {found["path_m"]:.0f} '
        f'| {found["sim_s"]:.0f} | {found["real_time_factor"]:.2f} |\n'
    )


def main(
    work: Annotated[Path, typer.Argument(help='Folder for the drives and the table.')],
    scenes: Annotated[list[str] | None, typer.Argument(help='Which, without a name all.')] = None,
    maps: Annotated[Path, typer.Option(help='Folder with the floor plans.')] = Path('maps'),
    seeds: Annotated[int, typer.Option(help='How many seeds.', min=1)] = 3,
    goals: Annotated[int, typer.Option(help='Goals of each drive.', min=0)] = 7,
) -> None:
    """Drive what has not been driven yet, and write the table."""
    work.mkdir(parents=True, exist_ok=True)
    for seed in range(1, seeds + 1):
        for name in scenes or JOBS:
            out = work / f'{name}_{seed}'
            if not (out / 'summary.json').is_file():
                with (work / f'{name}_{seed}.log').open('w') as log:
                    command = JOBS[name].command(seed, goals, maps, out)
                    status = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
                console.print(f'{name} {seed}: {"done" if not status else f"ended with {status}"}')
            (work / 'table.md').write_bytes(table(work, seeds).encode())
    console.print((work / 'table.md').read_text(), highlight=False, soft_wrap=True)


def table(work: Path, seeds: int) -> str:
    """Return the table of the drives that are there."""
    drives = [(name, work / f'{name}_{seed}') for name in JOBS for seed in range(1, seeds + 1)]
    found = [(name, folder / 'summary.json') for name, folder in drives]
    return HEAD + ''.join(row(n, read_json(f, 'an exploration')) for n, f in found if f.is_file())


if __name__ == '__main__':
    os.environ.setdefault('MUJOCO_GL', 'egl')
    typer.run(main)
