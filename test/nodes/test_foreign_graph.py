"""Drivers, tf trees and parameter files of others: what comes of them is said with its remedy."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from node_messages import CALIBRATION, MOUNTED, SIDES
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter
from stereo_drive import room_drive
from stereo_room import MOUNT

from segfloor_ros.core.geometry import R_ROS_OPTICAL, make_transform
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.configuration import unread_sections
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.diagnostics import HEALTH, Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.topics import IMAGES, KEYFRAMES, LATCHED, TOPICS
from segfloor_ros.nodes.stereo_slam import StereoSlamNode


@pytest.fixture(scope='module')
def frames():
    return room_drive(8, step_m=0.04)[0]


class Rig:
    """A stereo camera's driver with frame ids `left` and `right`."""

    def __init__(self, graph, info_profile=IMAGES) -> None:
        self._graph = graph
        node = graph.tester
        self._images = {
            s: node.create_publisher(TOPICS[f'{s}/image_raw'].type, f'{s}/image_raw', IMAGES)
            for s in SIDES
        }
        self._infos = {
            s: node.create_publisher(
                TOPICS[f'{s}/camera_info'].type, f'{s}/camera_info', info_profile
            )
            for s in SIDES
        }

    def connect(self) -> None:
        self._graph.connected([*self._images.values(), *self._infos.values()])

    def send_infos(self, stamp_ns: int = 0, **changes) -> None:
        for side, publisher in self._infos.items():
            message = camera_info_message(stamp_ns, side, getattr(CALIBRATION, side))
            for name, value in changes.items():
                setattr(message, name, value)
            publisher.publish(message)

    def send(self, frame, sides=SIDES) -> None:
        for side in sides:
            image = getattr(frame, side)
            self._images[side].publish(image_message(frame.stamp_ns, side, image))


def status_of(graph, words: str):
    found = [s for s in graph.statuses if s.node == 'stereo_slam' and words in s.message]
    return found[-1] if found else None


def tf_publishers(graph) -> SimpleNamespace:
    tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs could not be built by make')
    node, kind = graph.tester, tf2_msgs.TFMessage
    moving = node.create_publisher(kind, '/tf', KEYFRAMES)
    fixed = node.create_publisher(kind, '/tf_static', LATCHED)
    return SimpleNamespace(
        move=lambda *link: moving.publish(kind(transforms=[transform_message(*link)])),
        fix=lambda *link: fixed.publish(kind(transforms=[transform_message(0, *link)])),
    )


def at(height_m: float, R: np.ndarray) -> np.ndarray:
    return make_transform(R, np.array([0.1, 0.0, height_m]))


R_OPTICAL = MOUNT.T_base_left[:3, :3]
R_BODY = R_OPTICAL @ R_ROS_OPTICAL.T


@pytest.mark.parametrize(
    ('T_base_camera', 'arguments', 'words'),
    [
        (at(0.4, R_BODY), (), 'is no optical one'),
        (at(0.4, R_OPTICAL[:, [1, 0, 2]] * [1, -1, 1]), (), 'is no optical one'),  # on its side
        (at(0.0, R_OPTICAL), (), '0.000 m above the floor'),
        (at(-0.1, R_OPTICAL), (), '-0.100 m above the floor'),
        (None, ('-p', 'base_frame:=left'), 'the frame of the base is the camera itself'),
    ],
    ids=['body axes', 'rolled', 'height 0', 'below', 'camera as base'],
)
def test_a_mount_that_cannot_be_is_refused_by_its_names(
    make_graph, frames, T_base_camera, arguments, words
) -> None:
    graph = make_graph('-p', 'tf_wait_s:=5.0', *arguments)
    tf = tf_publishers(graph)
    if T_base_camera is not None:
        tf.fix('base_link', 'left', T_base_camera)
    rig = Rig(graph)
    graph.add(StereoSlamNode())
    rig.connect()
    rig.send_infos()
    stream = iter(frames)

    def refused() -> bool:
        if (frame := next(stream, None)) is not None:
            rig.send(frame)
        return status_of(graph, words) is not None

    odometry = graph.collect('odometry')
    graph.until(refused, words)
    status = status_of(graph, words)
    assert status.level is Level.ERROR
    base = 'left' if arguments else 'base_link'
    assert f'tf from {base} to left' in status.message
    assert not odometry


def health_says(graph, *words: str):
    found = [s for s in graph.statuses if s.node == 'stereo_slam' and s.kind == HEALTH]
    return bool(found) and all(word in found[-1].message for word in words)


@pytest.mark.parametrize('rival', ['odom', 'base_footprint', 'map to odom'])
def test_a_frame_with_two_parents_is_an_error_with_names_and_remedy(
    make_graph, frames, rival
) -> None:
    graph = make_graph(*MOUNTED, '-p', 'tf_wait_s:=0.2')
    tf, rig = tf_publishers(graph), Rig(graph)
    graph.add(StereoSlamNode())
    rig.connect()
    rig.send_infos()
    for frame in frames[:3]:
        rig.send(frame)
    graph.until(lambda: status_of(graph, 'tracking') is not None, 'a tracked frame')
    graph.comes(lambda: False, 0.5)  # the mount is settled by now
    T = at(0.0, np.eye(3))
    numbers = itertools.count(1)

    def rivalled() -> bool:
        stamp_ns = frames[2].stamp_ns + next(numbers) * 10_000_000
        if rival == 'base_footprint':
            tf.fix('base_footprint', 'base_link', T)
        elif rival == 'odom':
            tf.move(stamp_ns, 'odom', 'base_link', T)
        else:
            tf.move(stamp_ns, 'map', 'odom', T)
        words = {
            'odom': ('base_link jumps', 'odom', 'tester', 'publish_odom_tf of stereo_slam'),
            'base_footprint': ('base_link jumps', 'base_footprint', 'tester', 'set base_frame of'),
            'map to odom': ('odom jumps', 'map', 'tester', 'set publish_tf of stereo_slam'),
        }
        return health_says(graph, *words[rival])

    graph.until(rivalled, 'the rival to be named')


def test_what_the_node_broadcasts_itself_is_no_rival(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED, '-p', 'tf_wait_s:=0.2')
    tf, rig = tf_publishers(graph), Rig(graph)
    tf.fix('base_link', 'lidar', at(0.2, np.eye(3)))
    graph.add(StereoSlamNode())
    rig.connect()
    rig.send_infos()
    for frame in frames:
        rig.send(frame)
    graph.until(lambda: status_of(graph, 'tracking') is not None, 'a tracked frame')
    assert not graph.comes(lambda: health_says(graph, 'jumps'), 2.0)


def test_a_calibration_that_was_published_once_before_is_taken(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED)
    rig = Rig(graph, LATCHED)
    rig.send_infos()
    graph.add(StereoSlamNode())
    rig.connect()
    odometry, numbers = graph.collect('odometry'), itertools.count()

    def tracked() -> bool:
        number = next(numbers)
        frame = frames[number % len(frames)]
        rig.send(replace(frame, stamp_ns=frames[0].stamp_ns + number * 100_000_000))
        return bool(odometry)

    graph.until(tracked, 'odometry')


@pytest.mark.parametrize(('late_frames', 'apart_ms', 'is_said'), [(40, 0, False), (0, 15, True)])
def test_a_side_that_arrives_late_is_not_apart(make_graph, late_frames, apart_ms, is_said) -> None:
    node = make_graph(*MOUNTED).add(StereoSlamNode())
    watch = node._camera.watch
    watch.expect('left/image_raw', 'right/image_raw')
    for number in range(100):
        watch.saw_image('left/image_raw', number * 30_000_000)
        if number >= late_frames:
            stamp_ns = (number - late_frames) * 30_000_000 + apart_ms * 1_000_000
            watch.saw_image('right/image_raw', stamp_ns)
    watch.find_problems([])
    assert ('stamps' in node.reporter.health.problems) is is_said


@pytest.mark.parametrize(
    ('section', 'full_name', 'is_read'),
    [
        ('cloud_labelling', '/cloud_labelling', True),
        ('/cloud_labelling', '/cloud_labelling', True),
        ('cloud_labelling', '/robot1/cloud_labelling', False),
        ('/robot2/cloud_labelling', '/robot1/cloud_labelling', False),
        ('/robot1/cloud_labelling', '/robot1/cloud_labelling', True),
        ('robot1: {cloud_labelling', '/robot1/cloud_labelling', True),
        ('/**/cloud_labelling', '/fleet/robot1/cloud_labelling', True),
        ('/**', '/robot1/cloud_labelling', True),
        ('/*/cloud_labelling', '/robot1/cloud_labelling', True),
        ('/*/cloud_labelling', '/fleet/robot1/cloud_labelling', False),
        ('stereo_slam', '/robot1/cloud_labelling', True),  # of another node
    ],
)
def test_a_section_of_another_namespace_is_named(
    make_graph, tmp_path, section, full_name, is_read
) -> None:
    file = tmp_path / 'params.yaml'
    end = '}' if '{' in section else ''
    file.write_text(f'{section}: {{ros__parameters: {{step_height_m: 0.123}}}}{end}\n')
    lines = unread_sections(['--ros-args', '--params-file', str(file)], full_name)
    assert bool(lines) is not is_read
    for line in lines:
        assert line.startswith(f'{file} has parameters of {section.lstrip("/")}, but this node is')
        assert full_name in line and '/**/cloud_labelling' in line
    if section == 'stereo_slam':
        return
    namespace = full_name.rpartition('/')[0] or '/'
    graph = make_graph('--params-file', str(file), '-r', f'__ns:={namespace}')
    node = graph.add(CloudLabellingNode())
    assert (node.settings.step_height_m == 0.123) == is_read  # as ROS has it


@pytest.mark.parametrize('value', ['high', 7, 1e9, True, None])
def test_no_value_changes_the_described_type_of_a_parameter(make_graph, value) -> None:
    node = make_graph().add(CloudLabellingNode())
    node.set_parameters([Parameter('robot_height_m', value=value)])
    assert node.describe_parameter('robot_height_m').type == ParameterType.PARAMETER_DOUBLE
    found = node.get_parameter('robot_height_m').value
    assert type(found) is float
    assert found == (7.0 if value == 7 and value is not True else 1.0)
