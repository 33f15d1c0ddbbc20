"""`segfloor simulate`: a drive through a described world or a floor plan, with its truth."""

from __future__ import annotations

from typing import Annotated

import typer

from segfloor_ros.cli import options
from segfloor_ros.cli.options import within
from segfloor_ros.cli.output import console, progress_bar
from segfloor_ros.errors import about


def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            help='Name of a shipped scene, a scene file, or a map_server map (YAML) to drive in.'
        ),
    ],
    out: options.Out,
    set_values: Annotated[
        list[str] | None,
        typer.Option('--set', help='One value of the scene, e.g. camera.height_m=0.4; repeatable.'),
    ] = None,
    floor_every: Annotated[
        int,
        typer.Option(callback=within(0), help='A true floor mask every so many frames; 0: none.'),
    ] = 10,
    disparity: Annotated[
        bool, typer.Option('--disparity', help='With each mask the true disparity (1/256 px).')
    ] = False,
    supersampling: Annotated[
        int, typer.Option(callback=within(1, 4), help='Render so many times finer than the image.')
    ] = 1,
) -> None:
    """Render a drive with exact truth: images, calibration, poses, map and floor masks."""
    # Imported here: the simulator takes time that other commands should not wait for.
    from segfloor_ros.simulation.drive_files import RecordingOptions, record
    from segfloor_ros.simulation.scene_file import open_scene
    from segfloor_ros.simulation.simulation import Simulation

    described = open_scene(scene, set_values or ())
    options = RecordingOptions(floor_every, disparity)
    with (
        about(scene),
        Simulation(described, supersampling) as simulation,
        progress_bar('rendering', simulation.frame_count) as progress,
    ):
        record(simulation, out, options, progress)
        seconds = simulation.drive.times_s[-1]
        facts = (
            f'{simulation.frame_count} pairs, {simulation.drive.length_m:.1f} m, {seconds:.0f} s'
        )
    console.print(f'{facts}: {out}', highlight=False)
