"""Place recognition: which keyframes look like a view, whether it truly is the same place, and
whether several views agree that it is.

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
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.files.arrays import Arrays, joined, split
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.places.evidence import OF_VIEW, PlaceEvidence, is_enough, of_counts
from segfloor_ros.core.slam.places.views import COLUMNS, ROWS
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap, features_of
from segfloor_ros.core.slam.thresholds import CHANCE_SHARE, SAME, SEARCHED_FRAMES
from segfloor_ros.core.slam.tracking.evidence import ENOUGH_EVIDENCE
from segfloor_ros.core.slam.tracking.images import Features, hamming
from segfloor_ros.core.slam.tracking.map_tracking import MIN_VIEW_COSINE, Pixels, Tracker
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.twists import is_within

FILE = 'vocabulary.npy'
BRANCHES, LEVELS = 30, 3
NUM_WORDS = BRANCHES**LEVELS

SPEED_FACTOR, LEAST_SPEED_MPS = 2.0, 0.75
"""A robot that is lost moves at most so many times as fast as it ever did, this at least: it may be
carried at a walking pace.
"""

BEST_GROUPS = 2
"""Places tried with every frame; one more is tried in turn: words alone are not sure."""

VIEW_REACH_M = 2.0
"""A view shows a place also from so far before or behind where a keyframe stands."""


class PlaceRecognition:
    """The places of a map by their look."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._camera = sparse_map.rig.camera
        self._tracker = Tracker(sparse_map)
        self._map = sparse_map
        self._vocabulary = Vocabulary.load()
        self._index = PlaceIndex()
        self._latest: tuple[Features, NDArray[np.int32]] | None = None
        self._turn = 0

    def add(self, keyframe: KeyframeRecord) -> None:
        """Take in a keyframe."""
        self._index.add(keyframe.index, self._words(features_of(self._map, keyframe)))

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

    def shown_from(
        self, T_world_camera: Array, reach_m: Array | float, reach_rad: Array | float
    ) -> NDArray[np.bool_]:
        """Return which keyframes (K,) may show what a camera sees that stands within reach of a
        pose (4, 4).
        """
        poses = invert(np.stack([k.T_camera_world for k in self._map.keyframes]))
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        turned = np.arccos(np.clip(poses[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
        alike = turned < reach_rad + np.arccos(MIN_VIEW_COSINE)
        return np.asarray((distance < reach_m + VIEW_REACH_M) & alike)

    def find(
        self,
        images: Pixels,
        features: Features,
        may_show: NDArray[np.bool_],
        own_ids: NDArray[np.int32] | tuple[()] = (),
        is_possible: Callable[[Array], bool] = lambda T_camera_world: True,
        is_bounded: bool = False,
    ) -> Track | None:
        """Return a view with its pose; None where no place is seen, or two that look alike.

        may_show: which keyframes (K,) may be of the place. own_ids: points (N,) that are none of
        the place's. is_possible: whether the camera can be at a pose T_camera_world (4, 4).
        is_bounded: whether drift alone says where the place is; then only the one that looks most
        like the view is tried.
        """
        score = self.score(features) * may_show
        groups = self.groups(score, 1 if is_bounded else LOCAL_KEYFRAMES)
        chosen, others = groups[:BEST_GROUPS], groups[BEST_GROUPS:]
        if others:
            chosen.append(others[self._turn % len(others)])
            self._turn += 1
        found = []
        for group in chosen:
            track = self.locate(images, features, self.points_of(group, own_ids))
            if track is not None and is_possible(track.T_camera_world):
                found.append(track)
        if not found or any(_differ(found[0], other) for other in found[1:]):
            return None
        return max(found, key=lambda track: len(track.point_ids))

    def points_of(
        self, keyframes: NDArray[np.intp], own_ids: NDArray[np.int32] | tuple[()]
    ) -> NDArray[np.int32]:
        """Return the points of keyframes without some (N,)."""
        ids = self._map.points_of(keyframes)
        return ids[~np.isin(ids, own_ids)]

    def locate(
        self, images: Pixels, features: Features, ids: NDArray[np.int32], near: Array | None = None
    ) -> Track | None:
        """Find a camera among points `ids` (N,); None unless it sees them. near: the pose (4, 4)
        that it is roughly at.
        """
        estimate = self._tracker.locate(features, ids, near)
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
        return track if track is not None and self.log_ratio(track) > 0 else None

    def log_ratio(self, track: Track) -> float:
        """Return how much likelier than by chance what a frame shows of what it should is, in nats,
        where two parts of the image count as much as a view: each is one thing.
        """
        seen, there = (
            self._per_cell(self._map.xyz_world[ids], track.T_camera_world)
            for ids in (track.point_ids, track.visible_ids)
        )
        full = np.flatnonzero(there)
        parts = [of_counts(seen[k], CHANCE_SHARE * there[k]) for k in full]
        return float(np.clip(parts, -0.5 * OF_VIEW, 0.5 * OF_VIEW).sum())

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
        with (resources.files('segfloor_ros.core.slam.places') / FILE).open('rb') as file:
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


View = TypeVar('View')


class Sightings(Generic[View]):
    """Views that see a place and agree with the latest of them where that is. One that sees none
    takes the oldest away. agree: of an earlier view and the latest. newness: of each view (N,) to
    those before, 1 where it is all new.
    """

    def __init__(
        self,
        agree: Callable[[View, View], bool],
        newness: Callable[[list[View]], list[float]] = lambda views: [1.0] * len(views),
    ) -> None:
        self._agree, self._newness = agree, newness
        self.reset()

    def reset(self) -> None:
        """Know of no view."""
        self._seen: list[tuple[View, PlaceEvidence]] = []

    @property
    def views(self) -> list[View]:
        """The views, the latest last."""
        return [view for view, _ in self._seen]

    def add(self, seen: tuple[View, PlaceEvidence] | None) -> list[View]:
        """Take in the next view and what it says, None for one that does not see the place. Returns
        the views, once, when they prove the place, the latest last, else none.
        """
        if seen is None:
            self._seen = self._seen[1:]
            return []
        self._seen = [*(before for before in self._seen if self._agree(before[0], seen[0])), seen]
        views = self.views
        if not is_enough([evidence for _, evidence in self._seen], self._newness(views)):
            return []
        self.reset()
        return views


class Relocaliser:
    """Looks for a camera that does not know where it is in the whole map."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self._sightings = Sightings(self._can_have_moved)
        self.reset()

    def reset(self) -> None:
        """Search the whole map, and forget what was found in it."""
        self._near: tuple[Array, tuple[float, float]] | None = None
        self._searches_left = 0
        self._sightings.reset()
        self._proof: dict[int, Track] = {}

    def search_near(self, T_world_camera: Array, reach: tuple[float, float]) -> None:
        """Look around a pose (4, 4) alone, for some time or until the camera is found."""
        self._near = T_world_camera, reach
        self._searches_left = SEARCHED_FRAMES

    @property
    def is_narrow(self) -> bool:
        """Whether only the neighbourhood of a given pose is searched."""
        return self._near is not None and self._searches_left > 0

    def find(
        self,
        images: Pixels,
        features: Features,
        stamp_ns: int,
        is_possible: Callable[[Array], bool] = lambda T_camera_world: True,
        lost_at: Array | None = None,
    ) -> Track | None:
        """Return a frame with its pose; None until several agree, or one is found around a given
        pose or where the camera was lost (T_camera_world, (4, 4)).
        """
        given = self._near if self.is_narrow else None
        may_show = np.ones(len(self._map.keyframes), bool)
        if given is not None:
            self._searches_left -= 1
            may_show = self._places.shown_from(given[0], *given[1])

        def may_be(pose: Array) -> bool:
            return is_possible(pose) and (given is None or is_within(pose @ given[0], given[1]))

        found = self._places.find(images, features, may_show, is_possible=may_be)
        if found is None:
            self._sightings.add(None)
            return None
        pose = found.T_camera_world
        is_expected = lost_at is not None and is_within(pose @ invert(lost_at), SAME)
        # Where it is expected, no other place can be meant.
        travel = ENOUGH_EVIDENCE if is_expected or given is not None else 0.0
        evidence = PlaceEvidence(look=self._places.log_ratio(found), travel=travel)
        views = self._sightings.add(((stamp_ns, found), evidence))
        if not views:
            return None
        self.reset()
        self._proof = dict(views)
        return found

    def take_proof(self) -> dict[int, Track]:
        """Return, once, the frames that saw the place where the camera was found, by stamp."""
        proof, self._proof = self._proof, {}
        return proof

    def _can_have_moved(self, before: tuple[int, Track], now: tuple[int, Track]) -> bool:
        """Whether a camera can have come from one view, with its stamp, to another."""
        seconds = 1e-9 * (now[0] - before[0])
        way = greatest_speed_mps(self._map.keyframes) * seconds
        step = now[1].T_camera_world @ invert(before[1].T_camera_world)
        return is_within(step, (SAME[0] + way, SAME[1] + way))


def _differ(a: Track, b: Track) -> bool:
    return not is_within(a.T_camera_world @ invert(b.T_camera_world), SAME)
