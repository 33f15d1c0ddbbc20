"""YAML files: their values, their lines, and what they may cost."""

import math
import time

import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.yaml_files import MAX_YAML_BYTES, read_marked_yaml, read_yaml, yaml_value


def read(tmp_path, text):
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    return read_yaml(path, 'names')


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1e-3', 0.001),
        ('1E5', 100_000.0),
        ('-.5', -0.5),
        ('12', 12),
        ('0x1F', 31),
        ('1:30', '1:30'),
        ('1:30.5', '1:30.5'),
        ('2024-01-31', '2024-01-31'),
        ('2024-13-45', '2024-13-45'),
        ('²', '²'),
        ('08', '08'),
        ('yes', True),
        ('', None),
        ('~', None),
        ("'3'", '3'),
        ('.inf', math.inf),
        ('[1, {a: b}]', [1, {'a': 'b'}]),
    ],
)
def test_scalars_are_those_of_parameter_files(text, value):
    found = yaml_value(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    'text',
    ['1e400', '9223372036854775808', '0x' + 5000 * 'f', 5000 * '9', '!!int abc', '!!timestamp x',
     '!!python/name:os.system', '[' * 2000, '{a: 1, a: 2}', '{[1]: 2}', '{<<: 3}', '&a [*a]',
     '*none', '- a\nb', '\0'],
)  # fmt: skip
def test_what_is_no_value_is_refused(text):
    with pytest.raises(ValueError, match=r'^[^\n]+$'):
        yaml_value(text)


def test_entries_know_their_lines_and_merges_give_way(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_text('base: &b {x: 1, y: 2}\nderived:\n  y: 3\n  <<: *b\n  on: 4\n')
    marked = read_marked_yaml(path)
    assert marked.values['derived'] == {'x': 1, 'y': 3, 'on': 4}
    assert str(marked.error(('derived', 'y'), 'bad')) == f'{path}, line 3: bad'
    assert str(marked.error(('derived', 'none'), 'bad')) == f'{path}, line 2: bad'


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('a: 1\nb: 2\na: 3\n', 'line 3: a is given twice'),
        ('a: 1\nb: [\n', 'line 3: not valid YAML'),
        ('a:\n  - 1e999\n', 'line 2: 1e999 is larger than any number'),
        ('a: 1\n<<: 3\n', 'line 2: << takes over a mapping'),
        ('a: 1\n? [1]\n: 2\n', 'line 2: a list or mapping cannot be'),
        ('a: &x [*x]\n', 'line 1: has too many values, or aliases that hold themselves'),
        ('- 1\n', 'expected names'),
        ('', 'expected names'),
        ('a: b\0c\n', 'not valid YAML'),
    ],
)
def test_a_bad_file_is_named_with_its_line(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert message in str(error.value)
    assert str(tmp_path / 'a.yaml') in str(error.value)
    assert '\n' not in str(error.value)


def test_what_a_file_costs_is_bounded(tmp_path):
    """An alias bomb, mappings in mappings, and the most values that a file can name."""
    bomb = 'a0: &a0 [0]\n' + ''.join(
        f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 9)}]\n' for i in range(1, 12)
    )
    start_s = time.monotonic()
    for text in (bomb, 'a: ' + '{a: ' * 5000, 'a:\n' + '- \n' * 1000 + '- ' * 1000):
        with pytest.raises(InputError, match=r'too many values|nested too deeply'):
            read(tmp_path, text)
    assert time.monotonic() - start_s < 10
    with pytest.raises(InputError, match=r'more than 0\.3 MB'):
        read(tmp_path, 'a: ' + MAX_YAML_BYTES * 'x')
    assert len(read(tmp_path, f'a: [{", ".join(["1"] * 20_000)}]')['a']) == 20_000


def test_a_file_of_opencv_is_read(tmp_path):
    assert read(tmp_path, '%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n') == {'K': {'rows': 3}}
