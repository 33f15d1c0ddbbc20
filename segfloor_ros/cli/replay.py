"""`segfloor replay`: a recording through the five nodes, each a process of its own."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import TaskID

from segfloor_ros.camera.sources import StereoSource, open_source
from segfloor_ros.camera.sources.sensor_files import DEPTH
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
    console,
    finish_run,
    print_error,
    print_sensors,
    print_summary,
    progress_bar,
)
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import SettingsError
from segfloor_ros.lockstep import MapOptions, SaveMasks
from segfloor_ros.node_settings import StereoCameraNodeSettings
from segfloor_ros.results_folder import OutputFolder


def replay(
    input: InputArgument,
    out: OutOption,
    rate: Annotated[
        float,
        typer.Option(
            help='Speed against real time, less where the nodes cannot follow; 0: full speed.'
        ),
    ] = 1.0,
    params: ParamsOption = None,
    assignments: SetOption = None,
    ignore: IgnoreOption = None,
    depth: DepthOption = False,
    save_masks: Annotated[
        SaveMasks, typer.Option(help='Floor masks to save: none or keyframes.')
    ] = SaveMasks.keyframes,
    masks: MasksOption = None,
    save_map: SaveMapOption = None,
    load_map: LoadMapOption = None,
    localize: LocalizeOption = False,
    report: ReportOption = False,
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
    configuration, source = _open(
        params, assignments, recording_settings(input, masks, ignore, depth)
    )
    loaded = maps.read(source.camera)
    print_sensors(source.sensors)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with OutputFolder(out) as folder:
        on_mask = folder.add_mask if save_masks is SaveMasks.keyframes else None
        with progress_bar('replaying', source.frame_count) as progress:
            result, session = ReplaySession(
                configuration,
                params,
                rate,
                on_mask,
                lambda done, state: progress.update(TaskID(0), completed=done, note=state),
                maps,
                loaded,
            ).execute()
        folder.write(result)
    for notice in session.notices:
        print_error(notice)
    print_summary(input, result.summary)
    console.print(
        f'nodes connected in {session.discovery_s:.1f} s, stopped in {session.shutdown_s:.1f} s; '
        f'keyframes that failed: {session.failed_keyframes}',
        highlight=False,
    )
    finish_run(input, out, report)


def _open(
    params: Path | None, assignments: list[str] | None, recording: dict[str, Any]
) -> tuple[Configuration, StereoSource]:
    """Return the configuration and the recording, which the camera node reads: it is opened here so
    that bad input ends at once.
    """
    configuration = resolve(params, assignments or (), stereo_camera=recording)
    source = open_source(configuration.stereo_camera)
    if any(sensor.name == DEPTH and sensor.used for sensor in source.sensors):
        camera = dataclasses.replace(configuration.stereo_camera, depth=True)
        configuration = dataclasses.replace(configuration, stereo_camera=camera)
    return configuration, source
