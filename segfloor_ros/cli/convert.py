"""`segfloor convert`: any recording to a rosbag2 file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.camera.bag_writer import ImageCoding
from segfloor_ros.camera.bag_writer import convert as write_bag
from segfloor_ros.camera.sources import open_source
from segfloor_ros.camera.sources.sensor_files import DEPTH
from segfloor_ros.cli import options
from segfloor_ros.cli.output import console, print_sensors, progress_bar


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
