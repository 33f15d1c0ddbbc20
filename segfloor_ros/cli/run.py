"""`segfloor run`: a recording through the pipeline in lockstep."""

from __future__ import annotations

from typing import Annotated

import typer

from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli import options, output
from segfloor_ros.errors import MapError
from segfloor_ros.lockstep import LockstepRun, MapOptions, SaveMasks
from segfloor_ros.processes import first_interrupt_noted
from segfloor_ros.results_folder import OutputFolder


def run(
    input: options.Input,
    out: options.Out,
    params: options.Params = None,
    assignments: options.Set = None,
    ignore: options.Ignore = None,
    depth: options.Depth = False,
    save_masks: Annotated[
        SaveMasks, typer.Option(help='Floor masks to save.')
    ] = SaveMasks.keyframes,
    save_debug: Annotated[
        bool,
        typer.Option(
            '--save-debug',
            help='Save pictures of the floor of each keyframe: mask, v-disparity with profile.',
        ),
    ] = False,
    masks: options.Masks = None,
    save_map: options.SaveMap = None,
    load_map: options.LoadMap = None,
    localize: options.Localize = False,
    report: options.Report = False,
    no_map: options.NoMap = False,
) -> None:
    """Map a recording: every frame, no ROS graph, the same result byte for byte."""
    maps = MapOptions(load_map, save_map, localize)
    configuration = options.configuration(params, assignments, input, masks, ignore, depth)
    source = open_source(configuration.stereo_camera)
    output.print_sensors(source.sensors)
    inputs = (configuration.stereo_camera.input, configuration.stereo_camera.masks)
    with OutputFolder(out, inputs) as folder, first_interrupt_noted() as interrupt:
        with output.progress_bar('mapping', source.frame_count) as progress:
            drive = LockstepRun(
                source, configuration, folder, save_masks, save_debug, maps, interrupt, no_map
            )
            try:
                result = drive.execute(progress)
            except MapError:
                output.end_if_interrupted(interrupt)
                raise
        folder.write(result)
        try:
            drive.save_map()
        except Exception as error:  # whatever it is, the results are there
            folder.problems.append(str(error) or type(error).__name__)
    output.print_summary(input, result.summary)
    remarks, status = [drive.note] if drive.note else [], interrupt.status
    if drive.no_map and not no_map:
        folder.problems.append(drive.no_map)
    if drive.broken_off is not None:
        remarks.append(f'{drive.broken_off}; the map is of what came before')
        status = status or 2
    output.finish_run(input, out, folder, report, remarks, status)
