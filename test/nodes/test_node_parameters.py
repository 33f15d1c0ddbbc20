import math
from pathlib import Path

import pytest
import yaml
from rclpy.parameter import Parameter

from segfloor_ros.core.errors import SettingsError
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.configuration import NODE_SETTINGS, STAGE_SETTINGS
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.settings.cloud import CloudLabellingNodeSettings
from segfloor_ros.nodes.shared.running import command_line_parameters
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

PARAMS = Path(__file__).resolve().parents[2] / 'params'


@pytest.mark.parametrize(
    'make', [StereoSlamNode, FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode]
)
def test_every_setting_is_a_parameter_with_description_and_range(make_graph, make) -> None:
    node = make_graph().add(make())
    stage = node.get_name()
    specs = NODE_SETTINGS[stage].specs()
    for spec in specs:
        value = node.get_parameter(spec.name).value
        assert value == spec.default or (math.isnan(value) and math.isnan(spec.default))
        described = node.describe_parameter(spec.name)
        assert described.description.startswith(spec.description)
        assert described.read_only is not spec.live
        assert described.additional_constraints == spec.range_text()
        for found in (*described.floating_point_range, *described.integer_range):
            assert (found.from_value, found.to_value) == spec.within
    assert set(node.get_parameters_by_prefix('')) - {s.name for s in specs} <= {
        'use_sim_time',
        'start_type_description_service',
    }


def test_files_and_arguments_set_parameters_and_the_last_one_wins(make_graph, tmp_path) -> None:
    file = tmp_path / 'params.yaml'
    file.write_text(
        'cloud_labelling:\n  ros__parameters:\n    robot_height_m: 2\n    step_height_m: 0.1\n'
        '/**:\n  ros__parameters:\n    resolution_m: 0.1\n'
    )
    graph = make_graph('--params-file', str(file), '-p', 'step_height_m:=0.2')
    node = graph.add(CloudLabellingNode())
    assert node.settings == CloudLabellingNodeSettings(robot_height_m=2.0, step_height_m=0.2)


@pytest.mark.parametrize('namespace', ['/', '/robot', '/fleet/robot'])
def test_a_file_of_the_package_holds_in_every_namespace(make_graph, tmp_path, namespace) -> None:
    file = tmp_path / 'params.yaml'
    file.write_text('/**/cloud_labelling:\n  ros__parameters:\n    robot_height_m: 0.7\n')
    graph = make_graph('--params-file', str(file), '-r', f'__ns:={namespace}')
    assert graph.add(CloudLabellingNode()).settings.robot_height_m == 0.7
    for params in PARAMS.glob('*.yaml'):
        sections = yaml.safe_load(params.read_text())
        own = [name for name in sections if name.rsplit('/', 1)[-1] in STAGE_SETTINGS]
        assert all(name.startswith('/**/') for name in own), params


def test_the_command_line_wins_over_every_section_of_a_file(
    make_graph, tmp_path, monkeypatch
) -> None:
    """rcl lets the section of the node win once there is one for all nodes before it."""
    file = tmp_path / 'params.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    step_height_m: 0.1\n'
        'cloud_labelling:\n  ros__parameters:\n    robot_height_m: 2.0\n    step_height_m: 0.3\n'
    )
    arguments = ['-p', 'step_height_m:=1e-2', '--params-file', str(file)]
    monkeypatch.setattr('sys.argv', ['node', '--ros-args', *arguments])
    node = make_graph(*arguments).add(CloudLabellingNode())
    assert node.settings == CloudLabellingNodeSettings(robot_height_m=2.0, step_height_m=0.01)
    assert node.get_parameter('step_height_m').value == 0.01


def test_parameters_of_a_command_line_are_those_for_ros_and_any_node() -> None:
    line = 'node -p a:=1 --ros-args -p b:=2 --param c:=x:=y -p other:d:=3 -r e:=f -- -p g:=4'
    assert command_line_parameters(line.split()) == {'b': '2', 'c': 'x:=y'}


@pytest.mark.parametrize(
    'make', [StereoSlamNode, FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode]
)
def test_each_parameter_changes_while_running_or_says_that_it_does_not(make_graph, make) -> None:
    node = make_graph().add(make())
    stage = node.get_name()
    settings = vars(node.settings)
    for spec in NODE_SETTINGS[stage].specs():
        (result,) = node.set_parameters([Parameter(spec.name, value=another(spec))])
        assert result.successful is spec.live, (spec.name, result.reason)
        now = getattr(node.settings, spec.name)
        expected = another(spec) if spec.live else settings[spec.name]
        assert now == expected or math.isnan(expected)
        if not spec.live:
            assert 'read-only' in result.reason
            assert spec.name in result.reason


def another(spec):
    """Return a good value that is not the default."""
    if spec.type is bool:
        return not spec.default
    if spec.choices:
        return spec.choices[-1]
    if spec.type is str:
        return f'{spec.default}_2'
    for value in (*reversed(spec.within or ()), spec.default + 1):
        if value != spec.default:
            return spec.type(value)
    return spec.default


@pytest.mark.parametrize(
    ('argument', 'words'),
    [
        ('robot_heigth_m:=1.0', r'cloud_labelling\.robot_heigth_m.*did you mean robot_height_m'),
        ('robot_height_m:=99.0', r'cloud_labelling\.robot_height_m = 99\.0 .*0\.05 to 10 m'),
        ('robot_height_m:=tall', r"cloud_labelling\.robot_height_m = 'tall': expected a number"),
    ],
)
def test_bad_parameters_stop_the_node_with_the_reason(make_graph, argument, words) -> None:
    make_graph('-p', argument)
    with pytest.raises(SettingsError, match=words):
        CloudLabellingNode()


def test_live_parameters_change_and_bad_values_are_rejected_with_the_reason(make_graph) -> None:
    node = make_graph().add(CloudLabellingNode())
    (accepted,) = node.set_parameters([Parameter('robot_height_m', value=0.5)])
    assert accepted.successful
    assert node.settings.robot_height_m == 0.5
    (rejected,) = node.set_parameters([Parameter('robot_height_m', value=-1.0)])
    assert not rejected.successful
    assert 'robot_height_m' in rejected.reason
    (wrong_type,) = node.set_parameters([Parameter('robot_height_m', value='tall')])
    assert not wrong_type.successful
    assert 'expected a number' in wrong_type.reason
    assert node.settings.robot_height_m == 0.5


def test_other_parameters_are_read_only(make_graph) -> None:
    node = make_graph().add(OccupancyGridNode())
    (result,) = node.set_parameters([Parameter('resolution_m', value=0.1)])
    assert not result.successful
    assert 'read-only' in result.reason
