"""The declared topics against the running nodes, and the parameter files against them."""

from pathlib import Path

import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.topics import (
    DIAGNOSTICS,
    MASKS,
    NODES,
    ROBOT,
    TOPICS,
    published_by,
    subscribed_by,
)
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

PARAMS = Path(__file__).resolve().parents[2] / 'params'
OURS = sorted(set(PARAMS.glob('*.yaml')) - {PARAMS / 'nav2.yaml'})
MAKERS = {
    'stereo_camera': make_stereo_camera,
    'stereo_slam': StereoSlamNode,
    'floor_segmentation': FloorSegmentationNode,
    'cloud_labelling': CloudLabellingNode,
    'occupancy_grid': OccupancyGridNode,
}
OF_EVERY_NODE = {'/parameter_events', '/rosout', '/clock', DIAGNOSTICS.name}


def make(node: str, graph):
    return graph.add(MAKERS[node]())


@pytest.mark.parametrize('node', NODES)
def test_a_node_has_the_topics_that_are_declared_and_no_others(make_graph, tmp_path, node) -> None:
    drive = write_kitti(tmp_path / 'drive', room_drive(1)[0])
    arguments = ('-p', f'input:={drive}') if node == 'stereo_camera' else ()
    graph = make_graph('-r', '__ns:=/robot', *arguments)
    made = make(node, graph)
    publishers = dict(made.get_publisher_names_and_types_by_node(node, '/robot'))
    assert publishers.pop(f'/robot/{node}/transition_event')
    expected = {f'/robot/{t.name}': [t.type_name] for t in published_by(node)}
    found = {k: v for k, v in publishers.items() if k not in OF_EVERY_NODE and '/tf' not in k}
    assert found == expected
    assert DIAGNOSTICS.name in publishers
    subscribers = dict(made.get_subscriber_names_and_types_by_node(node, '/robot'))
    found = {k: v for k, v in subscribers.items() if k not in OF_EVERY_NODE and '/tf' not in k}
    assert found == {f'/robot/{t.name}': [t.type_name] for t in subscribed_by(node)}


@pytest.mark.parametrize('node', ['stereo_camera', 'stereo_slam'])
def test_compressed_images_take_the_place_of_raw_ones(make_graph, tmp_path, node) -> None:
    drive = write_kitti(tmp_path / 'drive', room_drive(1)[0])
    arguments = ('-p', f'input:={drive}') if node == 'stereo_camera' else ()
    made = make(node, make_graph('-p', 'image_transport:=compressed', *arguments))
    publishers = made.get_publisher_names_and_types_by_node(node, '/')
    subscribers = made.get_subscriber_names_and_types_by_node(node, '/')
    names = dict(publishers if node == 'stereo_camera' else subscribers)
    assert names['/left/image_raw/compressed'] == ['sensor_msgs/msg/CompressedImage']
    assert '/right/image_raw/compressed' in names
    assert '/left/image_raw' not in names


def test_slam_takes_rectified_images_by_parameter(make_graph) -> None:
    graph = make_graph('-p', 'image_kind:=rect', '-p', 'image_reliability:=best_effort')
    node = make('stereo_slam', graph)
    names = dict(node.get_subscriber_names_and_types_by_node('stereo_slam', '/'))
    assert '/left/image_rect' in names
    assert '/left/image_raw' not in names
    (info,) = node.get_subscriptions_info_by_topic('/left/image_rect')
    assert info.qos_profile.reliability.name == 'BEST_EFFORT'


def test_every_publisher_of_a_topic_is_a_node_and_every_listener_too() -> None:
    for topic in TOPICS.values():
        assert topic.publisher in (*NODES, ROBOT, MASKS, '')
        assert set(topic.subscribers) <= {*NODES, ROBOT, MASKS}
        assert not topic.name.startswith('/')


@pytest.mark.parametrize(
    'file', sorted(set(PARAMS.glob('*.yaml')) - {PARAMS / 'nav2.yaml'}), ids=lambda path: path.name
)
def test_the_parameter_files_are_taken_by_the_command_and_by_the_nodes(make_graph, file) -> None:
    configuration = resolve(file)
    graph = make_graph('--params-file', str(file))
    for name in NODES[1:]:
        known = vars(make(name, graph).settings)
        expected = vars(configuration.stages()[name])
        assert repr({key: known[key] for key in expected}) == repr(expected)


def test_every_use_has_its_parameter_file() -> None:
    names = {path.stem for path in PARAMS.glob('*.yaml')}
    assert names >= {'default', 'demo', 'kitti', 'euroc', 'library'}
