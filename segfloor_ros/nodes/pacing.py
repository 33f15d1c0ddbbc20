"""When the next frame of a recording may be sent: in step with the clock, or with the chain."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_KEYFRAMES_UNDER_WAY = 4
"""Keyframes that may be between SLAM and the grid while the next frame is sent."""


class ClockPace:
    """Sends frames at the recording's own pace times a rate; the first one starts the clock."""

    def __init__(self, rate: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock_s = clock_s
        self._start: tuple[float, int] | None = None

    def ready(self, stamp_ns: int) -> bool:
        """Whether the frame is due."""
        if self._start is None:
            return True
        start_s, start_ns = self._start
        return self._clock_s() >= start_s + (stamp_ns - start_ns) * 1e-9 / self._rate

    def sent(self, stamp_ns: int) -> None:
        """Start the clock with the first frame."""
        if self._start is None:
            self._start = self._clock_s(), stamp_ns

    def restart(self) -> None:
        """Start the clock anew with the next frame, e.g. after a pause."""
        self._start = None

    def waits_for(self) -> str:
        """Return '': the clock needs no report."""
        return ''


class ChainPace:
    """Sends a frame when SLAM has answered the one before and few keyframes are under way, so
    that no queue between the nodes can run over, however fast the frames come.
    """

    def __init__(self) -> None:
        self._unanswered: int | None = None
        self._under_way: set[int] = set()
        self._ended_early: set[int] = set()

    def ready(self, stamp_ns: int) -> bool:
        """Whether the chain has room for the next frame."""
        return self._unanswered is None and len(self._under_way) < MAX_KEYFRAMES_UNDER_WAY

    def sent(self, stamp_ns: int) -> None:
        """Wait for the answer to this frame from now on."""
        self._unanswered = stamp_ns

    def restart(self) -> None:
        """Nothing depends on the time."""

    def answered(self, stamp_ns: int) -> None:
        """SLAM has processed a frame."""
        if stamp_ns == self._unanswered:
            self._unanswered = None

    def keyframe_began(self, stamp_ns: int) -> None:
        """SLAM has published a keyframe."""
        # The statuses of two nodes may overtake each other.
        if stamp_ns in self._ended_early:
            self._ended_early.discard(stamp_ns)
        else:
            self._under_way.add(stamp_ns)

    def keyframe_ended(self, stamp_ns: int) -> None:
        """A keyframe has reached the end of the chain, or failed on the way."""
        if stamp_ns in self._under_way:
            self._under_way.discard(stamp_ns)
        else:
            self._ended_early.add(stamp_ns)

    def waits_for(self) -> str:
        """Return what is being waited for, in words."""
        if self._unanswered is not None:
            return f'stereo_slam to answer the frame with stamp {self._unanswered}'
        stamps = ', '.join(str(stamp) for stamp in sorted(self._under_way))
        return f'the keyframes with stamps {stamps} to reach the map'
