"""The commands about recordings: info, record, view, convert, calibrate."""

from __future__ import annotations

import dataclasses
import re
from importlib import util
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from segfloor_ros.apps.calibration import (
    DICTIONARY,
    FILES,
    KINDS,
    PAGE,
    Board,
    CalibrationResult,
    calibrate_folder,
    check_recording,
    convert_calibration,
)
from segfloor_ros.apps.cli import printing, terminal
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import figure_table, number_option, value_table
from segfloor_ros.apps.cli.view import open_view, read_results, show_recording, show_results
from segfloor_ros.apps.map_files import is_map, load_map, map_facts
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.bag_writer import BagWriter, ImageCoding, NewBag
from segfloor_ros.apps.recordings.bag_writer import convert as write_bag
from segfloor_ros.apps.recordings.folder_writer import Layout, layout_for, read_truth, write_folder
from segfloor_ros.apps.recordings.opening import Inspection, Stream, inspect_recording, size_mb
from segfloor_ros.apps.recordings.source import StereoSource
from segfloor_ros.apps.results_folder import read_summary
from segfloor_ros.core.camera.recording import DEPTH
from segfloor_ros.core.errors import InputError, SettingsError, os_errors
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.files.results import is_map_file
from segfloor_ros.core.files.writing import write_output
from segfloor_ros.core.plugins.rig.check import SETTLED_FRAMES
from segfloor_ros.core.processes import Interrupt, first_interrupt_noted

NEXT = (
    'copy left.yaml and right.yaml beside the images, or name them by '
    'stereo_camera.left_calibration and right_calibration; then try segfloor calibrate --check '
    'RECORDING'
)
"""What to do with a good calibration."""


@terminal.with_options
def info(
    options: terminal.InputOptions,
    ignore: terminal.Ignore = None,
    depth: terminal.Depth = False,
    as_json: terminal.Json = False,
) -> None:
    """Describe an input, and whether it can be mapped: topics or folders, rates, gaps, calibration,
    sensors, and faults that some dozens of pairs show, with remedies.

    \b
    segfloor info drive.mcap
    segfloor info ~/data/V1_01_easy --json
    segfloor info result
    """
    name = options.input
    path = user_path(name)
    known = _known_output(path)
    if known and as_json:
        return terminal.print_json({'name': name, 'kind': known})
    if known:
        return console.print(f'{name}: {known}', soft_wrap=True)
    source = open_source(options.configuration(ignore=ignore, depth=depth).stereo_camera)
    with terminal.progress_bar('reading', source.frame_count) as progress:
        found = inspect_recording(source, path, progress)
    if as_json:
        return terminal.print_json(dataclasses.asdict(found))
    console.print(value_table('recording', _rows(found), found.name))
    console.print(_stream_table(found.streams))
    for line in found.to_mend or ['nothing to fix']:
        console.print(f'- {line}', soft_wrap=True)


def _known_output(path: Path) -> str:
    """Return in a line what one of the program's own outputs is, '' for anything else."""
    if (path / 'summary.json').is_file():
        summary = read_summary(path / 'summary.json')
        made = f'with {summary["map"]}' if summary.get('map') else 'without a map'
        return (
            f'results of a drive, {made}: {summary["tracked_frames"]} of {summary["frames"]} '
            f'frames tracked, {summary["keyframes"]} keyframes'
        )
    if is_map(path):
        facts = map_facts(load_map(path))
        width, height = facts['size_m']
        return (
            f'a map of map_server: {width:.1f} x {height:.1f} m known, {facts["free_m2"]:.1f} m² '
            f'free, {facts["occupied_m2"]:.1f} m² occupied'
        )
    if path.is_file() and is_map_file(path):
        return 'a saved map of segfloor; take it with --load-map'
    return ''


def _rows(found: Inspection) -> list[tuple[str, str]]:
    across, along = found.fov_deg
    rectified = 'rectified' if found.is_rectified else f'rectified here, {found.distortion}'
    baseline = 'none: measured depth' if found.baseline_m is None else f'{found.baseline_m:.4f} m'
    rows = 'not measured' if found.rows_px is None else f'{found.rows_px:.2f} px'
    return [
        ('kind', found.kind),
        ('size', f'{found.size_mb:.1f} MB'),
        ('pairs', f'{found.pairs}' + (f', {found.skipped} skipped' if found.skipped else '')),
        ('duration', f'{found.duration_s:.1f} s at {found.rate_hz:.2f} Hz'),
        ('images', f'{found.image}, {rectified}'),
        ('field of view', f'{across:.0f} x {along:.0f} deg, focal length {found.focal_px:.1f} px'),
        ('baseline', baseline),
        ('row error', rows),
    ]


def _stream_table(streams: list[Stream]) -> Table:
    table = Table('where', 'what', 'messages', 'Hz', 'longest gap')
    for column in table.columns[2:]:
        column.justify = 'right'
    for one in streams:
        rate = '' if one.rate_hz is None else f'{one.rate_hz:.1f}'
        gap = '' if one.longest_gap_s is None else f'{one.longest_gap_s:.3f} s'
        table.add_row(one.where, one.what, str(one.messages), rate, gap)
    return table


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
    seconds: Annotated[float, number_option('How long; 0: until Ctrl-C.', 0.0)] = 0.0,
    images: Annotated[
        ImageCoding, typer.Option(help='How images of a device are kept; raw and png are exact.')
    ] = ImageCoding.raw,
    params: terminal.Params = None,
    assignments: terminal.Set = None,
    as_json: terminal.Json = False,
) -> None:
    """Record topics of the live graph, or a camera of this machine, to a rosbag2 (mcap).

    Whatever ends it, what is recorded stays in OUT. Ctrl-C, SIGTERM, SIGHUP and a disk that becomes
    full leave a complete file; a file that lacks its end is read all the same.

    \b
    segfloor record drive.mcap
    segfloor record drive.mcap --topics "/camera/.*|/imu" --seconds 60
    segfloor record drive.mcap --device 0,2 --images jpeg --set stereo_camera.exposure_s=0.005
    """
    with terminal.json_alone(as_json), first_interrupt_noted() as interrupt:
        if device is None:
            is_full = _record_topics(out, topics, seconds, interrupt)
        else:
            settings = terminal.configuration(params, assignments, device).stereo_camera
            is_full = _record_device(out, open_source(settings), images, seconds, interrupt)
    if as_json:
        terminal.print_json({'size_mb': size_mb(out), 'is_disk_full': is_full, 'out': str(out)})
    else:
        console.print(f'{size_mb(out):.1f} MB: {out}')
    if is_full:
        raise InputError(f'{out}: the disk is almost full; what came until then is in the file')


def _record_topics(out: Path, topics: str | None, seconds: float, interrupt: Interrupt) -> bool:
    """Return whether the disk became full."""
    if util.find_spec('rclpy') is None:
        raise InputError('topics are recorded with rclpy (extra ros), or name a camera by --device')
    from segfloor_ros.apps.cli.topic_recorder import PICTURES, TopicRecord, record_topics

    def show(records: dict[str, TopicRecord]) -> None:
        pictures = [r for r in records.values() if r.kind in PICTURES and r.messages > 1]
        size_mb = sum(record.size for record in records.values()) / 1e6
        rates = ', '.join(f'{record.rate_hz:.1f}' for record in pictures) or '-'
        dropped = sum(record.dropped for record in pictures)
        status.update(f'{size_mb:.0f} MB, images at {rates} Hz, {dropped} dropped')

    with (
        NewBag(out, keeps=True) as bag,
        printing.error_console.status('waiting for topics') as status,
    ):
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
    writer = BagWriter(out, source.calibration, images, keeps=True)
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
    console.print(f'{pairs} pairs{rate}')
    return is_full


@terminal.with_options
def view(
    options: terminal.InputOptions,
    live: Annotated[
        bool, typer.Option('--live', help='Show running nodes; INPUT is their namespace, e.g. /.')
    ] = False,
    out: Annotated[
        Path | None, typer.Option('--out', metavar='FILE.rrd', help='Write a file, open no window.')
    ] = None,
) -> None:
    """Show the results folder of a run, a recording or the nodes that run.

    \b
    segfloor view result
    segfloor view drive.mcap --every 5
    segfloor view / --live
    """
    folder = user_path(options.input)
    has_results = not live and (folder / 'summary.json').is_file()
    source = results = None  # what cannot be read ends before a window is opened
    if live:
        with terminal.needing_ros('--live'):
            from segfloor_ros.apps.cli.replay_recorder import watch
    elif has_results:
        results = read_results(folder)
    else:
        source = open_source(options.configuration().stereo_camera)
    with open_view(str(out or ''), [options.input, options.params]) as shown:
        assert shown is not None
        if results is not None:
            show_results(shown, results)
        elif source is not None:
            show_recording(shown, source)
        else:
            watch(shown, options.input)


@terminal.with_options
def convert(
    options: terminal.InputOptions,
    out: Annotated[
        Path, typer.Argument(help='New bag, e.g. drive.mcap, or new folder.', metavar='OUT')
    ],
    layout: Annotated[
        Layout | None,
        typer.Option(
            help='What is written; else a bag becomes a folder, of TUM with depth in place of '
            'right images, of KITTI without, and anything else a bag.',
            show_default=False,
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            metavar='TOPIC',
            help='True poses for a folder: an Odometry of the bag, or a file (TUM or KITTI).',
        ),
    ] = None,
    images: Annotated[
        ImageCoding, typer.Option(help='How images are kept in a bag; raw and png are exact.')
    ] = ImageCoding.raw,
    as_json: terminal.Json = False,
) -> None:
    """Convert a recording to a rosbag2 (mcap), or to a folder as of KITTI or TUM RGB-D.

    \b
    segfloor convert sequences/06 drive.mcap --images png
    segfloor convert drive.mcap sequences/07 --truth /ground_truth
    """
    settings = options.configuration().stereo_camera
    source = open_source(settings)
    layout = layout or layout_for(user_path(settings.input), out, source)
    if layout is Layout.bag and truth is not None:
        raise SettingsError('--truth goes with a folder: give --layout kitti or tum')
    if layout is not Layout.bag and images is ImageCoding.jpeg:
        raise SettingsError('--images jpeg goes with a bag; the images of a folder are PNG')
    terminal.print_sensors(source.sensors)
    has_depth = any(sensor.name == DEPTH and not sensor.used for sensor in source.sensors)
    depth = open_source(dataclasses.replace(settings, depth=True)) if has_depth else None
    poses = None if truth is None else read_truth(truth, settings, source.calibration.left)
    with terminal.progress_bar('converting', source.frame_count) as progress:
        if layout is Layout.bag:
            pairs = write_bag(source, out, images, progress, depth)
        else:
            pairs = write_folder(source, out, layout, progress, depth, poses)
    if as_json:
        terminal.print_json({'pairs': pairs, 'size_mb': size_mb(out), 'out': str(out)})
    console.print(f'{pairs} pairs, {size_mb(out):.1f} MB: {out}')


def calibrate(
    folder: Annotated[
        Path | None,
        typer.Argument(help='Folder of pairs left01, right01, … or with left/ and right/.'),
    ] = None,
    square_m: Annotated[
        float | None, number_option('Side of a square in metres.', 1e-6, 100, name='--square')
    ] = None,
    board: Annotated[
        str,
        typer.Option(help='Inner corners along both sides: the long one first, ChArUco as drawn.'),
    ] = '9x6',
    marker_m: Annotated[
        float, number_option('ChArUco: side of a marker in metres.', 0, name='--marker')
    ] = 0.0,
    dictionary: Annotated[
        str, typer.Option(help='ChArUco: of its markers, e.g. 4X4_50.')
    ] = DICTIONARY,
    out: Annotated[
        Path, typer.Option('--out', help='Folder for left.yaml, right.yaml and the report.')
    ] = Path('calibration'),
    recording: Annotated[
        str | None,
        typer.Option(
            '--check',
            metavar='RECORDING',
            help='In place of pictures: measure how the calibration of a recording fits it, with '
            '--square also by the length of a board in view. Status 1: it does not.',
        ),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option(
            '--from',
            metavar='FILE',
            help='In place of pictures: write the calibration of another tool (ZED, OAK, Basalt, '
            'ORB-SLAM, OpenCV, Kalibr, ost.txt) as ROS files into --out.',
        ),
    ] = None,
    size: Annotated[
        str, typer.Option(help='With --from: WIDTHxHEIGHT of the images, where FILE needs it.')
    ] = '',
    params: terminal.Params = None,
    assignments: terminal.Set = None,
    as_json: terminal.Json = False,
) -> None:
    """Calibrate a stereo pair from pictures of a board: ROS calibration files and a report.

    \b
    segfloor calibrate pictures --square 0.03 --board 9x6
    segfloor calibrate pictures --square 0.03 --board 10x7 --marker 0.022 --dictionary 5X5_100
    segfloor calibrate --check drive.mcap --square 0.03 --board 9x6
    segfloor calibrate --from SN12345.conf --size 1280x720 --out zed
    """
    if other is not None:
        if folder is not None or recording is not None:
            raise SettingsError('give --from FILE and --out FOLDER alone')
        given = re.fullmatch('([1-9][0-9]{0,4})x([1-9][0-9]{0,4})', size)
        if size and given is None:
            raise SettingsError(f'--size {size}: expected e.g. 1280x720')
        made = convert_calibration(
            other, None if given is None else (int(given[1]), int(given[2])), out
        )
        camera = made.camera
        if as_json:
            facts = {'size_px': [camera.width, camera.height], 'baseline_m': camera.baseline_m}
            return terminal.print_json({**facts, 'out': str(out)})
        words = f'{camera.width}x{camera.height}, baseline {camera.baseline_m:.4f} m'
        return console.print(f'{out}: left.yaml, right.yaml: {words}', soft_wrap=True)
    sides = re.fullmatch('([0-9]{1,2})x([0-9]{1,2})', board)
    if sides is None:
        raise SettingsError(f'--board {board}: expected e.g. 9x6')
    pattern = None
    if square_m is not None:
        pattern = Board(int(sides[1]), int(sides[2]), square_m, marker_m, dictionary)
    if recording is not None and folder is None:
        settings = terminal.configuration(params, assignments, recording).stereo_camera
        with terminal.json_alone(as_json):
            _check_calibration(open_source(settings), pattern, as_json)
        return
    if folder is None or pattern is None or recording is not None:
        raise SettingsError('give a folder of pictures and --square, or --check RECORDING alone')
    with terminal.progress_bar('searching boards', None) as progress:
        result = calibrate_folder(folder, pattern, out, progress)
    if result.left_out:
        printing.print_error(f'{folder}: left out: {result.left_out}')
    with terminal.json_alone(as_json):
        _print_calibration(result, out)
    if as_json:
        terminal.print_json(_calibration_figures(result, out))


def _calibration_figures(result: CalibrationResult, folder: Path) -> dict[str, Any]:
    camera = result.calibration.camera
    return {
        'pairs_used': len(result.views),
        'pairs_total': result.pairs_total,
        'reprojection_px': result.rms_px,
        'rows_px': result.epipolar_rms_px,
        'seen_share': [result.seen_share(0), result.seen_share(1)],
        'focal_px': camera.fx,
        'baseline_m': camera.baseline_m,
        'is_good': not result.advice,
        'advice': result.advice,
        'out': str(folder),
    }


def _print_calibration(result: CalibrationResult, folder: Path) -> None:
    """Print figures of a calibration and the errors of each pair, and write its report."""
    # Imported here: Matplotlib takes a second that other commands should not wait for.
    from segfloor_ros.apps.evaluation.report import calibration_page

    table = figure_table('pair', 'left px', 'right px', 'rows px')
    for view, errors_px in zip(result.views, result.view_errors_px, strict=True):
        table.add_row(view.paths[0].name, *(f'{error:.3f}' for error in errors_px))
    console.print(table)
    camera = result.calibration.camera
    rows = [
        ('pairs used', f'{len(result.views)} of {result.pairs_total}'),
        ('reprojection error', f'{result.rms_px:.3f} px RMS'),
        ('row difference after rectification', f'{result.epipolar_rms_px:.3f} px RMS'),
        ('worst pair', result.views[0].paths[0].name),
        ('board seen in the left image', f'{result.seen_share(0):.0%} of it'),
        ('board seen in the right image', f'{result.seen_share(1):.0%} of it'),
        ('focal length, rectified', f'{camera.fx:.1f} px'),
        ('baseline', f'{camera.baseline_m:.4f} m'),
    ]
    rows.append(('verdict', 'not good yet' if result.advice else 'good'))
    console.print(value_table('calibration', rows, str(folder)))
    for line in result.advice or [NEXT]:
        console.print(f'- {line}', soft_wrap=True)
    write_output(folder / PAGE, KINDS[PAGE], calibration_page(result, rows, folder))
    for name in (*FILES, PAGE):
        console.print(str(folder / name), soft_wrap=True)


def _check_calibration(source: StereoSource, board: Board | None, as_json: bool) -> None:
    """Print how the calibration of a recording fits it. Raises typer.Exit where it does not."""
    with terminal.progress_bar('checking', source.frame_count) as progress:
        found = check_recording(source, board, progress)
    lags = [fault.value for fault in found.faults if fault.fault == 'not_simultaneous']
    lag, rows, length = 'none seen', 'not measured: too little is seen', 'no board is seen'
    if lags:
        lag = f'{lags[0]:.0f} ms'
    elif found.pairs < SETTLED_FRAMES:
        lag = f'not measured: takes {SETTLED_FRAMES} pairs of a moving camera'
    if found.rows_px is not None:
        rows = '{:.2f} px, at most {:.2f} px'.format(*found.rows_px)
    if found.scale is not None and board is not None:
        true_m = board.diagonal_m
        length = f'{found.scale * true_m:.4f} m for {true_m:.4f} m, in {found.boards} pairs'
    figures = [('pairs', str(found.pairs)), ('row error', rows), ('lag between the cameras', lag)]
    figures += [] if board is None else [('first to last corner of the board', length)]
    console.print(value_table('calibration', figures, source.name))
    if as_json:
        terminal.print_json({**dataclasses.asdict(found), 'lag_ms': lags[0] if lags else None})
    for fault in found.faults:
        printing.print_error(fault.line())
    if found.faults:
        raise typer.Exit(1)
