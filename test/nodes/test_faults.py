"""What cameras, links and foreign nodes do to the chain: it says so and maps on."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from node_chain import CALIBRATION, CHAIN, NodeChain, seen_again
from rclpy.node import Node
from ros_graph import fresh_graph
from std_srvs.srv import Trigger
from stereo_drive import room_drive

from segfloor_ros.core.geometry import invert
from segfloor_ros.core.slam.places.views import NEW_TURN_RAD
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.poses import path_arrays, pose_array
from segfloor_ros.nodes.messages.topics import FLOOR, SLAM, TOPICS, to_ns
from segfloor_ros.nodes.shared.stamp_order import AGREEING

NEW_VIEW_RAD = 1.1 * NEW_TURN_RAD
"""Turn per frame: every one is a new view, which becomes a keyframe."""

PLACES = 24
FRAME_NS = 100_000_000
S = 1_000_000_000
REFUSED_S = 20.0


class Drive:
    """A drive to and fro; every frame has the stamp after the last one's."""

    def __init__(self, chain: NodeChain) -> None:
        self.chain = chain
        self._views, self._poses = room_drive(PLACES, step_m=0.05, arc_rad=NEW_VIEW_RAD)
        self._count = 0
        self.stamp_ns = 0
        self._truth: dict[int, np.ndarray] = {}
        self._odometry = chain.graph.collect('odometry')
        self.paths = chain.graph.collect('keyframe/path')

    def next(self):
        """Return the next frame."""
        turn = 2 * (PLACES - 1)
        place = min(self._count % turn, turn - self._count % turn)
        self.stamp_ns += FRAME_NS
        self._count += 1
        self._truth[self.stamp_ns] = self._poses[place]
        return seen_again(self._views[place], self._count, self.stamp_ns)

    @property
    def next_stamp_ns(self) -> int:
        """The stamp of the next frame."""
        return self.stamp_ns + FRAME_NS

    def go_on(self, count: int = 3, check: bool = True) -> None:
        """Drive on undisturbed: every frame must be tracked, at its true place."""
        for _ in range(count):
            (answer,) = self.chain.drive([self.next()])
            assert answer.level is Level.OK, answer
        if check:
            self.check_pose()

    def jump(self) -> None:
        """Send the pairs that show that the clock has jumped: all but the last are dropped."""
        for answer in self.chain.drive([self.next() for _ in range(AGREEING - 1)]):
            assert 'from the one before; dropped' in answer.message

    def check_pose(self) -> None:
        """The last pose must be the true one."""
        found = self.stamp_ns

        def poses():
            return [m for m in self._odometry if to_ns(m.header.stamp) == found]

        self.chain.graph.until(poses, 'the last pose')
        self.chain.graph.until(lambda: self.paths, 'the keyframes')
        first = int(path_arrays(self.paths[-1]).stamp_ns[0])
        truth = invert(self._truth[first]) @ self._truth[found]
        error = pose_array(poses()[0].pose.pose)[:3, 3] - truth[:3, 3]
        assert np.linalg.norm(error) < 0.03


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    with fresh_graph() as graph:
        chain = NodeChain(graph, tmp_path_factory.mktemp('logs'))
        try:
            drive = Drive(chain)
            chain.start(*CHAIN)
            graph.until(lambda: graph.tester.count_publishers('keyframe/path'), 'the keyframes')
            yield drive
        finally:
            chain.stop()
            assert 'Traceback' not in ''.join(chain.log(node) for node in CHAIN)


def info(side: str, stamp_ns: int, **changes):
    message = camera_info_message(stamp_ns, f'{side}_eye', getattr(CALIBRATION, side))
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def said(chain: NodeChain, node: str, since: int, words: str) -> list[str]:
    """Return the warnings and errors that a node has logged since, once there are any with these
    words.
    """
    chain.graph.until(lambda: words in chain.log(node)[since:], f'{node} to say {words!r}')
    lines = chain.log(node)[since:].splitlines()
    return [line for line in lines if '[WARN]' in line or '[ERROR]' in line]


def test_a_camera_info_of_foreign_numbers_is_refused_with_one_line(drive) -> None:
    """Before the real one comes: it must not stand in its way."""
    chain = drive.chain
    for changes, words in (
        ({'k': [float('nan')] * 9}, 'left/camera_info'),
        ({'width': 10_000, 'height': 10_000}, 'left/camera_info'),
    ):
        begun = len(chain.log(SLAM))
        chain.inputs['left/camera_info'].publish(info('left', 0, **changes))
        (line,) = said(chain, SLAM, begun, words)
        assert line.count('left/camera_info') == 1
    drive.go_on()


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'encoding': '64FC7'}, '64FC7'),
        ({'step': 17}, '17'),
        ({'width': 10_000, 'height': 10_000}, '10000x10000'),
        ({'width': 0, 'height': 0}, '0x0'),
    ],
)
def test_a_foreign_image_is_refused_with_one_line(drive, changes, words) -> None:
    chain = drive.chain
    begun = len(chain.log(SLAM))
    for _ in range(2):
        frame = drive.next()
        chain.send(frame, **changes)
        (answer,) = chain.answers([frame.stamp_ns])
        assert answer.level is Level.ERROR
        assert 'left/image_raw' in answer.message
        assert words in answer.message
    assert len(said(chain, SLAM, begun, words)) <= 2
    drive.go_on()


def test_an_image_of_another_size_than_the_calibration_is_refused(drive) -> None:
    chain = drive.chain
    frame = drive.next()
    half = replace(frame, left=frame.left[::2].copy(), right=frame.right[::2].copy())
    chain.send(half)
    (answer,) = chain.answers([frame.stamp_ns])
    assert answer.level is Level.ERROR
    assert '320x120' in answer.message
    drive.go_on()


def test_frames_that_are_lost_at_random_leave_no_gap_in_the_track(drive) -> None:
    rng = np.random.default_rng(7)
    frames = [drive.next() for _ in range(30)]
    kept = [frame for frame in frames if rng.random() > 0.1]
    assert len(kept) < len(frames)
    answers = drive.chain.drive(kept)
    assert all(answer.level is Level.OK for answer in answers)
    drive.go_on()


def test_images_of_one_eye_alone_are_named_and_left_out(drive) -> None:
    chain = drive.chain
    lonely = [drive.next() for _ in range(3)]
    for frame in lonely:
        chain.send(frame, sides=('left',))
    drive.go_on()
    for answer in chain.answers([frame.stamp_ns for frame in lonely]):
        assert answer.level is Level.ERROR
        assert 'no message on right/image_raw' in answer.message


def test_frames_twice_or_out_of_order_are_taken_once_and_in_order(drive) -> None:
    chain = drive.chain
    first, second, third = (drive.next() for _ in range(3))
    begun = len(chain.graph.statuses)
    for frame in (first, first, third, second):
        chain.send(frame)
    drive.go_on()
    by_stamp = {}
    for status in chain.graph.statuses[begun:]:
        if status.node == SLAM and not status.kind:
            by_stamp.setdefault(status.stamp_ns, []).append(status)
    assert [s.level for s in by_stamp[first.stamp_ns]] == [Level.OK]
    assert [s.level for s in by_stamp[third.stamp_ns]] == [Level.OK]
    assert [s.message for s in by_stamp[second.stamp_ns]] == [
        'older than the pair before it; dropped'
    ]
    stamps = path_arrays(drive.paths[-1]).stamp_ns
    assert (np.diff(stamps) > 0).all()


@pytest.mark.parametrize('gap_s', [5, 3600])
def test_a_camera_that_was_unplugged_is_taken_up_again(drive, gap_s) -> None:
    """The same view returns after a pause, or after a jump of the clock."""
    drive.stamp_ns += gap_s * S
    drive.jump()
    drive.go_on()
    stamps = path_arrays(drive.paths[-1]).stamp_ns
    assert stamps[0] < FRAME_NS * 10, 'the map was begun anew'


def test_two_publishers_of_one_topic_are_told_apart_by_their_stamps(drive) -> None:
    chain = drive.chain
    begun = len(chain.log(SLAM))
    stranger, topic = Node('stranger'), TOPICS['left/image_raw']
    other = stranger.create_publisher(topic.type, topic.name, topic.profile)
    chain.graph.until(lambda: other.get_subscription_count(), 'the second publisher')
    black = np.zeros((240, 320), np.uint8)
    for _ in range(3):
        other.publish(image_message(drive.stamp_ns + FRAME_NS // 2, 'other', black))
        drive.go_on(1)
    assert any(
        'left/image_raw is published by 2 nodes' in line
        for line in said(chain, SLAM, begun, 'left/image_raw')
    )
    stranger.destroy_node()


def test_a_slow_subscriber_holds_nobody_up(drive) -> None:
    """One that never takes a message, and a node of the chain that stands still for a while."""
    chain = drive.chain
    sleeper = Node('sleeper')
    for name in ('map_points', 'labelled_points', 'keyframe/left/image_rect', 'map'):
        topic = TOPICS[name]
        sleeper.create_subscription(topic.type, name, lambda message: None, topic.profile)
    # A place that is seen again makes no keyframe: of a new map every one is seen first.
    assert chain.graph.call(Trigger, f'{SLAM}/reset', Trigger.Request()).success
    begun_ns = drive.next_stamp_ns
    drive.go_on(1, check=False)
    chain.graph.until(lambda: path_arrays(drive.paths[-1]).stamp_ns[0] == begun_ns, 'a new map')
    begun = len(chain.graph.statuses)
    os.kill(chain.pid(FLOOR), signal.SIGSTOP)
    try:
        drive.go_on(8)
    finally:
        os.kill(chain.pid(FLOOR), signal.SIGCONT)
    keyframes = {
        s.stamp_ns
        for s in chain.graph.statuses[begun:]
        if s.node == SLAM and s.values.get('keyframe') == '1'
    }
    assert len(keyframes) >= 3
    for stamp_ns in keyframes:
        chain.mapped(stamp_ns)
    sleeper.destroy_node()


def test_a_clock_that_goes_back_begins_a_new_map(drive) -> None:
    chain = drive.chain
    drive.stamp_ns = 1000 * FRAME_NS
    drive.jump()
    frame = drive.next()
    (answer,) = chain.drive([frame])
    assert answer.level is Level.OK
    chain.mapped(frame.stamp_ns)
    chain.graph.until(lambda: len(path_arrays(drive.paths[-1]).stamp_ns) == 1, 'a new path')
    chain.drive([drive.next() for _ in range(3)])
