"""Real /tf and /tf_static between the process of `stereo_slam` and the test."""

from typing import Any

import numpy as np
import pytest
from node_chain import NodeChain
from stereo_drive import room_drive
from stereo_room import MOUNT

from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.nodes.frame_tree import FrameTree
from segfloor_ros.nodes.messages.poses import pose_array, transform_array, transform_message
from segfloor_ros.nodes.messages.topics import KEYFRAMES, LATCHED, LATCHED_BY_MANY, SLAM, to_ns

tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs could not be built by make')

FRAMES = 8
CAMERA_FRAME = 'left_eye'
GIVEN = ('camera_height_m', 'camera_pitch_rad', 'camera_roll_rad')
WITHOUT_MOUNT = dict.fromkeys(GIVEN, '.nan')
DRIFT = make_transform(np.eye(3), np.array([0.3, -0.2, 0.0]))


@pytest.fixture(scope='module')
def drive():
    return room_drive(FRAMES, step_m=0.04)


class Listener:
    """tf as another process sees it."""

    def __init__(self, graph) -> None:
        self.graph = graph
        self.frames = FrameTree()
        self.moving: list[Any] = []
        self.fixed: list[Any] = []
        node, kind = graph.tester, tf2_msgs.TFMessage
        node.create_subscription(kind, '/tf', self._take_moving, KEYFRAMES)
        node.create_subscription(kind, '/tf_static', self._take_fixed, LATCHED_BY_MANY)

    def stamps(self, child: str) -> list[int]:
        return [to_ns(m.header.stamp) for m in self.moving if m.child_frame_id == child]

    def _take_moving(self, message) -> None:
        for found in message.transforms:
            self.moving.append(found)
            stamp_ns, T = to_ns(found.header.stamp), transform_array(found)
            self.frames.add_moving(stamp_ns, found.header.frame_id, found.child_frame_id, T)

    def _take_fixed(self, message) -> None:
        for found in message.transforms:
            self.fixed.append(found)
            T = transform_array(found)
            self.frames.add_fixed(found.header.frame_id, found.child_frame_id, T)


class Broadcaster:
    """Another node's frames."""

    def __init__(self, graph) -> None:
        self._kind = tf2_msgs.TFMessage
        self.moving = graph.tester.create_publisher(self._kind, '/tf', KEYFRAMES)
        self.fixed = graph.tester.create_publisher(self._kind, '/tf_static', LATCHED)

    def send_fixed(self, *links) -> None:
        """links: parent, child, T_parent_child."""
        self.fixed.publish(self._kind(transforms=[transform_message(0, *link) for link in links]))

    def send(self, stamp_ns: int, *link) -> None:
        self.moving.publish(self._kind(transforms=[transform_message(stamp_ns, *link)]))


@pytest.fixture
def start(make_graph, tmp_path):
    """Start SLAM with changed parameters in a graph of its own."""
    chains = []

    def start(before=None, **parameters: Any) -> NodeChain:
        graph = make_graph()
        if before is not None:
            before(graph)
        chains.append(NodeChain(graph, tmp_path))
        chains[-1].start(SLAM, **parameters)
        return chains[-1]

    yield start
    for chain in chains:
        chain.stop()


def poses_by_stamp(messages) -> dict[int, np.ndarray]:
    return {to_ns(m.header.stamp): pose_array(m.pose.pose) for m in messages}


def test_the_chain_of_frames_leads_to_the_camera(start, drive) -> None:
    """map → odom → base_link → camera, each link at the stamp of the image."""
    frames, truth = drive
    chain = start(tf_wait_s=1.0)
    graph, tf = chain.graph, Listener(chain.graph)
    keyframes, odometry = graph.collect('keyframe/odometry'), graph.collect('odometry')
    graph.until(lambda: graph.tester.count_subscribers('/tf') >= 2, 'the listeners')
    graph.until(lambda: graph.tester.count_publishers('/tf') >= 1, 'the broadcaster')
    # Both are known then, and connected a moment later.
    graph.comes(lambda: False, 0.5)
    chain.drive(frames)
    stamps = [frame.stamp_ns for frame in frames]
    graph.until(lambda: tf.stamps('base_link') == stamps, 'all transforms')
    assert tf.stamps('odom') == stamps
    assert {m.child_frame_id for m in tf.moving} == {'odom', 'base_link'}
    graph.until(lambda: tf.fixed, 'the mount')
    (fixed,) = tf.fixed
    assert (fixed.header.frame_id, fixed.child_frame_id) == ('base_link', CAMERA_FRAME)
    graph.until(lambda: len(odometry) == len(frames), 'odometry')
    for stamp_ns, T_odom_base in poses_by_stamp(odometry).items():
        found = tf.frames.lookup('odom', 'base_link', stamp_ns)
        np.testing.assert_allclose(found, T_odom_base, atol=1e-9)
    for frame, T_world_base in zip(frames, truth, strict=True):
        T_map_base = tf.frames.lookup('map', 'base_link', frame.stamp_ns)
        np.testing.assert_allclose(T_map_base, invert(truth[0]) @ T_world_base, atol=0.02)
        T_map_camera = tf.frames.lookup('map', CAMERA_FRAME, frame.stamp_ns)
        np.testing.assert_allclose(T_map_camera, T_map_base @ MOUNT.T_base_left, atol=1e-9)
    for stamp_ns, T_map_base in poses_by_stamp(keyframes).items():
        found = tf.frames.lookup('map', 'base_link', stamp_ns)
        np.testing.assert_allclose(found, T_map_base, atol=0.005)


@pytest.mark.slow
def test_without_publish_tf_nothing_is_broadcast(start, drive) -> None:
    frames, _ = drive
    chain = start(publish_tf='false')
    tf, odometry = Listener(chain.graph), chain.graph.collect('odometry')
    chain.drive(frames[:3])
    chain.graph.until(lambda: len(odometry) == 3, 'odometry')
    assert not chain.graph.comes(lambda: tf.moving or tf.fixed, 0.3)


@pytest.mark.slow
def test_a_mount_on_tf_is_that_of_the_parameters(start, drive) -> None:
    """Over two links, as a camera's body stands between the base and its optical frame."""
    frames, _ = drive
    T_base_body = make_transform(np.eye(3), np.array([0.1, 0.0, 0.2]))
    links = (
        ('base_link', 'camera_link', T_base_body),
        ('camera_link', CAMERA_FRAME, invert(T_base_body) @ MOUNT.T_base_left),
    )
    others: list[Broadcaster] = []

    def broadcast(graph) -> None:
        others.append(Broadcaster(graph))
        others[0].send_fixed(*links)

    poses = []
    for parameters, before in (({}, None), (WITHOUT_MOUNT, broadcast)):
        chain = start(before, **parameters)
        mounts = chain.graph.collect('camera_mount')
        odometry = chain.graph.collect('odometry')
        chain.graph.until(lambda chain=chain: chain.graph.tester.count_publishers('odometry'), '')
        chain.drive(frames[:4])
        chain.graph.until(lambda m=mounts: m, 'the mount')
        found = Mount.from_transform(transform_array(mounts[0]))
        assert (found.height_m, found.pitch_rad) == pytest.approx((MOUNT.height_m, MOUNT.pitch_rad))
        chain.graph.until(
            lambda o=odometry: frames[3].stamp_ns in {to_ns(m.header.stamp) for m in o},
            'the pose of the last frame',
        )
        poses.append(pose_array(odometry[-1].pose.pose))
        chain.stop()
        chain.graph.close()
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-9)


@pytest.mark.slow
def test_without_tf_the_wait_ends_and_the_mount_is_measured(start, drive) -> None:
    frames, _ = drive
    chain = start(**WITHOUT_MOUNT, tf_wait_s=1.0)
    tf, mounts = Listener(chain.graph), chain.graph.collect('camera_mount')
    chain.drive(frames[:3])
    chain.graph.until(lambda: mounts and tf.fixed, 'the mount measured')
    measured = Mount.from_transform(transform_array(mounts[0]))
    assert measured.height_m == pytest.approx(MOUNT.height_m, rel=0.03)
    np.testing.assert_allclose(transform_array(tf.fixed[0]), transform_array(mounts[0]), atol=1e-12)
    assert chain.log(SLAM).count(f'no tf from base_link to {CAMERA_FRAME} within 1 s') == 1


@pytest.mark.slow
def test_a_camera_that_hangs_on_its_body_is_put_on_the_base_with_it(start, drive) -> None:
    """The optical frame has a parent already; a second one would tear the tree apart."""
    frames, _ = drive
    T_body_camera = make_transform(np.eye(3), np.array([0.0, 0.06, 0.0]))
    others: list[Broadcaster] = []

    def broadcast(graph) -> None:
        others.append(Broadcaster(graph))
        others[0].send_fixed(('camera_link', CAMERA_FRAME, T_body_camera))

    chain = start(broadcast, tf_wait_s=4.0)
    tf = Listener(chain.graph)
    chain.graph.connected([others[0].fixed])
    chain.drive(frames[:1])
    chain.graph.until(lambda: len(tf.fixed) == 2, 'both links')
    assert {m.child_frame_id for m in tf.fixed} == {'camera_link', CAMERA_FRAME}
    found = tf.frames.lookup('base_link', CAMERA_FRAME)
    np.testing.assert_allclose(found, MOUNT.T_base_left, atol=1e-9)


@pytest.mark.slow
def test_odometry_of_another_node_is_corrected(start, drive) -> None:
    """The other node's odometry starts elsewhere and drifts; at the times of the images, over both
    links, the base is where SLAM has it.
    """
    frames, truth = drive
    others: list[Broadcaster] = []
    chain = start(lambda graph: others.append(Broadcaster(graph)), publish_odom_tf='false')
    tf = Listener(chain.graph)
    chain.graph.connected([others[0].moving])
    T_odom_base = {}
    for frame in frames:
        for step in range(3):
            # Twice as often as the images and a little late, so that the odometry is interpolated.
            stamp_ns = frame.stamp_ns + (2 * step - 1) * 25_000_000
            drift = np.linalg.matrix_power(DRIFT, frame.index)
            T_odom_base[stamp_ns] = drift @ truth[frame.index]
            if stamp_ns > 0:
                others[0].send(stamp_ns, 'odom', 'base_link', T_odom_base[stamp_ns])
        chain.drive([frame])
        if frame.index > 0:
            stamp_ns = frame.stamp_ns
            chain.graph.until(lambda: stamp_ns in tf.stamps('odom'), 'the correction')  # noqa: B023
    own = [m for m in tf.moving if m.header.frame_id == 'map']
    assert {m.child_frame_id for m in own} == {'odom'}
    by_stamp = {frame.stamp_ns: frame for frame in frames}
    at_frames = [m for m in own if to_ns(m.header.stamp) in by_stamp]
    assert len(at_frames) >= len(frames) - 1
    for message in at_frames:
        stamp_ns = to_ns(message.header.stamp)
        frame = by_stamp[stamp_ns]
        T_map_base = transform_array(message) @ tf.frames.lookup('odom', 'base_link', stamp_ns)
        expected = invert(truth[0]) @ truth[frame.index]
        np.testing.assert_allclose(T_map_base, expected, atol=0.02)
    # The camera is silent, the other odometry goes on: map -> odom stays as it was, and fresh.
    last = transform_array(own[-1])
    latest_ns = frames[-1].stamp_ns + 400_000_000
    others[0].send(latest_ns, 'odom', 'base_link', T_odom_base[max(T_odom_base)])
    chain.graph.until(lambda: latest_ns in tf.stamps('odom'), 'the correction without a frame')
    np.testing.assert_allclose(tf.frames.lookup('map', 'odom', latest_ns), last, atol=1e-12)
