"""`segfloor demo`: the drive that comes with the package, mapped and scored against the truth."""

from __future__ import annotations

from importlib import resources, util
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.cli.evaluate import map_table
from segfloor_ros.cli.output import console
from segfloor_ros.cli.replay import replay
from segfloor_ros.cli.run import run
from segfloor_ros.evaluation.map_score import compare, overlay_png, score_map
from segfloor_ros.evaluation.truth import load_truth
from segfloor_ros.files.results import add_files
from segfloor_ros.grid.map_file import load_map

DRIVE = Path(str(resources.files('segfloor_ros.simulation') / 'demo'))
"""A drive through the shipped scene corridor1 with its truth, made by `segfloor simulate corridor1
--supersampling 2 --floor-every 0 --set camera.width=480 --set camera.height=360
--set camera.noise_sigma=1.0` and `segfloor convert` with JPEG images.
"""


def demo(
    out: Annotated[Path, typer.Option('--out', help='Folder for the results.')] = Path(
        'segfloor_demo'
    ),
    rate: Annotated[
        float, typer.Option(help='Speed against real time; 0: as fast as the nodes take it.')
    ] = 0.0,
    lockstep: Annotated[
        bool, typer.Option('--lockstep', help='Without ROS: one process in place of five nodes.')
    ] = False,
) -> None:
    """Map a recorded drive through a corridor with the five nodes and score the map."""
    drive = str(DRIVE / 'drive.mcap')
    if lockstep or util.find_spec('rclpy') is None:
        console.print('mapping a simulated drive through a corridor, in one process without ROS')
        run(drive, out)
    else:
        console.print('replaying a simulated drive through a corridor through the five nodes')
        replay(drive, out, rate=rate)
    _print_scores(out)


def _print_scores(out: Path) -> None:
    """Print how good map and path are; the last line is the path of the report."""
    # Imported here: evo and matplotlib take a second that no other command should wait for.
    from segfloor_ros.evaluation.report import write_report
    from segfloor_ros.evaluation.trajectory import match_files, score_trajectory

    truth = load_truth(DRIVE)
    grid = load_map(out / 'map.yaml')
    console.print(map_table(score_map(grid, truth)))
    path = score_trajectory(match_files(out, DRIVE))
    console.print(
        f'path: {path.path_length_m:.1f} m, {100 * path.tracked:.1f} % of the frames tracked, '
        f'error {100 * path.ate_rmse_m:.1f} cm (RMSE after alignment)',
        highlight=False,
    )
    add_files(out, {'overlay.png': overlay_png(compare(grid, truth))})
    console.print(f'map on the truth: {out / "overlay.png"}', highlight=False, soft_wrap=True)
    console.print(str(write_report(out, DRIVE)), highlight=False, soft_wrap=True)
