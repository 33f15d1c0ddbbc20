"""Tracking: the pose of a frame from the map points it sees again.

Which map points a camera at a given pose should see, and where; the local map: the part of the map
that a frame is tracked against, and whether it is enough.

The points of the last frame are followed into an ordinary one. Corners and descriptors are only
needed where nothing is known of the motion, or where new points are wanted. Between keyframes
optical flow of some points gives the pose to a pixel, and the patches of a spread selection of map
points give the rest (Forster et al., SVO: Semidirect Visual Odometry, ICRA 2014). The patches come
from keyframes: errors do not add up from frame to frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.places.views import View, is_keyframe, novelty, view_novelty, views_near
from segfloor_ros.core.slam.rig import (
    AT_ONCE,
    LOCAL_KEYFRAMES,
    MIN_DEPTH_M,
    NEIGHBOURS,
    Observations,
    Readout,
    in_view,
    moved_on,
)
from segfloor_ros.core.slam.sparse_map import Covisible, SparseMap, median_depth_m
from segfloor_ros.core.slam.tracking.evidence import is_proof
from segfloor_ros.core.slam.tracking.images import (
    PYRAMID_LEVELS,
    PYRAMID_SCALE,
    SIDE_PX,
    SIGMA_FLOW_PX,
    Features,
    Images,
    follow_pixels,
    is_inside,
    match_predicted,
    match_unguided,
    spread,
)
from segfloor_ros.core.slam.tracking.patch_alignment import (
    ALIGNED_PX,
    MIN_SIGMA_PIXEL,
    align_patches,
    measure_disparity,
)
from segfloor_ros.core.slam.tracking.pose import Consensus, PoseEstimate, Searched, solve_pnp
from segfloor_ros.core.slam.tracking.track import ObservedFeatures, Track
from segfloor_ros.core.timing import timed

NARROW_PX, USUAL_PX, WIDE_PX = 6.0, 15.0, 45.0
"""Search radius around a predicted pixel, at the finest pyramid level: once a pose is known from
this very frame; by a prediction; and when that finds too little."""

FOUND_PER_PX, ALIGNED = 1 / 300, 0.015
"""Probability, for each pixel of the radius, that a feature is found where the point is not, and
that a patch is aligned there: measured at poses that are wrong by 5 to 10 degrees."""

Pixels = Images | Observations
"""What the features of a frame are measured in: its images, or where these are gone, as of a saved
keyframe, what was measured in them."""

MIN_VIEW_COSINE = 0.5
"""A point is recognised up to 60 degrees from the direction it was last seen from."""

TRACKED_POINTS = 400
"""Map points, spread over the image, that are measured in a frame between keyframes."""

MAX_FOLLOWED = 250

SIGMAS = 3.0
"""Within so many standard deviations lies what is where it was expected."""


class Tracker:
    """Finds the pose of frames against the local map."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self.consensus = Consensus(sparse_map)
        self._map = sparse_map

    def best(
        self,
        images: Images,
        features: Features,
        local_ids: NDArray[np.int32],
        starts: Iterable[Start],
        expected: PoseEstimate | None,
    ) -> Track | None:
        """Return the pose of a frame with the most evidence, of those found from some starts, tried
        in order until two lead to the same, the second one roughly where the first was expected, or
        one that must be near is proven and is where the camera was expected; its observations have
        the disparity offset. None where nothing is proven.
        """
        if len(features) == 0 or len(local_ids) == 0:
            return None
        best: Track | None = None
        most = -math.inf
        for start in starts:
            coarse = self._coarse(features, local_ids, start)
            if coarse is None:
                continue
            if best is not None and is_proof(most) and best.fits(expected) and best.fits(coarse):
                break
            track = self.track_at(images, features, local_ids, coarse.T_camera_world)
            if track is None:
                continue
            evidence = track.estimate.evidence(expected)
            proven = is_proof(evidence)
            is_found_again = best is not None and proven and track.fits(best.estimate)
            if evidence > most:
                best, most = track, evidence
            if is_found_again or (start.is_sure and proven and track.fits(expected)):
                break
        return best if is_proof(most) else None

    @timed
    def track_at(
        self,
        images: Pixels,
        features: Features,
        local_ids: NDArray[np.int32],
        T_camera_world: Array,
        known: PoseEstimate | None = None,
    ) -> Track | None:
        """Find which features show map points, and the pose, which is known to a few pixels; its
        observations have the disparity offset. None where there is no evidence for it. known: the
        pose by the same images before.
        """
        if len(features) == 0 or len(local_ids) == 0:
            return None
        rig = self._map.rig
        if isinstance(images, Images):
            observations, excluded = features.observations, images.excluded
        else:
            observations, excluded = images, None
        # What was measured in a keyframe is freed of the readout already.
        readout = rig.shutter.expected if isinstance(images, Images) else AT_ONCE
        seen = predict_points(self._map, local_ids, T_camera_world, excluded)
        points, rows, area_px2 = self._search(features, seen, NARROW_PX)
        if len(rows) == 0:
            return None
        ids = seen.ids[points]
        if isinstance(images, Images):
            align_pixels(images.left, observations, rows, self._map, ids, T_camera_world)
            guess_px = seen.uvd_px[points, 2] + rig.offset.at(seen.uvd_px[points])
            measure_disparity(images, observations, rows, guess_px)
        measured = observations.take(rows).without_offset(rig.offset)
        missed, by_chance = len(seen.ids) - len(rows), NARROW_PX * FOUND_PER_PX
        searched = Searched(area_px2, range_of(images, measured), missed, by_chance)
        estimate = self.consensus.refine(T_camera_world, ids, measured, searched, known, readout)
        if not is_proof(estimate.evidence(known)):
            if known is None:
                return None
            estimate = self.consensus.at(known, ids, measured)
        rows, ids = rows[estimate.inliers], ids[estimate.inliers]
        point_id = np.full(len(features), NO_POINT, np.int32)
        point_id[rows] = ids
        as_noisy = observations.with_noise_factor(estimate.noise_factor)
        observed = ObservedFeatures(features, as_noisy, point_id, estimate.readout.twist)
        return Track(estimate, ids, observations.take(rows), seen.ids, observed)

    def locate(
        self, features: Features, ids: NDArray[np.int32], near: Array | None = None
    ) -> PoseEstimate | None:
        """Find the pose among map points, roughly at a pose (4, 4), or without a prediction:
        descriptors alone and PnP-RANSAC for a first guess, which then has to find more points where
        they should be.
        """
        start = self.by_descriptors(features, ids) if near is None else Start(near, WIDE_PX)
        return None if start is None else self._coarse(features, ids, start)

    def by_descriptors(self, features: Features, ids: NDArray[np.int32]) -> Start | None:
        """Return the pose that most of the map points `ids` (N,) agree with whose descriptors are
        each other's nearest with those of features.
        """
        points, rows = match_unguided(self._map.descriptor[ids], features.descriptor)
        xyz_world = self._map.xyz_world[ids[points]]
        found = solve_pnp(self._map.rig.camera, xyz_world, features.uv_px[rows])
        return None if found is None else Start(found[0])

    def _coarse(
        self, features: Features, local_ids: NDArray[np.int32], start: Start
    ) -> PoseEstimate | None:
        """Return the pose by the features around a start; None where there is no evidence."""
        seen = predict_points(self._map, local_ids, start.T_camera_world)
        points, rows, area_px2 = self._search(features, seen, start.radius_px)
        if len(rows) == 0:
            return None
        missed, by_chance = len(seen.ids) - len(rows), min(start.radius_px * FOUND_PER_PX, 1.0)
        searched = Searched(area_px2, None, missed, by_chance)
        found = self.consensus.refine(
            start.T_camera_world, seen.ids[points], features.observations.take(rows), searched
        )
        return found if is_proof(found.evidence()) else None

    def _search(
        self, features: Features, seen: Prediction, radius_px: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Return pairs of points (N,) and features (N,) and the areas (N,) they were looked for
        in.
        """
        reach_px = radius_px * PYRAMID_SCALE ** np.clip(seen.octave, 0, None)
        points, rows = match_predicted(
            features, seen.uvd_px[:, :2], seen.octave, self._map.descriptor[seen.ids], reach_px
        )
        return points, rows, np.pi * reach_px[points] ** 2


@dataclass(frozen=True)
class Start:
    """Where the camera may be, T_camera_world (4, 4), and how far from there points are looked for
    at the finest level of the pyramid. is_sure: whether it must be there.
    """

    T_camera_world: Array
    radius_px: float = USUAL_PX
    is_sure: bool = False


def range_of(images: Pixels, measured: Observations) -> float:
    """Return the range of disparities in which a wrong one may lie: near a guess; of a depth camera
    it takes those that come.
    """
    near_px = 2 * ALIGNED_PX
    disparity = measured.uvd_px[measured.has_disparity, 2]
    if len(disparity) == 0 or (isinstance(images, Images) and not images.depth_scale):
        return near_px
    return max(near_px, float(np.ptp(disparity)))


@dataclass(frozen=True)
class Prediction:
    """Map points expected in the image: ids (N,), pixel and disparity (N, 3), pyramid level
    (N,).
    """

    ids: NDArray[np.int32]
    uvd_px: Array
    octave: Array

    def take(self, rows: NDArray[np.intp]) -> Prediction:
        """Return the chosen rows."""
        return Prediction(self.ids[rows], self.uvd_px[rows], self.octave[rows])


def predict_points(
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
    excluded: Region | None = None,
    readout: Readout = AT_ONCE,
) -> Prediction:
    """Project points (N,) into the image and keep those that a camera there should recognise:
    inside the image, from about the known direction, at a size the pyramid has, and not in a region
    that is excluded. readout: of the image.
    """
    camera = sparse_map.rig.camera
    points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
    uvd, visible = in_view(camera, points)
    if readout.twist.any():
        share = np.nan_to_num((uvd[:, 1] - camera.cy) / camera.height).clip(-0.5, 0.5)
        uvd, visible = in_view(camera, moved_on(points.T, share, readout.twist).T)
    visible[visible] = ~is_inside(excluded, uvd[visible, :2])
    ids, points, uvd = ids[visible], points[visible], uvd[visible]
    distance = np.sqrt((points**2).sum(axis=1))
    direction = points @ T_camera_world[:3, :3] / distance[:, None]
    cosine = (direction * sparse_map.viewing_direction[ids]).sum(axis=1)
    zoom = np.log(sparse_map.viewing_distance_m[ids] / distance)
    octave = sparse_map.viewing_octave[ids] + zoom / np.log(PYRAMID_SCALE)
    alike = (cosine > MIN_VIEW_COSINE) & (octave > -1.5) & (octave < PYRAMID_LEVELS + 0.5)
    return Prediction(ids[alike], uvd[alike], octave[alike])


class LocalMap:
    """Chooses points around a view (Mur-Artal et al., ORB-SLAM, 2015, section V-D). max_frames:
    after which a keyframe is due. new_view: novelty that makes a view new.
    """

    def __init__(self, sparse_map: SparseMap, max_frames: int, new_view: float = 1.0) -> None:
        self.point_ids: NDArray[np.int32] = np.zeros(0, np.int32)
        self._max_frames, self._new_view = max_frames, new_view
        self._map = sparse_map
        self._depth_m = MIN_DEPTH_M
        self._asked: tuple[NDArray[np.int32], Covisible] | None = None

    @timed
    def move_to(self, ids: NDArray[np.int32], T_camera_world: Array) -> None:
        """Take the points around a camera that sees points `ids` (N,)."""
        self.point_ids = self.points_around(ids, T_camera_world)

    def points_around(self, ids: NDArray[np.int32], T_camera_world: Array) -> NDArray[np.int32]:
        """Return the points of keyframes that share points `ids` (N,) with a view, or stand where
        it is.
        """
        order, _ = self._covisible(ids)
        depth_m = self._median_depth(ids, T_camera_world)
        here = views_near(self._map, T_camera_world, depth_m, LOCAL_KEYFRAMES)
        local = self._map.points_of(np.append(order[:NEIGHBOURS], here))
        # The oldest first: of two points that fit a feature equally well it is the one to keep.
        return local[np.argsort(self._map.stable_id[local])]

    def drop_dead(self) -> None:
        """Forget points that are not part of the map any more."""
        self.point_ids = self.point_ids[self._map.alive[self.point_ids]]

    @timed
    def wants_keyframe(
        self, track: Track, frames_since: int, since_ns: int, mapper_idle: bool
    ) -> bool:
        """Whether a frame shows enough that is new. frames_since, since_ns: since the last one."""
        covisible = self._covisible(track.point_ids)
        reference = self._map.keyframes[covisible[0][0]]
        known = reference.seen_ids
        reliable = known[self._map.observer_count[known] > 1]
        depth_m = self._median_depth(reliable if len(reliable) else known, track.T_camera_world)
        novelty = view_novelty(self._map, track.point_ids, track.T_camera_world, depth_m, covisible)
        novelty /= self._new_view
        num_reliable = min(len(reliable), TRACKED_POINTS)
        found = len(track.point_ids)
        share = found / max(1, len(track.visible_ids))
        view = View(frames_since, found, num_reliable, novelty, mapper_idle, share, since_ns)
        return is_keyframe(view, self._max_frames)

    def reach_px(self, expected: PoseEstimate) -> float:
        """Return how far from where they are expected the points around a camera may be, in px."""
        variance = np.diag(expected.covariance)
        sigma_rad = np.sqrt(variance[3:].max()) + np.sqrt(variance[:3].max()) / self._depth_m
        return float(SIGMAS * self._map.rig.camera.fx * sigma_rad)

    def is_new_view(self, T_camera_world: Array) -> bool:
        """Whether a camera that sees no point has come to where the last keyframe was not."""
        T_last_now = self._map.keyframes[-1].T_camera_world @ invert(T_camera_world)
        return bool(novelty(T_last_now, self._depth_m) > 1)

    def _covisible(self, ids: NDArray[np.int32]) -> Covisible:
        """Return what `covisible` of the map does, once for the points of a frame."""
        if self._asked is None or self._asked[0] is not ids:
            self._asked = ids, self._map.covisible(ids)
        return self._asked[1]

    def _median_depth(self, ids: NDArray[np.int32], T_camera_world: Array) -> float:
        """Return the depth of points `ids` (N,); without any, that of those seen last."""
        if len(ids):
            self._depth_m = median_depth_m(self._map, ids, T_camera_world)
        return self._depth_m


@timed
def align_pixels(
    left: NDArray[np.float32],
    observations: Observations,
    rows: NDArray[np.intp],
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
) -> NDArray[np.bool_]:
    """Move observations, in place, from where they are to where the patches of their points lie.

    left: (H, W) float32. rows, ids: (N,) the observations and their points. T_camera_world: the
    pose as known so far. Returns which patches were found (N,); the others stay as they were.
    """
    points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
    zoom = sparse_map.patch_distance_m[ids] / np.linalg.norm(points, axis=1)
    template = sparse_map.patch[ids].astype(np.float32)
    found = align_patches(template, left, observations.uvd_px[rows, :2], zoom)
    sound = rows[found.sound]
    observations.uvd_px[sound, :2] = found.uv_px[found.sound]
    observations.sigma_px[sound, :2] = np.clip(found.sigma_px[found.sound], MIN_SIGMA_PIXEL, None)
    return found.sound


class Follower:
    """Finds the pose of a frame from the one before. seen_ids: points (N,) that this one showed."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._camera = sparse_map.rig.camera
        self._consensus = Consensus(sparse_map)
        self.reset()

    def reset(self) -> None:
        """Know no frame before."""
        self._small: NDArray[np.uint8] | None = None
        self.seen_ids: NDArray[np.int32] = np.zeros(0, np.int32)
        self._uv_px: Array = np.zeros((0, 2))

    def see(self, images: Images, ids: NDArray[np.int32], uv_px: Array) -> None:
        """Take in a frame that shows map points `ids` (N,) at pixels (N, 2)."""
        self._small, self.seen_ids, self._uv_px = images.small, ids, uv_px

    def expected_shift(self, T_then: Array, T_now: Array) -> float:
        """Return how far the picture of these points should have moved between two poses
        (T_camera_world, (4, 4)), in image widths; 0 without points.
        """
        points = self._map.xyz_world[self.seen_ids]
        if len(points) == 0:
            return 0.0
        then, now = (
            self._camera.project(transform_points(T, points))[:, :2] for T in (T_then, T_now)
        )
        return float(np.median(np.linalg.norm(now - then, axis=1))) / self._camera.width

    def drop_inside(self, region: Region) -> None:
        """Forget the points that the last frame shows in a region."""
        outside = ~is_inside(region, self._uv_px)
        self.seen_ids, self._uv_px = self.seen_ids[outside], self._uv_px[outside]

    def drop_dead(self) -> None:
        """Forget points that are not part of the map any more."""
        alive = self._map.alive[self.seen_ids]
        self.seen_ids, self._uv_px = self.seen_ids[alive], self._uv_px[alive]

    def follow(
        self, images: Images, local_ids: NDArray[np.int32], T_predicted: Array
    ) -> Track | None:
        """Find the pose of a frame; None where too little of the last one is found again."""
        rig, roughly = self._map.rig, self._by_flow(images, T_predicted)
        if roughly is None:
            return None
        pose = roughly.T_camera_world
        seen = self._select(local_ids, roughly, images.excluded)
        observations = Observations(seen.uvd_px.copy(), np.ones((len(seen.ids), 3)))
        rows = np.arange(len(seen.ids))
        rows = rows[align_pixels(images.left, observations, rows, self._map, seen.ids, pose)]
        guess_px = seen.uvd_px[rows, 2] + rig.offset.at(seen.uvd_px[rows])
        measure_disparity(images, observations, rows, guess_px)
        if len(rows) == 0:
            return None
        ids = seen.ids[rows]
        measured = observations.take(rows)
        searched = Searched(
            4 * ALIGNED_PX**2, range_of(images, measured), len(seen.ids) - len(rows), ALIGNED
        )
        found = self._consensus.refine(pose, ids, measured.without_offset(rig.offset), searched)
        return Track(found, ids[found.inliers], measured.take(found.inliers), seen.ids)

    @timed
    def _by_flow(self, images: Images, T_predicted: Array) -> PoseEstimate | None:
        """Find the pose to about a pixel from where the last frame's points went."""
        if self._small is None or len(self.seen_ids) == 0:
            return None
        step = -(-len(self.seen_ids) // MAX_FOLLOWED)
        ids, uv_last = self.seen_ids[::step], self._uv_px[::step]
        points = transform_points(T_predicted, self._map.xyz_world[ids])
        front = points[:, 2] > MIN_DEPTH_M
        ids, uv_last, points = ids[front], uv_last[front], points[front]
        if len(ids) == 0:
            return None
        guess = self._camera.project(points)[:, :2]
        width = self._camera.width
        uv, found = follow_pixels(self._small, images.small, width, uv_last, guess)
        found &= ~is_inside(images.excluded, uv)
        if not found.any():
            return None
        observations = Observations.of_pixels(uv[found], SIGMA_FLOW_PX)
        searched = Searched(float(SIDE_PX * width / self._small.shape[1]) ** 2)
        roughly = self._consensus.refine(T_predicted, ids[found], observations, searched)
        return roughly if is_proof(roughly.evidence()) else None

    @timed
    def _select(
        self, local_ids: NDArray[np.int32], known: PoseEstimate, excluded: Region | None
    ) -> Prediction:
        """Return points that should be seen, spread over the image, the often found first."""
        seen = predict_points(self._map, local_ids, known.T_camera_world, excluded, known.readout)
        if len(seen.ids) <= TRACKED_POINTS:
            return seen
        area = self._camera.width * self._camera.height
        cell_px = max(1, int(np.sqrt(area / TRACKED_POINTS)))
        reliability = self._map.points.reliability(seen.ids).astype(np.float32)
        return seen.take(spread(seen.uvd_px[:, :2], reliability, cell_px, TRACKED_POINTS))
