"""A stamp that is wrong, told from a clock that jumped."""

from __future__ import annotations

from enum import Enum
from itertools import pairwise

from segfloor_ros.core.geometry import MAX_DISORDER_NS

AGREEING = 3
"""So many stamps in a row must agree that the clock has jumped: two wrong ones are rare."""

MAX_STEP_NS = 2_000_000_000
"""From one stamp to the next, unless they always come more slowly."""


class InTime(Enum):
    """Where a stamp lies: after the last one; before it, by little; elsewhere, which may be wrong;
    or where the last few agree that time has jumped to.
    """

    NEXT = 'next'
    LATE = 'late'
    ELSEWHERE = 'elsewhere'
    JUMPED = 'jumped'


class StampOrder:
    """Tells a wrong stamp from a clock that jumped: a jump counts when several in a row agree on
    the new time. last_ns: the last stamp that counts. elsewhere_ns: those that may be of another
    time.
    """

    def __init__(self, last_ns: int | None = None) -> None:
        self.last_ns = last_ns
        self.elsewhere_ns: list[int] = []
        self._usual_step_ns = MAX_STEP_NS

    def take(self, stamp_ns: int) -> InTime:
        """Take the next stamp."""
        step_ns = 1 if self.last_ns is None else stamp_ns - self.last_ns
        if -MAX_DISORDER_NS <= step_ns <= 0:
            return InTime.LATE
        if 0 < step_ns <= self._usual_step_ns:
            self.elsewhere_ns.clear()
            self.last_ns = stamp_ns
            return InTime.NEXT
        if self.elsewhere_ns and stamp_ns <= self.elsewhere_ns[-1]:
            self.elsewhere_ns.clear()
        self.elsewhere_ns.append(stamp_ns)
        if len(self.elsewhere_ns) < AGREEING:
            return InTime.ELSEWHERE
        # Of a slow camera every step is long.
        longest_ns = max(b - a for a, b in pairwise(self.elsewhere_ns))
        self._usual_step_ns = max(MAX_STEP_NS, 2 * longest_ns)
        self.elsewhere_ns.clear()
        self.last_ns = stamp_ns
        return InTime.JUMPED
