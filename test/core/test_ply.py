from pathlib import Path

import numpy as np
import pytest

from segfloor_ros.apps.ply import read_ply, write_ply
from segfloor_ros.core.contracts import LabelledPoints
from segfloor_ros.core.errors import InputError

POINTS = LabelledPoints(
    point_id=np.array([3, 70000], np.int32),
    xyz_map=np.array([[1.5, -2.0, 0.25], [0.0, 4.0, -1.0]], np.float32),
    label=np.array([2, 1], np.uint8),
    confidence=np.array([0.5, 1.0], np.float32),
)


def test_round_trip(tmp_path: Path) -> None:
    write_ply(tmp_path / 'c.ply', POINTS)
    loaded = read_ply(tmp_path / 'c.ply')
    np.testing.assert_array_equal(loaded.point_id, POINTS.point_id)
    np.testing.assert_array_equal(loaded.xyz_map, POINTS.xyz_map)
    np.testing.assert_array_equal(loaded.label, POINTS.label)
    np.testing.assert_array_equal(loaded.confidence, POINTS.confidence)


def test_bytes_of_a_vertex(tmp_path: Path) -> None:
    write_ply(tmp_path / 'c.ply', POINTS)
    head, _, body = (tmp_path / 'c.ply').read_bytes().partition(b'end_header\n')
    assert head.splitlines()[:2] == [b'ply', b'format binary_little_endian 1.0']
    assert b'element vertex 2' in head
    names = [line.split()[-1] for line in head.splitlines() if line.startswith(b'property')]
    assert names == [b'x', b'y', b'z', b'id', b'label', b'confidence']
    # 1.5, -2.0 and 0.25 as IEEE 754 single precision, 3 as int32, 2 as a byte, then 0.5.
    expected = '0000c03f000000c00000803e03000000020000003f'
    assert body[:21].hex() == expected
    assert len(body) == 42


def test_broken_files_are_refused_by_name(tmp_path: Path) -> None:
    write_ply(tmp_path / 'c.ply', POINTS)
    whole = (tmp_path / 'c.ply').read_bytes()
    (tmp_path / 'c.ply').write_bytes(whole[:-1])
    with pytest.raises(InputError, match=r'c\.ply'):
        read_ply(tmp_path / 'c.ply')
    with pytest.raises(InputError, match=r'gone\.ply: cannot be read'):
        read_ply(tmp_path / 'gone.ply')
