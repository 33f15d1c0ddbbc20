"""What somebody meets who starts the nodes for the first time: other topics, none, or twins."""

import time
from dataclasses import replace

import pytest
from node_messages import CALIBRATION, INPUTS, MOUNTED, cloud_messages, publish, stereo_messages
from rclpy.node import Node
from ros_graph import another_participant
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from stereo_drive import room_drive

from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, compressed_message
from segfloor_ros.nodes.messages.diagnostics import HEALTH, Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.topics import FRAMES, IMAGES, SLAM, TOPICS, to_time
from segfloor_ros.nodes.shared import reporter
from segfloor_ros.nodes.stereo_slam import StereoSlamNode
from segfloor_ros.nodes.watches.lookalikes import likeness


@pytest.fixture
def console(monkeypatch):
    """The warnings of all nodes with the time since the start."""
    lines: list[tuple[float, str]] = []
    from rclpy.impl.rcutils_logger import RcutilsLogger

    begun_s, log = time.monotonic(), RcutilsLogger.warning

    def warning(self, message, **options):
        lines.append((time.monotonic() - begun_s, message))
        return log(self, message, **options)

    monkeypatch.setattr(RcutilsLogger, 'warning', warning)
    return lines


@pytest.mark.parametrize(
    'kind', ['image_raw', 'image_rect', 'image_raw/compressed', 'image_rect/compressed']
)
def test_slam_takes_the_images_that_are_published(make_graph, kind) -> None:
    (frame, *_), _ = room_drive(1)
    graph = make_graph(*MOUNTED)
    node = graph.add(StereoSlamNode())
    names = [f'{side}/{what}' for side in ('left', 'right') for what in (kind, 'camera_info')]
    publishers = {name: graph.publisher(name) for name in names}
    graph.connected(list(publishers.values()))
    for side in ('left', 'right'):
        info = camera_info_message(0, side, getattr(CALIBRATION, side))
        publishers[f'{side}/camera_info'].publish(info)
        image = getattr(frame, side)
        message = (
            compressed_message(0, side, image, None)
            if kind.endswith('compressed')
            else image_message(0, side, image)
        )
        publishers[f'{side}/{kind}'].publish(message)
    graph.until(lambda: graph.reports('stereo_slam'), 'the answer')
    assert graph.reports('stereo_slam')[0].values['tracked'] == '1'
    others = {f'/left/{other}' for other in ('image_raw', 'image_rect')} - {f'/left/{kind}'}
    assert not {s.topic_name for s in node.subscriptions} & others


def test_raw_images_come_first_and_an_explicit_choice_holds(make_graph) -> None:
    graph = make_graph(*MOUNTED, '-p', 'image_kind:=rect')
    for kind in ('image_raw', 'image_rect'):
        for side in ('left', 'right'):
            graph.publisher(f'{side}/{kind}')
    node = graph.add(StereoSlamNode())
    graph.until(lambda: node.count_publishers('left/image_raw'), 'the driver')
    graph.comes(lambda: False, 0.5)
    assert node.count_subscribers('left/image_rect') == 1
    assert node.count_subscribers('left/image_raw') == 0
    graph.close()
    graph = make_graph(*MOUNTED)
    for kind in ('image_rect', 'image_raw'):
        for side in ('left', 'right'):
            graph.publisher(f'{side}/{kind}')
    node = graph.add(StereoSlamNode())
    graph.until(lambda: node.count_publishers('left/image_rect'), 'the driver')
    graph.until(lambda: node.count_subscribers('left/image_raw'), 'the subscription to raw images')


def test_a_topic_that_nobody_publishes_is_one_short_line_and_its_remedy_a_diagnosis(
    make_graph, console, monkeypatch
) -> None:
    monkeypatch.setattr(reporter, 'PATIENCE_S', 2.0)
    graph = make_graph()
    for name in ('/camera/infra1/image_rect_raw', '/camera/infra2/image_rect_raw', '/map_image'):
        graph.tester.create_publisher(Image, name, TOPICS['left/image_raw'].profile)
    graph.add(StereoSlamNode())

    def line() -> list[tuple[float, str]]:
        return [(s, text) for s, text in console if 'nobody publishes' in text]

    graph.until(line, 'the warning')
    seconds, text = line()[0]
    # Others may be started at the same time, and are seen one after the other.
    assert seconds > 2.0
    assert 'left/image_raw' in text
    assert 'right/image_raw' in text
    assert len(text) < 120
    assert not graph.comes(lambda: len(line()) > 1, 2.5), 'once is enough'
    (*_, health) = [s for s in graph.statuses if s.kind == HEALTH and s.node == 'stereo_slam']
    assert health.level is Level.WARN
    assert '-r left/image_raw:=/camera/infra1/image_rect_raw' in health.message
    assert '-r right/image_raw:=/camera/infra2/image_rect_raw' in health.message
    assert (
        '/left/camera_info: no other topic of the type sensor_msgs/msg/CameraInfo' in health.message
    )


def test_advice_names_the_topic_of_the_camera_and_none_that_these_nodes_make(make_graph) -> None:
    """A depth camera by its preset; floor segmentation of another robot runs in the same network,
    and draws on images.
    """
    camera = '/camera/camera/color/image_raw'
    graph = make_graph('-p', 'use_depth:=true', '-r', f'left/image_raw:={camera}')
    for name in ('/robot2/keyframe/floor_overlay', '/wrist/image'):
        graph.tester.create_publisher(Image, name, TOPICS['left/image_raw'].profile)
    graph.add(StereoSlamNode())
    graph.add(CloudLabellingNode())

    def health(node: str) -> str:
        said = [s.message for s in graph.statuses if s.kind == HEALTH and s.node == node]
        return said[-1] if said else ''

    graph.until(lambda: '/wrist/image' in health('stereo_slam'), 'what is published')
    text = health('stereo_slam')
    missing, _, advice = text.partition(';')
    assert camera in missing and 'left/image_raw' not in missing
    assert 'overlay' not in advice and 'right/' not in text
    graph.until(lambda: 'floor_mask' in health('cloud_labelling'), 'what is missing')
    text = health('cloud_labelling')
    assert '/keyframe/floor_mask is what floor_segmentation publishes' in text
    assert '-r ' not in text


def test_parts_that_are_missing_at_the_start_are_counted_and_not_logged(
    make_graph, console
) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    publishers = publish(graph, {'map_points': cloud_messages(0)['map_points']})
    publish(graph, cloud_messages(1), publishers)
    graph.until(lambda: labelled, 'the keyframe that is complete')
    graph.until(
        lambda: any(
            s.values.get('dropped') == '1' for s in graph.statuses if s.node == 'cloud_labelling'
        ),
        'the count',
    )
    assert [text for _, text in console if 'dropped' in text] == []


def test_one_camera_alone_is_declined_in_one_line_that_says_why(make_graph, console) -> None:
    frames, _ = room_drive(12)
    graph = make_graph(*MOUNTED)
    graph.add(StereoSlamNode())
    with another_participant() as driver:
        left = driver.create_publisher(Image, '/left/image_raw', IMAGES)
        graph.until(lambda: left.get_subscription_count() == 1, 'the left images are received')
        for frame in frames:
            left.publish(image_message(frame.stamp_ns, 'left', frame.left))
        graph.until(lambda: any('one camera alone' in line for _, line in console), 'the line')
    (line,) = {line for _, line in console if 'one camera alone' in line}
    assert 'left/image_raw' in line and 'right/image_raw' in line and '\n' not in line


def test_a_topic_of_another_type_is_named_as_that(make_graph) -> None:
    graph = make_graph('-p', 'image_transport:=raw')
    profile = TOPICS['left/image_raw'].profile
    # A process has a topic with one type only.
    with another_participant() as driver:
        driver.create_publisher(CompressedImage, 'left/image_raw', profile)
        graph.add(StereoSlamNode())
        words = (
            '/left/image_raw is published as sensor_msgs/msg/CompressedImage, not as sensor_msgs'
        )
        graph.until(lambda: any(words in s.message for s in graph.statuses), 'the diagnosis')
    assert all(s.node == SLAM for s in graph.statuses if words in s.message)


def test_a_node_of_the_same_name_is_named(make_graph, console) -> None:
    graph = make_graph()
    graph.add(CloudLabellingNode())
    graph.until(lambda: graph.reports_any('cloud_labelling'), 'a sign of life')
    assert not any('nodes are called' in text for _, text in console)
    twin = Node('cloud_labelling')
    graph.add(twin)
    words = '2 nodes are called /cloud_labelling and publish on the same topics'
    graph.until(lambda: any(words in text for _, text in console), 'the warning')
    health = [s for s in graph.statuses if s.kind == HEALTH and words in s.message]
    graph.until(lambda: health or any(words in s.message for s in graph.statuses), 'the status')
    found = [s for s in graph.statuses if words in s.message]
    assert found[-1].level is Level.ERROR


@pytest.mark.slow
def test_after_a_bag_has_ended_nobody_asks_for_the_camera(make_graph, console) -> None:
    """Its player publishes no time any more, and the images are as old as they were."""
    (frame, *_), _ = room_drive(1)
    graph = make_graph(*MOUNTED, '-p', 'use_sim_time:=true')
    node = graph.add(StereoSlamNode())
    clock = graph.tester.create_publisher(Clock, '/clock', FRAMES)
    publishers = {name: graph.publisher(name) for name in INPUTS}
    graph.connected([clock, *publishers.values()])
    stamp_ns = 1_000_000_000_000

    def told_the_time() -> bool:
        clock.publish(Clock(clock=to_time(stamp_ns)))
        return node.get_clock().now().nanoseconds == stamp_ns

    graph.until(told_the_time, 'the time of the recording')
    publish(graph, stereo_messages(replace(frame, stamp_ns=stamp_ns)), publishers)
    graph.until(lambda: graph.reports('stereo_slam'), 'the answer')
    assert not graph.comes(lambda: any('connected' in text for _, text in console), 5.0)


def test_the_side_of_a_topic_counts_more_than_its_letters() -> None:
    wanted = '/right/image_raw'
    assert likeness(wanted, '/camera/infra2/image_rect_raw') > likeness(wanted, '/left/image_raw')
    assert likeness(wanted, '/cam1/image_raw') > likeness(wanted, '/cam0/image_raw')
