"""A scene by name, by file (YAML with the fields of `scene.Scene`), or from a floor plan."""

from __future__ import annotations

import copy
import dataclasses
import typing
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

from segfloor_ros.errors import InputError
from segfloor_ros.files.yaml_files import read_yaml, shortened, yaml_value
from segfloor_ros.settings import suggestion
from segfloor_ros.simulation import scene as scene_module
from segfloor_ros.simulation.floor_plan import is_map_file, scene_of_map
from segfloor_ros.simulation.scene import Scene

EXPECTED = 'names and values, e.g. `walls:`'


def shipped_scenes() -> dict[str, Path]:
    """Return the scene files that come with the package, by name."""
    folder = Path(str(resources.files('segfloor_ros.simulation') / 'scenes'))
    return {file.stem: file for file in sorted(folder.glob('*.yaml'))}


def read_scene_values(path: Path) -> dict[str, Any]:
    """Return what a scene file says. `like: NAME` takes over everything from a shipped scene that
    the file does not say itself; lists are replaced as a whole. Raises InputError.
    """
    values = read_yaml(path, EXPECTED)
    if 'like' not in values:
        return values
    name, shipped = str(values.pop('like')), shipped_scenes()
    if name not in shipped or shipped[name] == path:
        raise InputError(f'{path}: like: {name} is no shipped scene{suggestion(name, [*shipped])}')
    return _merged(read_scene_values(shipped[name]), values)


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
    return kind(**{name: _build(types[name], v, f'{where}, {name}') for name, v in value.items()})


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
    path = Path(name)
    shipped = shipped_scenes()
    if not path.exists() and name not in shipped:
        raise InputError(f'{name}: no such scene or file{suggestion(name, list(shipped))}')
    file = path if path.exists() else shipped[name]
    if file.is_dir():
        raise InputError(f'{name}: is a folder; name a scene file or a map YAML')
    if is_map_file(read_yaml(file, EXPECTED)):
        values = scene_of_map(file, assigned({}, assignments))
    else:
        values = read_scene_values(file)
    return scene_from_mapping(assigned(values, assignments), name)


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
