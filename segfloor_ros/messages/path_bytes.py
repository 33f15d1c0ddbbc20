"""Paths of thousands of keyframes as they travel: written and read by NumPy.

A nav_msgs/Path holds an object with five more inside for every pose. To make, serialise and read
2,400 of them takes 0.2 s of Python; as an array of its serialised form (CDR: DDSI-RTPS 2.3, 10) it
takes a millisecond.
"""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from segfloor_ros.geometry import Array
from segfloor_ros.messages.headers import NS_PER_S
from segfloor_ros.messages.poses import path_arrays, path_of_numbers, pose_numbers
from segfloor_ros.slam.results import KeyframePath

ENCAPSULATION = b'\x00\x01\x00\x00'
"""Plain CDR, little endian; alignment counts from behind these bytes."""

_POSE_BYTES = 7 * 8


def path_bytes(stamp_ns: int, frame_id: str, path: KeyframePath) -> bytes:
    """Return the serialised path; `path_message` gives the same when it is serialised."""
    name = frame_id.encode() + b'\0'
    head = _header_bytes(np.array([stamp_ns]), name).tobytes()
    head += b'\0' * (-len(head) % 4) + np.uint32(len(path.stamp_ns)).tobytes()
    headers, numbers = _header_bytes(path.stamp_ns, name), pose_numbers(path.T_map_base)
    first = _pose_rows(headers[:1], numbers[:1], len(head))
    # Behind a pose everything is aligned to eight bytes.
    return ENCAPSULATION + head + first + _pose_rows(headers[1:], numbers[1:], 0)


def path_of_bytes(data: bytes) -> KeyframePath:
    """Return stamps and poses of a serialised path; one that another program wrote may have its
    fields elsewhere and is read the long way. Raises MessageError for impossible poses.
    """
    read = _read(data)
    if read is None:
        return path_arrays(deserialize_message(data, Path))
    stamps_ns, numbers = read
    return path_of_numbers(stamps_ns, numbers)


def _header_bytes(stamps_ns: NDArray[np.int64], name: bytes) -> NDArray[np.void]:
    """Return headers (N,): stamp, length of the frame's name, name."""
    kind = [('sec', '<i4'), ('nanosec', '<u4'), ('length', '<u4'), ('name', f'V{len(name)}')]
    headers = np.zeros(len(stamps_ns), kind)
    headers['sec'], headers['nanosec'] = np.divmod(stamps_ns, NS_PER_S)
    headers['length'] = len(name)
    headers['name'] = np.frombuffer(name, f'V{len(name)}')
    return headers


def _row_type(header: np.dtype, start: int) -> np.dtype:
    """Return the type of header and pose, of which the header starts `start` bytes after a
    boundary.
    """
    at = header.itemsize + -(start + header.itemsize) % 8
    return np.dtype(
        {
            'names': ['header', 'pose'],
            'formats': [header, ('<f8', 7)],
            'offsets': [0, at],
            'itemsize': at + _POSE_BYTES,
        }
    )


def _pose_rows(headers: NDArray[np.void], numbers: Array, start: int) -> bytes:
    rows = np.zeros(len(headers), _row_type(headers.dtype, start))
    rows['header'], rows['pose'] = headers, numbers
    return rows.tobytes()


def _read(data: bytes) -> tuple[NDArray[np.int64], Array] | None:
    """Return stamps (N,) and numbers (N, 7); None unless all poses name the path's own frame."""
    payload = data[len(ENCAPSULATION) :]
    if not data.startswith(ENCAPSULATION) or len(payload) < 12:
        return None
    length = int(np.frombuffer(payload, '<u4', 1, 8)[0])
    at = 12 + length + -length % 4
    if len(payload) < at + 4:
        return None
    count, name = int(np.frombuffer(payload, '<u4', 1, at)[0]), payload[12 : 12 + length]
    header = _header_bytes(np.zeros(0, np.int64), name).dtype
    kinds = (_row_type(header, at + 4), _row_type(header, 0))
    if count == 0 or len(payload) != at + 4 + kinds[0].itemsize + (count - 1) * kinds[1].itemsize:
        return None
    first = np.frombuffer(payload, kinds[0], 1, at + 4)
    rest = np.frombuffer(payload, kinds[1], count - 1, at + 4 + kinds[0].itemsize)
    headers = np.concatenate([first['header'], rest['header']])
    if (headers['length'] != length).any() or (headers['name'] != headers['name'][:1]).any():
        return None
    stamps_ns = headers['sec'].astype(np.int64) * NS_PER_S + headers['nanosec']
    return stamps_ns, np.concatenate([first['pose'], rest['pose']])
