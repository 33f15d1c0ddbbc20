"""A scene by name, by file, or made from a floor plan."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from segfloor_ros.errors import InputError
from segfloor_ros.settings import suggestion
from segfloor_ros.simulation.floor_plan import is_map_file, scene_of_map
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.scene_file import (
    read_scene_values,
    read_yaml,
    scene_from_mapping,
    shipped_scenes,
)


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
    if is_map_file(read_yaml(file)):
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
        inner[name] = yaml.safe_load(text)
    return result
