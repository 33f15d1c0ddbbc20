"""`segfloor map`: what can be done with saved maps without driving."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from segfloor_ros.cli.terminal import Json, console, print_json, value_table
from segfloor_ros.errors import SettingsError
from segfloor_ros.files.images import png_bytes
from segfloor_ros.files.results import write_file, write_map_file
from segfloor_ros.grid.map_file import save_map
from segfloor_ros.map_files import changes, draw_changes, merge, open_map
from segfloor_ros.semantics.label_map import filter_mask

KEEPOUT = 'type: 0, base: 0.0, multiplier: 1.0'
SPEED = 'type: 1, base: 100.0, multiplier: -1.0'
"""Parameters of Nav2's server for each kind of mask."""

app = typer.Typer(help='Look at saved maps, compare them, make one of two.')

FirstMap = Annotated[Path, typer.Argument(metavar='A', help='File of --save-map.')]
SecondMap = Annotated[Path, typer.Argument(metavar='B', help='File of --save-map.')]


@app.command('info')
def info(
    path: Annotated[Path, typer.Argument(metavar='FILE', help='File of --save-map.')],
    as_json: Json = False,
) -> None:
    """Say what a saved map holds: drives with dates, keyframes, areas, camera.

    \b
    segfloor map info building.map
    """
    facts = open_map(path).facts() | {'file_mb': round(path.stat().st_size / 1e6, 2)}
    if as_json:
        return print_json(facts)
    console.print(value_table('map', list(_rows(facts)), str(path)))


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    width, height = facts['size_m']
    rows = [
        ('size', f'{width:.1f} x {height:.1f} m'),
        ('free', f'{facts["free_m2"]:.1f} m²'),
        ('occupied', f'{facts["occupied_m2"]:.1f} m²'),
        ('way of the keyframes', f'{facts["path_m"]:.1f} m'),
        ('keyframes', str(facts['keyframes'])),
        ('points', str(facts['points'])),
        ('loops', str(facts['loops'])),
        ('camera', f'{facts["camera"]}, {facts["camera_height_m"]:.2f} m above the floor'),
        ('file', f'{facts["file_mb"]:.1f} MB'),
    ]
    for number, session in enumerate(facts['sessions'], 1):
        began, ended = session['first_ns'] / 1e9, session['last_ns'] / 1e9
        words = f'{_date(began)}, {ended - began:.0f} s, {session["keyframes"]} keyframes'
        rows.append((f'drive {number}', words))
    return rows


def _date(seconds: float) -> str:
    """Return a time of the recording's clock; recordings without dates begin near 0."""
    if seconds < datetime.timedelta(days=365).total_seconds():
        return f'at {seconds:.0f} s'
    then = datetime.datetime.fromtimestamp(seconds, datetime.timezone.utc)
    return then.strftime('%Y-%m-%d %H:%M UTC')


@app.command('export')
def export(
    path: Annotated[Path, typer.Argument(metavar='FILE', help='File of --save-map.')],
    out: Annotated[Path, typer.Argument(metavar='MAP.yaml', help='Map for map_server and Nav2.')],
) -> None:
    """Write the occupancy grid of a saved map, as Nav2's map_server reads it.

    \b
    segfloor map export building.map building.yaml
    """
    save_map(open_map(path).grid(), out)
    typer.echo(f'map: {out}')


@app.command('merge')
def merge_maps(
    first: FirstMap,
    second: SecondMap,
    out: Annotated[Path, typer.Argument(metavar='OUT', help='The map of both.')],
) -> None:
    """Make one map of two that show some of the same places, in the frame of the first.

    \b
    segfloor map merge robot1.map robot2.map building.map
    """
    write_map_file(out, merge(open_map(first), open_map(second)).file)
    typer.echo(f'map: {out}')


@app.command('diff')
def diff(
    first: FirstMap,
    second: SecondMap,
    out: Annotated[Path, typer.Argument(metavar='OUT.png', help='Picture.')],
    as_json: Json = False,
) -> None:
    """Draw what appeared (red) and what is gone (green) from one map to the other.

    \b
    segfloor map diff monday.map friday.map changes.png
    """
    grid, change = changes(open_map(first), open_map(second))
    write_file(out, png_bytes(draw_changes(grid, change)))
    areas = {name: grid.area_m2(change == sign) for name, sign in (('appeared', 1), ('gone', -1))}
    if as_json:
        return print_json({f'{name}_m2': round(area, 2) for name, area in areas.items()})
    rows = [(name, f'{area:.2f} m²') for name, area in areas.items()]
    console.print(value_table('change', [*rows, ('picture', str(out))]))


@app.command('filter')
def filter_labels(
    labels: Annotated[
        Path, typer.Argument(metavar='LABELS.yaml', help='map_labels.yaml of a run with --network.')
    ],
    out: Annotated[Path, typer.Argument(metavar='MASK.yaml', help='Mask for map_server.')],
    keepout: Annotated[
        list[str] | None, typer.Option(help='Class that is kept out of; repeatable.')
    ] = None,
    speed: Annotated[
        list[str] | None,
        typer.Option(metavar='CLASS=PERCENT', help='Share of the highest speed; repeatable.'),
    ] = None,
) -> None:
    """Write a mask for Nav2's keepout or speed filter from the classes of a map.

    \b
    segfloor map filter result/map_labels.yaml keepout.yaml --keepout grass
    segfloor map filter result/map_labels.yaml speed.yaml --speed carpet=50
    """
    if bool(keepout) == bool(speed):
        raise SettingsError('give classes by either --keepout or --speed')
    # A speed filter of type 1 with base 100 and multiplier -1 takes off the percentage.
    percent = dict.fromkeys(keepout or (), 100)
    for assignment in speed or ():
        name, _, share = assignment.partition('=')
        if not share.isdecimal() or not 0 < int(share) <= 100:
            raise SettingsError(f'--speed {assignment}: expected CLASS=PERCENT, 1 to 100')
        percent[name] = 100 - int(share)
    save_map(filter_mask(labels, percent), out, 'raw')
    typer.echo(f'mask: {out}; costmap_filter_info_server: {KEEPOUT if keepout else SPEED}')
