"""Relocalisation: where in the whole map a camera is that does not know."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, invert, rotation_angle
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.places.place_recognition import BEST_KEYFRAMES, PlaceRecognition
from segfloor_ros.slam.results import Track
from segfloor_ros.slam.tracking.features import Features
from segfloor_ros.slam.tracking.images import Images

BEST_GROUPS = 2
"""Places tried with every frame; one more is tried in turn: words alone do not tell for sure."""

SAME_M = 0.5
SAME_RAD = 0.3
"""Two finds further apart than this are two places that look alike."""

FRAMES_IN_A_ROW = 2
STEP_M, STEP_RAD = 0.5, 0.6
MIN_AGREEMENT = 0.7
"""Away from where it was lost, so many frames must find the camera, each about where the one before
did, and show what is expected in so many parts of the image: a shelf that stands twice in a
building shows now and then enough for one frame, by chance."""

NARROW_SEARCHES = 100
"""Frames for which only the neighbourhood of a given pose is searched: it may be wrong."""

VIEW_REACH_M = 2.0
"""A view shows a place also from so far before or behind where a keyframe stands."""

MAX_VIEW_TURN_RAD = 1.0


class Relocaliser:
    """Looks for a view in the map, some places per frame."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self._turn = 0
        self.reset()

    def reset(self) -> None:
        """Search the whole map, and forget what was found in it."""
        self._near: tuple[Array, float, float] | None = None
        self._searches_left = 0
        self._last_found: Array | None = None
        self._in_a_row = 0

    def search_near(self, T_world_camera: Array, reach_m: float, reach_rad: float) -> None:
        """Look around a pose (4, 4) alone, for some time or until the camera is found."""
        self._near = T_world_camera, reach_m, reach_rad
        self._searches_left = NARROW_SEARCHES

    @property
    def is_narrow(self) -> bool:
        """Whether only the neighbourhood of a given pose is searched."""
        return self._near is not None and self._searches_left > 0

    def find_surely(
        self,
        images: Images,
        features: Features,
        offset_px: float,
        is_possible: Callable[[Array], bool] | None,
        lost_at: Array | None,
    ) -> Track | None:
        """Return a frame with its pose as `find` does; None until enough frames in a row are found
        there, or one around a given pose or where the camera was lost (T_camera_world, (4, 4)).
        """
        given = self.is_narrow
        found = self.find(images, features, offset_px, is_possible)
        expected = found is not None and (given or _follows(found, lost_at))
        if found is None or not (expected or self._places.agreement(found) >= MIN_AGREEMENT):
            self._last_found, self._in_a_row = None, 0
            return None
        self._in_a_row = self._in_a_row + 1 if _follows(found, self._last_found) else 1
        self._last_found = found.T_camera_world
        if self._in_a_row < FRAMES_IN_A_ROW and not expected:
            return None
        self._last_found, self._near = None, None
        return found

    def find(
        self,
        images: Images,
        features: Features,
        offset_px: float,
        is_possible: Callable[[Array], bool] | None = None,
    ) -> Track | None:
        """Return a frame with its pose; None where no place of the map is seen, or two that look
        alike. is_possible: whether the camera can be at a pose T_camera_world (4, 4).
        """
        score = self._places.score(features) * self._allowed()
        groups = self._places.groups(score, BEST_KEYFRAMES)
        chosen, others = groups[:BEST_GROUPS], groups[BEST_GROUPS:]
        if others:
            chosen.append(others[self._turn % len(others)])
            self._turn += 1
        found = []
        for group in chosen:
            ids = self._map.points_of(group)
            track = self._places.locate(images, features, ids, offset_px)
            if track is None or not self._is_near(track):
                continue
            if is_possible is None or is_possible(track.T_camera_world):
                found.append(track)
        if not found or any(_apart(found[0], other) for other in found[1:]):
            return None
        return max(found, key=lambda track: len(track.point_ids))

    def _allowed(self) -> NDArray[np.bool_]:
        """Return the keyframes (K,) that may show where the camera is."""
        keyframes = self._map.keyframes
        if self._near is None or self._searches_left == 0:
            return np.ones(len(keyframes), bool)
        self._searches_left -= 1
        T_world_camera, reach_m, reach_rad = self._near
        poses = np.stack([k.T_world_camera for k in keyframes])
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        turned = np.arccos(np.clip(poses[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
        return (distance < reach_m + VIEW_REACH_M) & (turned < reach_rad + MAX_VIEW_TURN_RAD)

    def _is_near(self, track: Track) -> bool:
        if self._near is None or self._searches_left == 0:
            return True
        T_world_camera, reach_m, reach_rad = self._near
        return is_within(track.T_camera_world @ T_world_camera, reach_m, reach_rad)


def is_within(motion: Array, reach_m: float, reach_rad: float) -> bool:
    """Whether a motion (4, 4) is at most so far and so much of a turn."""
    moved_m = float(np.linalg.norm(motion[:3, 3]))
    return moved_m <= reach_m and rotation_angle(motion[:3, :3]) <= reach_rad


def _follows(found: Track, T_camera_world: Array | None) -> bool:
    """Whether a frame is about where a camera was before (4, 4), if that is known."""
    if T_camera_world is None:
        return False
    return is_within(found.T_camera_world @ invert(T_camera_world), STEP_M, STEP_RAD)


def _apart(a: Track, b: Track) -> bool:
    return not is_within(a.T_camera_world @ invert(b.T_camera_world), SAME_M, SAME_RAD)
