"""The five nodes in one process."""

from __future__ import annotations

import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from nav_msgs.msg import Path
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_graph import fresh_graph
from std_srvs.srv import SetBool, Trigger
from stereo_drive import lockstep_map, room_drive, write_kitti

from segfloor_ros.grid.map_file import load_map
from segfloor_ros.messages import qos
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.topics import CAMERA, GRID, NODES, SLAM, published_by
from segfloor_ros.nodes.hand_over import HandOver

FRAMES = 14


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', room_drive(FRAMES)[0])


@pytest.fixture(scope='module')
def pipeline(drive, tmp_path_factory):
    """The graph around a pipeline that plays the drive once it is asked to."""
    folder = tmp_path_factory.mktemp('pipeline')
    parameters = {'input': drive, 'rate': 0.0, 'start_paused': 'true', 'background': 'false',
                  'map_file': folder / 'map.yaml'}  # fmt: skip
    options = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    command = [sys.executable, '-m', 'segfloor_ros.nodes.segfloor_pipeline', '--ros-args']
    with fresh_graph() as graph, (folder / 'log').open('w') as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log)
        try:
            yield graph, process, folder
        finally:
            process.kill()
            process.wait()


def test_it_makes_the_map_of_the_run_and_serves_listeners_outside(pipeline, drive) -> None:
    graph, _, folder = pipeline
    names = ('keyframe/features', 'keyframe/path', 'labelled_points', 'map')
    received = {name: graph.collect(name) for name in names}
    graph.until(lambda: all(graph.reports_any(node) for node in NODES), 'all nodes')
    graph.until(lambda: all(graph.tester.count_publishers(name) for name in names), 'the topics')
    graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=False))
    graph.until(lambda: len(graph.reports(SLAM)) == FRAMES, 'all frames')
    keyframes = [s.stamp_ns for s in graph.reports(SLAM) if s.values['keyframe'] == '1']
    graph.until(lambda: len(graph.reports(GRID)) == len(keyframes), 'all keyframes in the map')
    graph.until(lambda: len(received['labelled_points']) == len(keyframes), 'all clouds')
    for name in names[:3]:
        assert [to_ns(m.header.stamp) for m in received[name]] == keyframes, name
    assert graph.call(Trigger, 'save_map', Trigger.Request()).success
    np.testing.assert_array_equal(load_map(folder / 'map.yaml').cells, lockstep_map(drive).cells)


def test_it_has_the_topics_of_the_five_nodes_and_ends_on_interrupt(pipeline) -> None:
    graph, process, _ = pipeline
    for node in NODES:
        for topic in published_by(node):
            publishers = graph.tester.get_publishers_info_by_topic(topic.name)
            assert node in {publisher.node_name for publisher in publishers}, topic.name
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=20) == 0


class Outside:
    """What the middleware is to a publisher."""

    def __init__(self, topic_name: str, listeners: int = 0) -> None:
        self.topic_name = topic_name
        self.listeners = listeners
        self.sent: list[Path] = []

    def publish(self, message) -> None:
        self.sent.append(message)

    def get_subscription_count(self) -> int:
        return self.listeners


@pytest.fixture
def later():
    """Work that waits for the executor."""
    tasks = []
    return SimpleNamespace(create_task=tasks.append, tasks=tasks)


class Received(list):
    """Messages, and the numbers they were handed over with."""

    def __init__(self) -> None:
        self.numbers = []

    def take(self, message, info) -> None:
        """Take one, as a node does."""
        self.append(message)
        self.numbers.append(info['publication_sequence_number'])


def test_messages_wait_for_the_executor_and_the_depth_bounds_them(later) -> None:
    hand_over, outside, got = HandOver(later), Outside('/path'), Received()
    publisher = hand_over.publisher(outside, qos.KEYFRAMES)
    assert hand_over.subscribe('/other', got.take, qos.KEYFRAMES, False) is None
    hand_over.subscribe('/path', got.take, QoSProfile(depth=2), False)
    messages = [Path(), Path(), Path()]
    for message in messages:
        publisher.publish(message)
    assert got == []
    for task in later.tasks:
        task()
    assert [id(m) for m in got] == [id(m) for m in messages[1:]]
    assert got.numbers == [2, 3], 'the first one is known to be lost by its number'
    assert outside.sent == []
    outside.listeners = 1
    publisher.publish(messages[0])
    assert outside.sent == [messages[0]]
    assert publisher.get_subscription_count() == 2


def test_latched_messages_reach_those_who_come_later_and_raw_ones_are_serialised(later) -> None:
    hand_over, outside, got = HandOver(later), Outside('/mount'), Received()
    publisher = hand_over.publisher(outside, qos.LATCHED)
    message = Path()
    message.header.frame_id = 'map'
    publisher.publish(message)
    assert outside.sent == [message]
    late = hand_over.subscribe('/mount', got.take, qos.LATCHED, True)
    hand_over.subscribe('/mount', got.take, qos.LATCHED, False)
    hand_over.unsubscribe(late)
    for task in later.tasks:
        task()
    assert got == [message]
    hand_over.subscribe('/mount', got.take, qos.LATCHED, True)
    later.tasks[-1]()
    assert deserialize_message(got[1], Path) == message
