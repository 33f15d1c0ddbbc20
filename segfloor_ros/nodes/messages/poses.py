"""Poses, paths and transforms as messages. Quaternions are normalised on the way in."""

from __future__ import annotations

import array

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Path
from numpy.typing import NDArray

from segfloor_ros.core.contracts import KeyframePath
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array, make_transform, quaternions_of
from segfloor_ros.core.quaternions import rotations_of
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
