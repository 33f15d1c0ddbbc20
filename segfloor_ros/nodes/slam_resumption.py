"""How SLAM goes on with the map of a node that was killed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.slam.continuation import Continuation, LastState
from segfloor_ros.slam.results import FrameResult
from segfloor_ros.slam.stereo_slam import StereoSlam

PATIENCE_S = 5.0
"""For how long the place of the last keyframe is looked for before a new map begins."""


class SlamResumption:
    """Keeps what a later SLAM needs and lets a new SLAM go on with what was found."""

    def __init__(self, keep: Callable[[LastState], None], last: LastState | None = None) -> None:
        self._keep = keep
        self._last = last
        self._continuation: Continuation | None = None
        self._first_ns: int | None = None
        self._found = False

    @property
    def has_mount(self) -> bool:
        """Whether there is a map to resume, whose mount is known."""
        return self._last is not None

    def mount_for(self, camera: StereoCamera, stamp_ns: int) -> Mount | None:
        """Return the mount of the map to go on with; None where there is none, or it was made
        with another camera or later than this stamp.
        """
        last = self._last
        if last is None or last.camera != camera or stamp_ns <= last.keyframe.stamp_ns:
            self._last = None
            return None
        return last.mount

    def begin(self, slam: StereoSlam) -> None:
        """Start a new SLAM, made with that mount, at the last keyframe of the old one."""
        if self._last is not None:
            slam.process(self._last.frame)
            self._continuation = Continuation(self._last)

    def join(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Return results of the new SLAM as ones of the old map, where there is one."""
        if self._continuation is None:
            return list(results)
        self._found = self._found or any(result.tracked for result in results)
        return [self._continuation.join(result) for result in results]

    def is_hopeless(self, stamp_ns: int) -> bool:
        """Whether the place of the last keyframe has not been found again for too long."""
        if self._continuation is None or self._found:
            return False
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        return stamp_ns - self._first_ns > PATIENCE_S * 1e9

    def keep(self, camera: StereoCamera, mount: Mount, result: FrameResult) -> None:
        """Keep a keyframe for a later SLAM."""
        if result.keyframe is not None:
            self._keep(LastState(camera, mount, result.keyframe, result.T_map_odom))
