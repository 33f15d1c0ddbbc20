"""YAML whose values know their lines, so that an error can name the line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from segfloor_ros.errors import SettingsError

Key = tuple[str | int, ...]
"""Where a value is: names of entries and numbers of list items from the top."""


@dataclass(frozen=True)
class MarkedYaml:
    """A file's values as plain mappings, lists and scalars, and the line of each."""

    path: Path
    values: Any
    lines: dict[Key, int] = field(default_factory=dict)

    def error(self, key: Key, message: str) -> SettingsError:
        """Return an error about the value at a key; of a missing one, about what would hold it."""
        while key and key not in self.lines:
            key = key[:-1]
        return SettingsError(f'{self.path}, line {self.lines.get(key, 1)}: {message}')


def read_marked_yaml(path: Path) -> MarkedYaml:
    """Read a YAML file. Raises SettingsError naming the file and the line that is malformed."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise SettingsError(f'{path}: cannot be read ({reason})') from None
    lines: dict[Key, int] = {}
    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()
        values = _values(loader, node, (), lines) if node is not None else None
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        problem = getattr(error, 'problem', None) or 'not valid YAML'
        raise SettingsError(f'{path}, line {mark.line + 1 if mark else 1}: {problem}') from None
    finally:
        loader.dispose()
    return MarkedYaml(path, values, lines)


def _values(loader: yaml.SafeLoader, node: yaml.Node, key: Key, lines: dict[Key, int]) -> Any:
    lines[key] = node.start_mark.line + 1
    if isinstance(node, yaml.SequenceNode):
        return [_values(loader, item, (*key, i), lines) for i, item in enumerate(node.value)]
    if not isinstance(node, yaml.MappingNode):
        return loader.construct_object(node)
    loader.flatten_mapping(node)
    result = {}
    for name_node, item in node.value:
        name = str(loader.construct_object(name_node, deep=True))
        result[name] = _values(loader, item, (*key, name), lines)
        lines[(*key, name)] = name_node.start_mark.line + 1
    return result
