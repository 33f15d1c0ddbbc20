"""Stamps and headers. A stamp is a whole number of nanoseconds everywhere outside messages."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

NS_PER_S = 1_000_000_000


def to_time(stamp_ns: int) -> Time:
    """Return the ROS time of a stamp in ns."""
    sec, nanosec = divmod(int(stamp_ns), NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def to_ns(time: Time) -> int:
    """Return a ROS time in ns."""
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def make_header(stamp_ns: int, frame_id: str) -> Header:
    """Return a header with a stamp in ns and a frame."""
    return Header(stamp=to_time(stamp_ns), frame_id=frame_id)


def stamp_of(message: Any) -> int:
    """Return the stamp of a message or of a header in ns; 0 for what carries none."""
    header = message if isinstance(message, Header) else getattr(message, 'header', None)
    return 0 if header is None else to_ns(header.stamp)
