"""Makes messages by the names of their types: those of ROS here, those of a library for bags where
it is handed in. Both have the same fields, so one function fills both. ROS is imported when its
first message is made.
"""

from __future__ import annotations

import array
import importlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

Message = Any
"""A message of ROS or of such a library."""

Make = Callable[..., Message]
"""Makes a message of a type from all of its fields; NumPy arrays stand for arrays and sequences."""


@cache
def message_class(kind: str) -> type[Message]:
    """Return the class of a type that ROS has, e.g. `sensor_msgs/msg/Image`."""
    package, _, name = kind.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def ros_message(kind: str, **fields: Any) -> Message:
    """Return a message of ROS. It takes arrays of the standard library without a look at every
    element.
    """
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            fields[name] = array.array(value.dtype.char, value.tobytes())
    return message_class(kind)(**fields)


def to_time(stamp_ns: int, make: Make = ros_message) -> Message:
    """Return the ROS time of a stamp in ns."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def to_ns(time: Message) -> int:
    """Return a ROS time in ns."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def make_header(stamp_ns: int, frame_id: str, make: Make = ros_message) -> Message:
    """Return a header with a stamp in ns and a frame."""
    return make('std_msgs/msg/Header', stamp=to_time(stamp_ns, make), frame_id=frame_id)
