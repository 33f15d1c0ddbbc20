"""Place recognition: which keyframes look like a view, and whether it truly is the same place.

Candidates come from binary words, grouped by covisibility (Mur-Artal and Tardos, Fast
Relocalisation and Loop Closing in Keyframe-Based SLAM, ICRA 2014). Buildings repeat themselves:
what counts is the geometry. A place is the same when most of what should be seen there is seen,
where it should be, all over the image.

Relocalisation looks for a camera that does not know where it is in the whole map.

The index of places: which keyframes hold the words of a view (Nister and Stewenius, Scalable
Recognition with a Vocabulary Tree, CVPR 2006: inverted files and tf-idf).

Visual words: a tree of binary descriptors, found by hierarchical clustering (Galvez-Lopez and
Tardos, Bags of Binary Words for Fast Place Recognition, IEEE T-RO 2012, section III).

The shipped tree was made by `tools/train_vocabulary.py` from rendered drives alone.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.files.results import Arrays, joined, split
from segfloor_ros.geometry import Array, invert, is_within, transform_points
from segfloor_ros.slam.places.known_views import COLUMNS, ROWS
from segfloor_ros.slam.results import CHANCE_SHARE, ENOUGH, MOST, SAME, Track
from segfloor_ros.slam.rig import LOCAL_KEYFRAMES
from segfloor_ros.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.slam.tracking.features import Features, hamming
from segfloor_ros.slam.tracking.map_tracking import Pixels, Tracker

FILE = 'vocabulary.npy'
BRANCHES, LEVELS = 30, 3
NUM_WORDS = BRANCHES**LEVELS

SPEED_FACTOR, LEAST_SPEED_MPS = 2.0, 0.75
"""A robot that is lost moves at most so many times as fast as it ever did, this at least: it may be
carried at a walking pace.
"""

BEST_GROUPS = 2
"""Places tried with every frame; one more is tried in turn: words alone are not sure."""

TIMES_SURE = 2
"""Where nothing limits where a place can be, so many times the evidence is asked for: walls with
the same paper, and shelves that stand twice in a building, are taken for one now and then. Of the
frames of a camera that is lost, away from where it was lost, each as far from where the one before
found it as it can have moved since; of keyframes that see a known map, as many times those of a
loop."""

MIN_AGREEMENT = 0.7
"""Share of the parts of the image that must show what is expected in each of these frames."""

NARROW_SEARCHES = 100
"""Frames for which only the neighbourhood of a given pose is searched: it may be wrong."""

VIEW_REACH = 2.0, 1.0
"""A view shows a place also from so far, in m, before or behind where a keyframe stands, and turned
by so many radians."""


class PlaceRecognition:
    """The places of a map by their look."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._camera = sparse_map.rig.camera
        self._tracker = Tracker(sparse_map)
        self._map = sparse_map
        self._vocabulary = Vocabulary.load()
        self._index = PlaceIndex()
        self._latest: tuple[Features, NDArray[np.int32]] | None = None

    def add(self, keyframe: KeyframeRecord) -> None:
        """Take in a keyframe."""
        self._index.add(keyframe.index, self._words(keyframe.features))

    def _words(self, features: Features) -> NDArray[np.int32]:
        """Return the words (N,) of features; those of the latest view are asked for twice."""
        if self._latest is None or self._latest[0] is not features:
            self._latest = features, self._vocabulary.words(features.descriptor)
        return self._latest[1]

    def reset(self) -> None:
        """Begin again with an empty map."""
        self._index.reset()

    def to_arrays(self) -> Arrays:
        """Return the words of all keyframes."""
        words, length = joined(
            [self._index.words_of(k.index) for k in self._map.keyframes], np.zeros(0, np.int32)
        )
        return {'words': words.astype(np.uint16), 'word_count': length}

    def from_arrays(self, arrays: Arrays) -> None:
        """Take in the words of the keyframes that come next."""
        for words in split(arrays['words'], arrays['word_count']):
            self._index.add(len(self._index), words.astype(np.int32))

    def score(self, features: Features) -> Array:
        """Return how much each keyframe (K,) looks like a view, in [0, 1]; those that are retired
        not at all.
        """
        keyframes = self._map.keyframes
        score = self._index.score(self._words(features), len(keyframes))
        return score * np.array([k.retired is None for k in keyframes])

    def groups(self, score: Array, count: int) -> list[NDArray[np.intp]]:
        """Return up to `count` groups of covisible keyframes, by index, that look most like a view
        as scored (K,); each keyframe is in one of them only.
        """
        best = np.argsort(-score, kind='stable')[:LOCAL_KEYFRAMES]
        links = self._map.links()
        groups = [self._around(int(k), score, links) for k in best if score[k] > 0]
        groups.sort(key=lambda group: -float(score[group].sum()))
        chosen: list[NDArray[np.intp]] = []
        for group in groups:
            if not any(np.isin(group[0], other).any() for other in chosen):
                chosen.append(group)
        return chosen[:count]

    def _around(
        self, index: int, score: Array, links: tuple[NDArray[np.intp], NDArray[np.intp]]
    ) -> NDArray[np.intp]:
        """Return a keyframe and those linked to it that look most like the view."""
        i, j = links
        others = np.union1d(j[i == index], i[j == index])
        others = others[np.argsort(-score[others], kind='stable')]
        others = others[score[others] > 0][: LOCAL_KEYFRAMES - 1]
        return np.append(index, others).astype(np.intp)

    def locate(self, images: Pixels, features: Features, ids: NDArray[np.int32]) -> Track | None:
        """Find a camera among points `ids` (N,); None unless it sees them."""
        observations = self._tracker.pixel_observations(features)
        tree = cKDTree(features.uv_px)
        estimate = self._tracker.locate(features, tree, observations, ids)
        if estimate is None:
            return None
        return self.confirm(images, features, ids, estimate.T_camera_world)

    def confirm(
        self, images: Pixels, features: Features, ids: NDArray[np.int32], T_camera_world: Array
    ) -> Track | None:
        """Find a camera that should be at a pose from which points `ids` (N,) are seen; None
        unless it sees them.
        """
        track = self._tracker.track_at(images, features, ids, T_camera_world)
        return track if track is not None and self.is_same_place(track) else None

    def is_same_place(self, track: Track) -> bool:
        """Whether a frame shows enough of what it should, all over the image."""
        found, expected = len(track.point_ids), len(track.visible_ids)
        if found < ENOUGH or found < CHANCE_SHARE * expected:
            return False
        return self.agreement(track) >= MOST

    def agreement(self, track: Track) -> float:
        """Return the share of the parts of the image that show what is expected there, by more than
        chance; 0 where no part expects enough.
        """
        seen, there = (
            self._per_cell(self._map.xyz_world[ids], track.T_camera_world)
            for ids in (track.point_ids, track.visible_ids)
        )
        full = there >= ENOUGH // 2
        agree = seen - np.sqrt(seen) >= 0.5 * CHANCE_SHARE * there
        return float(agree[full].mean()) if full.any() else 0.0

    def _per_cell(self, xyz_world: Array, T_camera_world: Array) -> NDArray[np.intp]:
        """Return how many of points (N, 3) lie in each part (COLUMNS * ROWS,) of the image."""
        uv = self._camera.project(transform_points(T_camera_world, xyz_world))[:, :2]
        size = (self._camera.width / COLUMNS, self._camera.height / ROWS)
        column, row = np.clip(uv // size, 0, (COLUMNS - 1, ROWS - 1)).astype(np.intp).T
        return np.bincount(row * COLUMNS + column, minlength=COLUMNS * ROWS)


class PlaceIndex:
    """Keyframes by the words they hold. The budget of features is the same for every view, so a
    word counts once per view, and what weighs it is how rare it is in the map.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all keyframes."""
        self._keyframes = [array('i') for _ in range(NUM_WORDS)]
        self._words: dict[int, NDArray[np.int32]] = {}

    def __len__(self) -> int:
        return len(self._words)

    def add(self, keyframe: int, words: NDArray[np.int32]) -> None:
        """Take in a keyframe, by index, with the words (N,) of its features."""
        own = np.unique(words)
        self._words[keyframe] = own
        for word in own.tolist():
            self._keyframes[word].append(keyframe)

    def words_of(self, keyframe: int) -> NDArray[np.int32]:
        """Return the words (N,) of a keyframe, ascending."""
        return self._words.get(keyframe, np.zeros(0, np.int32))

    def remove(self, keyframe: int) -> None:
        """Forget a keyframe."""
        for word in self._words.pop(keyframe, np.zeros(0, np.int32)).tolist():
            self._keyframes[word].remove(keyframe)

    def score(self, words: NDArray[np.int32], count: int) -> Array:
        """Return how much of a view with words (N,) each keyframe (count,) holds, in [0, 1]: words
        weigh the more the rarer they are, log(keyframes / keyframes that hold the word).
        """
        own = [self._keyframes[word] for word in np.unique(words).tolist()]
        holders = np.array([len(keyframes) for keyframes in own], np.intp)
        weight = np.log((len(self) + 1.0) / (holders + 1.0)) + 1e-9
        found = [np.frombuffer(keyframes, np.int32) for keyframes in own if keyframes]
        if not found:
            return np.zeros(count)
        held = np.bincount(np.concatenate(found), np.repeat(weight, holders), minlength=count)
        return held[:count] / weight.sum()


class Vocabulary:
    """A tree with `BRANCHES` children at each node. nodes: (N, 32) uint8, level by level; the
    children of node i of a level are the nodes i * BRANCHES, ... of the next.
    """

    def __init__(self, nodes: NDArray[np.uint8]) -> None:
        ends = np.cumsum([BRANCHES**level for level in range(1, LEVELS + 1)])
        if nodes.shape != (ends[-1], 32):
            raise ValueError(f'a vocabulary has {ends[-1]} nodes of 32 bytes, not {nodes.shape}')
        self._levels = [
            level.reshape(-1, BRANCHES, 32) for level in np.split(nodes, ends[:-1].tolist())
        ]

    @staticmethod
    def load() -> Vocabulary:
        """Read the shipped vocabulary."""
        with (resources.files('segfloor_ros.slam.places') / FILE).open('rb') as file:
            return Vocabulary(np.load(file, allow_pickle=False))

    def words(self, descriptor: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the word (N,) of each descriptor (N, 32), in [0, NUM_WORDS)."""
        node = np.zeros(len(descriptor), np.intp)
        for children in self._levels:
            distance = hamming(descriptor[:, None], children[node])
            node = node * BRANCHES + distance.argmin(axis=1)
        return node.astype(np.int32)


def greatest_speed_mps(keyframes: Sequence[KeyframeRecord]) -> float:
    """Return how fast a robot moves at most while nobody sees it."""
    stamp_s = np.array([k.stamp_ns for k in keyframes]) / 1e9
    steps = np.diff([k.T_world_camera[:3, 3] for k in keyframes], axis=0)
    speeds = np.linalg.norm(steps.reshape(-1, 3), axis=1) / np.maximum(np.diff(stamp_s), 1e-3)
    return SPEED_FACTOR * float(speeds.max(initial=LEAST_SPEED_MPS))


class Relocaliser:
    """Looks for a view in the map, some places per frame."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self._turn = 0
        self.reset()

    def reset(self) -> None:
        """Search the whole map, and forget what was found in it."""
        self._near: tuple[Array, tuple[float, float]] | None = None
        self._searches_left = 0
        self._last_found: tuple[int, Array] | None = None
        self._in_a_row = 0

    def search_near(self, T_world_camera: Array, reach: tuple[float, float]) -> None:
        """Look around a pose (4, 4) alone, for some time or until the camera is found."""
        self._near = T_world_camera, reach
        self._searches_left = NARROW_SEARCHES

    @property
    def is_narrow(self) -> bool:
        """Whether only the neighbourhood of a given pose is searched."""
        return self._near is not None and self._searches_left > 0

    def find_surely(
        self,
        images: Pixels,
        features: Features,
        stamp_ns: int,
        is_possible: Callable[[Array], bool] | None = None,
        lost_at: Array | None = None,
    ) -> Track | None:
        """Return a frame with its pose as `find` does; None until enough frames in a row are found
        there, or one around a given pose or where the camera was lost (T_camera_world, (4, 4)).
        """
        given = self.is_narrow
        found = self.find(images, features, is_possible)
        expected = found is not None and (given or _follows(found, lost_at, SAME[0]))
        if found is None or not (expected or self._places.agreement(found) >= MIN_AGREEMENT):
            self._last_found, self._in_a_row = None, 0
            return None
        before_ns, last = self._last_found or (stamp_ns, None)
        way_m = greatest_speed_mps(self._map.keyframes) * 1e-9 * (stamp_ns - before_ns)
        self._in_a_row = self._in_a_row + 1 if _follows(found, last, SAME[0] + way_m) else 1
        self._last_found = stamp_ns, found.T_camera_world
        if self._in_a_row < TIMES_SURE and not expected:
            return None
        self._last_found, self._near = None, None
        return found

    def find(
        self, images: Pixels, features: Features, is_possible: Callable[[Array], bool] | None = None
    ) -> Track | None:
        """Return a frame with its pose; None where no place of the map is seen, or two that look
        alike. is_possible: whether the camera can be at a pose T_camera_world (4, 4).
        """
        score = self._places.score(features) * self._allowed()
        groups = self._places.groups(score, LOCAL_KEYFRAMES)
        chosen, others = groups[:BEST_GROUPS], groups[BEST_GROUPS:]
        if others:
            chosen.append(others[self._turn % len(others)])
            self._turn += 1
        found = []
        for group in chosen:
            ids = self._map.points_of(group)
            track = self._places.locate(images, features, ids)
            if track is None or not self._is_near(track):
                continue
            if is_possible is None or is_possible(track.T_camera_world):
                found.append(track)
        if not found or any(_differ(found[0], other) for other in found[1:]):
            return None
        return max(found, key=lambda track: len(track.point_ids))

    def _allowed(self) -> NDArray[np.bool_]:
        """Return the keyframes (K,) that may show where the camera is."""
        keyframes = self._map.keyframes
        if self._near is None or self._searches_left == 0:
            return np.ones(len(keyframes), bool)
        self._searches_left -= 1
        T_world_camera, (reach_m, reach_rad) = self._near
        poses = np.stack([k.T_world_camera for k in keyframes])
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        turned = np.arccos(np.clip(poses[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
        return (distance < reach_m + VIEW_REACH[0]) & (turned < reach_rad + VIEW_REACH[1])

    def _is_near(self, track: Track) -> bool:
        if self._near is None or self._searches_left == 0:
            return True
        T_world_camera, reach = self._near
        return is_within(track.T_camera_world @ T_world_camera, reach)


def _follows(found: Track, T_camera_world: Array | None, reach_m: float) -> bool:
    """Whether a frame is within reach of where a camera was before (4, 4), if that is known."""
    if T_camera_world is None:
        return False
    return is_within(found.T_camera_world @ invert(T_camera_world), (reach_m, 2 * SAME[1]))


def _differ(a: Track, b: Track) -> bool:
    return not is_within(a.T_camera_world @ invert(b.T_camera_world), SAME)
