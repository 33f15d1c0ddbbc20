"""`segfloor run`: a recording through the pipeline in lockstep."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.progress import TaskID

from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli.options import (
    DepthOption,
    IgnoreOption,
    InputArgument,
    LoadMapOption,
    LocalizeOption,
    MasksOption,
    OutOption,
    ParamsOption,
    ReportOption,
    SaveMapOption,
    SetOption,
    recording_settings,
)
from segfloor_ros.cli.output import (
    finish_run,
    print_error,
    print_sensors,
    print_summary,
    progress_bar,
)
from segfloor_ros.configuration import resolve
from segfloor_ros.lockstep import LockstepRun, MapOptions, SaveMasks
from segfloor_ros.results_folder import OutputFolder


def run(
    input: InputArgument,
    out: OutOption,
    params: ParamsOption = None,
    assignments: SetOption = None,
    ignore: IgnoreOption = None,
    depth: DepthOption = False,
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
    masks: MasksOption = None,
    save_map: SaveMapOption = None,
    load_map: LoadMapOption = None,
    localize: LocalizeOption = False,
    report: ReportOption = False,
) -> None:
    """Map a recording: every frame, no ROS graph, the same result byte for byte."""
    maps = MapOptions(load_map, save_map, localize)
    configuration = resolve(
        params, assignments or (), stereo_camera=recording_settings(input, masks, ignore, depth)
    )
    source = open_source(configuration.stereo_camera)
    print_sensors(source.sensors)
    with OutputFolder(out) as folder:
        with progress_bar('mapping', source.frame_count) as progress:
            drive = LockstepRun(source, configuration, folder, save_masks, save_debug, maps)
            result = drive.execute(
                lambda done, state: progress.update(TaskID(0), completed=done, note=state)
            )
        folder.write(result)
    print_summary(input, result.summary)
    finish_run(input, out, report)
    if drive.note:
        print_error(drive.note)
