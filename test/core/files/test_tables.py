"""Numbers and stamps in text."""

import numpy as np
import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import (
    END_NS,
    nanoseconds,
    number,
    read_lines,
    read_table,
    whole_nanoseconds,
)


def test_numbers_are_finite_and_plain():
    assert [number(word) for word in ('1', '-2.5', '.5', '3.', '1e-3', '+4E2')] == [
        1.0, -2.5, 0.5, 3.0, 0.001, 400.0,
    ]  # fmt: skip


@pytest.mark.parametrize(
    'word', ['nan', 'inf', '1e400', '²', '١', '1_000', '0x10', '', 'a', '1:30']
)
def test_what_is_no_finite_number_is_refused(word):
    with pytest.raises(ValueError, match='not a finite number'):
        number(word)


def test_stamps_are_exact():
    assert nanoseconds('1403636579.763555527') == 1_403_636_579_763_555_527
    assert nanoseconds('0') == 0
    assert nanoseconds('1e-9') == 1
    assert nanoseconds('1e-999999') == 0
    assert whole_nanoseconds('1403636579763555527') == 1_403_636_579_763_555_527
    assert nanoseconds('2147483647.999999999') == END_NS - 1


@pytest.mark.parametrize(
    'word',
    ['-1', '-99.9', '1403636579763555527', '2147483648', '1e30', '1e999999999', 'nan', '²', 'x'],
)
def test_seconds_that_no_clock_shows_are_refused(word):
    with pytest.raises(ValueError, match='not a'):
        nanoseconds(word)


@pytest.mark.parametrize('word', ['-1', '1403636579.5', '9' * 19, '9' * 5000, '²', '', '1e9'])
def test_nanoseconds_that_no_clock_shows_are_refused(word):
    with pytest.raises(ValueError, match='not a stamp'):
        whole_nanoseconds(word)


def test_lines_are_counted_with_comments(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_bytes(b'\xef\xbb\xbf# t x\r\n\r\n1 2\r\n  # more\n\xff 3\n')
    assert list(read_lines(path)) == [(f'{path}, line 3', '1 2'), (f'{path}, line 5', '\ufffd 3')]


def test_a_table_has_numbers_in_equal_rows(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('# t x\n1 2\n3 4.5\n')
    np.testing.assert_array_equal(read_table(path), [[1, 2], [3, 4.5]])
    for text, message in (
        ('1 2\n3 nan\n', 'line 2: nan: not a finite number'),
        ('1 2\n3\n', 'line 2: has 1 numbers, the first row 2'),
        ('# none\n', 'is empty'),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_table(path)
