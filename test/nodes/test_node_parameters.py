from __future__ import annotations

import math

import pytest
from rclpy.parameter import Parameter

from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.configuration import STAGE_SETTINGS
from segfloor_ros.errors import SettingsError
from segfloor_ros.node_settings import NODE_SETTINGS
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode


@pytest.mark.parametrize(
    'make', [StereoSlamNode, FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode]
)
def test_every_setting_is_a_parameter_with_description_and_range(make_graph, make) -> None:
    node = make_graph().add(make())
    stage = node.get_name()
    specs = [*STAGE_SETTINGS[stage].specs(), *NODE_SETTINGS[stage].specs()]
    for spec in specs:
        value = node.get_parameter(spec.name).value
        assert value == spec.default or (math.isnan(value) and math.isnan(spec.default))
        described = node.describe_parameter(spec.name)
        assert described.description.startswith(spec.description)
        assert described.read_only is not spec.live
        assert described.additional_constraints == spec.range_text()
        for found in (*described.floating_point_range, *described.integer_range):
            assert spec.minimum is None or found.from_value == spec.minimum
            assert spec.maximum is None or found.to_value == spec.maximum
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
    assert node.parameters.stage == CloudLabellingSettings(robot_height_m=2.0, step_height_m=0.2)


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
    assert node.parameters.stage.robot_height_m == 0.5
    (rejected,) = node.set_parameters([Parameter('robot_height_m', value=-1.0)])
    assert not rejected.successful
    assert 'robot_height_m' in rejected.reason
    (wrong_type,) = node.set_parameters([Parameter('robot_height_m', value='tall')])
    assert not wrong_type.successful
    assert 'expected a number' in wrong_type.reason
    assert node.parameters.stage.robot_height_m == 0.5


def test_other_parameters_are_read_only(make_graph) -> None:
    node = make_graph().add(OccupancyGridNode())
    (result,) = node.set_parameters([Parameter('resolution_m', value=0.1)])
    assert not result.successful
    assert 'read-only' in result.reason
