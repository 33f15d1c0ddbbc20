"""When the next frame of a recording may be sent: in step with the clock, or with the chain."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_FRAMES_UNDER_WAY = 3
"""Frames that may be between the camera and SLAM: no more than SLAM lets wait before it skips any
(`max_waiting_frames`), and enough for it to find the next one when it has done with one.
"""

MAX_KEYFRAMES_UNDER_WAY = 4
"""Keyframes that may be between SLAM and the grid while the next frame is sent."""

PATIENCE_S = 10.0
"""Seconds without any sign of progress after which what is under way is taken for lost."""


class ClockPace:
    """Sends frames at the recording's own pace times a rate; the first one starts the clock."""

    def __init__(self, rate: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock_s = clock_s
        self._start: tuple[float, int] | None = None

    def wait_s(self, stamp_ns: int) -> float:
        """Return in how many seconds the frame is due; 0 when it is."""
        if self._start is None:
            return 0.0
        start_s, start_ns = self._start
        due_s = start_s + (stamp_ns - start_ns) * 1e-9 / self._rate
        return max(due_s - self._clock_s(), 0.0)

    def sent(self, stamp_ns: int) -> None:
        """Start the clock with the first frame."""
        if self._start is None:
            self._start = self._clock_s(), stamp_ns

    def restart(self) -> None:
        """Start the clock again with the next frame, e.g. after a pause."""
        self._start = None


class ChainPace:
    """Lets few frames and keyframes be under way at a time, so that no queue between the nodes
    can run over, however fast the frames come.

    What a node had in its queue is lost when it is paused, deactivated or killed: when nothing
    at all has happened for some seconds, what is under way is given up.

    is_on: off, any number may be under way.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, is_on: bool = True) -> None:
        self.is_on = is_on
        self._clock_s = clock_s
        self._last_sign_s = clock_s()
        self._frames: set[int] = set()
        self._keyframes: set[int] = set()
        self._done_early: set[int] = set()

    def ready(self) -> bool:
        """Whether the next frame may be sent."""
        return (
            len(self._frames) < MAX_FRAMES_UNDER_WAY
            and len(self._keyframes) < MAX_KEYFRAMES_UNDER_WAY
        )

    def sent(self, stamp_ns: int) -> None:
        """Wait for SLAM to be done with this frame from now on."""
        self._last_sign_s = self._clock_s()
        if self.is_on:
            self._frames.add(stamp_ns)

    def frame_done(self, stamp_ns: int) -> None:
        """SLAM is done with a frame; it takes them in order, so earlier ones are done or lost."""
        self._last_sign_s = self._clock_s()
        self._frames = {t for t in self._frames if t > stamp_ns}

    def keyframe_began(self, stamp_ns: int) -> None:
        """SLAM has published a keyframe."""
        # The messages of two nodes may overtake each other.
        if stamp_ns in self._done_early:
            self._done_early.discard(stamp_ns)
        else:
            self._keyframes.add(stamp_ns)

    def keyframe_done(self, stamp_ns: int) -> None:
        """A keyframe goes no further; the nodes take them in order, so earlier ones are nearly done
        or lost.
        """
        self._last_sign_s = self._clock_s()
        if stamp_ns not in self._keyframes:
            self._done_early.add(stamp_ns)
        self._keyframes = {t for t in self._keyframes if t > stamp_ns}

    def restart(self) -> None:
        """Start the patience again, e.g. after a pause."""
        self._last_sign_s = self._clock_s()

    def drop_frames(self) -> None:
        """Wait for no frame any more: whoever had them listens no longer."""
        self._frames.clear()

    def give_up(self) -> str:
        """Where nothing has happened for too long, wait for nothing that is under way any more and
        return in words what it was; else ''.
        """
        if self.ready() or self._clock_s() - self._last_sign_s < PATIENCE_S:
            return ''
        words = f'{len(self._frames)} frames and {len(self._keyframes)} keyframes'
        self._frames.clear()
        self._keyframes.clear()
        return words

    def waits_for(self) -> str:
        """Return what is being waited for, in words."""
        if self._frames:
            return f'stereo_slam to answer the frame with stamp {min(self._frames)}'
        return f'the keyframe with stamp {min(self._keyframes, default=0)} to reach the map'
