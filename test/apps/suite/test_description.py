"""Suites as their files describe them, and every way in which a file can be wrong."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from segfloor_ros.apps.suite.description import SCENE, read_suite
from segfloor_ros.apps.suite.measures import Bound, Slack
from segfloor_ros.core.errors import SettingsError

SUITES = Path(__file__).resolve().parents[3] / 'suites'


def write(folder, text):
    for name in ('a', 'b', 'other', 'o[red]x'):
        (folder / 'bags' / name).mkdir(parents=True, exist_ok=True)
    (folder / 'robot.yaml').write_text('stereo_slam:\n  ros__parameters:\n    num_features: 700\n')
    path = folder / 'nightly.yaml'
    path.write_text(text)
    return path


def test_a_suite_is_read_with_its_defaults(tmp_path):
    suite = read_suite(write(tmp_path, """
        defaults:
          params: robot.yaml
          timeout_s: 60
          set: {occupancy_grid.resolution_m: 0.1}
          expect: {tracked_percent: 99, path_error_m: 0.05}
        recordings:
          - input: bags/a
            expect: {path_error_m: 0.02, keyframes: {min: 3, max: 9}}
          - input: bags/other
            name: the other
            mode: replay
            rate: 2
            set: [occupancy_grid.resolution_m=0.2]
            no_worse_by: {recall_percent: 2, memory_peak_mb: 30 %}
          - simulate: corridor2
            seed: 4
            scene: {camera.width: 160}
        """))  # fmt: skip
    assert suite.name == 'nightly'
    one, other, simulated = suite.entries
    assert (one.name, one.input, one.mode) == ('a', str(tmp_path / 'bags' / 'a'), 'run')
    assert one.timeout_s == 60.0
    assert set(one.bounds) == {
        Bound('tracked_percent', least=99.0),
        Bound('path_error_m', greatest=0.02),
        Bound('keyframes', 3.0, 9.0),
    }
    assert (other.name, other.mode, other.rate) == ('the-other', 'replay', 2.0)
    # The recording's own value comes last, and so wins.
    assert other.assignments[-1] == 'occupancy_grid.resolution_m=0.2'
    assert other.slacks == {
        'recall_percent': Slack(2.0),
        'memory_peak_mb': Slack(0.3, relative=True),
    }
    assert simulated.source == SCENE
    assert (simulated.name, simulated.input) == ('corridor2-4', 'corridor2')
    assert simulated.scene_assignments == ('camera.width=160', 'seed=4')
    assert all(entry.params == str(tmp_path / 'robot.yaml') for entry in suite.entries)


def test_a_folder_whose_name_is_a_pattern_is_that_folder(tmp_path):
    suite = read_suite(write(tmp_path, "recordings:\n  - input: 'bags/o[red]x'\n    name: 1:30\n"))
    assert [(entry.name, entry.input) for entry in suite.entries] == [
        ('1-30', str(tmp_path / 'bags' / 'o[red]x'))
    ]


def test_a_pattern_is_all_it_matches(tmp_path):
    suite = read_suite(write(tmp_path, 'recordings:\n  - input: bags/?\n'))
    assert [entry.name for entry in suite.entries] == ['a', 'b']


def test_drives_in_order_each_continue_the_map_of_the_last(tmp_path):
    text = """
        recordings:
          - input: bags/other
            continue_from: previous
          - input: bags/?
            continue_from: previous
          - input: bags/other
            name: again
            continue_from: a
        """
    suite = read_suite(write(tmp_path, text))
    assert {e.name: e.continue_from for e in suite.entries} == {
        'other': '', 'a': 'other', 'b': 'a', 'again': 'a',
    }  # fmt: skip


@pytest.mark.parametrize(
    ('text', 'line', 'words'),
    [
        (
            'recordings:\n  - input: bags/a\n    expct: {}\n',
            3,
            'unknown expct: did you mean expect',
        ),
        ('recordings:\n  - input: bags/a\n    expect:\n      tracked: 3\n', 4, 'unknown tracked'),
        (
            'recordings:\n  - input: bags/a\n    expect: {path_error_m: near}\n',
            3,
            "'near' is not a",
        ),
        ('recordings:\n  - input: bags/a\n    expect: {keyframes: 3}\n', 3, 'expected {min'),
        ('recordings:\n  - input: bags/no\n', 2, 'no such recording'),
        ('recordings:\n  - input: bags/no*\n', 2, 'matches no recording'),
        ('recordings:\n  - name: x\n', 2, 'expected one of input'),
        ('recordings:\n  - input: bags/a\n  - input: bags/a\n', 3, 'two recordings are called a'),
        ('recordings:\n  - simulate: coridor2\n', 2, 'did you mean corridor2'),
        ('recordings:\n  - simulate: corridor2\n    seed: x\n', 3, 'not a whole number'),
        ('recordings:\n  - input: bags/a\n    seed: 3\n', 3, 'is for simulate'),
        ('recordings:\n  - input: bags/a\n    mode: fast\n', 3, 'not one of run, replay'),
        ('recordings:\n  - input: bags/a\n    truth: nowhere\n', 3, 'does not exist'),
        ('recordings:\n  - input: bags/a\n    timeout_s: 0\n', 3, 'below 1'),
        ('recordings:\n  - input: bags/a\n    set: {stereo_slm.x: 1}\n', 3, 'mean stereo_slam'),
        ('recordings:\n  - input: bags/a\n    no_worse_by: {loops: -1}\n', 3, 'negative'),
        ('defaults: {expect: {recall: 3}}\nrecordings: []\n', 2, 'a list of recordings'),
        ('recordings:\n  - input: bags/a\n    continue_from: b\n', 3, 'no earlier recording'),
        (
            'recordings:\n  - input: bags/a\n  - input: bags/b\n    mode: replay\n'
            '    continue_from: a\n',
            5,
            'b is not mapped by mode run',
        ),
        ('recordings:\n  - input: [\n', 3, ''),
        ('recordings:\n  - simulate: corridor2\n    seed: -1\n', 2, 'seed: -1 is not within 0'),
        ('recordings:\n  - input: bags/a\n    timeout_s: .inf\n', 3, 'inf is not a number'),
        ('recordings:\n  - input: bags/a\n    rate: .nan\n', 3, 'nan is not a number'),
        (
            'recordings:\n  - input: bags/a\n    expect: {loops: {min: 3, max: 1}}\n',
            3,
            'min 3 > max 1',
        ),
        ('recordings:\n  - input: bags/a\n    expect: {tracked_percent: .nan}\n', 3, 'nan is not'),
        (
            'recordings:\n  - input: bags/a\n    expect: {tracked_percent: 1:30}\n',
            3,
            "'1:30' is not",
        ),
        ('', 1, 'expected name, defaults, recordings'),
    ],
)
def test_a_bad_suite_is_named_with_its_line(tmp_path, text, line, words):
    path = write(tmp_path, text)
    with pytest.raises(SettingsError, match=re.escape(f'{path}, line {line}: ')) as caught:
        read_suite(path)
    assert words in str(caught.value)


def test_a_suite_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r'no\.yaml: cannot be read'):
        read_suite(tmp_path / 'no.yaml')


# Public benchmarks

BENCHMARK = """
    published:
      Other: a paper, table I; rigid alignment
    defaults: {no_map: true}
    recordings:
      - input: one
        published: {Other: 0.035}
      - input: two
      - input: three
        truth: three/truth.txt
    """


def test_recordings_that_are_not_in_the_folder_of_data_are_named(tmp_path):
    suite, data = write(tmp_path, BENCHMARK), tmp_path / 'data'
    for name in ('one', 'two'):
        (data / name).mkdir(parents=True)
    found = read_suite(suite, data)
    assert [entry.input for entry in found.entries] == [str(data / 'one'), str(data / 'two')]
    assert found.missing == ('three',)
    assert found.published == {'Other': 'a paper, table I; rigid alignment'}
    assert [entry.published for entry in found.entries] == [{'Other': 0.035}, {}]
    assert all(entry.no_map for entry in found.entries)
    with pytest.raises(SettingsError, match='no such recording'):
        read_suite(suite)
    with pytest.raises(SettingsError, match=r'has none of the recordings of .*, e.g. one'):
        read_suite(suite, tmp_path / 'bags')
    with pytest.raises(SettingsError, match='line 7: unknown Anther'):
        read_suite(write(tmp_path, BENCHMARK.replace('published: {O', 'published: {An')), data)


def test_what_published_figures_measure_is_one_of_two(tmp_path):
    data = tmp_path / 'data'
    (data / 'one').mkdir(parents=True)
    assert read_suite(write(tmp_path, BENCHMARK), data).published_measure == 'path_error_m'
    lengths = BENCHMARK + 'published_measure: '
    found = read_suite(write(tmp_path, lengths + 'length_m'), data)
    assert found.published_measure == 'length_m'
    with pytest.raises(SettingsError, match='published_measure: speed is none of path_error_m, le'):
        read_suite(write(tmp_path, lengths + 'speed'), data)


@pytest.mark.parametrize('path', sorted(SUITES.glob('*.yaml')), ids=lambda path: path.stem)
def test_the_shipped_suites_can_be_read(path, tmp_path):
    for item in (described := yaml.safe_load(path.read_text()))['recordings']:
        if 'input' in item:
            (tmp_path / item['input']).mkdir()
        if 'truth' in item:
            (tmp_path / item['truth']).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / item['truth']).touch()
    suite = read_suite(path, tmp_path)
    assert len(suite.entries) == len(described['recordings']) and not suite.missing
    assert all('rigid alignment' in source for source in suite.published.values())
    assert {name for entry in suite.entries for name in entry.published} == set(suite.published)
    assert 'https://' in described['about']
