"""`segfloor map`: what can be done with saved maps, the files of `--save-map`, without driving:
look at them, compare them, make one of two, leave out what is old, correct them by hand.
"""

from __future__ import annotations

import datetime
import os
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import Json, number_option, print_json, value_table
from segfloor_ros.apps.evaluation.maps import resample
from segfloor_ros.apps.label_files import draw_labels, filter_mask, save_labels
from segfloor_ros.apps.map_files import is_map, load_map, map_facts
from segfloor_ros.core.contracts import KeyframePath, SparseCloud
from segfloor_ros.core.errors import InputError, MapError, SettingsError, os_errors
from segfloor_ros.core.files.arrays import Arrays, MapFile
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.files.results import SAVED_MAP, read_map_file, write_map_file
from segfloor_ros.core.files.writing import PNG, check_output, marked_png, write_output
from segfloor_ros.core.floor.pictures import MASK_COLOURS
from segfloor_ros.core.geometry import planar
from segfloor_ros.core.grid.keyframe_evidence import evidence_from_arrays, evidence_to_arrays
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import (
    FREE,
    OCCUPIED,
    OccupancyGrid,
    OccupancyGridSettings,
    enlarged,
)
from segfloor_ros.core.plugins.maps.known_map import OFFSET, as_seen_by, merge_slam
from segfloor_ros.core.plugins.maps.pruning import prune_file
from segfloor_ros.core.plugins.maps.saved_slam import (
    PART,
    gap_ns,
    loaded_map,
    mount_of,
    parts_that_fit,
    saved_camera,
    sessions_of,
    straightened,
)
from segfloor_ros.core.plugins.semantics.label_map import LABELS, LabelMap, Labels
from segfloor_ros.core.slam.places.loops import SLOPE_SIGMA, UP_SIGMA_M
from segfloor_ros.core.slam.rig import DisparityOffset, Rig
from segfloor_ros.nodes.map_files import check_map_output, save_map

KEEPOUT = 'type: 0, base: 0.0, multiplier: 1.0'
SPEED = 'type: 1, base: 100.0, multiplier: -1.0'
"""Parameters of Nav2's server for each kind of mask."""

app = typer.Typer(help='Look at saved maps, compare, merge, prune and correct them.')

FirstMap = Annotated[Path, typer.Argument(metavar='A', help='File of --save-map.')]
SecondMap = Annotated[Path, typer.Argument(metavar='B', help='File of --save-map.')]

APPEARED_BGR, GONE_BGR = MASK_COLOURS['not floor'], MASK_COLOURS['floor']


@app.command('info')
def info(
    path: Annotated[Path, typer.Argument(metavar='FILE', help='File of --save-map, or map.yaml.')],
    as_json: Json = False,
) -> None:
    """Describe a saved map: drives with dates, keyframes, areas, camera; of a map.yaml size,
    areas and resolution.

    \b
    segfloor map info building.map
    """
    if is_map(path):
        grid = load_map(path)
        facts = map_facts(grid) | {'resolution_m': grid.resolution_m}
    else:
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
    ]
    if 'resolution_m' in facts:
        return [*rows, ('resolution', f'{facts["resolution_m"]:g} m')]
    rows += [
        ('way of the keyframes', f'{facts["path_m"]:.1f} m'),
        ('keyframes', str(facts['keyframes'])),
        ('points', str(facts['points'])),
        ('loops', str(facts['loops'])),
        ('camera', f'{facts["camera"]}, {facts["camera_height_m"]:.2f} m above the floor'),
        ('file', f'{facts["file_mb"]:.1f} MB'),
    ]
    if facts['classes_m2']:
        areas = (f'{name} {area:.1f} m²' for name, area in facts['classes_m2'].items())
        rows.append(('classes', ', '.join(areas)))
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
    """Write the occupancy grid of a saved map, as Nav2's map_server reads it; where a network has
    looked, the classes beside it.

    \b
    segfloor map export building.map building.yaml
    """
    check_map_output(out, [path])
    saved = open_map(path)
    grid, labels = saved.grid(), saved.labels()
    if labels is None:
        save_map(grid, out)
        return console.print(f'map: {out}', soft_wrap=True)
    beside, picture = (out.with_name(out.stem + n) for n in ('_labels.yaml', '_semantic.png'))
    check_map_output(beside, [path])
    check_output(picture, PNG, [path])
    save_map(grid, out)
    save_labels(beside, grid, labels)
    write_output(picture, PNG, marked_png(png_bytes(draw_labels(grid, labels))))
    console.print(f'map: {out}\nclasses: {beside}, {picture}', soft_wrap=True)


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
    check_output(out, SAVED_MAP, [first, second])
    write_map_file(out, merge(open_map(first), open_map(second)).file, [first, second])
    console.print(f'map: {out}', soft_wrap=True)


@app.command('prune')
def prune_map(
    path: Annotated[Path, typer.Argument(metavar='FILE', help='File of --save-map.')],
) -> None:
    """Leave out what later visits have shown again, and with it what is not there any more, as is
    done whenever a drive goes on with a map.

    \b
    segfloor map prune building.map
    """
    console.print(f'map: {prune_file(path)}', soft_wrap=True)


@app.command('diff')
def diff(
    first: Annotated[Path, typer.Argument(metavar='A', help='File of --save-map, or map.yaml.')],
    second: Annotated[Path, typer.Argument(metavar='B', help='File of --save-map, or map.yaml.')],
    out: Annotated[Path, typer.Argument(metavar='OUT.png', help='Picture.')],
    as_json: Json = False,
) -> None:
    """Draw what appeared (red) and what is gone (green) from one map to the other. Where one of
    them is a map.yaml, both are taken to have one frame.

    \b
    segfloor map diff monday.map friday.map changes.png
    """
    check_output(out, PNG, [first, second])
    if is_map(first) or is_map(second):
        then, grid = (load_map(p) if is_map(p) else open_map(p).grid() for p in (first, second))
        change = changed_cells(resample(then, grid), grid.states)
    else:
        grid, change = changes(open_map(first), open_map(second))
    write_output(out, PNG, marked_png(png_bytes(draw_changes(grid, change))))
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
    check_map_output(out, [labels])
    # A speed filter of type 1 with base 100 and multiplier -1 takes off the percentage.
    percent = dict.fromkeys(keepout or (), 100)
    for assignment in speed or ():
        name, _, share = assignment.partition('=')
        if not share.isdecimal() or not 0 < int(share) <= 100:
            raise SettingsError(f'--speed {assignment}: expected CLASS=PERCENT, 1 to 100')
        percent[name] = 100 - int(share)
    save_map(filter_mask(labels, percent), out, 'raw')
    words = f'mask: {out}; costmap_filter_info_server: {KEEPOUT if keepout else SPEED}'
    console.print(words, soft_wrap=True)


@app.command('edit')
def edit(
    path: Annotated[
        Path, typer.Argument(metavar='MAP', help='map.yaml of map_server, or file of --save-map.')
    ],
    out: Annotated[Path, typer.Argument(metavar='OUT.yaml', help='The corrected map.')],
    port: Annotated[int, number_option('Of the page; 0: any that is free.', 0, 65535)] = 0,
) -> None:
    """Correct a map in the browser: erase, draw walls and keepout zones, undo.

    MAP stays as it is. Save writes OUT.yaml, and OUT_keepout.yaml for Nav2's keepout filter where a
    zone was drawn. The page is on this machine alone, until Ctrl-C.

    \b
    segfloor map edit result/map.yaml corrected.yaml
    """
    from segfloor_ros.apps.cli.map_editor import editor_server

    grid = load_map(path) if is_map(path) else open_map(path).grid()
    beside = out.with_name(f'{out.stem}_keepout.yaml')
    for target in (out, beside):
        check_map_output(target, [path])

    def save(corrected: OccupancyGrid, zones: OccupancyGrid | None) -> str:
        save_map(corrected, out)
        words = f'saved: {out}'
        if zones is not None:
            save_map(zones, beside, 'raw')
            words = f'{words}; keepout mask: {beside}; costmap_filter_info_server: {KEEPOUT}'
        elif os.path.lexists(beside):
            nothing = np.zeros(corrected.cells.shape, np.int8)
            none = OccupancyGrid(nothing, corrected.resolution_m, corrected.origin_xy_m)
            save_map(none, beside, 'raw')
            words = f'{words}; no zone is left in the keepout mask: {beside}'
        console.print(words, soft_wrap=True)
        return words

    with os_errors(f'--port {port}'):
        server, address = editor_server(grid, str(path), save, port)
    with server, suppress(KeyboardInterrupt):
        console.print(f'page: {address}', soft_wrap=True)
        console.print('it is there until Ctrl-C')
        if os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'):
            webbrowser.open(address)
        server.serve_forever()


@dataclass(frozen=True)
class SavedMap:
    """A saved map and the name of its file. Everything raises InputError, by that name, for parts
    that are damaged.
    """

    name: str
    file: MapFile

    @property
    def slam(self) -> Arrays:
        """What SLAM knows."""
        return self.file.parts[PART]

    def grid(self) -> OccupancyGrid:
        """Return the occupancy grid."""
        return grid_of(self.file.parts['grid'])

    def labels(self) -> Labels | None:
        """Return the classes of cells and points, None where no network has looked."""
        loaded, known = loaded_map(self.file, 0), LabelMap(saved_camera(self.file, self.name))
        if LABELS in self.file.parts:
            known.from_arrays(self.file.parts[LABELS])
        return known.labels(self.grid(), loaded.path, loaded.cloud.point_id)

    def facts(self) -> dict[str, Any]:
        """Return what the map holds, by name: counts, areas in m², metres."""
        slam, camera, mount = self.slam, saved_camera(self.file, self.name), mount_of(self.file)
        grid = self.grid()
        poses = loaded_map(self.file, 0).path.T_map_base
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        return {
            'keyframes': len(poses),
            'points': len(slam['point_stable_id']),
            'loops': len(slam['loop_ends']),
            'path_m': round(float(steps_m.sum()), 2),
            **map_facts(grid),
            'camera': f'{camera.width}x{camera.height}, baseline {camera.baseline_m:.3f} m',
            'camera_height_m': round(mount.height_m, 3),
            'classes_m2': self._classes_m2(grid),
            'sessions': sessions_of(self.file),
        }

    def _classes_m2(self, grid: OccupancyGrid) -> dict[str, float]:
        labels = self.labels()
        if labels is None:
            return {}
        cells = np.asarray(labels.cells)
        areas = {n: round(grid.area_m2(cells == i), 2) for i, n in enumerate(labels.classes)}
        return {name: area for name, area in areas.items() if area}


def open_map(path: Path) -> SavedMap:
    """Read a saved map with all its parts. Raises InputError."""
    file, name = read_map_file(path), str(path)
    with parts_that_fit(name):
        saved = SavedMap(name, straightened(file, name))
        saved.facts()
    return saved


def merge(first: SavedMap, second: SavedMap) -> SavedMap:
    """Return two maps as one, in the frame of the first; its keyframes come first. The cameras may
    differ, but not how they are mounted. Raises InputError where they are, MapError where no place
    is in both.
    """
    _check_mounts(first, second)
    camera = saved_camera(first.file, first.name)
    with parts_that_fit(f'{first.name} or {second.name}'):
        added = _after(first, second)
        slam = merge_slam(first.slam, added.parts[PART], Rig(camera, mount_of(first.file)))
    if slam is None:
        raise MapError(
            f'{second.name}: shows no place of {first.name}; both must have seen the same things '
            'over half a metre or more, or from the other side the same floor with texture'
        )
    sessions = sessions_of(first.file) + sessions_of(second.file)
    merged = MapFile(first.file.header | {'sessions': sessions}, {PART: slam})
    both = first.file, added
    merged.parts['cloud'] = _labels(loaded_map(merged, 0).cloud, both)
    merged.parts['grid'] = _evidence(loaded_map(merged, 0).path, both)
    known = LabelMap(camera)
    with parts_that_fit(f'{first.name} or {second.name}'):
        if LABELS in first.file.parts:
            known.from_arrays(first.file.parts[LABELS])
        if LABELS in second.file.parts:
            shift_ns, first_id = gap_ns(first.slam, second.slam), int(first.slam['num_ever'])
            known.from_arrays(second.file.parts[LABELS], shift_ns, first_id)
    if known.classes:
        merged.parts[LABELS] = known.to_arrays()
    return SavedMap(f'{first.name} and {second.name}', merged)


def _check_mounts(first: SavedMap, second: SavedMap) -> None:
    mount, other = mount_of(first.file), mount_of(second.file)
    turned = max(abs(mount.pitch_rad - other.pitch_rad), abs(mount.roll_rad - other.roll_rad))
    if abs(mount.height_m - other.height_m) > 4 * UP_SIGMA_M or turned > 4 * SLOPE_SIGMA:
        raise InputError(
            f'{second.name}: the camera is not mounted as in {first.name} (it is '
            f'{other.height_m:.2f} m above the floor, not {mount.height_m:.2f} m); keep both maps'
        )


def _after(first: SavedMap, second: SavedMap) -> MapFile:
    """Return the second map as the camera of the first would have measured it, with ids and stamps
    that come after those of the first.
    """
    slam, parts = second.slam, second.file.parts
    count, shift_ns = first.slam['num_ever'], gap_ns(first.slam, slam)
    offset, own_offset = (
        DisparityOffset(saved_camera(one.file, one.name)).restored(one.slam[OFFSET])
        for one in (first, second)
    )
    seen = as_seen_by(offset, own_offset, slam)
    ids = slam['point_stable_id'] + count.astype(np.int32)
    stamp_ns = slam['keyframe_stamp_ns'] + shift_ns
    changed = {
        'keyframe_stamp_ns': stamp_ns,
        'point_stable_id': ids,
        'num_ever': slam['num_ever'] + count,
    }
    cloud = parts['cloud'] | {'point_id': parts['cloud']['point_id'] + count.astype(np.int32)}
    grid = parts['grid'] | {'stamp_ns': parts['grid']['stamp_ns'] + shift_ns}
    return MapFile(second.file.header, {PART: seen | changed, 'cloud': cloud, 'grid': grid})


def _labels(cloud: SparseCloud, files: Sequence[MapFile]) -> Arrays:
    """Return what is known of the points of a cloud that was merged of those of files; floor and
    height move along with a point.
    """
    parts = []
    for file in files:
        known, before = file.parts['cloud'], loaded_map(file, 0).cloud
        row = np.searchsorted(cloud.point_id, known['point_id'])
        row = np.minimum(row, len(cloud.point_id) - 1)
        kept = cloud.point_id[row] == known['point_id']
        at = np.searchsorted(before.point_id, known['point_id'][kept])
        raised_m = cloud.xyz_map[row[kept], 2] - before.xyz_map[at, 2]
        part = {name: column[kept] for name, column in known.items()}
        part |= {name: part[name] + raised_m for name in ('floor_z_m', 'judged_z_m')}
        parts.append(part)
    return _joined(parts)


def _evidence(path: KeyframePath, files: Sequence[MapFile]) -> Arrays:
    """Return the evidence of keyframes that were merged of those of files."""
    parts = [file.parts['grid'] for file in files]
    # Those of an earlier release get all arrays.
    arrays = _joined([p | evidence_to_arrays(evidence_from_arrays(p)) for p in parts])
    row = np.searchsorted(path.stamp_ns, arrays['stamp_ns'])
    return arrays | {'pose': planar(path.T_map_base[row])}


def _joined(parts: Sequence[Arrays]) -> Arrays:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def changes(first: SavedMap, second: SavedMap) -> tuple[OccupancyGrid, NDArray[np.int8]]:
    """Return the map that both make, and what changed (H, W) from the first to the second: 1 in
    cells that were free and are occupied, -1 the other way round, else 0. What stands beside a cell
    in which something stood before is the same. Raises what `merge` does.
    """
    whole = merge(first, second).file.parts['grid']
    grid, count = grid_of(whole), len(first.file.parts['grid']['stamp_ns'])
    poses = whole['pose'][:count], whole['pose'][count:]
    then, now = (
        resample(grid_of(saved.file.parts['grid'] | {'pose': pose}), grid)
        for saved, pose in zip((first, second), poses, strict=True)
    )
    return grid, changed_cells(then, now)


def changed_cells(then: NDArray[np.int8], now: NDArray[np.int8]) -> NDArray[np.int8]:
    """Return what changed (H, W) between states (H, W) on one raster, as `changes`."""
    stood, stands = (_occupied_or_beside(cells) for cells in (then, now))
    change = np.zeros(now.shape, np.int8)
    change[(now == OCCUPIED) & (then == FREE) & ~stood] = 1
    change[(then == OCCUPIED) & (now == FREE) & ~stands] = -1
    return change


def draw_changes(grid: OccupancyGrid, change: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) BGR of a map and of what `changes` says of it."""
    picture = cv2.cvtColor(grid.picture, cv2.COLOR_GRAY2BGR)
    for sign, colour in ((1, APPEARED_BGR), (-1, GONE_BGR)):
        picture[change[::-1] == sign] = colour
    return enlarged(picture)


def grid_of(evidence: Arrays) -> OccupancyGrid:
    """Return the occupancy grid of the evidence that a map holds."""
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    mapper.from_arrays(evidence, evidence['stamp_ns'])
    return mapper.grid()


def _occupied_or_beside(cells: NDArray[np.int8]) -> NDArray[np.bool_]:
    return cv2.dilate((cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
