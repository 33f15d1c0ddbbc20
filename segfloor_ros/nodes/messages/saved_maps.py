"""Saved maps or parts of one, and which map a keyframe belongs to."""

from __future__ import annotations

import array

from sensor_msgs.msg import TimeReference
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray

from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.nodes.messages.making import make_header, to_ns, to_time

LEAST_SHARE = 20
"""Times that keeping a map took pass before it is kept again."""


def map_start_message(stamp_ns: int, frame_id: str, start_ns: int) -> TimeReference:
    """Return that the keyframe of a stamp belongs to the map that was begun at `start_ns`."""
    return TimeReference(header=make_header(stamp_ns, frame_id), time_ref=to_time(start_ns))


def map_start_ns(message: TimeReference) -> int:
    """Return when the keyframe's map was begun."""
    return to_ns(message.time_ref)


def map_file_message(saved: MapFile) -> UInt8MultiArray:
    """Return a map, or a part of one, as the bytes of its file, not compressed."""
    from segfloor_ros.core.files.results import FORMAT, to_bytes

    data = array.array('B', to_bytes(saved, compress=False))
    size = MultiArrayDimension(label=FORMAT, size=len(data), stride=len(data))
    return UInt8MultiArray(layout=MultiArrayLayout(dim=[size]), data=data)


def map_file_of(message: UInt8MultiArray, topic: str) -> MapFile:
    """Return the map of a message. Raises InputError, by the topic's name, for other bytes."""
    from segfloor_ros.core.files.results import from_bytes

    return from_bytes(bytes(message.data), topic)
