"""A scene by name, by file (YAML with the fields of `scene.Scene`), or from a floor plan.

A scene from a map_server floor plan: walls extruded from its occupied cells, and a tour through
its free space for a robot of some width.
"""

from __future__ import annotations

import copy
import dataclasses
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.navigation import Ways, graph_of
from segfloor_ros.apps.simulation import scene as scene_module
from segfloor_ros.apps.simulation.scene import Scene, Wall
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import shortened
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, Cells, OccupancyGrid
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.yaml_files import read_yaml, yaml_value

EXPECTED = 'names and values, e.g. `walls:`'
FARTHEST_M = 1e4
RANGES = {
    'seed': (0, 2**32 - 1), 'posters': (0, 100), 'width': (16, 4096), 'height': (16, 4096),
    'fov_x_deg': (1, 170), 'baseline_m': (1e-3, 10), 'exposure_s': (0, 1), 'rate_hz': (0, 2000),
    'noise_sigma': (0, 255), 'speed_m_s': (0.01, 100), 'acceleration_m_s2': (0.01, 100),
    'turn_rate_deg_s': (0.1, 1e4), 'smoothing_m': (0, 100), 'resolution_m': (0.005, 1),
    'size': (1e-4, 1000), 'radius_m': (1e-4, 1000), 'height_m': (0, 100), 'width_m': (1e-4, 1000),
    'thickness_m': (1e-4, 100), 'step_px': (1e-6, 1000), 'max_m': (0, FARTHEST_M),
    'track_m': (0.01, 100), 'frequency_hz': (0.01, 100), 'noise_m': (0, 10), 'noise_px': (0, 1000),
    'hole_share': (0, 1), 'raster_phase': (0, 1),
    'right_gain': (0, 100), 'ambient': (0, 1), 'reflectance': (0, 1), 'shot_noise': (0, 255),
    'rolling_s': (0, 1), 'auto_exposure': (0, 1), 'vignetting': (0, 1), 'softness_px': (0, 100),
    'gamma': (0.1, 10), 'jpeg': (0, 100), 'pair_focal': (-0.5, 0.5), 'lag_s': (0, 1),
    'drift_s': (0, FARTHEST_M), 'flying_share': (0, 1), 'dark_grey': (0, 255),
    'shiny_grey': (0, 255),
}  # fmt: skip
"""Of numbers by name; all others, metres and degrees, are within `FARTHEST_M`."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FloorPlan:
    """How a floor plan becomes a scene. wall_extent_m: connected obstacles at least this large are
    walls, up to the ceiling; smaller ones are furniture. texture_patch_m: long walls change their
    look about this often.

    Of the tour: comfort_m: nearer to an obstacle than this the way counts longer, up to three times
    at the clearance. seen_m: what is so near was seen.
    """

    wall_extent_m: float = 2.5
    furniture_heights_m: tuple[float, ...] = (0.4, 0.8, 1.2, 1.8)
    wall_textures: tuple[str, ...] = ('rough_plaster', 'bricks', 'concrete', 'books', 'goods')
    furniture_textures: tuple[str, ...] = ('wood', 'granite', 'goods', 'metal')
    texture_patch_m: float = 5.0
    clearance_m: float = 0.45
    comfort_m: float = 1.2
    seen_m: float = 4.0
    longest_m: float = 60.0

    @property
    def cell_m(self) -> float:
        """Side of the cells in which the tour is planned."""
        return self.clearance_m / 3


PLAN = FloorPlan()


def shipped(kind: str = 'scenes') -> dict[str, Path]:
    """Return the `scenes` or `cameras` that come with the package, by name."""
    folder = Path(str(resources.files('segfloor_ros.apps.simulation') / kind))
    return {file.stem: file for file in sorted(folder.glob('*.yaml'))}


def read_scene_values(path: Path) -> dict[str, Any]:
    """Return what a scene file says. `like: NAME` takes over everything from a shipped scene that
    the file does not say itself; lists are replaced as a whole. Raises InputError.
    """
    values = read_yaml(path, EXPECTED)
    if 'like' not in values:
        return values
    name, scenes = str(values.pop('like')), shipped()
    if name not in scenes or scenes[name] == path:
        raise InputError(f'{path}: like: {name} is no shipped scene{suggestion(name, [*scenes])}')
    return _merged(read_scene_values(scenes[name]), values)


def _with_camera_of_a_kind(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the values over those of the camera that `camera: {kind: …}` names."""
    camera = values.get('camera')
    if not isinstance(camera, dict) or 'kind' not in camera:
        return values
    kind, cameras = str(camera.pop('kind')), shipped('cameras')
    if kind not in cameras:
        raise InputError(f'{where}: camera {kind} is none of {", ".join(cameras)}')
    return _merged(read_yaml(cameras[kind], EXPECTED), values)


def _merged(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    result = dict(values)
    for key, change in changes.items():
        inner = result.get(key)
        both = isinstance(inner, dict) and isinstance(change, dict)
        result[key] = _merged(inner, change) if both else change  # type: ignore[arg-type]
    return result


def scene_from_mapping(values: dict[str, Any], where: str) -> Scene:
    """Build a scene from plain values. where: what errors call it."""
    return _build(Scene, values, where)


def _build(kind: Any, value: Any, where: str) -> Any:
    """Return a value of a declared type: a dataclass, a tuple of a type or a plain value."""
    if dataclasses.is_dataclass(kind):
        return _build_entry(kind, value, where)
    if typing.get_origin(kind) is tuple:
        return _build_tuple(typing.get_args(kind), value, where)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        names = {float: 'a number', int: 'a whole number', str: 'text', bool: 'true or false'}
        raise InputError(f'{where}: {value!r} is not {names[kind]}')
    return value


def _build_entry(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise InputError(f'{where}: expected names and values, found {value!r}')
    types = typing.get_type_hints(kind, vars(scene_module))
    for name in value:
        if name not in types:
            raise InputError(f'{where}: unknown entry {name}{suggestion(str(name), list(types))}')
    required = [f.name for f in dataclasses.fields(kind) if _is_required(f)]
    missing = [name for name in required if name not in value]
    if missing:
        raise InputError(f'{where}: {missing[0]} is missing')
    built = {name: _build(types[name], v, f'{where}, {name}') for name, v in value.items()}
    for name, found in built.items():
        _check_range(name, found, f'{where}, {name}')
    return kind(**built)


def _check_range(name: str, value: Any, where: str) -> None:
    """Raise InputError for a number, or one of a tuple, that no world has."""
    if isinstance(value, tuple):
        for item in value:
            _check_range(name, item, where)
    elif isinstance(value, (int, float)):
        low, high = RANGES.get(name, (-FARTHEST_M, FARTHEST_M))
        if not low <= value <= high:
            raise InputError(f'{where}: {value:g} is not within {low:g} to {high:g}')


def _build_tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise InputError(f'{where}: expected a list, found {value!r}')
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        return tuple(_build(kinds[0], v, f'{where} {i + 1}') for i, v in enumerate(value))
    if len(value) != len(kinds):
        raise InputError(f'{where}: expected {len(kinds)} numbers, found {value!r}')
    return tuple(_build(kind, v, where) for kind, v in zip(kinds, value, strict=True))


def _is_required(entry: dataclasses.Field) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING


def open_scene(name: str, assignments: Iterable[str] = ()) -> Scene:
    """Return the scene of that name or file, some values replaced (`camera.height_m=0.4`).

    A map_server map becomes a scene with extruded walls and a planned path. Raises InputError.
    """
    path, scenes = Path(name), shipped()
    if not path.exists() and name not in scenes:
        raise InputError(f'{name}: no such scene or file{suggestion(name, list(scenes))}')
    is_shipped = name in scenes and not path.is_file()  # a folder of that name is what came of it
    file = scenes[name] if is_shipped else path
    if file.is_dir():
        raise InputError(f'{name}: is a folder; name a scene file or a map YAML')
    if is_map_file(read_yaml(file, EXPECTED)):
        values = scene_of_map(file, assigned({}, assignments))
    else:
        values = read_scene_values(file)
    return scene_from_mapping(_with_camera_of_a_kind(assigned(values, assignments), name), name)


def assigned(values: dict[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return a copy of nested values with `a.b=value` assignments applied."""
    result = copy.deepcopy(values)
    for assignment in assignments:
        key, separator, text = assignment.partition('=')
        *groups, name = key.strip().split('.')
        if not separator or not name:
            raise InputError(f'--set {assignment}: expected group.name=value')
        inner = result
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise InputError(f'--set {assignment}: {group} has no named values')
        try:
            inner[name] = yaml_value(text)
        except ValueError as error:
            what = f'{shortened(text)} is no value in YAML: {error}'
            raise InputError(f'--set {key}: {what}') from None
    return result


def is_map_file(values: dict[str, Any]) -> bool:
    """Return whether the values of a YAML file are those of a map_server map."""
    return 'image' in values and 'resolution' in values


def scene_of_map(file: Path, overrides: dict[str, Any]) -> dict[str, Any]:
    """Return a scene's values: boxes for the occupied cells and, unless `overrides` has waypoints,
    a tour through the free space. Raises InputError naming the file.
    """
    grid = load_map(file)
    occupied = grid.cells == OCCUPIED
    if not occupied.any():
        raise InputError(f'{file}: the map has no occupied cell to build walls from')
    seed = int(overrides.get('seed', Scene.seed))
    waypoints = overrides.get('path', {}).get('waypoints')
    if waypoints is None:
        waypoints = plan_tour(grid).tolist()
    return {
        'description': f'Floor plan {file.name}, walls extruded, a tour through its free space.',
        'seed': seed,
        'floor': {'texture': 'tiles'},
        'boxes': _boxes(grid, occupied, seed),
        'resolution_m': grid.resolution_m,
        'raster_phase': 0.0,
        'path': {'waypoints': waypoints},
    }


def merged_rectangles(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return rectangles (N, 4) = first row, last row + 1, first column, last column + 1 that cover
    the mask without overlap: runs along the rows, equal runs of adjacent rows joined.
    """
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    order = np.lexsort((rows, ends, starts))
    rows, starts, ends = rows[order], starts[order], ends[order]
    continues = (np.diff(rows) == 1) & (np.diff(starts) == 0) & (np.diff(ends) == 0)
    first = np.concatenate([[0], np.nonzero(~continues)[0] + 1])
    last = np.concatenate([first[1:] - 1, [len(rows) - 1]])
    return np.stack([rows[first], rows[last] + 1, starts[first], ends[first]], axis=1)


def _boxes(grid: OccupancyGrid, occupied: NDArray[np.bool_], seed: int) -> list[dict[str, Any]]:
    """Return one box per merged rectangle; connected obstacles share their height."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        occupied.astype(np.uint8), connectivity=8
    )
    rng = np.random.default_rng([seed, 5])
    extent_m = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) * grid.resolution_m
    is_wall = extent_m >= PLAN.wall_extent_m
    height_m = np.where(is_wall, Wall.height_m, rng.choice(PLAN.furniture_heights_m, count))
    boxes = []
    for rectangle in merged_rectangles(occupied):
        label = int(labels[rectangle[0], rectangle[2]])
        bottom, top, left, right = (float(value) * grid.resolution_m for value in rectangle)
        x, y = grid.origin_xy_m
        texture = PLAN.furniture_textures[label % len(PLAN.furniture_textures)]
        if is_wall[label]:
            texture = _wall_texture(rectangle[[0, 2]] * grid.resolution_m, seed)
        boxes.append(
            {
                'at': [x + (left + right) / 2, y + (bottom + top) / 2],
                'size': [right - left, top - bottom, float(height_m[label])],
                'texture': texture,
            }
        )
    return boxes


def _wall_texture(place_m: Array, seed: int) -> str:
    """Return the look of a wall by its place."""
    patch = (place_m // PLAN.texture_patch_m).astype(np.int64)
    chosen = np.random.default_rng([seed, 6, *patch]).integers(len(PLAN.wall_textures))
    return PLAN.wall_textures[int(chosen)]


def plan_tour(grid: OccupancyGrid) -> Array:
    """Return waypoints (N, 2) in metres: from the widest place on to the nearest part not yet seen,
    again and again, and back to the start.

    Raises InputError where no place is wide enough.
    """
    resolution_m = grid.resolution_m
    room_m = grid.away_m(np.pad(grid.cells != FREE, 1, constant_values=True))[1:-1, 1:-1]
    stride = max(1, round(PLAN.cell_m / resolution_m))
    places = _reachable(room_m[stride // 2 :: stride, stride // 2 :: stride])
    cells = np.argwhere(places)
    coarse_room_m = room_m[stride // 2 :: stride, stride // 2 :: stride][places]
    graph = _graph(places, coarse_room_m, stride * resolution_m)
    visits = _tour(graph, cells, coarse_room_m, stride * resolution_m)
    fine = cells[visits] * stride + stride // 2
    return grid.centres_of(_pulled_straight(room_m >= PLAN.clearance_m - resolution_m, fine))


def _reachable(room_m: Array) -> Mask:
    """Return the largest connected part that is wide enough."""
    wide = (room_m >= PLAN.clearance_m).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=4)
    if len(stats) < 2:
        raise InputError(
            f'the map has no place with {PLAN.clearance_m} m of room around it to drive'
        )
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _graph(places: Mask, room_m: Array, cell_m: float) -> csr_array:
    """Return the graph of steps between neighbouring places, weighted by their length and by how
    tight it is there.
    """
    tightness = np.clip((PLAN.comfort_m - room_m) / (PLAN.comfort_m - PLAN.clearance_m), 0, 1)
    return graph_of(places, cell_m, 1 + 2 * tightness)


def _tour(graph: csr_array, cells: Cells, room_m: Array, cell_m: float) -> Cells:
    """Return the places visited in order."""
    start = here = int(np.argmax(room_m))
    seen = _within(cells, cells[start], cell_m)
    visits, length_m = [start], 0.0
    while length_m < PLAN.longest_m and not seen.all():
        ways = Ways.from_place(graph, cells, here)
        costs = np.where(seen | ~np.isfinite(ways.cost), np.inf, ways.cost)
        if not np.isfinite(costs).any():
            break
        way = ways.to(int(np.argmin(costs)))
        for place in way:
            seen |= _within(cells, cells[place], cell_m)
        visits += way
        length_m += float(np.hypot(*np.diff(cells[[here, *way]], axis=0).T).sum()) * cell_m
        here = visits[-1]
    return np.array(visits + Ways.from_place(graph, cells, here).to(start))


def _within(cells: Cells, place: Cells, cell_m: float) -> Mask:
    return np.asarray(np.hypot(*(cells - place).T) * cell_m <= PLAN.seen_m)


def _pulled_straight(wide: Mask, cells: Cells) -> Cells:
    """Drop the cells between which the straight line is wide enough; turning points stay."""
    corners, index = [0], 0
    while index < len(cells) - 1:
        ahead = index + 1
        while ahead + 1 < len(cells) and _line_is_wide(wide, cells[index], cells[ahead + 1]):
            ahead += 1
            if np.hypot(*(cells[ahead] - cells[index])) < np.hypot(
                *(cells[ahead - 1] - cells[index])
            ):
                ahead -= 1
                break
        corners.append(ahead)
        index = ahead
    return cells[corners]


def _line_is_wide(wide: Mask, start: Cells, end: Cells) -> bool:
    steps = int(2 * np.hypot(*(end - start))) + 2
    line = np.round(np.linspace(start, end, steps)).astype(np.int64)
    return bool(wide[line[:, 0], line[:, 1]].all())
