"""Poses, odometry, paths, transforms, wheels and IMU as messages. Quaternions are normalised on the
way in.
"""

from __future__ import annotations

import array

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    Vector3,
)
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from sensor_msgs.msg import Imu

from segfloor_ros.core.camera.images import NOT_MEASURED
from segfloor_ros.core.contracts import ImuSample, KeyframePath, WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array, invert, make_transform, quaternions_of
from segfloor_ros.core.quaternions import rotations_of
from segfloor_ros.core.twists import se3_log
from segfloor_ros.nodes.messages.topics import make_header, to_ns

LEAST_VARIANCE = 1e-6
"""Of a millimetre and a milliradian, in m² and rad²: filters take a zero for certainty."""

WHEELS_FRAME = 'wheel_odom'


def pose_message(T_a_b: Array) -> Pose:
    """Return the pose message of a (4, 4) transform."""
    return _pose_messages(T_a_b[None])[0]


def pose_array(pose: Pose) -> Array:
    """Return the (4, 4) transform of a pose message. Raises InputError for impossible numbers."""
    p, q = pose.position, pose.orientation
    values = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    if not np.isfinite(values).all() or np.linalg.norm(values[3:]) < 0.5:
        raise InputError(f'a pose of {values.tolist()} is impossible (x y z qx qy qz qw)')
    return make_transform(rotations_of(values[None, 3:])[0], values[:3])


def odometry_message(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    T_a_b: Array,
    covariance: Array,
    twist: Array | None = None,
    twist_covariance: Array | None = None,
) -> Odometry:
    """Return the odometry of frame b in frame a.

    covariance: (6, 6), order x y z roll pitch yaw. twist: (6,) linear and angular velocity in
    frame b, m/s and rad/s, with its covariance (6, 6); None is marked as unknown by a large
    variance.
    """
    message = Odometry(header=make_header(stamp_ns, frame_id), child_frame_id=child_frame_id)
    message.pose.pose = pose_message(T_a_b)
    message.pose.covariance = np.ascontiguousarray(covariance, np.float64).ravel()
    if twist is None:
        message.twist.covariance = (np.eye(6) / LEAST_VARIANCE).ravel()
    else:
        vx, vy, vz, wx, wy, wz = (float(value) for value in twist)
        message.twist.twist = Twist(
            linear=Vector3(x=vx, y=vy, z=vz), angular=Vector3(x=wx, y=wy, z=wz)
        )
        if twist_covariance is not None:
            message.twist.covariance = np.ascontiguousarray(twist_covariance, np.float64).ravel()
    return message


def pose_with_covariance_message(
    stamp_ns: int, frame_id: str, T_a_b: Array, covariance: Array
) -> PoseWithCovarianceStamped:
    """Return the pose of frame b in frame a. covariance: (6, 6), order x y z roll pitch yaw."""
    message = PoseWithCovarianceStamped(header=make_header(stamp_ns, frame_id))
    message.pose.pose = pose_message(T_a_b)
    message.pose.covariance = np.ascontiguousarray(covariance, np.float64).ravel()
    return message


def body_twist(T_a_before: Array, T_a_now: Array, duration_s: float) -> Array:
    """Return the mean velocity (6,) between two poses in the moving frame: m/s, rad/s."""
    return se3_log(invert(T_a_before) @ T_a_now) / duration_s


def twist_covariance(
    covariance_before: Array, T_a_now: Array, covariance_now: Array, duration_s: float
) -> Array:
    """Return the covariance (6, 6) of the velocity between two poses, in the moving frame: what is
    wrong with one has nothing to do with what is wrong with the other.

    covariance_before, covariance_now: (6, 6) of the poses, in the axes of frame a.
    """
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T_a_now[:3, :3].T
    return axes @ (covariance_before + covariance_now) @ axes.T / duration_s**2


def never_certain(covariance: Array) -> Array:
    """Return a covariance (6, 6) with `LEAST_VARIANCE` at least: the first pose is the origin by
    definition.
    """
    return covariance + np.diag(np.maximum(LEAST_VARIANCE - np.diag(covariance), 0.0))


class PathMessages:
    """Makes the messages of a path that grows. A path of an hour holds thousands of poses, each of
    six objects; those that have not moved since the last message are used again.
    """

    def __init__(self, frame_id: str) -> None:
        self._frame_id = frame_id
        self._stamp_ns: NDArray[np.int64] = np.zeros(0, np.int64)
        self._T_map_base: Array = np.zeros((0, 4, 4))
        self._poses: list[PoseStamped] = []

    def next(self, stamp_ns: int, path: KeyframePath) -> Path:
        """Return the message of the path as it is now."""
        count = min(len(self._stamp_ns), len(path.stamp_ns))
        has_moved = np.ones(len(path.stamp_ns), bool)
        has_moved[:count] = (self._stamp_ns[:count] != path.stamp_ns[:count]) | (
            self._T_map_base[:count] != path.T_map_base[:count]
        ).any(axis=(1, 2))
        moved = np.flatnonzero(has_moved)
        self._poses = [*self._poses[:count], *[PoseStamped()] * (len(has_moved) - count)]
        for i, pose in zip(moved.tolist(), _pose_messages(path.T_map_base[moved]), strict=True):
            header = make_header(int(path.stamp_ns[i]), self._frame_id)
            self._poses[i] = PoseStamped(header=header, pose=pose)
        self._stamp_ns, self._T_map_base = path.stamp_ns.copy(), path.T_map_base.copy()
        return Path(header=make_header(stamp_ns, self._frame_id), poses=list(self._poses))


def path_arrays(message: Path) -> KeyframePath:
    """Return stamps and poses of a path message. Raises InputError for impossible poses."""
    stamps = np.array([to_ns(pose.header.stamp) for pose in message.poses], np.int64)
    values = array.array('d')
    for stamped in message.poses:
        p, q = stamped.pose.position, stamped.pose.orientation
        values.extend((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    numbers = np.frombuffer(values, np.float64).reshape(-1, 7)
    if not np.isfinite(numbers).all() or (np.linalg.norm(numbers[:, 3:], axis=1) < 0.5).any():
        raise InputError('a path holds poses that are impossible')
    T_map_base = np.zeros((len(numbers), 4, 4))
    T_map_base[:, :3, :3] = rotations_of(numbers[:, 3:])
    T_map_base[:, :3, 3] = numbers[:, :3]
    T_map_base[:, 3, 3] = 1.0
    return KeyframePath(stamps, T_map_base)


def transform_message(
    stamp_ns: int, frame_id: str, child_frame_id: str, T_a_b: Array
) -> TransformStamped:
    """Return the transform of frame b (child) in frame a."""
    pose = pose_message(T_a_b)
    p = pose.position
    return TransformStamped(
        header=make_header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        transform=Transform(translation=Vector3(x=p.x, y=p.y, z=p.z), rotation=pose.orientation),
    )


def transform_array(message: TransformStamped) -> Array:
    """Return the (4, 4) transform of a transform message. Raises InputError when impossible."""
    t, q = message.transform.translation, message.transform.rotation
    return pose_array(Pose(position=Point(x=t.x, y=t.y, z=t.z), orientation=q))


def pose_numbers(T_a_b: Array) -> Array:
    """Return transforms (N, 4, 4) as numbers (N, 7): x y z qx qy qz qw, with qw >= 0."""
    quaternions = quaternions_of(T_a_b[:, :3, :3])
    return np.concatenate([T_a_b[:, :3, 3], quaternions], axis=1)


def _pose_messages(T_a_b: Array) -> list[Pose]:
    return [
        Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for x, y, z, qx, qy, qz, qw in pose_numbers(T_a_b).tolist()
    ]


def wheel_message(wheels: WheelPose, base_frame: str) -> Odometry:
    """Return a pose that wheels tell as a message."""
    no_covariance = np.zeros((6, 6))
    return odometry_message(
        wheels.stamp_ns, WHEELS_FRAME, base_frame, wheels.T_wheels_base, no_covariance
    )


def imu_message(sample: ImuSample, frame_id: str, R_frame_left: Array) -> Imu:
    """Return a sample as a message in a frame that R_frame_left (3, 3) turns it into."""
    message = Imu(
        header=make_header(sample.stamp_ns, frame_id),
        angular_velocity=_vector(R_frame_left @ sample.gyro_rad_s),
        linear_acceleration=_vector(R_frame_left @ sample.accel_m_s2),
    )
    message.orientation_covariance[0] = NOT_MEASURED
    return message


def _vector(values: Array) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))
