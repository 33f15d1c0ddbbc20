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

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.geometry import Array
from segfloor_ros.map_file import Arrays
from segfloor_ros.measurements import Up
from segfloor_ros.slam.map.map_arrays import fill_map, map_to_arrays
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.bundle_adjustment import apply_global, copy_map, solve_global
from segfloor_ros.slam.mapping.disparity_offset import OffsetEstimate
from segfloor_ros.slam.mapping.keyframe_mapping import LocalMapper
from segfloor_ros.slam.places.loop_closing import (
    Closing,
    apply_closing,
    plan_closing,
    solve_closing,
)
from segfloor_ros.slam.places.loops import LoopDetector
from segfloor_ros.slam.places.relocalisation import KnownMap
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.tracking.features import Features
from segfloor_ros.slam.tracking.front_end import FrontEnd
from segfloor_ros.slam.tracking.images import Images


class BackEnd:
    """Adjusts the neighbourhood of every keyframe, closes loops, and adjusts the whole map after.

    background: on threads beside tracking; else at once, so that the outcome does not depend on
    timing. Tracking never waits for an adjustment of the whole map.
    """

    def __init__(
        self,
        camera: StereoCamera,
        settings: StereoSlamSettings,
        sparse_map: SparseMap,
        front_end: FrontEnd,
        background: bool,
    ) -> None:
        self.mapper = LocalMapper(camera, settings)
        self.places = front_end.places
        self.loop_count = 0
        self._known: KnownMap | None = None
        self._camera = camera
        self._tracker = front_end.tracker
        self._map = sparse_map
        self.loops = LoopDetector(camera, sparse_map, self.places)
        self._local = AdjustmentRunner(background)
        self._global = AdjustmentRunner(background)
        self._background = background
        self._is_closing = False
        self._up_world: Up | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing is being solved that a new keyframe would have to wait for."""
        return self._local.idle

    @property
    def takes_keyframes(self) -> bool:
        """Whether the map may grow: not while a loop is being closed."""
        return self.idle or not self._is_closing

    @property
    def offset_px(self) -> float:
        """The error that all disparities share, measured minus true, as estimated so far."""
        return self.mapper.offset.value_px

    def take_in(
        self, keyframe: KeyframeRecord, images: Images, mount: Mount | None, up_world: Up | None
    ) -> bool:
        """Adjust the map to a new keyframe: close a loop where it sees a place again, and fit its
        neighbourhood. up_world: as an accelerometer has it. Returns whether the map has changed
        already.
        """
        self._up_world = up_world
        self.places.add(keyframe)
        if self._join_known(keyframe, images, mount):
            return True
        closed = self._close_loop(keyframe, images, mount)
        if self._background:
            if not closed:
                self._adjust(keyframe)
            return False
        closed = closed and self.collect(wait=True)
        self._adjust(keyframe)
        return self.collect(wait=True) or closed

    @property
    def is_apart(self) -> bool:
        """Whether the map is a part of its own, beside one that is known."""
        return self._known is not None

    def map_apart(self, of_drive: bool) -> None:
        """Go on with an empty map, until the known one, which is all there is so far, is
        recognised. of_drive: whether this drive made it, and got lost.
        """
        known = map_to_arrays(self._map) | self.places.to_arrays()
        self._known = KnownMap(self._camera, self._tracker, self._map, known, of_drive)
        self.begin_again()

    def begin_again(self) -> None:
        """Go on with an empty map; no id is given twice."""
        self._map.reset(self._map.num_ever)
        self._forget_places()

    def sees_known(self, images: Images, features: Features, stamp_ns: int) -> bool:
        """Whether a camera that is lost in a part of the map is seen to be in the known one."""
        known = self._known
        return known is not None and known.is_seen(images, features, self.offset_px, stamp_ns)

    def give_up_part(self) -> None:
        """Go back to the known map, and forget the part beside it."""
        assert self._known is not None
        known, self._known = self._known, None
        arrays = known.to_arrays()
        known.restore(arrays)
        self._forget_places()
        self.places.from_arrays(arrays)

    def _forget_places(self) -> None:
        self._global.drop()
        self.places.reset()
        self.loops.reset()

    def _join_known(self, keyframe: KeyframeRecord, images: Images, mount: Mount | None) -> bool:
        """Make the drive's own map a part of the known one, where that is recognised."""
        known = self._known
        if known is None or not known.recognise(keyframe, images, self.offset_px, mount):
            return False
        words = known.join(self.places.to_arrays())
        self._forget_places()
        self.places.from_arrays(words)
        self._known = None
        return True

    def collect(self, wait: bool) -> bool:
        """Bring what is solved into the map; with `wait` a running adjustment of a neighbourhood is
        waited for. Returns whether there was anything.
        """
        finished = [self._local.collect(wait)]
        if finished[0] is not None:
            finished[0]()
        if not self._local.holds_one:
            finished.append(self._global.collect(wait=False))
            if finished[1] is not None:
                finished[1]()
        return any(apply is not None for apply in finished)

    def to_arrays(self, of_known: bool) -> Arrays:
        """Return the map and what belongs to it, for a file. of_known: of the known map, where the
        present one is a part beside it.
        """
        offset = self.mapper.offset.estimate
        measured: Arrays = {'disparity_offset': np.array([offset.value_px, offset.information])}
        if of_known and self._known is not None:
            return self._known.to_arrays() | measured
        return map_to_arrays(self._map) | self.places.to_arrays() | measured

    def from_arrays(self, arrays: Arrays) -> None:
        """Go on with what `to_arrays` returned."""
        fill_map(self._map, arrays)
        self.places.from_arrays(arrays)
        self.mapper.offset.estimate = OffsetEstimate(*arrays['disparity_offset'].tolist())

    def close(self) -> None:
        """End the background threads, if there are any."""
        self._global.drop()
        self._local.close()
        self._global.close()

    def _adjust(self, keyframe: KeyframeRecord) -> None:
        """Adjust the neighbourhood of a new keyframe."""
        if keyframe.index == 0:
            return
        adjustment = self.mapper.plan_adjustment(self._map, keyframe, self._up_world)
        if adjustment is None:
            return
        self._local.submit(
            partial(self.mapper.solve, adjustment),
            partial(self.mapper.apply, self._map, adjustment),
        )

    def _close_loop(self, keyframe: KeyframeRecord, images: Images, mount: Mount | None) -> bool:
        """Begin to close a loop where a keyframe sees a place again; returns whether it does."""
        matches = self.loops.detect(keyframe, images, self.offset_px, mount)
        if not matches:
            return False
        # It would bring back the map from before the loop.
        self._global.drop()
        closing = plan_closing(self._map, matches)
        self._is_closing = True
        self._local.submit(partial(solve_closing, closing), partial(self._apply, closing))
        return True

    def _apply(self, closing: Closing, result: tuple[Array, Array]) -> None:
        self._is_closing = False
        if not apply_closing(self._camera, self._map, closing, result):
            return
        self.loop_count += 1
        copied = copy_map(self._map, self.mapper.offset.estimate, self._up_world)
        self._global.submit(
            partial(solve_global, self._camera, copied, self._global.is_wanted()),
            partial(apply_global, self._map),
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
        """Return what tells the next adjustment whether it was dropped."""
        number = self._dropped
        return lambda: self._dropped == number

    def drop(self) -> None:
        """Forget an adjustment; one that is running is asked to end."""
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

    def collect(self, wait: bool) -> Callable[[], None] | None:
        """Return what applies a finished adjustment, once, or None; with `wait` a running one is
        waited for.
        """
        apply = self._apply
        if apply is None or not (wait or self._result.done()):
            return None
        self._apply = None
        result = self._result.result()
        return lambda: apply(result)

    def close(self) -> None:
        """Wait for a running adjustment and end the thread."""
        if self._worker is not None:
            self._worker.shutdown()
