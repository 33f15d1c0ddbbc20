"""`segfloor simulate`: a drive through a described world or a floor plan, with its truth.

`segfloor convert`: any recording to a rosbag2 file.

`segfloor calibrate`: a stereo camera's calibration from pictures of a chessboard.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.camera.bag_writer import ImageCoding
from segfloor_ros.camera.bag_writer import convert as write_bag
from segfloor_ros.camera.calibration.chessboard import CalibrationResult, calibrate_folder
from segfloor_ros.camera.sources import open_source
from segfloor_ros.camera.sources.sensor_files import DEPTH
from segfloor_ros.cli import options
from segfloor_ros.cli.options import within
from segfloor_ros.cli.output import console, print_sensors, progress_bar, value_table
from segfloor_ros.errors import SettingsError, about


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


def convert(
    input: options.Input,
    out: Annotated[Path, typer.Argument(help='New bag, e.g. drive.mcap.', metavar='OUT.mcap')],
    images: Annotated[
        ImageCoding, typer.Option(help='How images are kept; raw and png are exact.')
    ] = ImageCoding.raw,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Convert a recording to a rosbag2 (mcap) with images, CameraInfo and what was measured."""
    settings = options.configuration(params, assignments, input).stereo_camera
    source = open_source(settings)
    print_sensors(source.sensors)
    has_depth = any(sensor.name == DEPTH and not sensor.used for sensor in source.sensors)
    depth = open_source(dataclasses.replace(settings, depth=True)) if has_depth else None
    with progress_bar('converting', source.frame_count) as progress:
        pairs = write_bag(source, out, images, progress, depth)
    size_mb = sum(f.stat().st_size for f in [out, *out.rglob('*')] if f.is_file()) / 1e6
    console.print(f'{pairs} pairs, {size_mb:.1f} MB: {out}', highlight=False)


def calibrate(
    folder: Annotated[
        Path, typer.Argument(help='Folder of pairs left01, right01, … or with left/ and right/.')
    ],
    square_m: Annotated[
        float,
        typer.Option('--square', callback=within(1e-6, 100), help='Side of a square in metres.'),
    ],
    board: Annotated[
        str, typer.Option(help='Inner corners along the long and the short side.')
    ] = '9x6',
    out: Annotated[
        Path | None,
        typer.Option('--out', help="Folder for left.yaml and right.yaml; else the pictures'."),
    ] = None,
) -> None:
    """Calibrate a stereo pair from chessboard pictures; writes ROS camera calibration files."""
    sides = re.fullmatch('([0-9]{1,2})x([0-9]{1,2})', board)
    if sides is None:
        raise SettingsError(f'--board {board}: expected e.g. 9x6')
    with progress_bar('searching boards', None) as progress:
        result = calibrate_folder(folder, square_m, (int(sides[1]), int(sides[2])), out, progress)
    _print_result(result, out or folder)


def _print_result(result: CalibrationResult, folder: Path) -> None:
    camera = result.calibration.camera
    rows = [
        ('pairs used', f'{result.pairs_used} of {result.pairs_total}'),
        ('reprojection error', f'{result.rms_px:.3f} px RMS'),
        ('row difference after rectification', f'{result.epipolar_rms_px:.3f} px RMS'),
        ('focal length, rectified', f'{camera.fx:.1f} px'),
        ('baseline', f'{camera.baseline_m:.4f} m'),
    ]
    console.print(value_table('calibration', rows, str(folder)))
    console.print(f'{folder / "left.yaml"}\n{folder / "right.yaml"}', highlight=False)
