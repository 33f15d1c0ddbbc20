"""Which map a keyframe belongs to, as a message."""

from __future__ import annotations

from sensor_msgs.msg import TimeReference

from segfloor_ros.nodes.messages.making import make_header, to_ns, to_time


def map_start_message(stamp_ns: int, frame_id: str, start_ns: int) -> TimeReference:
    """Return that the keyframe of a stamp belongs to the map that was begun at `start_ns`."""
    return TimeReference(header=make_header(stamp_ns, frame_id), time_ref=to_time(start_ns))


def map_start_ns(message: TimeReference) -> int:
    """Return when the keyframe's map was begun."""
    return to_ns(message.time_ref)
