"""The tree of frames that tf messages describe."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator

import numpy as np

from segfloor_ros.core.geometry import HISTORY_NS, MAX_DISORDER_NS, Array, invert
from segfloor_ros.core.twists import between


class FrameTree:
    """Keeps fixed transforms for good and moving ones for ten seconds.

    A moving frame whose stamps jump back by more than half a second starts anew: a recording plays
    again. The latest word on a frame's parent counts.
    """

    def __init__(self) -> None:
        self._fixed: dict[str, tuple[str, Array]] = {}
        self._moving: dict[str, tuple[str, list[int], list[Array]]] = {}

    def add_fixed(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Take in a transform that holds at all times."""
        self._moving.pop(child, None)
        self._fixed[child] = parent, T_parent_child

    def add_moving(self, stamp_ns: int, parent: str, child: str, T_parent_child: Array) -> None:
        """Take in a transform at one time; of several at the same time the first counts."""
        known = self._moving.get(child)
        if known is None or known[0] != parent or stamp_ns < known[1][-1] - MAX_DISORDER_NS:
            self._moving[child] = parent, [stamp_ns], [T_parent_child]
            return
        _, stamps, transforms = known
        place = bisect_left(stamps, stamp_ns)
        if stamps[place : place + 1] == [stamp_ns]:
            return
        stamps.insert(place, stamp_ns)
        transforms.insert(place, T_parent_child)
        old = bisect_left(stamps, stamps[-1] - HISTORY_NS)
        del stamps[:old], transforms[:old]

    def clear_moving(self) -> None:
        """Keep the fixed transforms alone."""
        self._moving.clear()

    def root_of(self, frame: str) -> str:
        """Return the frame above all others of the tree that a frame is in; itself if unknown."""
        for ancestor, _ in self._upwards(frame, None):
            frame = ancestor
        return frame

    def latest_ns(self, frame: str) -> int | None:
        """Return up to when it is known where a frame is on its parent; None where that is not
        known or always.
        """
        return self._moving[frame][1][-1] if frame in self._moving else None

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Array | None:
        """Return T_target_source (4, 4) at a time, or from the latest transforms; None where the
        frames are not connected, or not at that time.
        """
        T_ancestor_target: dict[str, Array] = {target: np.eye(4)}
        T_ancestor_target.update(self._upwards(target, stamp_ns))
        if source in T_ancestor_target:
            return invert(T_ancestor_target[source])
        for ancestor, T_ancestor_source in self._upwards(source, stamp_ns):
            if ancestor in T_ancestor_target:
                return invert(T_ancestor_target[ancestor]) @ T_ancestor_source
        return None

    def _upwards(self, frame: str, stamp_ns: int | None) -> Iterator[tuple[str, Array]]:
        """Yield the ancestors of a frame and T_ancestor_frame, the nearest first."""
        T_ancestor_frame: Array = np.eye(4)
        child, passed = frame, {frame}
        while (link := self._link(child, stamp_ns)) is not None and link[0] not in passed:
            child, T_parent_child = link
            passed.add(child)
            T_ancestor_frame = T_parent_child @ T_ancestor_frame
            yield child, T_ancestor_frame

    def _link(self, child: str, stamp_ns: int | None) -> tuple[str, Array] | None:
        if child in self._fixed:
            return self._fixed[child]
        if child not in self._moving:
            return None
        parent, stamps, transforms = self._moving[child]
        if stamp_ns is None:
            return parent, transforms[-1]
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            return None
        after = bisect_left(stamps, stamp_ns)
        if stamps[after] == stamp_ns:
            return parent, transforms[after]
        share = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return parent, between(transforms[after - 1], transforms[after], share)
