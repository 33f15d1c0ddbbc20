"""`segfloor simulate`: a drive through a described world or a floor plan, with its truth."""

from __future__ import annotations

from typing import Annotated, Optional

import typer
from rich.progress import TaskID

from segfloor_ros.cli.options import OutOption
from segfloor_ros.cli.output import console, progress_bar
from segfloor_ros.simulation.any_scene import open_scene
from segfloor_ros.simulation.drive_files import RecordingOptions, record
from segfloor_ros.simulation.simulation import Simulation


def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            help='Name of a shipped scene, a scene file, or a map_server map (YAML) to drive in.'
        ),
    ],
    out: OutOption,
    set_values: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option('--set', help='One value of the scene, e.g. camera.height_m=0.4; repeatable.'),
    ] = None,
    floor_every: Annotated[
        int, typer.Option(min=0, help='A true floor mask every so many frames; 0: none.')
    ] = 10,
    disparity: Annotated[
        bool, typer.Option('--disparity', help='With each mask the true disparity (1/256 px).')
    ] = False,
    supersampling: Annotated[
        int, typer.Option(min=1, max=4, help='Render so many times finer than the image.')
    ] = 1,
) -> None:
    """Render a drive with exact truth: images, calibration, poses, map and floor masks."""
    described = open_scene(scene, set_values or ())
    options = RecordingOptions(floor_every, disparity)
    with (
        Simulation(described, supersampling) as simulation,
        progress_bar('rendering', simulation.frame_count) as progress,
    ):
        record(
            simulation,
            out,
            options,
            lambda done: progress.update(TaskID(0), completed=done),
        )
        seconds = simulation.drive.times_s[-1]
        facts = (
            f'{simulation.frame_count} pairs, {simulation.drive.length_m:.1f} m, {seconds:.0f} s'
        )
    console.print(f'{facts}: {out}', highlight=False)
