"""Files that are read whole: what is no file, too large or no text is refused in one line."""

import os

import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import MAX_BYTES, check_file, read_bytes, read_json, read_text


def test_a_file_comes_back_without_its_byte_order_mark(tmp_path):
    path = tmp_path / 'text'
    path.write_bytes(b'\xef\xbb\xbfgr\xc3\xbcn')
    assert read_text(path) == 'grün'
    assert read_bytes(path) == b'\xef\xbb\xbfgr\xc3\xbcn'
    assert check_file(path) == 8


def test_what_may_never_end_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'link').symlink_to('/dev/zero')
    for name in ('pipe', 'link'):
        with pytest.raises(InputError, match=f'{name}: cannot be read .* device or pipe'):
            read_bytes(tmp_path / name)
    with pytest.raises(InputError, match=r'is a folder, not a file'):
        read_bytes(tmp_path)
    with pytest.raises(InputError, match=r'none: cannot be read \(No such file'):
        read_bytes(tmp_path / 'none')
    (tmp_path / 'loop').symlink_to('loop')
    with pytest.raises(InputError, match=r'loop: cannot be read'):
        read_bytes(tmp_path / 'loop')


def test_a_file_that_is_too_large_is_refused_before_it_takes_memory(tmp_path):
    with (tmp_path / 'sparse').open('wb') as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match=r'sparse: has more than 268\.4 MB'):
        read_bytes(tmp_path / 'sparse')
    (tmp_path / 'small').write_bytes(b'12345')
    with pytest.raises(InputError, match='small: has more than'):
        read_bytes(tmp_path / 'small', at_most=4)


@pytest.mark.parametrize('text', ['', '[1]', '{', '[' * 100_000, '{"a": 1' + 5000 * '0' + '}'])
def test_json_that_is_no_object_is_refused(tmp_path, text):
    path = tmp_path / 'a.json'
    path.write_text(text)
    with pytest.raises(InputError, match=r'a\.json: not a baseline'):
        read_json(path, 'a baseline')
    path.write_text('{"a": [1, 2.5]}')
    assert read_json(path, 'a baseline') == {'a': [1, 2.5]}
