"""Poses, paths and transforms as messages. Quaternions are normalised on the way in."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import KeyframePath
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array, make_transform, quaternions_of
from segfloor_ros.core.quaternions import rotations_of
from segfloor_ros.nodes.messages.making import Make, Message, make_header, ros_message, to_ns


def pose_message(T_a_b: Array, make: Make = ros_message) -> Message:
    """Return the pose message of a (4, 4) transform."""
    return _pose(pose_numbers(T_a_b[None])[0], make)


def _pose(numbers: Array, make: Make = ros_message) -> Message:
    place, turn = filled('Point', numbers[:3], make), filled('Quaternion', numbers[3:], make)
    return make('geometry_msgs/msg/Pose', position=place, orientation=turn)


def filled(kind: str, numbers: Array, make: Make = ros_message) -> Message:
    """Return a type of geometry_msgs with the fields x, y, z and, of four numbers, w."""
    return make(f'geometry_msgs/msg/{kind}', **dict(zip('xyzw', numbers.tolist(), strict=False)))


def pose_array(pose: Message) -> Array:
    """Return the (4, 4) transform of a pose message. Raises InputError for impossible numbers."""
    return _rigid_motion(pose.position, pose.orientation)


def _rigid_motion(p: Message, q: Message) -> Array:
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
        self._poses: list[Message] = []

    def next(self, stamp_ns: int, path: KeyframePath) -> Message:
        """Return the message of the path as it is now."""
        count = min(len(self._stamp_ns), len(path.stamp_ns))
        has_moved = np.ones(len(path.stamp_ns), bool)
        has_moved[:count] = (self._stamp_ns[:count] != path.stamp_ns[:count]) | (
            self._T_map_base[:count] != path.T_map_base[:count]
        ).any(axis=(1, 2))
        moved = np.flatnonzero(has_moved)
        self._poses = [*self._poses[:count], *[None] * (len(has_moved) - count)]
        for i, numbers in zip(moved.tolist(), pose_numbers(path.T_map_base[moved]), strict=True):
            header, pose = make_header(int(path.stamp_ns[i]), self._frame_id), _pose(numbers)
            self._poses[i] = ros_message('geometry_msgs/msg/PoseStamped', header=header, pose=pose)
        self._stamp_ns, self._T_map_base = path.stamp_ns.copy(), path.T_map_base.copy()
        header = make_header(stamp_ns, self._frame_id)
        return ros_message('nav_msgs/msg/Path', header=header, poses=list(self._poses))


def path_arrays(message: Message) -> KeyframePath:
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
    stamp_ns: int, frame_id: str, child_frame_id: str, T_a_b: Array, make: Make = ros_message
) -> Message:
    """Return the transform of frame b (child) in frame a."""
    place, turn = filled('Vector3', T_a_b[:3, 3], make), pose_message(T_a_b, make).orientation
    return make(
        'geometry_msgs/msg/TransformStamped',
        header=make_header(stamp_ns, frame_id, make),
        child_frame_id=child_frame_id,
        transform=make('geometry_msgs/msg/Transform', translation=place, rotation=turn),
    )


def transform_array(message: Message) -> Array:
    """Return the (4, 4) transform of a transform message. Raises InputError when impossible."""
    return _rigid_motion(message.transform.translation, message.transform.rotation)


def pose_numbers(T_a_b: Array) -> Array:
    """Return transforms (N, 4, 4) as numbers (N, 7): x y z qx qy qz qw, with qw >= 0."""
    quaternions = quaternions_of(T_a_b[:, :3, :3])
    return np.concatenate([T_a_b[:, :3, 3], quaternions], axis=1)
