"""Relocalisation: where in the whole map a camera is that does not know."""

from __future__ import annotations

import numpy as np

from segfloor_ros.geometry import invert, rotation_angle
from segfloor_ros.slam.features import Features
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.place_recognition import BEST_KEYFRAMES, PlaceRecognition
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.track import Track

BEST_GROUPS = 2
"""Places tried with every frame; one more is tried in turn: words alone do not tell for sure."""

SAME_M = 0.5
SAME_RAD = 0.3
"""Two finds further apart than this are two places that look alike."""


class Relocaliser:
    """Looks for a view in the map, some places per frame."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self._turn = 0

    def find(self, images: Images, features: Features, offset_px: float) -> Track | None:
        """Return a frame with its pose; None where no place of the map is seen, or two that look
        alike.
        """
        groups = self._places.groups(self._places.score(features), BEST_KEYFRAMES)
        chosen, others = groups[:BEST_GROUPS], groups[BEST_GROUPS:]
        if others:
            chosen.append(others[self._turn % len(others)])
            self._turn += 1
        found = []
        for group in chosen:
            ids = self._map.points_of(group)
            track = self._places.locate(images, features, ids, offset_px)
            if track is not None:
                found.append(track)
        if not found or any(_apart(found[0], other) for other in found[1:]):
            return None
        return max(found, key=lambda track: len(track.point_ids))


def _apart(a: Track, b: Track) -> bool:
    motion = a.T_camera_world @ invert(b.T_camera_world)
    moved_m = float(np.linalg.norm(motion[:3, 3]))
    return moved_m > SAME_M or rotation_angle(motion[:3, :3]) > SAME_RAD
