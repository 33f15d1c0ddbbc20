"""Wheel odometry and IMU over DDS: from a recording to poses of frames that show nothing."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from node_messages import MOUNTED
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT, depth_of_room

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.camera.measurements import imu_sample, wheel_pose
from segfloor_ros.core.contracts import ImuSample, StereoFrame, WheelPose
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.quaternions import quaternion_xyzw
from segfloor_ros.nodes import slam_camera
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.images import grey8_image, right_image
from segfloor_ros.nodes.messages.poses import pose_array, transform_message
from segfloor_ros.nodes.messages.sensors import imu_message, wheel_message
from segfloor_ros.nodes.messages.topics import KEYFRAMES, to_ns
from segfloor_ros.nodes.shared.inputs import LOOK_S
from segfloor_ros.nodes.slam_sensors import SensorInput
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

FRAMES, BLIND = 14, range(6, 10)
MS = 1_000_000


@pytest.fixture
def drive(tmp_path):
    """A drive whose images show nothing for a while, with what the wheels tell."""
    frames, poses = room_drive(FRAMES)
    grey = np.full(frames[0].left.shape, 90, np.uint8)
    for k in BLIND:
        frames[k] = StereoFrame(k, frames[k].stamp_ns, grey, grey)
    folder = write_kitti(tmp_path / 'drive', frames)
    rows = [[k * 0.1, *pose[:3, 3], *quaternion_xyzw(pose[:3, :3])] for k, pose in enumerate(poses)]
    np.savetxt(folder / 'wheel_odometry.txt', rows, fmt='%.9f')
    return folder, poses


def played(folder: Path, rate: float = 0.0) -> tuple[str, ...]:
    """Return the arguments of nodes for a recording."""
    return '-p', f'input:={folder}', '-p', f'rate:={rate}', '-p', 'background:=false'


def assert_true(odometry, poses) -> None:
    """Each pose must be the true one."""
    for message in odometry:
        truth = invert(poses[0]) @ poses[round(to_ns(message.header.stamp) * 1e-8)]
        error = invert(truth) @ pose_array(message.pose.pose)
        assert np.linalg.norm(error[:3, 3]) < 0.02


def test_frames_that_show_nothing_have_the_pose_of_the_wheels(make_graph, drive) -> None:
    folder, poses = drive
    graph = make_graph(*played(folder), *MOUNTED)
    odometry = graph.collect('odometry')
    graph.add(StereoSlamNode())
    graph.add(make_stereo_camera())
    graph.until(lambda: len(odometry) == FRAMES, 'the odometry of every frame')
    assert_true(odometry, poses)
    sigma_m = [np.sqrt(message.pose.covariance[0]) for message in odometry]
    assert min(sigma_m[k] for k in BLIND) > 2 * sigma_m[5]


@pytest.mark.slow
def test_where_the_imu_of_a_recording_is_comes_through_tf(make_graph, drive) -> None:
    pytest.importorskip('tf2_msgs')
    folder, _ = drive
    rows = ''.join(f'{t},0,0,0,0,-9.81,0\n' for t in range(0, FRAMES * 100 * MS, 5 * MS))
    (folder / 'imu.csv').write_text(rows)
    T_left_imu = make_transform(np.eye(3), np.array([0.1, 0.0, -0.3]))
    (folder / 'imu.yaml').write_text(
        f'T_BS: {{rows: 4, cols: 4, data: {T_left_imu.ravel().tolist()}}}'
    )
    graph = make_graph(*played(folder, 1.0), *MOUNTED)
    slam = graph.add(StereoSlamNode())
    graph.add(make_stereo_camera())

    def places() -> list[list[float]]:
        samples = slam.slam.sensors.gyroscope.samples if slam.slam else []
        return [sample.place_m.tolist() for sample in samples]

    graph.until(lambda: len(places()) > 100, 'a hundred samples of the IMU')
    # Until tf has told the place, samples count as felt at the camera.
    assert places()[-1] == [0.1, 0.0, -0.3]


@pytest.mark.slow
def test_where_no_topic_tells_the_odometry_that_another_node_broadcasts_is_taken(
    make_graph, drive, monkeypatch
) -> None:
    folder, poses = drive
    (folder / 'wheel_odometry.txt').unlink()
    monkeypatch.setattr('segfloor_ros.nodes.slam_sensors.DISCOVERY_S', 0.0)
    graph = make_graph(*played(folder), *MOUNTED, '-p', 'publish_odom_tf:=false')
    odometry = graph.collect('odometry')
    tf_msgs = pytest.importorskip('tf2_msgs.msg')
    slam = graph.add(StereoSlamNode())
    others = graph.tester.create_publisher(tf_msgs.TFMessage, '/tf', KEYFRAMES)
    graph.until(lambda: graph.tester.count_subscribers('/tf'), 'the listener to tf')
    told = [
        transform_message(round(k * 1e8), 'odom', 'base_link', pose) for k, pose in enumerate(poses)
    ]
    others.publish(tf_msgs.TFMessage(transforms=told))
    graph.add(make_stereo_camera())
    graph.until(lambda: len(odometry) == FRAMES, 'the odometry of every frame')
    assert_true(odometry, poses)
    assert slam.slam.sensors.messages['wheel_odometry'] >= FRAMES - 2


def test_wheels_and_imu_survive_the_way_through_messages() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 0.0
    told = wheel_pose(wheel_message(WheelPose(123_456_789, pose), 'base_link'), 'wheel_odometry')
    assert told.stamp_ns == 123_456_789
    np.testing.assert_allclose(told.T_wheels_base, pose)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    sample = ImuSample(5, np.array([0.1, 0.2, 0.3]), np.array([1.0, -9.8, 0.5]))
    message = imu_message(sample, 'left', quarter)
    T_left_imu = make_transform(quarter.T, np.array([0.1, 0.0, -0.2]))
    assert message.angular_velocity.x == pytest.approx(-0.2)
    back = imu_sample(message, T_left_imu)
    np.testing.assert_allclose(back.place_m, [0.1, 0.0, -0.2])
    np.testing.assert_allclose(back.gyro_rad_s, sample.gyro_rad_s)
    np.testing.assert_allclose(back.accel_m_s2, sample.accel_m_s2)


class Tf:
    """Transforms that know one frame."""

    def fused_until_ns(self):
        return None

    def between(self, target: str, source: str):
        turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
        known = {('left', 'imu_link'): make_transform(turn, np.array([0.0, 0.1, -0.3]))}
        return known.get((target, source))


@pytest.fixture
def now_s() -> list[float]:
    """The time that the sensors are told."""
    return [100.0]


@pytest.fixture
def sensors(make_graph, now_s):
    graph = make_graph('-p', 'autostart:=false')
    node = graph.add(StereoSlamNode())
    return SensorInput(node, Tf(), lambda: None, clock_s=lambda: now_s[0])


def imu(stamp_ns: int, frame: str, accel=(0.0, 0.0, 9.81)) -> Imu:
    return imu_message(ImuSample(stamp_ns, np.zeros(3), np.array(accel)), frame, np.eye(3))


def test_an_imu_is_turned_by_tf_or_by_gravity_or_not_used(sensors) -> None:
    sensors.begin('left', np.eye(3))
    sensors.receive('imu', imu(1, 'imu_link'))
    (sample,) = sensors.take(0)
    np.testing.assert_allclose(sample.accel_m_s2, [0, -9.81, 0])
    np.testing.assert_allclose(sample.place_m, [0.0, 0.1, -0.3])
    sensors.reset()
    sensors.begin('left', np.eye(3))
    sensors.receive('imu', imu(2, 'elsewhere'))
    assert sensors.take(0) == []
    sensors.receive('imu', imu(3, 'elsewhere'))
    assert not sensors.is_behind(100 * MS)  # no image waits for it
    assert sensors.take(0) == []
    sensors.receive('imu', imu(4, '', (0.0, -9.81, 0.0)))
    assert [m.stamp_ns for m in sensors.take(0)] == [4]


def test_an_imu_is_in_the_axes_of_the_rectified_camera(sensors) -> None:
    R_rectified_left = Rotation.from_rotvec((0.1, -0.2, 0.3)).as_matrix()
    for frame, accel_left, place_left in (
        ('imu_link', [0, -9.81, 0], [0.0, 0.1, -0.3]),
        ('elsewhere', [0, -9.81, 0], [0.0, 0.0, 0.0]),
    ):
        sensors.reset()
        sensors.begin('left', R_rectified_left)
        accel = (0.0, 0.0, 9.81) if frame == 'imu_link' else (0.0, -9.81, 0.0)
        sensors.receive('imu', imu(1, frame, accel))
        (sample,) = sensors.take(0)
        np.testing.assert_allclose(sample.accel_m_s2, R_rectified_left @ accel_left)
        np.testing.assert_allclose(sample.place_m, R_rectified_left @ place_left, atol=1e-12)


def test_each_image_takes_what_was_measured_up_to_it_and_one_more(sensors) -> None:
    for k in (0, 2, 1, 3, 4, 5):
        sensors.receive('imu', imu(k * 5 * MS, 'imu_link'))
    sensors.receive('wheel_odometry', wheel_message(WheelPose(8 * MS, np.eye(4)), 'base_link'))
    sensors.begin('left', np.eye(3))  # the first image is looked at
    assert [m.stamp_ns // MS for m in sensors.take(6 * MS)] == [8, 0, 5, 10]
    assert [m.stamp_ns // MS for m in sensors.take(13 * MS, lag_ns=4 * MS)] == [15, 20]
    sensors.receive('imu', imu(12 * MS, 'imu_link'))  # late
    assert [m.stamp_ns // MS for m in sensors.take(30 * MS)] == [12, 25]


def test_an_image_waits_for_a_sensor_that_is_late_and_not_for_long(sensors, now_s) -> None:
    assert not sensors.is_behind(50 * MS)  # nothing was ever heard
    sensors.receive('imu', imu(40 * MS, ''))
    assert sensors.is_behind(60 * MS)
    sensors.receive('imu', imu(60 * MS, ''))
    assert not sensors.is_behind(60 * MS)
    assert not sensors.is_behind(60 * MS, lag_ns=2 * MS)  # what comes next would tell little more
    assert sensors.is_behind(70 * MS)
    now_s[0] += 1.1 * LOOK_S
    assert not sensors.is_behind(70 * MS)
    now_s[0] += 1.0  # the sensor has fallen silent
    assert not sensors.is_behind(90 * MS)


def test_messages_that_came_while_the_node_was_busy_are_taken_at_once(make_graph) -> None:
    graph = make_graph()
    node = graph.add(CloudLabellingNode())
    taken: list[Imu] = []
    node.inputs.subscribe('imu', taken.append, takes_all=True)
    node.inputs.update()
    imus = graph.publisher('imu')
    graph.connected([imus])
    for k in range(60):
        imus.publish(imu(k * 5 * MS, 'left'))
    time.sleep(0.5)  # the middleware receives them meanwhile
    passes = set()
    graph.until(lambda: passes.add(len(taken)) or len(taken) == 60, 'the samples')
    assert len(passes) < 20
    assert [to_ns(m.header.stamp) for m in taken] == [k * 5 * MS for k in range(60)]


@pytest.fixture
def depth_drive(tmp_path):
    """A drive of a depth camera: no right images."""
    frames, poses = room_drive(8)
    folder = write_kitti(tmp_path / 'rgbd', frames)
    for frame, pose in zip(frames, poses, strict=True):
        depth = depth_of_room(pose @ MOUNT.T_base_left)
        cv2.imwrite(str(make(folder / 'depth') / f'{frame.index:06d}.png'), depth)
    return folder, poses


def make(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder


def test_depth_images_take_the_place_of_right_ones_that_nobody_publishes(
    make_graph, depth_drive, monkeypatch
) -> None:
    monkeypatch.setattr(slam_camera, 'DISCOVERY_S', 0.5)
    folder, poses = depth_drive
    graph = make_graph(*played(folder), *MOUNTED, '-p', 'depth:=true')
    odometry, right = graph.collect('odometry'), graph.collect('keyframe/right/image_rect')
    masks, scans = graph.collect('keyframe/floor_mask'), graph.collect('scan')
    graph.add(StereoSlamNode())
    graph.add(FloorSegmentationNode())
    graph.add(make_stereo_camera())
    graph.until(lambda: len(odometry) == 8 and masks and scans, 'odometry and floor')
    assert_true(odometry, poses)
    disparity = right_image(right[0], 'keyframe/right/image_rect')
    assert disparity.dtype == np.float32
    # The floor fills the lowest rows of the picture.
    mask = grey8_image(masks[0], 'keyframe/floor_mask')
    assert (mask[-40:] == 255).mean() > 0.9


def test_right_images_that_are_seen_late_are_taken_before_depth_images(
    make_graph, monkeypatch
) -> None:
    monkeypatch.setattr(slam_camera, 'DISCOVERY_S', 2.0)
    graph = make_graph()
    node = graph.add(StereoSlamNode())
    graph.publisher('left/image_raw')
    graph.publisher('depth/image_raw')
    assert not graph.comes(lambda: node.count_subscribers('depth/image_raw'), 0.5)
    right = graph.publisher('right/image_raw')
    assert not graph.comes(lambda: node.count_subscribers('depth/image_raw'), 2.0)
    assert node.count_subscribers('right/image_raw') == 1
    graph.tester.destroy_publisher(right)
    graph.until(lambda: node.count_subscribers('depth/image_raw'), 'depth for want of right images')
    graph.publisher('right/image_raw')
    graph.until(lambda: node.count_subscribers('right/image_raw'), 'the right images again')
    graph.until(lambda: not node.count_subscribers('depth/image_raw'), 'no depth any more')
