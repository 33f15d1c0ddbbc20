"""Settings: declaration, checks, and the order defaults < file < command line."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.settings import StageSettings, setting
from segfloor_ros.nodes.configuration import STAGE_SETTINGS, resolve

REPOSITORY = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class TwoWordSettings(StageSettings):
    size_m: float = setting(0.5, 'A size.', unit='m', within=(0.1, 2.0), live=True)
    count: int = setting(3, 'A count.', within=(1, 9))
    kind: str = setting('a', 'A kind.', choices=('a', 'b'))
    fast: bool = setting(False, 'A switch.')
    height_m: float = setting(float('nan'), 'Measured when not given.', within=(0.0, 9.0))


def test_stage_name_comes_from_the_class():
    assert TwoWordSettings.stage_name() == 'two_word'
    assert list(STAGE_SETTINGS) == [
        'stereo_camera',
        'stereo_slam',
        'floor_segmentation',
        'cloud_labelling',
        'occupancy_grid',
    ]


def test_whole_numbers_serve_as_floats_and_nothing_else_is_converted():
    assert TwoWordSettings(size_m=1).size_m == 1.0
    assert isinstance(TwoWordSettings(size_m=1).size_m, float)
    for bad in ({'size_m': '1'}, {'count': 1.5}, {'count': True}, {'fast': 1}, {'kind': 3}):
        with pytest.raises(SettingsError, match='expected'):
            TwoWordSettings(**bad)


@pytest.mark.parametrize(
    ('bad', 'words'),
    [
        ({'size_m': 5.0}, ['two_word.size_m', '5.0', '0.1 to 2 m']),
        ({'count': 0}, ['two_word.count', '0', '1 to 9']),
        ({'kind': 'c'}, ['two_word.kind', "'c'", 'one of a, b']),
        ({'size_m': math.inf}, ['two_word.size_m', 'finite']),
        ({'size_m': math.nan}, ['two_word.size_m', 'nan']),
    ],
)
def test_errors_name_parameter_value_and_range(bad, words):
    with pytest.raises(SettingsError) as error:
        TwoWordSettings(**bad)
    for word in words:
        assert word in str(error.value)


def test_not_a_number_means_not_given_only_where_it_is_the_default():
    assert math.isnan(TwoWordSettings().height_m)
    assert TwoWordSettings(height_m=0.3).height_m == 0.3


@pytest.mark.parametrize(
    ('stage', 'name', 'why'),
    [
        ('stereo_slam', 'keyframe_turn_rad', 'constant'),
        ('cloud_labelling', 'height_sigma_m', 'constant'),
        ('occupancy_grid', 'max_hit_error_m', 'follows from resolution_m'),
        ('stereo_slam', 'bit_depth', 'brightest pixel'),
        ('stereo_camera', 'jpeg_quality', 'constant'),
        ('floor_segmentation', 'num_disparities', 'camera and mount'),
    ],
)
def test_settings_of_earlier_versions_are_named_as_gone(tmp_path, stage, name, why):
    file = tmp_path / 'old.yaml'
    for node in (stage, '/**'):
        file.write_text(f'{node}:\n  ros__parameters:\n    {name}: 0.1\n')
        with pytest.raises(SettingsError, match=f'{name}: it is gone, .*{why}.*; remove it'):
            resolve(file)


def test_unknown_names_get_a_suggestion():
    with pytest.raises(SettingsError, match=r'two_word.siz_m: did you mean size_m'):
        TwoWordSettings.from_mapping({'siz_m': 1.0})


def test_replaced_checks_like_the_original():
    assert TwoWordSettings().replaced(count=7).count == 7
    with pytest.raises(SettingsError, match='out of range'):
        TwoWordSettings().replaced(count=-7)


@pytest.mark.parametrize('stage', list(STAGE_SETTINGS.values()))
def test_every_setting_is_described_and_its_default_is_valid(stage):
    stage()
    for spec in stage.specs():
        assert spec.description.endswith('.'), spec.name


def test_command_line_beats_file_beats_default(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text('occupancy_grid:\n  ros__parameters:\n    resolution_m: 0.1\n')
    assert resolve().occupancy_grid.resolution_m == 0.05
    assert resolve(file).occupancy_grid.resolution_m == 0.1
    both = resolve(file, ['occupancy_grid.resolution_m=0.02'])
    assert both.occupancy_grid.resolution_m == 0.02
    assert both.stereo_slam == resolve().stereo_slam


def test_wildcard_and_foreign_nodes_in_a_file(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    use_sim_time: true\n    camera_height_m: 0.4\n'
        '/robot/stereo_slam:\n  ros__parameters:\n    num_features: 900\n'
        'planner_server:\n  ros__parameters:\n    anything: 1\n'
    )
    slam = resolve(file).stereo_slam
    assert (slam.camera_height_m, slam.num_features) == (0.4, 900)


def test_written_settings_read_back_to_the_same(tmp_path):
    first = resolve(None, ['stereo_slam.num_features=777', 'stereo_slam.camera_height_m=0.25'])
    file = tmp_path / 'settings.yaml'
    file.write_text(yaml.safe_dump(first.as_ros_parameters()))
    again = resolve(file)
    assert again.stereo_slam.num_features == 777
    assert again.stereo_slam.camera_height_m == 0.25
    assert math.isnan(again.stereo_slam.camera_pitch_rad)
    assert again.occupancy_grid == first.occupancy_grid


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('stereo_slam: [1, 2', 'line 1: not valid YAML'),
        ('- a\n- b\n', 'expected node names'),
        ('stereo_slam:\n  num_features: 3\n', 'stereo_slam has no ros__parameters'),
        ('/**:\n  ros__parameters:\n    camera_hight_m: 1.0\n', 'camera_hight_m'),
        ('stereo_slam:\n  ros__parameters:\n    num_feature: 3\n', 'did you mean num_features'),
    ],
)
def test_bad_parameter_files_are_refused_in_one_line(tmp_path, text, words):
    file = tmp_path / 'params.yaml'
    file.write_text(text)
    with pytest.raises(SettingsError) as error:
        resolve(file)
    assert words in str(error.value)
    assert '\n' not in str(error.value)


def test_missing_parameter_file_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r'nowhere.*cannot be read'):
        resolve(tmp_path / 'nowhere.yaml')


@pytest.mark.parametrize('assignment', ['resolution_m=0.1', 'occupancy_grid.resolution_m', '='])
def test_assignments_need_stage_name_and_value(assignment):
    with pytest.raises(SettingsError):
        resolve(None, [assignment])


def test_unknown_stage_gets_a_suggestion():
    with pytest.raises(SettingsError, match='did you mean stereo_slam'):
        resolve(None, ['stereo_slm.num_features=3'])


@pytest.mark.parametrize(
    'assignment',
    [
        'robot_height_m=0.4',
        'cloud_labelling.robot_height_m=0.4',
        'floor_segmentation.robot_height_m=0.4',
    ],
)
def test_there_is_one_robot_whichever_stage_it_is_set_for(assignment):
    configuration = resolve(None, [assignment])
    robot = {'robot_height_m': 0.4, 'step_height_m': 0.03, 'drop_height_m': 0.04}
    assert configuration.floor_segmentation.robot == robot
    assert configuration.cloud_labelling.robot == robot


def test_the_robot_of_a_file_is_that_of_both_stages_and_the_command_line_wins(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text('/**:\n  ros__parameters:\n    step_height_m: 0.05\n    robot_height_m: 2\n')
    configuration = resolve(file, ['cloud_labelling.robot_height_m=0.4'])
    assert configuration.floor_segmentation.robot == configuration.cloud_labelling.robot
    assert configuration.floor_segmentation.step_height_m == 0.05
    assert configuration.floor_segmentation.robot_height_m == 0.4


def test_two_robots_in_one_place_are_refused(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text(
        '/**/cloud_labelling:\n  ros__parameters:\n    drop_height_m: 0.1\n'
        '/**:\n  ros__parameters:\n    drop_height_m: 0.04\n'
    )
    with pytest.raises(SettingsError, match=r'params\.yaml: .*0\.04.*0\.1: there is one robot'):
        resolve(file)
    both = ['floor_segmentation.step_height_m=0.02', 'cloud_labelling.step_height_m=0.05']
    with pytest.raises(SettingsError, match=r'--set: .*step_height_m = 0\.02.*= 0\.05'):
        resolve(None, both)


DAMAGED = [b'', b'\xff\xfe\x00', b'# caf\xe9\n/**:\n', b'\x00' * 40, b'{' * 3000, b'- 1\n- 2\n',
           b'/**: {ros__parameters: 3}', b'? [a]\n: b', b'2001-99-99', b'!!python/object:os.x {}',
           b'a: &a [*a]', b'/**:\n  ros__parameters:\n    \t1']  # fmt: skip


@pytest.mark.parametrize('seed', range(30))
def test_damaged_parameter_files_end_in_one_line(tmp_path, seed) -> None:
    """Whatever a file holds, it is read or refused with one line."""
    rng = np.random.default_rng(seed)
    whole = (REPOSITORY / 'params' / 'kitti.yaml').read_bytes()
    damaged = bytearray(DAMAGED[seed] if seed < len(DAMAGED) else whole)
    for _ in range(3 if seed >= len(DAMAGED) else 0):
        damaged[rng.integers(len(damaged))] = rng.integers(256)
    file = tmp_path / 'params.yaml'
    file.write_bytes(damaged)
    try:
        resolve(file)
    except SettingsError as error:
        assert '\n' not in str(error)
        assert str(error).strip()


def test_a_parameter_file_in_another_encoding_is_named_with_the_byte(tmp_path) -> None:
    file = tmp_path / 'latin1.yaml'
    file.write_bytes('# café'.encode('latin-1'))
    with pytest.raises(SettingsError, match=r'latin1.yaml, byte 5: .* not UTF-8'):
        resolve(file)


def test_an_assignment_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(SettingsError, match='no value in YAML'):
        resolve(assignments=['stereo_slam.num_features=[1'])
