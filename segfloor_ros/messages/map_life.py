"""Which map a keyframe belongs to. SLAM may begin a new one: after a reset, when it was started
again, or when the time jumped back. The path of all keyframes, which comes with every keyframe,
shows it: the keyframes before are not in it any more.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import NS_PER_S

ENCAPSULATION_BYTES = 4


@dataclass(frozen=True)
class PathHead:
    """What there is to know of a path without reading its poses: its stamp, how many keyframes it
    has, and the stamp of the first one (0 when it has none).
    """

    stamp_ns: int
    count: int
    first_stamp_ns: int


def path_head(serialized: bytes, topic: str) -> PathHead:
    """Return the head of a serialized nav_msgs/Path (CDR: DDSI-RTPS 2.3, 10). A path grows with
    the map, and to make thousands of pose objects would cost more than what a stage does.

    Raises MessageError, naming the topic.
    """
    try:
        order = '<' if serialized[1] & 1 else '>'
        at = ENCAPSULATION_BYTES
        stamp_ns = _stamp_ns(order, serialized, at)
        at = _after_text(order, serialized, at + 8)
        (count,) = struct.unpack_from(order + 'I', serialized, at)
        first_ns = _stamp_ns(order, serialized, at + 4) if count else 0
    except (struct.error, IndexError):
        raise MessageError(f'{topic}: not a path') from None
    return PathHead(stamp_ns, count, first_ns)


class MapLife:
    """Follows the paths of one map."""

    def __init__(self) -> None:
        self._last: PathHead | None = None

    def is_new(self, head: PathHead) -> bool:
        """Take in the path of the next keyframe; returns whether it is of another map than the
        one before.
        """
        last, self._last = self._last, head
        if last is None:
            return False
        return head.first_stamp_ns != last.first_stamp_ns or head.count <= last.count


def _stamp_ns(order: str, data: bytes, at: int) -> int:
    sec, nanosec = struct.unpack_from(order + 'iI', data, at)
    return sec * NS_PER_S + nanosec


def _after_text(order: str, data: bytes, at: int) -> int:
    """Return where the 4-byte aligned value behind a text begins."""
    (length,) = struct.unpack_from(order + 'I', data, at)
    end = at + 4 + length - ENCAPSULATION_BYTES
    return ENCAPSULATION_BYTES + (end + 3) // 4 * 4
