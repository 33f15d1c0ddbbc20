"""Maps on disk: round trips, and files that are not what they should be."""

import io
import json
import zipfile

import numpy as np
import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.arrays import MapFile, joined, split
from segfloor_ros.core.files.results import from_bytes, read_map_file, to_bytes, write_map_file


def some_map():
    rng = np.random.default_rng(1)
    return MapFile(
        {'camera': {'width': 640}, 'mount': {'height_m': 0.3}},
        {
            'slam': {'xyz': rng.normal(size=(50, 3)), 'ids': np.arange(50, dtype=np.int32)},
            'grid': {'fan_m': np.zeros(0, np.float16), 'words': rng.integers(0, 9, 7)},
        },
    )


def test_a_map_comes_back_as_it_was_and_its_bytes_repeat(tmp_path):
    path = tmp_path / 'new' / 'building.map'
    write_map_file(path, some_map())
    back = read_map_file(path)
    assert back.header['camera'] == {'width': 640}
    for part, arrays in some_map().parts.items():
        assert set(back.parts[part]) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(back.parts[part][name], array)
            assert back.parts[part][name].dtype == array.dtype
    assert path.read_bytes() == to_bytes(some_map())
    assert [file.name for file in path.parent.iterdir()] == ['building.map']


def test_an_uncompressed_map_is_read_the_same_way():
    back = from_bytes(to_bytes(some_map(), compress=False), 'x')
    np.testing.assert_array_equal(back.parts['slam']['ids'], np.arange(50))
    assert len(to_bytes(some_map(), compress=False)) > len(to_bytes(some_map()))


@pytest.mark.parametrize('share', [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_one_line(share):
    data = to_bytes(some_map())
    with pytest.raises(InputError, match=r'^my\.map: is truncated or damaged') as error:
        from_bytes(data[: int(share * len(data))], 'my.map')
    assert '\n' not in str(error.value)


def test_a_damaged_member_is_told_by_its_checksum():
    data = bytearray(to_bytes(some_map()))
    at = data.find(b'slam/xyz.npy') + 200
    data[at : at + 8] = bytes(8)
    with pytest.raises(InputError, match='damaged'):
        from_bytes(bytes(data), 'my.map')


def archive(header=None):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w') as file:
        if header is not None:
            file.writestr('header.json', json.dumps(header))
        file.writestr('other.txt', 'hello')
    return buffer.getvalue()


def test_another_archive_and_a_newer_map_are_refused():
    for foreign in (archive(), archive({'format': 'something else'}), archive([1, 2])):
        with pytest.raises(InputError, match='no map of segfloor'):
            from_bytes(foreign, 'x.zip')
    newer = archive({'format': 'segfloor map', 'version': 99})
    with pytest.raises(InputError, match='version 99, this release reads version 1'):
        from_bytes(newer, 'x.map')


def test_objects_are_neither_written_nor_read():
    with pytest.raises(ValueError, match=r'[Oo]bject'):
        to_bytes(MapFile({}, {'slam': {'bad': np.array([{}], object)}}))


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / 'folder').mkdir()
    with pytest.raises(InputError, match='cannot be written'):
        write_map_file(tmp_path / 'folder', some_map())
    assert [file.name for file in tmp_path.iterdir()] == ['folder']


def test_arrays_are_joined_and_split():
    parts = [np.arange(3), np.zeros(0, np.int64), np.arange(2)]
    one, lengths = joined(parts, np.zeros(0, np.int64))
    np.testing.assert_array_equal(lengths, [3, 0, 2])
    for a, b in zip(split(one, lengths), parts, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match='5 rows'):
        split(one, lengths + 1)


def with_member(name, content):
    buffer = io.BytesIO(to_bytes(some_map()))
    with zipfile.ZipFile(buffer, 'a', zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    return buffer.getvalue()


def npy(header, data=b''):
    text = f'{header}\n'.encode()
    return b'\x93NUMPY\x01\x00' + len(text).to_bytes(2, 'little') + text + data


@pytest.mark.parametrize(
    'content',
    [
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (9895604649984,)}"),
        npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", bytes(8)),
        npy('(' * 5000),
        b'hello',
        bytes(1 << 28),
    ],
    ids=['72 TiB', 'objects', 'a deep header', 'no array', 'a zip bomb'],
)
def test_an_array_of_more_than_the_file_has_is_refused(content):
    with pytest.raises(InputError, match=r'my\.map: is truncated or damaged'):
        from_bytes(with_member('slam/bad.npy', content), 'my.map')


def test_every_wrong_byte_of_the_directory_is_one_line():
    """The list of members has no checksum: libraries stumble over it in many ways."""
    data = to_bytes(some_map())
    refused = 0
    for at in range(data.find(b'PK\x01\x02'), len(data)):
        damaged = bytearray(data)
        damaged[at] ^= 0xFF
        try:
            from_bytes(bytes(damaged), 'my.map')
        except InputError as error:
            refused += str(error).startswith('my.map: is ')
    assert refused > 100


def test_a_deep_header_is_one_line():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w') as file:
        file.writestr('header.json', '[' * 100_000)
    with pytest.raises(InputError, match=r'x\.map: is no map'):
        from_bytes(buffer.getvalue(), 'x.map')


def test_a_file_of_gigabytes_that_is_no_map_is_not_read(tmp_path):
    with (tmp_path / 'my.map').open('wb') as file:
        file.truncate(1 << 34)
    with pytest.raises(InputError, match=r'my\.map: is truncated or damaged'):
        read_map_file(tmp_path / 'my.map')
