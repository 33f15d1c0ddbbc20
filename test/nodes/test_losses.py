"""What is lost on the way into a node is counted, named with its topic, and said."""

import re
import time

import numpy as np
import pytest
from node_chain import CHAIN, NodeChain
from node_messages import INPUTS, MOUNTED, cloud_messages, publish, stereo_messages
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_graph import fresh_graph
from std_srvs.srv import SetBool
from stereo_drive import room_drive

from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.messages.diagnostics import HEALTH, LASTS_S, Level
from segfloor_ros.nodes.messages.topics import IMAGES, KEYFRAMES, PROFILES, TOPICS
from segfloor_ros.nodes.shared.joining import StampJoiner
from segfloor_ros.nodes.shared.reporter import LossCounter, loss_in_words, loss_level
from segfloor_ros.nodes.slam_camera import PairQueue
from segfloor_ros.nodes.stereo_slam import StereoSlamNode
from segfloor_ros.nodes.watches.camera import CameraWatch


def health(graph, node: str):
    """Return what a node has said about how it fares."""
    return [s for s in graph.statuses if s.node == node and s.kind == HEALTH]


def test_gaps_in_the_numbers_are_losses_and_a_new_publisher_is_none() -> None:
    counter = LossCounter()
    assert [counter.note(n) for n in (7, 8, 11, 12, 1, 2, 4)] == [0, 0, 2, 0, 0, 0, 1]
    assert [counter.note(n) for n in (None, 500, None, 502)] == [0, 0, 0, 0]


def test_a_loss_is_told_with_what_to_do_about_it() -> None:
    words = loss_in_words('map_points', 3, 'cloud_labelling', QoSProfile(depth=100))
    assert words.startswith('3 messages lost on map_points: cloud_labelling was too slow')
    assert 'queue of 100' in words
    lossy = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    assert 'image_reliability' in loss_in_words('left/image_raw', 1, 'stereo_slam', lossy)
    for profile in lossy, IMAGES:  # what Fast DDS drops where images are large
        words = loss_in_words('left/image_raw', 1, 'stereo_slam', profile)
        assert f'FASTRTPS_DEFAULT_PROFILES_FILE={PROFILES}' in words and PROFILES.exists()


def test_how_bad_a_loss_is_follows_from_what_is_lost() -> None:
    """A calibration comes again, of small images only the latest counts; a picture less is a lower
    rate; a keyframe that a node misses is never in the map.
    """
    levels = {name: loss_level(topic) for name, topic in TOPICS.items()}
    assert levels['left/camera_info'] is levels['frame/left/image_rect'] is Level.OK
    assert levels['left/image_raw'] is levels['imu'] is Level.WARN
    assert levels['keyframe/left/image_rect'] is levels['map_points'] is Level.ERROR


def test_a_queue_that_runs_over_is_named_with_its_topic_and_the_node_goes_on(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    publishers = publish(graph, cloud_messages(1))
    graph.until(lambda: labelled, 'the first keyframe')
    last = KEYFRAMES.depth + 10
    # Nobody takes a message meanwhile: the graph is not spun.
    for stamp_ns in range(2, last + 1):
        for name, message in cloud_messages(stamp_ns).items():
            publishers[name].publish(message)
    time.sleep(LASTS_S + 0.2)
    graph.until(lambda: len(labelled) > KEYFRAMES.depth, 'the keyframes of the queue')
    lost = last - len(labelled)
    assert lost == 9

    def said() -> bool:
        return any(
            s.values['lost map_points'] == str(lost) for s in health(graph, 'cloud_labelling')
        )

    graph.until(said, 'the count')
    status = health(graph, 'cloud_labelling')[-1]
    assert status.level is Level.ERROR
    assert f'{lost} messages lost on map_points' in status.message
    assert 'lossless' in status.message
    assert any(
        'cloud_labelling falls behind' in s.message for s in health(graph, 'cloud_labelling')
    )


def test_small_images_without_a_partner_are_neither_kept_nor_said(make_graph) -> None:
    """Of those only the latest counts; hours of a drive lose many."""
    graph = make_graph()
    node = graph.add(CloudLabellingNode())
    joiner = StampJoiner(('frame/left/image_rect', 'frame/right/image_rect'), capacity=2)
    for stamp_ns in range(50):
        joiner.add('frame/left/image_rect', stamp_ns, None)
        node.reporter.report_dropped(joiner, lambda _: 1)
    assert joiner.take_dropped() == []
    graph.until(lambda: health(graph, 'cloud_labelling'), 'a sign of life')
    assert health(graph, 'cloud_labelling')[-1].values['dropped'] == '0'


def test_what_comes_while_a_node_is_paused_is_not_lost(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    publishers = publish(graph, cloud_messages(1))
    graph.until(lambda: len(labelled) == 1, 'the first keyframe')
    graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=True))
    for message in cloud_messages(2).items():
        publishers[message[0]].publish(message[1])
    graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=False))
    publish(graph, cloud_messages(3), publishers)
    graph.until(lambda: len(labelled) == 2, 'the keyframe after the pause')
    graph.statuses.clear()
    graph.until(lambda: health(graph, 'cloud_labelling'), 'a sign of life')
    assert health(graph, 'cloud_labelling')[-1].values['lost map_points'] == '0'


@pytest.mark.parametrize('before_calibration', [False, True])
def test_frames_that_come_faster_than_they_are_tracked_are_skipped_and_said(
    make_graph, before_calibration
) -> None:
    """A camera that floods: the newest frames are tracked, every frame gets its answer. Frames that
    wait for their calibration are kept.
    """
    frames, _ = room_drive(12, step_m=0.01)
    graph = make_graph(*MOUNTED)
    graph.add(StereoSlamNode())
    inputs = {name: graph.publisher(name) for name in INPUTS}
    graph.connected(list(inputs.values()))

    def send(frame, is_wanted=lambda name: True) -> None:
        for name, message in stereo_messages(frame).items():
            if is_wanted(name):
                inputs[name].publish(message)

    for frame in frames:
        send(frame, lambda name: not (before_calibration and name.endswith('camera_info')))
        if frame.index == 0 and not before_calibration:
            graph.until(lambda: graph.reports('stereo_slam'), 'the first answer')
    if before_calibration:
        graph.comes(lambda: False, 0.5)
        send(frames[0], lambda name: name.endswith('camera_info'))
    graph.until(lambda: len(graph.reports('stereo_slam')) == len(frames), 'all answers')
    by_stamp = {s.stamp_ns: s for s in graph.reports('stereo_slam')}
    taken = [f.index for f in frames if 'skipped' not in by_stamp[f.stamp_ns].message]
    if before_calibration:
        assert taken == [f.index for f in frames], 'there is time to catch up'
        return
    assert taken == [0, 7, 8, 9, 10, 11], 'of a burst less than twice as many as may wait'
    assert all(by_stamp[frames[i].stamp_ns].level is Level.OK for i in taken)
    graph.until(lambda: health(graph, 'stereo_slam')[-1].values['skipped'] == '6', 'the count')
    message = health(graph, 'stereo_slam')[-1].message
    assert re.search(r'left/image_raw comes faster than it is tracked: \d of 10 images', message)


@pytest.mark.parametrize(
    ('rate_hz', 'skipped', 'said'),
    [(10, 4, None), (10, 20, '8 of 10 images a second'), (2, 20, '1.6 of 2 images a second')],
)
def test_a_rate_is_called_low_where_it_is_and_not_for_a_short_burst(
    make_graph, rate_hz, skipped, said
):
    """100 images, of which the last ones came in a burst."""
    node = make_graph(*MOUNTED).add(StereoSlamNode())
    watch = CameraWatch(node)
    watch.expect('left/image_raw', 'right/image_raw')
    for number in range(100):
        watch.saw_image('left/image_raw', stamp_ns := number * 10**9 // rate_hz)
        if number < 100 - skipped:
            watch.note_taken()
        else:
            watch.report_skipped(stamp_ns, is_ready=True)
    problem = node.reporter.health.problems.get('skipped')
    assert (problem is None) if said is None else (said in problem.text)


def taken_of(arriving: list[int], least: int) -> tuple[list[int], int]:
    """Return the pairs that are processed where so many arrive during each, and the longest queue
    at the end.
    """
    queue, taken, number = PairQueue(), [], 0
    for count in (1, *arriving):
        queue.extend((number + i, {}) for i in range(count))
        number += count
        queue.skip_overdue(True, least)
        if queue:
            taken.append(queue.popleft()[0])
    return taken, len(queue)


def test_what_comes_while_a_keyframe_is_mapped_is_caught_up_on() -> None:
    taken, waiting = taken_of([5, 0, 1, 0, 1, 0, 1, 0], least=3)
    assert taken == list(range(9))
    assert waiting == 0


def test_a_camera_that_is_too_fast_all_the_time_has_no_more_waiting_than_may() -> None:
    taken, waiting = taken_of([2] * 60, least=3)
    assert waiting < 3
    assert set(np.diff(taken[30:])) == {2}, 'one of two, the other is skipped'


@pytest.mark.slow
def test_no_keyframe_is_lost_where_images_come_faster_than_they_are_tracked(tmp_path) -> None:
    """Bursts as of a camera of 30 Hz whose images wait for a core that is busy: what is skipped was
    never a keyframe, and every keyframe comes into the map.
    """
    bursts, together = 6, 8
    frames, _ = room_drive(2 + bursts * together, step_m=0.01, arc_rad=0.02)
    with fresh_graph() as graph:
        chain = NodeChain(graph, tmp_path)
        try:
            chain.start(*CHAIN, max_waiting_frames=3)
            chain.drive(frames[:2])
            for burst in range(bursts):
                first = 2 + burst * together
                for frame in frames[first : first + together]:
                    chain.send(frame)
                graph.comes(lambda: False, together / 30)
            chain.answers([frames[-1].stamp_ns])
            answers = graph.reports('stereo_slam')
            keyframes = [a.stamp_ns for a in answers if a.values.get('keyframe') == '1']
            for stamp_ns in keyframes:
                chain.mapped(stamp_ns)
        finally:
            chain.stop()
        skipped = [a for a in answers if 'skipped' in a.message]
        in_map = {s.stamp_ns for s in graph.reports('occupancy_grid') if s.level is Level.OK}
    assert len(skipped) >= bursts and len(keyframes) > 2
    assert all(a.values['tracked'] == '1' for a in answers if a not in skipped)
    assert in_map == set(keyframes)
