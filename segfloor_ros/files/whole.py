"""Files as bytes, text and JSON, and as tables of numbers and stamps in text: one row per line,
words parted by blanks or commas.

YAML: files and single values, as plain mappings, lists and scalars that know their lines.

Scalars are those of YAML 1.2 and of ROS parameter files: `1e-3` is a number, `1:30` and a date are
text. What a file may cost is bounded: its size, its depth, and the values it has when all aliases
are written out.
"""

from __future__ import annotations

import json
import math
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros.errors import InputError, SegfloorError

MAX_BYTES = 1 << 28
"""Of a file that is read whole: an hour of an IMU at 1 kHz has about as many."""

END_NS = 2**31 * 10**9
"""Stamps are before this and not before 0: what `builtin_interfaces/Time` can say."""

_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?', re.ASCII)

MAX_YAML_BYTES, MAX_DEPTH = 1 << 18, 40
Key = tuple[str | int, ...]
"""Where a value is: names of entries and numbers of list items from the top."""

_TAG = 'tag:yaml.org,2002:'
_KEPT = tuple(f'{_TAG}{name}' for name in ('bool', 'null', 'merge'))


def user_path(name: str | Path, error_type: type[SegfloorError] = InputError) -> Path:
    """Return the path of a name that a user gives, with `~` and `~user` for home folders. Raises an
    error of a type for a name that cannot be one.
    """
    if '\0' in str(name):
        raise error_type(f'{name}: a name holds no null character')
    try:
        return Path(name).expanduser()
    except RuntimeError:
        raise error_type(f'{name}: there is no such user; write the whole path') from None


def check_file(path: Path, error_type: type[SegfloorError] = InputError) -> int:
    """Return the size of a file in bytes. Raises an error of a type for what is missing, a folder,
    a FIFO or a device: reading one of these may never end.
    """
    try:
        facts = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        reason = getattr(error, 'strerror', None) or error
        raise error_type(f'{path}: cannot be read ({reason})') from None
    if not stat.S_ISREG(facts.st_mode):
        what = 'a folder' if stat.S_ISDIR(facts.st_mode) else 'a device or pipe'
        raise error_type(f'{path}: cannot be read (is {what}, not a file)')
    return facts.st_size


def read_bytes(
    path: Path, error_type: type[SegfloorError] = InputError, at_most: int = MAX_BYTES
) -> bytes:
    """Return what a file holds. Raises an error of a type, also for more than `at_most` bytes."""
    if check_file(path, error_type) > at_most:
        raise error_type(f'{path}: has more than {at_most / 1e6:.1f} MB; is it the right file?')
    try:
        return path.read_bytes()
    except OSError as error:
        raise error_type(f'{path}: cannot be read ({error.strerror})') from None


def read_text(
    path: Path, error_type: type[SegfloorError] = InputError, at_most: int = MAX_BYTES
) -> str:
    """Return the text of a file in UTF-8. Raises an error of a type."""
    try:
        return read_bytes(path, error_type, at_most).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise error_type(f'{path}, byte {error.start}: is not UTF-8; save it as that') from None


def read_json(path: Path, expected: str) -> dict[str, Any]:
    """Return the object that a JSON file holds. expected: what it should be, in words. Raises
    InputError.
    """
    document = json_object(read_text(path))
    if document is None:
        raise InputError(f'{path}: not {expected}: no object in JSON')
    return document


def json_object(text: str | bytes) -> dict[str, Any] | None:
    """Return the object that a JSON text is, None where it is none."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def number(word: str) -> float:
    """Return the finite number that a word is. Raises ValueError."""
    value = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise ValueError(f'{word[:40]}: not a finite number')
    return value


def nanoseconds(seconds: str) -> int:
    """Return a time in seconds, as text, in ns, exactly. Raises ValueError for what is no stamp."""
    value = Decimal(seconds) if -1 < number(seconds) < 1e10 else Decimal(-1)
    return checked_ns(int(value.scaleb(9).to_integral_value()), seconds)


def whole_nanoseconds(word: str) -> int:
    """Return a stamp in ns. Raises ValueError for what is none."""
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise ValueError(f'{word[:40]}: not a stamp in ns')
    return checked_ns(int(word), word)


def checked_ns(stamp_ns: int, word: str) -> int:
    """Return a stamp in ns. Raises ValueError for one that no clock shows."""
    if not 0 <= stamp_ns < END_NS:
        raise ValueError(f'{word[:40]}: not a stamp from 0 to {END_NS // 10**9} s')
    return stamp_ns


def read_lines(
    path: Path, error_type: type[SegfloorError] = InputError
) -> Iterator[tuple[str, str]]:
    """Yield the lines of a text, and what to call each in a message; without empty ones and
    comments (`#`). Bytes that are no text stay in their lines, where they are no numbers. Raises an
    error of a type.
    """
    text = read_bytes(path, error_type).decode('utf-8-sig', errors='replace')
    for number_of_line, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith('#'):
            yield f'{path}, line {number_of_line}', line


def read_table(path: Path) -> NDArray[np.float64]:
    """Return the numbers of a text file (rows, columns), all finite. Raises InputError."""
    rows: list[list[float]] = []
    for where, line in read_lines(path):
        words = line.partition('#')[0].split()
        try:
            rows.append([number(word) for word in words])
        except ValueError as error:
            raise InputError(f'{where}: {error}') from None
        if len(rows[-1]) != len(rows[0]):
            raise InputError(f'{where}: has {len(words)} numbers, the first row {len(rows[0])}')
    if not rows:
        raise InputError(f'{path}: is empty')
    return np.array(rows, np.float64)


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
    text = re.sub('(?m)^%YAML:', '#', read_text(path, error_type, MAX_YAML_BYTES))
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


def shortened(text: str) -> str:
    """Return a text that may be long, for a message."""
    return text if len(text) <= 40 else f'{text[:37]}…'
