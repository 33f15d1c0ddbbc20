"""`segfloor replay`: a recording through the five nodes, each a process of its own."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Annotated

import typer

from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli import terminal
from segfloor_ros.configuration import StereoCameraNodeSettings
from segfloor_ros.errors import MapError, SettingsError
from segfloor_ros.lockstep import MapOptions, SaveMasks
from segfloor_ros.processes import first_interrupt_noted
from segfloor_ros.results_folder import OutputFolder


def replay(
    input: terminal.Input,
    out: terminal.Out,
    rate: Annotated[
        float,
        typer.Option(
            help='Speed against real time, less where the nodes cannot follow; 0: full speed.'
        ),
    ] = 1.0,
    params: terminal.Params = None,
    assignments: terminal.Set = None,
    start: terminal.Start = None,
    frames: terminal.Frames = None,
    every: terminal.Every = None,
    ignore: terminal.Ignore = None,
    depth: terminal.Depth = False,
    save_masks: Annotated[
        SaveMasks, typer.Option(help='Floor masks to save: none or keyframes.')
    ] = SaveMasks.keyframes,
    masks: terminal.Masks = None,
    save_map: terminal.SaveMap = None,
    load_map: terminal.LoadMap = None,
    localize: terminal.Localize = False,
    report: terminal.Report = False,
    no_map: terminal.NoMap = False,
) -> None:
    """Map a recording with the five ROS 2 nodes over DDS."""
    try:
        from segfloor_ros.cli.replay_session import ReplaySession
    except ImportError as error:
        raise SettingsError(
            f'replay needs ROS 2 ({error}); source a ROS 2 installation or install the extra: '
            "pip install 'segfloor_ros[ros]'"
        ) from None
    if save_masks is SaveMasks.all:
        raise SettingsError(
            '--save-masks all: the nodes segment keyframes only; take keyframes, or segfloor run'
        )
    StereoCameraNodeSettings(rate=rate)  # refuses an impossible rate
    maps = MapOptions(load_map, save_map, localize)
    part = {'start': start, 'frames': frames, 'every': every}
    configuration = terminal.configuration(
        params, assignments, input, masks=masks, ignore=ignore, depth=depth, **part
    )
    # The camera node reads it; it is opened here so that bad input ends at once.
    source = open_source(configuration.stereo_camera)
    if source.takes_depth:
        camera = dataclasses.replace(configuration.stereo_camera, depth=True)
        configuration = dataclasses.replace(configuration, stereo_camera=camera)
    loaded = maps.read(source.camera)
    terminal.print_sensors(source.sensors)
    inputs = (configuration.stereo_camera.input, configuration.stereo_camera.masks)
    with OutputFolder(out, inputs) as folder, first_interrupt_noted() as interrupt:
        keep = partial(folder.add_picture, 'floor_masks')
        on_mask = keep if save_masks is SaveMasks.keyframes else None
        with terminal.progress_bar('replaying', source.frame_count) as progress:
            session = ReplaySession(
                configuration, params, rate, on_mask, progress, interrupt, maps, loaded, no_map
            )
            try:
                result, found = session.execute()
            except MapError:
                terminal.end_if_interrupted(interrupt)
                raise
        folder.write(result)
    terminal.print_summary(input, result.summary)
    terminal.console.print(
        f'nodes connected in {found.discovery_s:.1f} s, stopped in {found.shutdown_s:.1f} s; '
        f'keyframes that failed: {found.failed_keyframes}',
        highlight=False,
    )
    status = interrupt.status or found.status
    terminal.finish_run(input, out, folder, report, found.notices, status)
