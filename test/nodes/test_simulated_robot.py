"""The node of the simulated robot, over DDS, driven by the test."""

from importlib.util import find_spec

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped, Vector3
from ros_graph import another_participant, fresh_graph

from segfloor_ros.apps.simulation.simulated_robot import SimulatedRobotNode
from segfloor_ros.core.errors import SegfloorError
from segfloor_ros.nodes.messages.topics import TOPICS, make_header, stamp_of

pytestmark = pytest.mark.skipif(find_spec('mujoco') is None, reason='the extra sim')

SMALL = 'camera.width=64 camera.height=48'
IMAGES = ('left/image_raw', 'left/camera_info', 'right/image_raw', 'right/camera_info')


def stamps(messages) -> list[int]:
    return [stamp_of(message) for message in messages]


def robot_in(graph, *extra_topics: str):
    """Add the robot to a graph; returns the messages of its topics by name as they come."""
    heard = {name: graph.collect(name) for name in (*IMAGES, 'ground_truth', *extra_topics)}
    graph.add(SimulatedRobotNode())
    return heard


def drive(graph, publisher, stamp_ns: int, forward: float, turn: float = 0.0) -> None:
    twist = Twist(linear=Vector3(x=forward), angular=Vector3(z=turn))
    publisher.publish(TwistStamped(header=make_header(stamp_ns, 'base_link'), twist=twist))


def test_in_step_each_frame_waits_for_the_command_at_the_frame_before_the_last() -> None:
    arguments = ('-p', 'rate:=0.0', '-p', 'scene:=lane', '-p', f"scene_values:='{SMALL}'")
    with fresh_graph(*arguments) as graph:
        heard = robot_in(graph, 'wheel_odometry', 'imu')
        commands = graph.publisher('cmd_vel')
        graph.connected([commands])
        truth = heard['ground_truth']
        graph.until(lambda: len(truth) == 2, 'two frames without a command')
        assert not graph.comes(lambda: len(truth) > 2, 0.5)
        for count in range(30):
            drive(graph, commands, stamp_of(truth[count]), 0.2)
            graph.until(lambda wanted=count + 3: len(truth) == wanted, 'the next frame')
        graph.until(lambda: len(heard['right/camera_info']) == len(truth), 'its images')
        assert all(stamps(heard[name]) == stamps(truth) for name in IMAGES)
        assert set(np.diff(stamps(truth))) == {10**8}
        way = [message.pose.pose.position.x for message in truth]
        assert way[0] == pytest.approx(0.0, abs=0.001)
        assert way[-1] - way[-11] == pytest.approx(0.2, abs=0.005)
        for name in ('wheel_odometry', 'imu'):
            measured = heard[name]
            graph.until(lambda m=measured: stamp_of(m[-1]) > stamp_of(truth[-2]), name)
            assert set(np.diff(stamps(measured))) == {10**7}


@pytest.mark.slow
def test_against_the_clock_it_stops_when_no_command_comes_any_more() -> None:
    arguments = ('-p', 'rate:=5.0', '-p', 'scene:=lane', '-p', f"scene_values:='{SMALL}'",
                 '-p', 'stamped_commands:=false')  # fmt: skip
    with fresh_graph(*arguments) as graph:
        truth = robot_in(graph)['ground_truth']
        twist = graph.tester.create_publisher(Twist, 'cmd_vel', TOPICS['cmd_vel'].profile)
        graph.connected([twist])
        graph.until(lambda: truth, 'a frame')
        twist.publish(Twist(linear=Vector3(x=0.2)))
        told = len(truth)
        graph.until(lambda: len(truth) >= told + 20, 'two seconds of the robot')
        way = [message.pose.pose.position.x for message in truth]
        assert max(way) > 0.02
        assert way[-1] == pytest.approx(way[-6], abs=0.002)
        assert way[-1] < 0.2


def test_what_it_runs_into_is_published_once() -> None:
    box = '"boxes=[{at: [0.3, 0], size: [0.1, 1, 0.5]}]"'
    arguments = ('-p', 'rate:=0.0', '-p', 'scene:=lane', '-p', f"scene_values:='{SMALL} {box}'")
    with fresh_graph(*arguments) as graph:
        heard = robot_in(graph, 'contact')
        commands, truth = graph.publisher('cmd_vel'), heard['ground_truth']
        graph.connected([commands])
        for count in range(25):
            graph.until(lambda wanted=count: len(truth) > wanted, 'a frame')
            drive(graph, commands, stamp_of(truth[count]), 0.22)
        graph.until(lambda: heard['contact'], 'the bump')
        (bump,) = heard['contact']
        assert bump.header.frame_id == 'base_link'
        assert bump.point.x == pytest.approx(-0.032 + 0.138 / 2, abs=0.01)


def test_a_depth_camera_takes_the_place_of_the_right_eye() -> None:
    arguments = ('-p', 'depth:=true', '-p', 'scene:=lane', '-p', f"scene_values:='{SMALL}'")
    with fresh_graph(*arguments) as graph:
        depths, left = graph.collect('depth/image_raw'), graph.collect('left/image_raw')
        node = graph.add(SimulatedRobotNode())
        graph.until(lambda: depths and left, 'a frame')
        assert depths[0].encoding == '16UC1'
        names = dict(node.get_publisher_names_and_types_by_node('simulated_robot', '/'))
        assert not any(name.startswith('/right/') for name in names)


@pytest.mark.parametrize('is_stamped', [True, False])
def test_commands_of_the_other_kind_are_named_with_the_parameter(is_stamped) -> None:
    words = ('-p', f'stamped_commands:={str(is_stamped).lower()}', '-p', 'scene:=lane')
    arguments = (*words, '-p', f"scene_values:='{SMALL}'")
    # In one participant a topic has one type.
    with fresh_graph(*arguments) as graph, another_participant() as teleop:
        other = Twist if is_stamped else TwistStamped
        teleop.create_publisher(other, 'cmd_vel', TOPICS['cmd_vel'].profile)
        robot_in(graph)
        remedy = f'set stamped_commands to {str(not is_stamped).lower()}'
        graph.until(lambda: any(remedy in s.message for s in graph.statuses), 'the remedy')


def test_a_robot_or_a_scene_that_there_is_not_ends_it_with_one_line() -> None:
    for name, value in (('robot', 'huski'), ('scene', 'lain')):
        with (
            fresh_graph('-p', f'{name}:={value}') as graph,
            pytest.raises(SegfloorError, match=value),
        ):
            graph.add(SimulatedRobotNode())
