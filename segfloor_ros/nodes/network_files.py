"""A segmentation network in an ONNX file, with a YAML file beside it that says how to use it."""

from __future__ import annotations

import math
import typing
from pathlib import Path
from typing import Any

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import check_file
from segfloor_ros.core.plugins.semantics.network import Network, NetworkSettings
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.yaml_files import read_yaml


def open_network(path: Path) -> Network:
    """Return the network of an ONNX file. Raises InputError, in one line, for files that are
    missing, damaged or not understood, and for one whose output is not what its YAML file says.
    """
    if path.suffix != '.onnx':
        raise InputError(f'{path}: is no ONNX file; export the network as NAME.onnx')
    check_file(path)
    described = path.with_suffix('.yaml')
    if not described.is_file():
        raise InputError(f'{described}: is missing; it says what the network sees')
    return Network(path, read_network_settings(described))


def read_network_settings(path: Path) -> NetworkSettings:
    """Read a YAML file. Raises InputError naming the file and what is wrong with it."""
    document = read_yaml(path, 'kind, input and classes of a network')
    types = typing.get_type_hints(NetworkSettings)
    for name in document:
        if name not in types:
            raise InputError(f'{path}: unknown key {name}{suggestion(str(name), list(types))}')
    for name in ('kind', 'input', 'classes'):
        if name not in document:
            raise InputError(f'{path}: {name} is missing')
    try:
        settings = NetworkSettings(**{n: _of_type(types[n], v) for n, v in document.items()})
    except (TypeError, ValueError) as error:
        raise InputError(f'{path}: {error}') from None
    settings.check(path)
    return settings


def _of_type(kind: Any, value: Any) -> Any:
    """Return a value of YAML as a field takes it. Raises ValueError for another type."""
    if typing.get_origin(kind) is list:
        values = value if isinstance(value, list) else [value]
        return [_of_type(typing.get_args(kind)[0], one) for one in values]
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        raise ValueError(f'{value!r} where {kind.__name__} is expected')
    return value
