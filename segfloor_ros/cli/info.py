"""The command `info`: what an input is, and whether it will do."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.table import Table

from segfloor_ros.camera.sources import open_source
from segfloor_ros.camera.sources.inspection import Inspection, Stream, inspect_recording
from segfloor_ros.cli import terminal
from segfloor_ros.cli.terminal import console, value_table
from segfloor_ros.files.saved_map import is_map_file
from segfloor_ros.results_folder import read_summary


def info(
    input: terminal.Input,
    as_json: terminal.Json = False,
    start: terminal.Start = None,
    frames: terminal.Frames = None,
    every: terminal.Every = None,
    ignore: terminal.Ignore = None,
    depth: terminal.Depth = False,
    params: terminal.Params = None,
    assignments: terminal.Set = None,
) -> None:
    """Say what an input is, and whether it will do: topics or folders, rates, gaps, calibration,
    sensors, and what some dozens of pairs show to be wrong, with what to do.

    \b
    segfloor info drive.mcap
    segfloor info ~/data/V1_01_easy --json
    segfloor info result
    """
    known = _known_output(Path(input).expanduser())
    if known:
        if as_json:
            terminal.print_json({'name': input, 'kind': known})
        else:
            console.print(f'{input}: {known}', highlight=False, soft_wrap=True)
        return
    part = {'start': start, 'frames': frames, 'every': every}
    configuration = terminal.configuration(
        params, assignments, input, ignore=ignore, depth=depth, **part
    )
    source = open_source(configuration.stereo_camera)
    with terminal.progress_bar('reading', source.frame_count) as progress:
        found = inspect_recording(source, input, progress)
    if as_json:
        terminal.print_json(dataclasses.asdict(found))
        return
    console.print(value_table('recording', _rows(found), found.name))
    console.print(_stream_table(found.streams))
    for line in found.to_mend or ['nothing to mend']:
        console.print(f'- {line}', highlight=False, soft_wrap=True)


def _known_output(path: Path) -> str:
    """Return in a line what one of the program's own outputs is, '' for anything else."""
    if (path / 'summary.json').is_file():
        summary = read_summary(path / 'summary.json')
        made = f'with {summary["map"]}' if summary.get('map') else 'without a map'
        return (
            f'results of a drive, {made}: {summary["tracked_frames"]} of {summary["frames"]} '
            f'frames tracked, {summary["keyframes"]} keyframes'
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
