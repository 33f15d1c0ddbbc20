"""The session of a drive: which map the camera is in, and when its results are returned.

A camera that gets lost, or that cannot be found in a loaded map, maps a submap on its own. When the
submap is recognised in the known map, both are merged (Campos et al., ORB-SLAM3, IEEE T-RO 2021,
section VI).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from segfloor_ros.core.contracts import FrameResult, LastPose, StereoFrame
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.plugins.maps.known_map import OFFSET, KnownMap, map_and_words
from segfloor_ros.core.plugins.maps.map_arrays import fill_map
from segfloor_ros.core.plugins.maps.submap_results import in_merged_map, outside, searched
from segfloor_ros.core.slam.held_results import left_out
from segfloor_ros.core.slam.session import OneMap, Parts, SessionState
from segfloor_ros.core.slam.sparse_map import KeyframeRecord
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.twists import adjoint

LOST_NS = 1_500_000_000
"""For this long every frame is searched for in the map. After that a lost camera maps a submap, and
a submap beside a loaded map is published as outside of it."""

HARDLY_BEGUN = 5
"""A map of at most this many keyframes is dropped if the camera gets lost in it (Mur-Artal and
Tardos, ORB-SLAM2, 2017, does the same)."""


class MapSession(OneMap):
    """Decides which map the camera is in, and holds results back while that is not known.

    state changes by these methods alone:

      (new)                    load                     load
        |                       |                        |
        v         found         v                        v     found, search
     MAPPING <-------------- LOADED                   RESUMED --------------> MAPPING
        |  ^                    |  ^                     |
        |  |                    |  |                     |
    _start |             _start |  | _drop               | _start
        |  | join,              v  |                     v
        |  | _drop           BESIDE  -- join -->        LOST
        |  | _keep_submap       |        MAPPING
        v  |                    | _publish_outside
       LOST                     v
                             OUTSIDE -- join --> MAPPING

    unsure_start: pose T_camera_world (4, 4) and covariance (6, 6) at which a resumed drive began
    its submap, None where the map is known.
    """

    def __init__(self, parts: Parts) -> None:
        super().__init__(parts)
        self.unsure_start: tuple[Array, Array] | None = None
        self._map, self._back_end = parts.sparse_map, parts.back_end
        self._sensors, self._moving = parts.sensors, parts.moving
        self._known: KnownMap | None = None
        self._lost_ns: int | None = None
        self._beside_ns: int | None = None

    @property
    def provisional(self) -> FrameResult | None:
        """The newest pose while results are held back: while the mount is being measured; or in the
        submap of a resumed drive, with the uncertainty of its start.
        """
        mount = self._map.rig.base_mount
        if mount is not None and self.state.holds_results and self.unsure_start is not None:
            return self._held.newest(mount)
        return super().provisional

    @property
    def covariance(self) -> Array:
        """The covariance (6, 6) of the latest pose, with that of an unsure start."""
        if self.unsure_start is None:
            return super().covariance
        A = adjoint(self._front_end.motion.T_camera_world @ invert(self.unsure_start[0]))
        return super().covariance + A @ self.unsure_start[1] @ A.T

    def load(self, arrays: Arrays, last: LastPose | None) -> None:
        """Continue with a saved map. last: where its drive was interrupted, which is resumed.
        Raises KeyError or ValueError for arrays that are no map.
        """
        fill_map(self._map, arrays)
        self._back_end.places.from_arrays(arrays)
        self._map.rig.offset.restored(arrays[OFFSET])
        if last is None:
            self.state = SessionState.LOADED
            self._front_end.reset()
        else:
            self.state = SessionState.RESUMED
            self._front_end.resume(last)

    def find_in_loaded(
        self, frame: StereoFrame, images: Images, fault: str
    ) -> tuple[Track | None, dict[int, Track]]:
        """Search for a frame in a loaded map, and begin a submap beside it. Returns the frame if
        it is found, and the earlier frames that prove it, by stamp. The submap is dropped then, or
        if an image cannot be tracked.
        """
        front_end = self._front_end
        if fault and self.state is SessionState.BESIDE:
            self._drop()
        if fault or front_end.is_fixed:
            return None, {}
        if self.state is SessionState.LOADED and front_end.is_searching:
            self._start()
        elif self.state is SessionState.BESIDE and self._beside_ns is None:
            # Not at the start: a submap beside a large map takes so long that frames are skipped.
            self._beside_ns = frame.stamp_ns
        if self.state is not SessionState.BESIDE:
            return None, {}
        if self._beside_ns is not None and frame.stamp_ns - self._beside_ns >= LOST_NS:
            self._publish_outside()
            return None, {}
        found, proof = self._find_in_known(frame, images)
        if found is not None:
            self._drop()
        return found, proof

    def found(self, proof: dict[int, Track]) -> None:
        """Note that a frame was tracked. proof: earlier frames that saw the same place, by stamp;
        they are returned once more.
        """
        super().found(proof)
        self._lost_ns = None
        if not self.state.is_submap:
            self.state, self.unsure_start = SessionState.MAPPING, None

    def search(self, frame: StereoFrame, images: Images, fault: str) -> None:
        """Note that a frame was not tracked. After some time, begin a submap; a camera that is lost
        in a submap is searched for in the known map.
        """
        front_end = self._front_end
        if self.state is SessionState.RESUMED and not front_end.motion.state.is_resuming:
            self.state = SessionState.MAPPING
        if fault or not front_end.is_searching:
            self._lost_ns = None
            return
        self._lost_ns = frame.stamp_ns if self._lost_ns is None else self._lost_ns
        is_over = frame.stamp_ns - self._lost_ns >= LOST_NS
        if self.state is SessionState.LOST:
            is_over |= self._find_in_known(frame, images)[0] is not None
        if self.state.holds_results and is_over:
            self._drop()
        elif is_over and not (self.state.is_submap or front_end.is_fixed):
            self._start()

    def search_near(self, T_world_camera: Array, reach: tuple[float, float]) -> None:
        """Search for the camera around a pose (4, 4) in the known map. reach: in m and rad."""
        if self.state.holds_results:
            self._drop()
        super().search_near(T_world_camera, reach)

    def join(self, keyframe: KeyframeRecord, images: Images) -> bool:
        """Merge the submap into the known map if a new keyframe shows where it is. Returns whether
        it did.
        """
        known = self._known
        if known is None or not known.recognise(keyframe, images):
            return False

        def merge() -> bool:
            self._back_end.reset_places(known.merge(self._back_end.places.to_arrays()))
            return True

        self._back_end.follow(merge)
        self._known, self.state, self.unsure_start = None, SessionState.MAPPING, None
        self._reset_plugins(is_other_world=True)
        self._change_submap(in_merged_map(self._map, self._front_end.motion.T_world_odom))
        return True

    def finish(self, may_replace: bool) -> list[FrameResult]:
        """Return the results that are held back after the last frame. may_replace: whether a submap
        that is larger than the known map replaces it.
        """
        if self.state is SessionState.BESIDE:
            self._publish_outside()
        if self.state is SessionState.LOST:
            self._back_end.collect(wait=True)
            if not (may_replace and self._keep_submap()):
                self._drop()
        return super().finish(may_replace)

    def to_arrays(self) -> Arrays:
        """Return the map for a file: the known one while results are held back."""
        self._back_end.collect(wait=True)
        offset = self._map.rig.offset.estimate
        measured: Arrays = {OFFSET: np.r_[offset.value_px, offset.information.ravel()]}
        if self._known is not None and self.state.holds_results:
            return self._known.to_arrays() | measured
        return map_and_words(self._map, self._back_end.places) | measured

    def _find_in_known(
        self, frame: StereoFrame, images: Images
    ) -> tuple[Track | None, dict[int, Track]]:
        assert self._known is not None
        features = self._front_end.extractor.extract(frame.left, images.excluded)
        return self._known.find(images, features, frame.stamp_ns)

    def _start(self) -> None:
        """Begin a submap: at the last pose, or at the origin if no pose in the loaded map is known.
        A map that had hardly begun is dropped instead.
        """
        before, back_end, motion = self.state, self._back_end, self._front_end.motion
        self._lost_ns = self._beside_ns = None
        if before is SessionState.RESUMED:
            self.unsure_start = motion.T_camera_world, motion.covariance
        back_end.collect(wait=True)
        is_small = len(self._map.keyframes) <= HARDLY_BEGUN
        if before is not SessionState.MAPPING or not is_small:
            of_drive = before is not SessionState.LOADED
            arrays = map_and_words(self._map, back_end.places)
            self._known = KnownMap(self._map, arrays, of_drive)
            self.state = SessionState.LOST if of_drive else SessionState.BESIDE
        back_end.reset()
        if before is SessionState.LOADED:
            motion.reset()
        elif self._map.rig.mount is not None:
            self._mount_search.end()
        self._front_end.reset()
        self._reset_plugins(is_other_world=before is SessionState.LOADED)

    def _drop(self) -> None:
        """Drop the submap, and search for the camera in the known map again."""
        known, was_beside = self._known, self.state is SessionState.BESIDE
        assert known is not None
        self._lost_ns = self._known = None
        self._back_end.collect(wait=True)
        self.state = SessionState.LOADED if was_beside else SessionState.MAPPING
        arrays = known.to_arrays()
        known.restore(arrays)
        self._back_end.reset_places(arrays)
        self._front_end.reset()
        self._reset_plugins(is_other_world=was_beside)
        self._change_submap(searched if was_beside else left_out)

    def _publish_outside(self) -> None:
        """Return the results of a submap late: the loaded map was searched without success."""
        self.state = SessionState.OUTSIDE
        self._change_submap(outside)

    def _change_submap(self, change: Callable[[FrameResult], FrameResult]) -> None:
        """Change the results that are held of a submap."""
        self._held.change(lambda held: change(held) if held.in_submap else held)

    def _keep_submap(self) -> bool:
        """Drop the known map if the submap has more keyframes. Returns whether it did."""
        assert self._known is not None
        if len(self._map.keyframes) <= self._known.num_keyframes:
            return False
        self._known, self.state = None, SessionState.MAPPING
        of_map = in_merged_map(self._map, self._front_end.motion.T_world_odom)
        self._held.change(
            lambda held: (
                replace(of_map(held), in_submap=False) if held.in_submap else left_out(held)
            )
        )
        return True

    def _reset_plugins(self, is_other_world: bool) -> None:
        """Let plugins forget earlier frames, whose poses relative to the next are not known.
        is_other_world: whether the axes of the map change as well.
        """
        self._moving.reset()
        self._mount_search.reset()
        if is_other_world:
            self._sensors.reset_world()
