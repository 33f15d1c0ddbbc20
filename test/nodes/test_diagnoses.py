"""What is wrong with a camera or a connection is said in words, with the topic and what to do."""

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from node_messages import CALIBRATION, MOUNTED, cloud_messages, publish
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.floor.plane.mount import MountEstimator
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.diagnostics import HEALTH, Health, Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.topics import IMAGES, TOPICS, best_effort
from segfloor_ros.nodes.stereo_slam import StereoSlamNode
from segfloor_ros.nodes.watches import camera as camera_watch

FRAME_NS = 100_000_000


@pytest.fixture(scope='module')
def frames():
    return room_drive(3)[0]


def health(graph, node: str):
    """Return what a node said last about how it fares."""
    found = [s for s in graph.statuses if s.node == node and s.kind == HEALTH]
    return found[-1] if found else None


def says(graph, node: str, *words: str, meanwhile: Callable[[], None] = lambda: None):
    """Wait until a node's health says all the words, and do something now and then meanwhile;
    returns the status.
    """

    def found() -> bool:
        meanwhile()
        status = health(graph, node)
        return status is not None and all(word in status.message for word in words)

    graph.until(found, f'{words} of {node}')
    return health(graph, node)


class Driver:
    """A camera's driver that does something wrong."""

    def __init__(self, graph, image: str = 'image_raw', profile: QoSProfile = IMAGES) -> None:
        self._graph = graph
        self._image = image
        node = graph.tester
        for_each = {
            f'{side}/{what}' for side in ('left', 'right') for what in (image, 'camera_info')
        }
        self._publishers = {
            name: node.create_publisher(TOPICS[name].type, name, profile) for name in for_each
        }

    def connect(self) -> None:
        self._graph.connected(list(self._publishers.values()))

    def send(self, side: str, stamp_ns: int, image: np.ndarray, with_info: bool = True) -> None:
        if with_info:
            info = camera_info_message(stamp_ns, side, getattr(CALIBRATION, side))
            self._publishers[f'{side}/camera_info'].publish(info)
        self._publishers[f'{side}/{self._image}'].publish(image_message(stamp_ns, side, image))


def test_images_offered_best_effort_are_named_and_taken_by_parameter(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED, '-p', 'image_reliability:=reliable')
    driver = Driver(graph, profile=best_effort(IMAGES))
    graph.add(StereoSlamNode())
    words = ('/left/image_raw', '/tester', 'best effort', 'stereo_slam.image_reliability')
    status = says(graph, 'stereo_slam', *words)
    assert status.level is Level.ERROR
    assert '/right/camera_info' in status.message
    del driver
    graph.close()
    graph = make_graph(*MOUNTED, '-p', 'image_reliability:=best_effort')
    driver = Driver(graph, profile=best_effort(IMAGES))
    graph.add(StereoSlamNode())
    driver.connect()
    for side in ('left', 'right'):
        driver.send(side, 0, getattr(frames[0], side))
    status = says(graph, 'stereo_slam', 'tracking')
    assert status.level is Level.OK


@pytest.mark.parametrize('comes_first', ['driver', 'slam'])
def test_images_offered_best_effort_are_taken_as_that_by_themselves(
    make_graph, frames, comes_first
) -> None:
    graph = make_graph(*MOUNTED)
    driver = Driver(graph, profile=best_effort(IMAGES)) if comes_first == 'driver' else None
    node = graph.add(StereoSlamNode())
    says(graph, 'stereo_slam', '')
    driver = driver or Driver(graph, profile=best_effort(IMAGES))
    driver.connect()
    (info,) = node.get_subscriptions_info_by_topic('/left/image_raw')
    assert info.qos_profile.reliability.name == 'BEST_EFFORT'
    graph.statuses.clear()
    for side in ('left', 'right'):
        driver.send(side, 0, getattr(frames[0], side))
    assert says(graph, 'stereo_slam', 'tracking').level is Level.OK


def test_a_listener_that_asks_for_more_than_is_offered_is_named(make_graph) -> None:
    graph = make_graph()
    topic = TOPICS['floor_points']
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    graph.tester.create_subscription(topic.type, topic.name, lambda _: None, profile)
    graph.add(CloudLabellingNode())
    words = ('/floor_points: nothing reaches /tester', 'transient local', 'volatile')
    assert says(graph, 'cloud_labelling', *words).level is Level.ERROR


def test_eyes_that_are_not_triggered_together_are_named(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED)
    driver = Driver(graph)
    graph.add(StereoSlamNode())
    driver.connect()
    stamps = itertools.count(0, FRAME_NS)

    next_s = 0.0

    def go_on() -> None:
        # At the rate of the stamps: a node that cannot keep up loses messages, and says that.
        nonlocal next_s
        if time.monotonic() < next_s:
            return
        next_s = time.monotonic() + FRAME_NS * 1e-9
        stamp_ns = next(stamps)
        driver.send('left', stamp_ns, frames[0].left)
        driver.send('right', stamp_ns + 40_000_000, frames[0].right)

    words = ('left/image_raw and right/image_raw', '40.0 ms', 'sync_tolerance_s = 0.005 s')
    assert says(graph, 'stereo_slam', *words, meanwhile=go_on).level is Level.ERROR


def test_images_without_calibration_are_named(make_graph, frames, monkeypatch) -> None:
    monkeypatch.setattr(camera_watch, 'FIRST_INFO_S', 1.5)
    graph = make_graph(*MOUNTED)
    driver = Driver(graph)
    graph.add(StereoSlamNode())
    driver.connect()
    driver.send('left', 0, frames[0].left)
    driver.send('right', 0, frames[0].right, with_info=False)
    begin_s = time.monotonic()
    status = says(graph, 'stereo_slam', 'no message on right/camera_info', 'segfloor calibrate')
    assert 'left/camera_info' not in status.message
    assert (
        time.monotonic() - begin_s > 0.9 * camera_watch.FIRST_INFO_S
    )  # it may come a little later


def test_images_taken_for_rectified_are_named(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED, '-p', 'image_kind:=rect')
    driver = Driver(graph, image='image_rect')
    graph.add(StereoSlamNode())
    driver.connect()
    driver.send('left', 0, frames[0].left)
    driver.send('right', 0, np.roll(frames[0].right, 4, axis=0))
    words = ('left/image_rect and right/image_rect are not rectified', '4.0 rows', 'image_raw')
    assert says(graph, 'stereo_slam', *words).level is Level.ERROR
    answers = [s for s in graph.statuses if s.node == 'stereo_slam' and not s.kind]
    (fault,) = json.loads(answers[-1].values['input_faults'])
    assert (fault['fault'], fault['unit']) == ('rows_apart', 'px')
    assert fault['value'] == pytest.approx(4.0, abs=0.1)


def test_a_camera_that_was_unplugged_is_named(make_graph, frames) -> None:
    graph = make_graph(*MOUNTED)
    driver = Driver(graph)
    graph.add(StereoSlamNode())
    driver.connect()
    now_ns = graph.tester.get_clock().now().nanoseconds
    for side in ('left', 'right'):
        driver.send(side, now_ns, getattr(frames[0], side))
    words = ('no image on left/image_raw for a while', 'connected')
    assert says(graph, 'stereo_slam', *words).level is not Level.OK


def test_a_mount_that_the_floor_contradicts_is_named_with_both_numbers(make_graph, frames) -> None:
    """The camera looks down by 0.15 rad = 8.6 deg; the parameters say 14.3 deg."""
    wrong = (*MOUNTED[:3], 'camera_pitch_rad:=0.25', *MOUNTED[4:])
    wrong += ('-p', 'image_reliability:=best_effort', '-p', 'keyframe_max_frames:=1')
    graph = make_graph(*wrong)
    driver = Driver(graph, profile=best_effort(IMAGES))
    graph.add(StereoSlamNode())
    driver.connect()
    for frame in frames:
        for side in ('left', 'right'):
            driver.send(side, frame.stamp_ns, getattr(frame, side))
    words = ('camera mount: pitch 14.3 deg, the floor shows 8.', 'camera_pitch_rad', 'tf')
    assert says(graph, 'stereo_slam', *words).level is Level.WARN


def test_keyframes_that_wait_for_the_mount_say_so(make_graph, frames) -> None:
    graph = make_graph()
    graph.add(FloorSegmentationNode())
    status = says(graph, 'floor_segmentation', 'nobody publishes', 'camera_mount')
    assert status.level is Level.WARN


def test_rates_counts_and_state_are_told(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    publishers = None
    for stamp_ns in (1, 2, 3):
        publishers = publish(graph, cloud_messages(stamp_ns), publishers)
    alone = {'map_points': cloud_messages(4)['map_points']}
    publish(graph, alone, publishers)
    publish(graph, cloud_messages(5), publishers)
    graph.until(lambda: len(labelled) == 4, 'four keyframes')
    graph.statuses.clear()
    values = says(graph, 'cloud_labelling', 'running').values
    assert (values['state'], values['processed'], values['dropped']) == ('active', '4', '1')
    assert values['failed'] == '0'
    assert float(values['processing_ms']) >= 0
    assert float(values['rss_mb']) > 10
    assert {f'rate_hz {name}' for name in alone} <= values.keys()
    graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=True))
    graph.until(lambda: health(graph, 'cloud_labelling').values['state'] == 'paused', 'the pause')


def test_a_problem_is_logged_when_it_begins_and_when_it_is_over(make_graph) -> None:
    graph = make_graph()
    node = graph.add(CloudLabellingNode())
    lines: list[str] = []
    take = lambda message: lines.append(message.msg)  # noqa: E731
    graph.tester.create_subscription(Log, '/rosout', take, 100)
    graph.until(lambda: node.count_subscribers('/rosout'), 'the listener to the log')
    for _ in range(3):
        node.reporter.diagnose('light', 'it is dark; switch the light on', lasts_s=1.0)
        graph.comes(lambda: False, 0.3)
    says(graph, 'cloud_labelling', 'it is dark')
    graph.until(lambda: 'over: it is dark' in lines, 'the end')
    assert lines.count('it is dark; switch the light on') == 1
    node.reporter.diagnose('light', 'it is dark; switch the light on')
    graph.until(lambda: lines.count('it is dark; switch the light on') == 2, 'the second time')


def test_rate_delay_and_problems_are_those_of_the_time() -> None:
    now = [100.0]
    found = Health(clock_s=lambda: now[0])
    for _ in range(20):
        found.received('image', 0.25)
    found.received('cloud', 1e9)
    found.found('qos', Level.ERROR, 'cannot connect', 3.0)
    found.found('stamps', Level.WARN, 'apart', 10.0)
    now[0] = 102.0
    level, words, values = found.summary('active')
    assert (level, words) == (Level.ERROR, 'cannot connect; apart')
    assert (values['rate_hz image'], values['delay_s image']) == ('10.0', '0.250')
    assert 'delay_s cloud' not in values
    now[0] = 104.0
    level, words, values = found.summary('active')
    assert (level, words, values['rate_hz image']) == (Level.WARN, 'apart', '0.0')
    found.over('stamps')
    found.waits('waiting for the floor')
    level, words, values = found.summary('active')
    assert (level, words, values['processed']) == (Level.OK, 'waiting for the floor', '0')
    found.processed(12.0, 'running')
    found.count('skipped')
    found.lost('image', 3)
    level, words, values = found.summary('active')
    assert (level, words, values['processed']) == (Level.OK, 'running', '1')
    assert (values['skipped'], values['lost image']) == ('1', '3')
    found.received('image', 0.1, waited_s=2.5)
    found.received('image', 0.1, waited_s=0.5)
    assert found.longest_wait() == ('image', 2.5)
    assert found.summary('active')[2]['queue_s image'] == '2.500'
    assert found.longest_wait()[1] == 0.0


def test_a_mount_that_the_floor_confirms_is_not_mentioned(frames) -> None:
    given = replace(MOUNT, height_m=1.2 * MOUNT.height_m)
    check, high = MountEstimator(CAMERA, given=MOUNT), MountEstimator(CAMERA, given=given)
    for frame in frames:
        for estimator in (check, high):
            estimator.add(frame.left, frame.right, np.eye(4))
    assert (check.mount, check.remark) == (MOUNT, None)
    assert high.mount == given
    assert high.remark is not None
    assert f'the floor shows {MOUNT.height_m:.2f}' in high.remark


def test_nodes_with_different_robots_say_so(make_graph) -> None:
    graph = make_graph()
    graph.add(FloorSegmentationNode())
    labelling = graph.add(CloudLabellingNode())
    (set_,) = labelling.set_parameters([Parameter('robot_height_m', value=0.4)])
    assert set_.successful
    status = says(graph, 'cloud_labelling', 'robot_height_m is 0.4 here', '1 in floor_segmentation')
    assert status.level == Level.WARN
