"""The back end of SLAM: what is done with the map between frames (Cadena et al., Past, Present, and
Future of SLAM, IEEE T-RO 2016, section II).

Runs what takes long, an adjustment or the closing of a loop, beside tracking or at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import Up
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.mapping.bundle_adjustment import (
    GlobalResult,
    apply_global,
    copy_map,
    solve_global,
)
from segfloor_ros.core.slam.mapping.keyframe_mapping import LocalMapper
from segfloor_ros.core.slam.places.loop_closing import (
    Closing,
    apply_closing,
    optimise,
    plan_closing,
)
from segfloor_ros.core.slam.places.loops import Candidate, LoopDetector
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.timing import timed

GROWN = 1.25
"""The whole map is adjusted after a loop once it has so many times the keyframes that it had when
it was last: that costs a long drive no more than a few adjustments of all it has mapped."""


class BackEnd:
    """Adjusts the neighbourhood of every keyframe, closes loops, and adjusts the whole map after a
    loop that moves it far or once it has grown.

    background: on threads beside tracking; else at once, so that the outcome does not depend on
    timing. Tracking never waits for an adjustment of the whole map.
    """

    def __init__(self, sparse_map: SparseMap, front_end: FrontEnd, background: bool) -> None:
        self._front_end = front_end
        self.mapper = LocalMapper(sparse_map)
        self.places = front_end.places
        self.loop_count = 0
        self._map = sparse_map
        self._rig = sparse_map.rig
        self.loops = LoopDetector(sparse_map, self.places)
        self._local = AdjustmentRunner(background)
        self._global = AdjustmentRunner(background)
        self._background = background
        self._is_closing = False
        self._adjusted_keyframes = 0
        self._up_world: Up | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing is being solved that a new keyframe would have to wait for."""
        return self._local.idle

    def holds_one(self, of_all: bool = False) -> bool:
        """Whether there is an adjustment of a neighbourhood that is not in the map yet; of_all: or
        of the whole map.
        """
        return self._local.holds_one or (of_all and self._global.holds_one)

    def wants_keyframe(self, track: Track | None, stamp_ns: int) -> bool:
        """Whether a frame is to become a keyframe: not while a loop is being closed."""
        front_end = self._front_end
        frames_since = front_end.frames_since_keyframe
        if front_end.is_fixed or (self._is_closing and not self.idle):
            return False
        if track is None:
            return not self._map.keyframes or front_end.is_new_place()
        if len(track.point_ids) == 0:
            return True
        since_ns = stamp_ns - front_end.keyframe_ns
        return front_end.local.wants_keyframe(track, frames_since, since_ns, self.idle)

    def add(self, keyframe: KeyframeRecord, patches: NDArray[np.uint8]) -> None:
        """Add a keyframe to the map and to its places. patches: of its features."""
        self.mapper.insert(keyframe, patches)
        self.places.add(keyframe)

    def take_in(self, keyframe: KeyframeRecord, images: Images, up_world: Up | None) -> None:
        """Adjust the map to a new keyframe: close a loop where it sees a place again, and fit its
        neighbourhood. up_world: as an accelerometer has it.
        """
        self._up_world = up_world
        self.follow(partial(self._adjust_to, keyframe, images))

    def _adjust_to(self, keyframe: KeyframeRecord, images: Images) -> bool:
        """Returns whether the map has changed already."""
        closed = self._close_loop(keyframe, images)
        if self._background:
            if not closed:
                self._adjust(keyframe)
            return False
        closed = closed and self._collect(wait=True)
        self._adjust(keyframe)
        return self._collect(wait=True) or closed

    def reset(self) -> None:
        """Begin an empty map; no id is given twice."""
        self._map.reset(self._map.points.num_ever)
        self.reset_places()

    def reset_places(self, words: Arrays | None = None) -> None:
        """Forget places and loops: the map is another one now. words: of its keyframes."""
        self._global.reset()
        self.places.reset()
        self.loops.reset()
        self._adjusted_keyframes = 0
        if words is not None:
            self.places.from_arrays(words)

    def follow(self, change: Callable[[], bool]) -> None:
        """Let the camera, and with it `odom`, move along with the latest keyframe. change: of the
        map; returns whether there was any.
        """
        before = self._map.keyframes[-1].T_camera_world
        if change():
            self._front_end.follow_map(before, self._map.keyframes[-1].T_camera_world)

    def collect(self, wait: bool) -> None:
        """Bring what is solved into the map; with `wait` a running adjustment of a neighbourhood is
        waited for.
        """
        if self._map.keyframes:
            self.follow(partial(self._collect, wait))

    def _collect(self, wait: bool) -> bool:
        """Returns whether there was anything."""
        has_changed = self._local.collect(wait)
        if not self._local.holds_one:
            has_changed |= self._global.collect(wait=False)
        return has_changed

    def close(self) -> None:
        """End the background threads, if there are any."""
        self._global.reset()
        self._local.close()
        self._global.close()

    def _adjust(self, keyframe: KeyframeRecord) -> None:
        """Adjust the neighbourhood of a new keyframe."""
        if keyframe.index == 0:
            return
        adjustment = self.mapper.plan_adjustment(keyframe, self._up_world)
        if adjustment is None:
            return
        self._local.submit(
            partial(self.mapper.solve, adjustment), partial(self.mapper.apply, adjustment)
        )

    @timed
    def _close_loop(self, keyframe: KeyframeRecord, images: Images) -> bool:
        """Begin to close a loop where a keyframe sees a place again; returns whether it does."""
        matches = self.loops.detect(keyframe, images)
        if not matches:
            return False
        closing = plan_closing(self._map, matches)
        self._is_closing = True
        self._local.submit(partial(optimise, closing.graph), partial(self._apply, closing))
        return True

    def _apply(self, closing: Closing, result: tuple[Array, Array]) -> None:
        self._is_closing = False
        is_closed = apply_closing(self._map, closing, result)
        loop, verdict = closing.edges[-1], 'closed' if is_closed else 'contradicts the map'
        self.loops.candidates.append(Candidate(loop.i, loop.j, loop.T_i_j, verdict))
        if not is_closed:
            return
        self.loop_count += 1
        has_grown = len(self._map.keyframes) >= GROWN * self._adjusted_keyframes
        if closing.is_far:
            # What is being adjusted is another map; it goes on beside a loop that moves it little.
            self._global.reset()
        if not closing.is_far and (not has_grown or self._global.holds_one):
            return
        copied = copy_map(self._map, self._up_world)

        def apply(result: GlobalResult | None) -> None:
            self._adjusted_keyframes = len(copied.records)
            apply_global(self._map, result)

        self._global.submit(
            partial(solve_global, self._rig.camera, copied, self._global.is_wanted()), apply
        )


class AdjustmentRunner:
    """Holds at most one adjustment.

    Without `background` it is solved when it is submitted, so that the outcome does not depend on
    timing.
    """

    def __init__(self, background: bool) -> None:
        self._worker = ThreadPoolExecutor(1, 'adjustment') if background else None
        self._apply: Callable[[Any], None] | None = None
        self._result: Future[Any] = Future()
        self._dropped = 0

    @property
    def idle(self) -> bool:
        """Whether nothing is being solved now."""
        return self._apply is None or self._result.done()

    @property
    def holds_one(self) -> bool:
        """Whether there is an adjustment that was not collected yet."""
        return self._apply is not None

    def is_wanted(self) -> Callable[[], bool]:
        """Return whether the next adjustment is still wanted, to be asked while it runs."""
        number = self._dropped
        return lambda: self._dropped == number

    def reset(self) -> None:
        """Drop an adjustment; one that is running is asked to end."""
        self._dropped += 1
        self._apply = None

    def submit(self, solve: Callable[[], Any], apply: Callable[[Any], None]) -> None:
        """Begin an adjustment; the one before must have been collected. solve: works on a copy and
        shares nothing with the map. apply: brings what it returns into the map.
        """
        self._apply = apply
        if self._worker is not None:
            self._result = self._worker.submit(solve)
        else:
            self._result = Future()
            self._result.set_result(solve())

    def collect(self, wait: bool) -> bool:
        """Apply a finished adjustment; with `wait` a running one is waited for. Returns whether
        there was one.
        """
        apply = self._apply
        if apply is None or not (wait or self._result.done()):
            return False
        self._apply = None
        apply(self._result.result())
        return True

    def close(self) -> None:
        """Wait for a running adjustment and end the thread."""
        if self._worker is not None:
            self._worker.shutdown()
