"""When the next frame of a recording may be sent: in step with the clock, or with the chain."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_FRAMES_UNDER_WAY = 8
"""Frames that may be between the camera and SLAM; less than the depth of the image topics."""

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


class ChainPace:
    """Lets few frames and keyframes be under way at a time, so that no queue between the nodes
    can run over, however fast the frames come.
    """

    def __init__(self) -> None:
        self._unanswered: set[int] = set()
        self._keyframes: set[int] = set()
        self._ended_early: set[int] = set()

    def ready(self) -> bool:
        """Whether the chain has room for the next frame."""
        return (
            len(self._unanswered) < MAX_FRAMES_UNDER_WAY
            and len(self._keyframes) < MAX_KEYFRAMES_UNDER_WAY
        )

    def sent(self, stamp_ns: int) -> None:
        """Wait for the answer to this frame from now on."""
        self._unanswered.add(stamp_ns)

    def answered(self, stamp_ns: int) -> None:
        """SLAM has processed a frame."""
        self._unanswered.discard(stamp_ns)

    def keyframe_began(self, stamp_ns: int) -> None:
        """SLAM has published a keyframe."""
        # The statuses of two nodes may overtake each other.
        if stamp_ns in self._ended_early:
            self._ended_early.discard(stamp_ns)
        else:
            self._keyframes.add(stamp_ns)

    def keyframe_ended(self, stamp_ns: int) -> None:
        """A keyframe has reached the end of the chain, or failed on the way."""
        if stamp_ns in self._keyframes:
            self._keyframes.discard(stamp_ns)
        else:
            self._ended_early.add(stamp_ns)

    def waits_for(self) -> str:
        """Return what is being waited for, in words."""
        if self._unanswered:
            return f'stereo_slam to answer the frame with stamp {min(self._unanswered)}'
        return f'the keyframe with stamp {min(self._keyframes, default=0)} to reach the map'
