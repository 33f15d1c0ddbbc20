import numpy as np
import pytest
from node_messages import grid_arrays
from rclpy.serialization import deserialize_message, serialize_message
from sampled_poses import assert_spread, drawn_errors, uneven_covariance
from scipy.spatial.transform import Rotation

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.camera_info import eye_calibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    POINT_OBSTACLE,
    POINT_UNKNOWN,
    FloorObservation,
    FloorScan,
    ImuSample,
    KeyframeFeatures,
    KeyframePath,
    LabelledPoints,
    Mount,
    SparseCloud,
    VDisparity,
)
from segfloor_ros.core.errors import CalibrationError, InputError
from segfloor_ros.core.geometry import R_ROS_OPTICAL, make_transform
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.twists import se3_exp
from segfloor_ros.nodes.messages import (
    camera_infos,
    grids,
    images,
    odometry,
    points,
    poses,
    scans,
    sensors,
)
from segfloor_ros.nodes.messages import images as arrays
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, rectified_calibration
from segfloor_ros.nodes.messages.diagnostics import Level, Status, status_message, statuses
from segfloor_ros.nodes.messages.saved_maps import map_start_message, map_start_ns
from segfloor_ros.nodes.messages.topics import to_ns, to_time

STAMP_NS = 1_403_715_273_262_142_976
RNG = np.random.default_rng(0)


def over_the_wire(message):
    """Return the message as a subscriber gets it."""
    return deserialize_message(serialize_message(message), type(message))


def test_stamps_keep_every_nanosecond() -> None:
    for stamp_ns in (0, 999_999_999, 1_000_000_000, STAMP_NS):
        assert to_ns(to_time(stamp_ns)) == stamp_ns
    assert to_time(STAMP_NS).sec == 1_403_715_273
    assert to_time(STAMP_NS).nanosec == 262_142_976


def test_a_grey_image_survives() -> None:
    for dtype in (np.uint8, np.uint16):
        image = RNG.integers(0, np.iinfo(dtype).max, (5, 7)).astype(dtype)
        message = over_the_wire(images.image_message(STAMP_NS, 'eye', image))
        assert (message.header.frame_id, to_ns(message.header.stamp)) == ('eye', STAMP_NS)
        np.testing.assert_array_equal(arrays.grey_image(message, 'left'), image)


def test_colour_and_padded_rows_become_grey() -> None:
    message = images.image_message(0, '', np.zeros((2, 8), np.uint8))
    message.encoding, message.width, message.step = 'bgr8', 2, 8
    message.data[:6] = type(message.data)('B', [10, 10, 10, 200, 200, 200])
    np.testing.assert_array_equal(arrays.grey_image(message, 'left'), [[10, 200], [0, 0]])


@pytest.mark.parametrize(
    'change',
    [{'encoding': '32FC1'}, {'width': 9}, {'step': 3}, {'height': 10_000, 'width': 10_000}],
)
def test_an_image_that_contradicts_itself_is_refused_by_name(change) -> None:
    message = images.image_message(0, '', np.zeros((4, 8), np.uint8))
    for field, value in change.items():
        setattr(message, field, value)
    with pytest.raises(InputError, match='left/image_raw'):
        arrays.grey_image(message, 'left/image_raw')


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_a_png_survives_and_a_jpeg_nearly(dtype) -> None:
    y, x = np.mgrid[0:40, 0:60]
    image = (100 + 50 * np.sin(x / 9) + y).astype(dtype)
    exact = over_the_wire(camera_infos.compressed_message(STAMP_NS, 'left', image, None))
    assert (to_ns(exact.header.stamp), exact.header.frame_id) == (STAMP_NS, 'left')
    found = arrays.grey_image(exact, 'left/image_raw/compressed')
    np.testing.assert_array_equal(found, image)
    assert found.dtype == dtype
    small = over_the_wire(camera_infos.compressed_message(STAMP_NS, 'left', image, 90))
    assert small.format.endswith('mono8' if dtype == np.uint8 else 'mono16')
    lossy = arrays.grey_image(small, 'left/image_raw/compressed')
    assert np.abs(lossy.astype(int) - image.astype(int)).max() <= (8 if dtype == np.uint8 else 0)


def test_a_damaged_file_is_refused_by_topic() -> None:
    message = camera_infos.compressed_message(STAMP_NS, 'left', np.zeros((40, 60), np.uint8), 90)
    message.data = message.data[:-9]
    with pytest.raises(InputError, match='left/image_raw/compressed: the JPEG is truncated'):
        arrays.grey_image(message, 'left/image_raw/compressed')


def test_calibrations_survive() -> None:
    camera = StereoCamera(640, 480, 400.0, 410.0, 320.5, 240.25, 0.12)
    rectified = rectified_calibration(camera)
    assert rectified.right.P[0, 3] == pytest.approx(-400.0 * 0.12)
    assert rectified.camera == camera
    raw = EyeCalibration(
        640, 480,
        np.array([[500.0, 0, 321], [0, 501, 239], [0, 0, 1]]),
        np.array([0.1, -0.2, 0.001, 0.002, 0.03]),
        Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix(),
        rectified.right.P,
    )  # fmt: skip
    back = eye_calibration(over_the_wire(camera_info_message(STAMP_NS, 'eye', raw)), 'info')
    for name in 'KDRP':
        np.testing.assert_array_equal(getattr(back, name), getattr(raw, name))
    assert (back.width, back.height, back.distortion_model) == (640, 480, 'plumb_bob')
    assert StereoCalibration(rectified.left, back).camera == camera


def test_an_uncalibrated_camera_is_refused_by_topic() -> None:
    message = camera_info_message(0, '', rectified_calibration(_camera()).left)
    message.k = np.zeros(9)
    with pytest.raises(CalibrationError, match=r'left/camera_info.*K\[0\] = 0'):
        eye_calibration(message, 'left/camera_info')


def _camera() -> StereoCamera:
    return StereoCamera(4, 3, 2.0, 2.0, 1.5, 1.0, 0.1)


def test_poses_paths_and_transforms_survive() -> None:
    stack = se3_exp(RNG.normal(size=(4, 6)))
    message = over_the_wire(
        odometry.odometry_message(STAMP_NS, 'odom', 'base_link', stack[0], np.diag(np.arange(6.0)))
    )
    np.testing.assert_allclose(poses.pose_array(message.pose.pose), stack[0], atol=1e-15)
    np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), np.diag(np.arange(6.0)))
    path = KeyframePath(np.array([5, 7, STAMP_NS, STAMP_NS + 1]), stack)
    back = poses.path_arrays(over_the_wire(poses.PathMessages('map').next(STAMP_NS, path)))
    np.testing.assert_array_equal(back.stamp_ns, path.stamp_ns)
    np.testing.assert_allclose(back.T_map_base, stack, atol=1e-15)
    mount = Mount(0.3, 0.12, -0.01, 0.2, 0.06, 0.0)
    message = poses.transform_message(0, 'base_link', 'eye', mount.T_base_left)
    again = Mount.from_transform(poses.transform_array(over_the_wire(message)))
    for name in ('height_m', 'pitch_rad', 'roll_rad', 'forward_m', 'left_m', 'yaw_rad'):
        assert getattr(again, name) == pytest.approx(getattr(mount, name), abs=1e-12)


def test_a_pose_faces_where_ros_says() -> None:
    quarter_left = make_transform(
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3])
    )
    pose = poses.pose_message(quarter_left)
    assert (pose.position.x, pose.position.y, pose.position.z) == (1.0, 2.0, 3.0)
    assert pose.orientation.z == pytest.approx(np.sqrt(0.5))
    assert pose.orientation.w == pytest.approx(np.sqrt(0.5))


def test_of_the_two_quaternions_of_a_turn_the_one_with_a_positive_w_is_sent() -> None:
    turns = Rotation.from_quat(np.random.default_rng(3).normal(size=(200, 4)))
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, :3] = turns.as_matrix()
    expected = turns.as_quat(canonical=True)
    np.testing.assert_allclose(poses.pose_numbers(T)[:, 3:], expected, atol=1e-12)


def test_what_an_imu_measured_is_turned_into_the_frame_of_the_message() -> None:
    sample = ImuSample(STAMP_NS, np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.zeros(3))
    message = over_the_wire(sensors.imu_message(sample, 'imu_link', R_ROS_OPTICAL))
    turn, push = message.angular_velocity, message.linear_acceleration
    # Optical x right, y down, z forward; x forward, y left, z up.
    assert (turn.x, turn.y, turn.z) == (3.0, -1.0, -2.0)
    assert (push.x, push.y, push.z) == (6.0, -4.0, -5.0)


def test_the_velocity_is_in_the_moving_frame() -> None:
    before = make_transform(Rotation.from_euler('z', 90, degrees=True).as_matrix(), np.zeros(3))
    after = before.copy()
    after[:3, 3] = [0.0, 0.2, 0.0]
    np.testing.assert_allclose(
        odometry.body_twist(before, after, 0.1), [2.0, 0, 0, 0, 0, 0], atol=1e-12
    )


def test_the_covariance_of_the_velocity_is_that_of_both_poses_in_the_moving_frame() -> None:
    left = make_transform(Rotation.from_euler('z', 90, degrees=True).as_matrix(), np.zeros(3))
    before, now = np.diag([4.0, 1, 0, 0, 0, 1]), np.diag([12.0, 3, 0, 0, 0, 3])
    found = odometry.twist_covariance(before, left, now, 2.0)
    # x of the frame points along y of the moving frame, with its sign turned; 2 s: a quarter.
    np.testing.assert_allclose(found, np.diag([1.0, 4, 0, 0, 0, 1]), atol=1e-12)
    # An eighth of a turn: what is unsure along x of the frame is so ahead and to the right.
    slanted = make_transform(Rotation.from_euler('z', 45, degrees=True).as_matrix(), np.zeros(3))
    ahead = odometry.twist_covariance(np.zeros((6, 6)), slanted, np.diag([4.0, 0, 0, 0, 0, 0]), 1.0)
    np.testing.assert_allclose(ahead[:2, :2], [[2.0, -2.0], [-2.0, 2.0]], atol=1e-12)
    message = odometry.odometry_message(0, 'odom', 'base_link', left, now, np.ones(6), found)
    np.testing.assert_allclose(over_the_wire(message).twist.covariance.reshape(6, 6), found)


def test_a_velocity_is_as_unsure_as_samples_of_both_poses() -> None:
    """A base that pitches, rolls and turns, somewhere in a frame with other axes."""
    rng = np.random.default_rng(1)
    before = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
    now = before @ se3_exp(np.array([0.04, 0.01, -0.01, 0.02, -0.03, 0.04]))
    covariances = uneven_covariance(rng), uneven_covariance(rng)
    pairs = []
    for T, covariance in zip((before, now), covariances, strict=True):
        # Errors of place and turn, in the axes of the frame.
        errors = drawn_errors(rng, covariance, 2000)
        samples = np.tile(T, (len(errors), 1, 1))
        samples[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ T[:3, :3]
        samples[:, :3, 3] += errors[:, :3]
        pairs.append(samples)
    mean = odometry.body_twist(before, now, 0.1)
    twists = np.array([odometry.body_twist(a, b, 0.1) for a, b in zip(*pairs, strict=True)])
    expected = odometry.twist_covariance(covariances[0], now, covariances[1], 0.1)
    assert_spread(twists - mean, expected)


def test_no_variance_is_below_the_least_one() -> None:
    covariance = np.diag([0.0, 1e-9, 2.0, 0, 0, 0])
    covariance[0, 2] = covariance[2, 0] = 1e-12
    expected = np.diag([1e-6, 1e-6, 2.0, 1e-6, 1e-6, 1e-6])
    expected[0, 2] = expected[2, 0] = 1e-12
    np.testing.assert_allclose(odometry.never_certain(covariance), expected, rtol=1e-12)


def test_impossible_poses_are_refused() -> None:
    pose = poses.pose_message(np.eye(4))
    pose.position.x = float('nan')
    with pytest.raises(InputError):
        poses.pose_array(pose)
    zero = poses.pose_message(np.eye(4))
    zero.orientation.w = 0.0
    with pytest.raises(InputError):
        poses.pose_array(zero)
    with pytest.raises(InputError):
        message = poses.PathMessages('map').next(0, KeyframePath(np.array([1]), np.eye(4)[None]))
        message.poses[0].pose = zero
        poses.path_arrays(message)


def test_a_path_of_impossible_poses_is_refused() -> None:
    path = KeyframePath(np.array([5, 7, 9]), se3_exp(RNG.normal(size=(3, 6))))
    message = poses.PathMessages('map').next(STAMP_NS, path)
    message.poses[2].pose.position.x = float('inf')
    with pytest.raises(InputError):
        poses.path_arrays(over_the_wire(message))


def test_poses_that_have_not_moved_are_sent_again_and_others_anew() -> None:
    first = KeyframePath(np.array([5, 7, 9]), se3_exp(RNG.normal(size=(3, 6))))
    moved = KeyframePath(np.array([5, 7, 9, 11]), se3_exp(RNG.normal(size=(4, 6))))
    moved.T_map_base[0] = first.T_map_base[0]
    shorter = KeyframePath(np.array([7]), moved.T_map_base[:1])
    path_messages, used = poses.PathMessages('map'), []
    for stamp_ns, path in ((9, first), (11, moved), (12, shorter)):
        message = path_messages.next(stamp_ns, path)
        used.append(message.poses)
        assert message == poses.PathMessages('map').next(stamp_ns, path)
        back = poses.path_arrays(over_the_wire(message))
        np.testing.assert_array_equal(back.stamp_ns, path.stamp_ns)
        np.testing.assert_allclose(back.T_map_base, path.T_map_base, atol=1e-12)
    assert used[1][0] is used[0][0]
    assert used[1][1] is not used[0][1]


def test_the_beginning_of_a_map_survives() -> None:
    message = over_the_wire(map_start_message(STAMP_NS + 5, 'map', STAMP_NS))
    assert (to_ns(message.header.stamp), map_start_ns(message)) == (STAMP_NS + 5, STAMP_NS)


def test_an_empty_path_is_a_path() -> None:
    empty = KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    back = poses.path_arrays(over_the_wire(poses.PathMessages('map').next(0, empty)))
    assert back.T_map_base.shape == (0, 4, 4)


def test_clouds_survive() -> None:
    xyz = RNG.normal(size=(5, 3)).astype(np.float32)
    xyz[2] = np.nan
    features = KeyframeFeatures(
        RNG.uniform(0, 640, (5, 2)).astype(np.float32), np.array([3, -1, 7, 9, 2], np.int32), xyz
    )
    message = over_the_wire(points.features_message(STAMP_NS, 'map', features))
    assert [field.name for field in message.fields] == ['x', 'y', 'z', 'u', 'v', 'id']
    assert not message.is_dense
    back = points.features_arrays(message, 'keyframe/features')
    np.testing.assert_array_equal(back.xyz_map, xyz)
    np.testing.assert_array_equal(back.uv_px, features.uv_px)
    np.testing.assert_array_equal(back.point_id, features.point_id)


def test_labelled_points_survive_and_are_told_apart() -> None:
    labelled = LabelledPoints(
        np.array([1, 4, 6], np.int32),
        np.arange(9, dtype=np.float32).reshape(3, 3),
        np.array([POINT_FLOOR, POINT_OBSTACLE, POINT_UNKNOWN], np.uint8),
        np.array([0.25, 1.0, 0.0], np.float32),
    )
    message = over_the_wire(points.labelled_message(0, 'map', labelled))
    assert {f.name for f in message.fields} == {'x', 'y', 'z', 'id', 'label', 'confidence'}
    back = points.labelled_arrays(message, 'labelled_points')
    for name in ('point_id', 'xyz_map', 'label', 'confidence'):
        np.testing.assert_array_equal(getattr(back, name), getattr(labelled, name))
    obstacles = points.points_at(0, 'map', labelled, np.array([1]))
    only = points.sparse_cloud_arrays(obstacles, 'obstacle_points')
    assert only.point_id.tolist() == [4]
    np.testing.assert_array_equal(only.xyz_map, [[3, 4, 5]])


def test_a_foreign_cloud_is_read_by_its_field_names() -> None:
    """Big endian, doubles, other order, padded rows and two rows."""
    dtype = np.dtype([('id', '>i4'), ('z', '>f8'), ('y', '>f8'), ('x', '>f8')])
    rows = np.array([(7, 3, 2, 1), (8, 6, 5, 4)], dtype)
    message = points.sparse_cloud_message(
        0, 'map', SparseCloud(np.zeros(0, np.int32), np.zeros((0, 3)))
    )
    offsets = {'id': 0, 'z': 4, 'y': 12, 'x': 20}
    for field in message.fields:
        field.offset, field.datatype = offsets[field.name], 5 if field.name == 'id' else 8
    message.is_bigendian, message.point_step = True, 28
    message.height, message.width, message.row_step = 2, 1, 32
    padded = b''.join(p.tobytes() + b'junk' for p in rows)
    message.data = type(message.data)('B', padded)
    back = points.sparse_cloud_arrays(message, 'map_points')
    assert back.point_id.tolist() == [7, 8]
    np.testing.assert_array_equal(back.xyz_map, [[1, 2, 3], [4, 5, 6]])


def test_clouds_that_contradict_themselves_are_refused_by_name() -> None:
    cloud = SparseCloud(np.array([1], np.int32), np.zeros((1, 3), np.float32))
    short = points.sparse_cloud_message(0, 'map', cloud)
    short.width = 2
    with pytest.raises(InputError, match='map_points: 16 bytes'):
        points.sparse_cloud_arrays(short, 'map_points')
    without = points.sparse_cloud_message(0, 'map', cloud)
    without.fields = [field for field in without.fields if field.name != 'id']
    with pytest.raises(InputError, match='map_points: the cloud has no field id'):
        points.sparse_cloud_arrays(without, 'map_points')


def test_the_floor_scan_survives() -> None:
    ranges = np.array([0.0, np.nan, 2.5], np.float32)
    standing = np.array([1.0, np.nan, np.nan], np.float32)
    for obstacles, movable in ((None, None), (standing, None), (standing, ranges)):
        scan = FloorScan(-0.5, 0.25, ranges, obstacles, 8.25, movable)
        message = over_the_wire(scans.scan_message(STAMP_NS, 'base_link', scan))
        assert (message.angle_min, message.angle_max) == (-0.5, 0.0)
        back = scans.scan_arrays(message, 'scan')
        assert (back.angle_min_rad, back.angle_increment_rad) == (-0.5, 0.25)
        assert back.range_max_m == 8.25
        np.testing.assert_array_equal(back.ranges_m, ranges)
        for found, expected in ((back.obstacle_m, obstacles), (back.movable_m, movable)):
            if expected is None:
                assert found is None
            else:
                np.testing.assert_array_equal(found, expected)


def test_the_disparity_image_gives_depth() -> None:
    disparity = np.array([[0, 2, 4, 0]] * 3, np.float32)
    counted = VDisparity(np.zeros((3, 128), np.intp), 0, 2)
    mask, scan = np.zeros((3, 4), np.uint8), FloorScan(0, 1, disparity[0])
    seen = FloorObservation(disparity, mask, np.zeros(3), scan, 64.0, counted)
    message = over_the_wire(images.disparity_message(0, 'eye', _camera(), seen))
    pixels = np.frombuffer(message.image.data, np.float32).reshape(3, 4)
    np.testing.assert_array_equal(pixels, disparity)
    assert message.f * message.t / pixels[0, 1] == pytest.approx(2.0 * 0.1 / 2.0)
    assert (message.min_disparity, message.max_disparity) == (0.0, 64.0)


def test_the_map_is_row_major_from_its_lower_left_cell() -> None:
    cells = np.array([[0, 100, -1], [-1, -1, 0]], np.int8)
    grid = OccupancyGrid(cells, 0.05, (-1.0, 2.0))
    message = over_the_wire(grids.grid_message(STAMP_NS, 'map', grid))
    assert (message.info.width, message.info.height) == (3, 2)
    assert list(message.data) == [0, 100, -1, -1, -1, 0]
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, 2.0)
    assert message.info.origin.orientation.w == 1.0
    back = grid_arrays(message, 'map')
    np.testing.assert_array_equal(back.cells, cells)
    assert (back.resolution_m, back.origin_xy_m) == (0.05, (-1.0, 2.0))


def test_a_status_survives() -> None:
    status = Status(STAMP_NS, '/robot/stereo_slam: connections', Level.WARN, 'words', {'a': '1'})
    (back,) = statuses(over_the_wire(status_message(status)))
    assert back == status
    assert (back.node, back.kind) == ('stereo_slam', 'connections')


def test_a_part_of_an_image_survives_though_its_principal_point_lies_outside() -> None:
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, -60.0], [0.0, 0.0, 1.0]])
    part = EyeCalibration(
        640, 200, K, np.zeros(5), np.eye(3), np.hstack([K, np.zeros((3, 1))]), is_part=True
    )
    message = over_the_wire(camera_info_message(STAMP_NS, 'eye', part))
    for is_rectified in (False, True):
        back = eye_calibration(message, 'info', is_rectified)
        assert (back.width, back.height) == (640, 200)
        np.testing.assert_array_equal(back.K, K)
    camera = StereoCamera(640, 200, 500.0, 500.0, 320.0, -60.0, 0.1)
    for eye in (rectified_calibration(camera).left, rectified_calibration(camera).right):
        eye_calibration(over_the_wire(camera_info_message(STAMP_NS, 'eye', eye)), 'info', True)
