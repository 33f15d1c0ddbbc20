"""Labelled points in PLY files (binary, little endian)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from segfloor_ros.core.contracts import LabelledPoints
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import read_bytes

VERTEX = np.dtype(
    [
        ('x', '<f4'),
        ('y', '<f4'),
        ('z', '<f4'),
        ('id', '<i4'),
        ('label', 'u1'),
        ('confidence', '<f4'),
    ]
)

_PLY_TYPES = {'f4': 'float', 'i4': 'int', 'u1': 'uchar'}


def _header(count: int) -> bytes:
    lines = ['ply', 'format binary_little_endian 1.0', 'comment frame map, metres']
    lines.append('comment label 0 unknown, 1 floor, 2 obstacle')
    lines.append(f'element vertex {count}')
    names = VERTEX.names or ()
    lines += [f'property {_PLY_TYPES[VERTEX[name].str[1:]]} {name}' for name in names]
    return ('\n'.join([*lines, 'end_header']) + '\n').encode()


def write_ply(path: Path, points: LabelledPoints) -> None:
    """Write the points with x y z id label confidence, frame `map`, metres."""
    vertices = np.zeros(len(points.point_id), VERTEX)
    for axis, name in enumerate('xyz'):
        vertices[name] = points.xyz_map[:, axis]
    vertices['id'] = points.point_id
    vertices['label'] = points.label
    vertices['confidence'] = points.confidence
    path.write_bytes(_header(len(vertices)) + vertices.tobytes())


def read_ply(path: Path) -> LabelledPoints:
    """Read a file of `write_ply`. Raises InputError naming the file when it is not one."""
    content = read_bytes(path)
    head, mark, body = content.partition(b'end_header\n')
    count = len(body) // VERTEX.itemsize
    if not mark or head + mark != _header(count) or len(body) != count * VERTEX.itemsize:
        raise InputError(f'{path}: not a whole labelled cloud')
    vertices = np.frombuffer(body, VERTEX)
    return LabelledPoints(
        point_id=vertices['id'].astype(np.int32),
        xyz_map=np.stack([vertices[name] for name in 'xyz'], axis=1).astype(np.float32),
        label=vertices['label'].copy(),
        confidence=vertices['confidence'].astype(np.float32),
    )
