"""YAML: files and single values, as plain mappings, lists and scalars that know their lines.

Scalars are those of YAML 1.2 and of ROS parameter files: `1e-3` is a number, `1:30` and a date are
text. What a file may cost is bounded: its size, its depth, and the values it has when all aliases
are written out.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from segfloor_ros.core.errors import InputError, SegfloorError
from segfloor_ros.core.files.whole import read_text, shortened

MAX_YAML_BYTES, MAX_DEPTH = 1 << 18, 40

Key = tuple[str | int, ...]
"""Where a value is: names of entries and numbers of list items from the top."""

_TAG = 'tag:yaml.org,2002:'

_KEPT = tuple(f'{_TAG}{name}' for name in ('bool', 'null', 'merge'))


@dataclass(frozen=True)
class MarkedYaml:
    """A file's values as plain mappings (with texts for keys), lists and scalars, and the line of
    each.
    """

    path: Path
    values: Any
    lines: dict[Key, int] = field(default_factory=dict)
    error_type: type[SegfloorError] = InputError

    def error(self, key: Key, message: str) -> SegfloorError:
        """Return an error about the value at a key; of a missing one, about what would hold it."""
        while key and key not in self.lines:
            key = key[:-1]
        return self.error_type(f'{self.path}, line {self.lines.get(key, 1)}: {message}')


def read_marked_yaml(path: Path, error_type: type[SegfloorError] = InputError) -> MarkedYaml:
    """Read a YAML file. Raises an error of a type that names the file and the line that is
    malformed.
    """
    # OpenCV and EuRoC files begin with `%YAML:1.0`, which is not a directive YAML knows.
    # Their matrices have a tag of their own.
    text = re.sub('(?m)^%YAML:', '#', read_text(path, error_type, MAX_YAML_BYTES))
    text = text.replace('!!opencv-matrix', '')
    lines: dict[Key, int] = {}
    try:
        return MarkedYaml(path, _parsed(text, lines), lines, error_type)
    except _YamlError as error:
        raise error_type(f'{path}, line {error.line}: {error}') from None


def read_yaml(
    path: Path, expected: str, error_type: type[SegfloorError] = InputError
) -> dict[str, Any]:
    """Return the mapping that a YAML file holds. expected: what it should be, in words. Raises an
    error of a type that names the file and what is wrong with it.
    """
    document = read_marked_yaml(path, error_type).values
    if not isinstance(document, dict):
        raise error_type(f'{path}: expected {expected}')
    return document


def yaml_value(text: str) -> Any:
    """Return the value that a text is in YAML, e.g. of `--set`. Raises ValueError."""
    return _parsed(text, {})


class _YamlError(ValueError):
    """What is wrong with a text, and in which of its lines."""

    def __init__(self, message: str, line: int) -> None:
        super().__init__(message)
        self.line = line


class _Loader(yaml.SafeLoader):
    """Composes nodes up to a depth."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _YamlError('is nested too deeply', self.peek_event().start_mark.line + 1)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in forms if tag in _KEPT]
    for first, forms in yaml.SafeLoader.yaml_implicit_resolvers.items()
}

_Loader.add_implicit_resolver(
    f'{_TAG}int',
    re.compile('[-+]?(?:0b[01_]+|0x[0-9a-fA-F_]+|0o?[0-7_]+|0|[1-9][0-9_]*)$'),
    list('-+0123456789'),
)

_Loader.add_implicit_resolver(
    f'{_TAG}float',
    re.compile(
        r'[-+]?(?:\.[0-9]+|[0-9][0-9_]*\.[0-9]*)(?:[eE][-+]?[0-9]+)?$'
        r'|[-+]?[0-9]+[eE][-+]?[0-9]+$|[-+]?\.(?:inf|Inf|INF)$|\.(?:nan|NaN|NAN)$'
    ),
    list('-+0123456789.'),
)


def _parsed(text: str, lines: dict[Key, int]) -> Any:
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        problem = getattr(error, 'problem', None) or getattr(error, 'reason', None)
        line = mark.line if mark else text.count('\n', 0, getattr(error, 'position', 0))
        raise _YamlError(
            'not valid YAML' + (f' ({problem})' if problem else ''), line + 1
        ) from None
    return _Values(loader, lines).of(node, ()) if node is not None else None


class _Values:
    """Makes values of nodes; an alias is made anew wherever it stands."""

    def __init__(self, loader: _Loader, lines: dict[Key, int]) -> None:
        self._loader = loader
        self._lines = lines
        self._count = 0

    def of(self, node: yaml.Node, key: Key) -> Any:
        """Return the value of a node at a key."""
        self._lines[key] = line = node.start_mark.line + 1
        self._count += 1
        if len(key) > MAX_DEPTH or self._count > MAX_YAML_BYTES:
            raise _YamlError('has too many values, or aliases that hold themselves', line)
        if isinstance(node, yaml.SequenceNode):
            return [self.of(item, (*key, i)) for i, item in enumerate(node.value)]
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, key)
        return self._scalar(node, line)

    def _mapping(self, node: yaml.MappingNode, key: Key) -> dict[str, Any]:
        found: dict[str, Any] = {}
        merged: dict[str, Any] = {}
        for name_node, item in node.value:
            line = name_node.start_mark.line + 1
            if not isinstance(name_node, yaml.ScalarNode):
                raise _YamlError('a list or mapping cannot be the name of a value', line)
            name = str(name_node.value)
            if name_node.tag == f'{_TAG}merge':
                for values in self._merged(item, key, line):
                    merged = values | merged
                continue
            if name in found:
                raise _YamlError(f'{name} is given twice', line)
            found[name] = self.of(item, (*key, name))
            self._lines[(*key, name)] = line
        return merged | found

    def _merged(self, node: yaml.Node, key: Key, line: int) -> list[dict[str, Any]]:
        """Return what `<<` takes over: a mapping, or several of which the first wins."""
        values = self.of(node, (*key, '<<'))
        found = values if isinstance(values, list) else [values]
        if not all(isinstance(value, dict) for value in found):
            raise _YamlError('<< takes over a mapping, or a list of them', line)
        return found

    def _scalar(self, node: yaml.Node, line: int) -> Any:
        kind, text = node.tag.removeprefix(_TAG), str(node.value)
        if kind in ('str', 'merge', '!'):
            return text
        if kind not in ('int', 'float', 'bool', 'null'):
            raise _YamlError(f'the tag {node.tag} is not taken', line)
        try:
            value = getattr(self._loader, f'construct_yaml_{kind}')(node)
        except (ValueError, KeyError, IndexError, AttributeError, yaml.YAMLError):
            raise _YamlError(f'{shortened(text)} is no {kind}', line) from None
        whole = np.iinfo(np.int64)  # as ROS parameters
        too_large = kind == 'int' and not whole.min <= value <= whole.max
        if too_large or (kind == 'float' and math.isinf(value) and 'n' not in text.lower()):
            raise _YamlError(f'{shortened(text)} is larger than any number here', line)
        return value
