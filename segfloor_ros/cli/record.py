"""`segfloor record`: topics of the live graph, or a camera of this machine, to a bag."""

from __future__ import annotations

from importlib import util
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.camera.bag_writer import BagWriter, ImageCoding, NewBag
from segfloor_ros.camera.sources import open_source
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.cli import terminal
from segfloor_ros.cli.terminal import console, figure_table
from segfloor_ros.errors import InputError, os_errors
from segfloor_ros.processes import Interrupt, first_interrupt_noted


def record(
    out: Annotated[Path, typer.Argument(help='New bag, e.g. drive.mcap.', metavar='OUT.mcap')],
    topics: Annotated[
        str | None,
        typer.Option(
            help='Pattern of the topics, e.g. "/camera/.*|/imu"; else images, CameraInfo, IMU, '
            'odometry and tf.'
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(help='Camera in place of topics: 0 side by side, or left and right as 0,2.'),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help='How long; 0: until Ctrl-C.')] = 0.0,
    images: Annotated[
        ImageCoding, typer.Option(help='How images of a device are kept; raw and png are exact.')
    ] = ImageCoding.raw,
    params: terminal.Params = None,
    assignments: terminal.Set = None,
) -> None:
    """Record topics of the live graph, or a camera of this machine, to a rosbag2 (mcap).

    Ctrl-C, and a disk that becomes full, leave a whole file.

    \b
    segfloor record drive.mcap
    segfloor record drive.mcap --topics "/camera/.*|/imu" --seconds 60
    segfloor record drive.mcap --device 0,2 --images jpeg --set stereo_camera.exposure_s=0.005
    """
    with first_interrupt_noted() as interrupt:
        if device is None:
            is_full = _record_topics(out, topics, seconds, interrupt)
        else:
            settings = terminal.configuration(params, assignments, device).stereo_camera
            is_full = _record_device(out, open_source(settings), images, seconds, interrupt)
    size_mb = sum(f.stat().st_size for f in [out, *out.rglob('*')] if f.is_file()) / 1e6
    console.print(f'{size_mb:.1f} MB: {out}', highlight=False)
    if is_full:
        raise InputError(f'{out}: the disk is almost full; what came until then is in the file')


def _record_topics(out: Path, topics: str | None, seconds: float, interrupt: Interrupt) -> bool:
    """Return whether the disk became full."""
    if util.find_spec('rclpy') is None:
        raise InputError('topics are recorded with rclpy (extra ros), or name a camera by --device')
    from segfloor_ros.cli.topic_recorder import PICTURES, TopicRecord, record_topics

    def show(records: dict[str, TopicRecord]) -> None:
        pictures = [r for r in records.values() if r.kind in PICTURES and r.messages > 1]
        size_mb = sum(record.size for record in records.values()) / 1e6
        rates = ', '.join(f'{record.rate_hz:.1f}' for record in pictures) or '-'
        dropped = sum(record.dropped for record in pictures)
        status.update(f'{size_mb:.0f} MB, images at {rates} Hz, {dropped} dropped')

    with NewBag(out) as bag, terminal.error_console.status('waiting for topics') as status:
        records, is_full = record_topics(bag, topics, seconds, interrupt, show)
        if not any(record.messages for record in records.values()):
            names = ', '.join(records) or 'none that is wanted'
            raise InputError(f'{out}: nothing came; topics that are published: {names}')
    table = figure_table('topic', 'messages', 'Hz', 'MB', 'dropped')
    for name, record in sorted(records.items()):
        rate = f'{record.rate_hz:.1f}' if record.messages > 1 else '-'
        size = f'{record.size / 1e6:.1f}'
        table.add_row(name, str(record.messages), rate, size, str(record.dropped))
    console.print(table)
    return is_full


def _record_device(
    out: Path, source: StereoSource, images: ImageCoding, seconds: float, interrupt: Interrupt
) -> bool:
    """Return whether the disk became full."""
    pairs, first_ns, elapsed_s, is_full = 0, 0, 0.0, False
    writing = os_errors(f'{out}: cannot be written')
    writer = BagWriter(out, source.calibration, images)
    with writing, writer as bag, terminal.progress_bar('recording', None) as progress:
        for pair in source.raw_pairs():
            bag.write(pair)
            first_ns = first_ns or pair.stamp_ns
            pairs, elapsed_s = pairs + 1, 1e-9 * (pair.stamp_ns - first_ns)
            progress(pairs)
            is_full = bag.file.is_disk_full(elapsed_s)
            if interrupt.is_set() or is_full or (seconds and elapsed_s >= seconds):
                break
    rate = f' at {(pairs - 1) / elapsed_s:.1f} Hz' if elapsed_s else ''
    console.print(f'{pairs} pairs{rate}', highlight=False)
    return is_full
