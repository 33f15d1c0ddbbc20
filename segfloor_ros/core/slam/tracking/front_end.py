"""The front end of SLAM: where the camera is, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.core.camera.pixels import Region, union
from segfloor_ros.core.contracts import NO_POINT, BodySensors, LastPose, StereoFrame
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.slam.places.place_recognition import (
    PlaceRecognition,
    Relocaliser,
    greatest_speed_mps,
    is_within,
)
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.thresholds import SAME
from segfloor_ros.core.slam.tracking.evidence import is_proof
from segfloor_ros.core.slam.tracking.frame_to_frame import FrameToFrame
from segfloor_ros.core.slam.tracking.images import FeatureExtractor, Features, Images, is_inside
from segfloor_ros.core.slam.tracking.map_tracking import (
    USUAL_PX,
    WIDE_PX,
    Follower,
    LocalMap,
    Start,
    Tracker,
)
from segfloor_ros.core.slam.tracking.motion import CameraMotion, TrackingState, sigma_m
from segfloor_ros.core.slam.tracking.pose import PoseEstimate, differ, refine_pose
from segfloor_ros.core.slam.tracking.track import ObservedFeatures, Track
from segfloor_ros.core.timing import timed


class FrontEnd:
    """Tracks frames against the map, and looks for a camera that was lost.

    is_fixed: whether the map stays as it is.
    """

    def __init__(
        self, settings: StereoSlamSettings, sparse_map: SparseMap, body: BodySensors
    ) -> None:
        self.motion = CameraMotion(settings.max_speed_mps, body)
        self.local = LocalMap(sparse_map, settings.keyframe_max_frames, settings.keyframe_novelty)
        self.follower = Follower(sparse_map)
        self.frame_to_frame = FrameToFrame(sparse_map.rig, settings.fast_threshold)
        self.tracker = Tracker(sparse_map)
        self.extractor = FeatureExtractor(settings)
        self.places = PlaceRecognition(sparse_map)
        self.is_fixed = False
        self.frames_since_keyframe = self.keyframe_ns = 0
        self._map = sparse_map
        self.relocaliser = Relocaliser(sparse_map, self.places)

    @property
    def is_searching(self) -> bool:
        """Whether the camera is looked for in the whole map."""
        state = self.motion.state
        is_searched = state.is_lost or state is TrackingState.HELD
        return is_searched and not self.relocaliser.is_narrow

    def reset(self) -> None:
        """Begin anew in a map in which the camera must be found."""
        self.local.point_ids = np.zeros(0, np.int32)
        self.follower.reset()
        self.frame_to_frame.reset()
        self.relocaliser.reset()
        self.motion.lose()

    def resume(self, last: LastPose) -> None:
        """Go on with a map whose drive was broken off."""
        # A robot that nobody sees goes three standard deviations at most.
        self.motion.resume(last, greatest_speed_mps(self._map.keyframes) / 3)
        self.local.move_to(self._map.keyframes[-1].seen_ids, last.T_camera_world)

    def search_near(self, T_world_camera: Array, reach: tuple[float, float]) -> None:
        """Look for the camera around a pose (4, 4) alone, unless it is tracked there."""
        here = is_within(self.motion.T_camera_world @ T_world_camera, reach)
        if here and not self.motion.state.is_lost:
            return
        self.reset()
        self.relocaliser.search_near(T_world_camera, reach)

    def follow_map(self, T_reference_before: Array, T_reference_after: Array) -> None:
        """Move along with a keyframe (T_camera_world, (4, 4)) that the map has moved."""
        self.motion.move_map(T_reference_before, T_reference_after)
        self.frame_to_frame.move_map(invert(T_reference_before) @ T_reference_after)
        self.drop_dead()

    def drop_dead(self) -> None:
        """Forget points that are not part of the map any more."""
        self.local.drop_dead()
        self.follower.drop_dead()

    def expected_shift(self, stamp_ns: int) -> float:
        """Return how far the picture should have moved since the last frame, in image widths."""
        motion = self.motion
        return self.follower.expected_shift(motion.T_camera_world, motion.predict(stamp_ns))

    def track(self, frame: StereoFrame, images: Images, found: Track | None = None) -> Track | None:
        """Find the pose of a frame: from the one before, else by its features. found: where
        it is in this map, as that was found while the camera was in a submap.
        """
        expected, shutter = self.motion.expected(frame.stamp_ns), self._map.rig.shutter
        shutter.expect(*self.motion.velocity_at(frame.stamp_ns))
        if found is not None:
            features = self.extractor.extract(frame.left, images.excluded)
            track = self._relocalise(images, features, frame.stamp_ns, found)
        else:
            track = self._followed(frame, images, expected)
        if track is not None and not self.motion.is_plausible(track.T_camera_world, frame.stamp_ns):
            track = None
        prior = self.motion.prior(frame.stamp_ns)
        knows_less = track is not None and self.motion.knows_more(track.estimate, frame.stamp_ns)
        # Of images that know less than the sensors: errors of the same points do not average out.
        if track is None or (knows_less and (prior is not None or not track.fits(expected))):
            self.follower.reset()
            return None
        track = replace(track, sigma_m=sigma_m(track.covariance))
        T_seen = None if knows_less else track.T_camera_world
        track = self._weighed(replace(track, prior=prior))
        self.motion.take(track.T_camera_world, track.covariance, frame.stamp_ns, T_seen)
        self.follower.see(images, track.point_ids, track.uv_px)
        self.frame_to_frame.see(frame, images, track.estimate)
        if len(track.point_ids) == 0:
            self.motion.since_keyframe.see(track.T_camera_world, track.covariance)
        else:
            shutter.learn(track.estimate.readout, self.motion.velocity)
        self.local.move_to(track.point_ids, track.T_camera_world)
        if not self.is_fixed:
            self._map.points.note_tracking(track.visible_ids, track.point_ids)
        self.frames_since_keyframe += 1
        return track

    def _followed(
        self, frame: StereoFrame, images: Images, expected: PoseEstimate | None
    ) -> Track | None:
        """Return the pose by what the last frame showed; by the features of this one where that is
        no proof, or not where the camera was expected.
        """
        prediction = self.motion.predict(frame.stamp_ns)
        followed = self.follower.follow(images, self.local.point_ids, prediction)
        if followed is not None and not is_proof(followed.estimate.evidence(expected)):
            followed = None
        reach_px = math.inf if expected is None else self.local.reach_px(expected)
        if followed is not None and followed.fits(expected) and reach_px < WIDE_PX:
            return followed
        features = self.extractor.extract(frame.left, images.excluded)
        starts = self._starts(frame, images, features, followed, reach_px)
        found = self.tracker.best(images, features, self.local.point_ids, starts, expected)
        found = followed if found is None else found
        if found is not None and expected is not None and reach_px < WIDE_PX:
            found = self._standing(images, features, found, expected)
        if found is None and self.motion.state is not TrackingState.TRACKING:
            found = self._relocalise(images, features, frame.stamp_ns)
        found = self._stepped(frame, images) if found is None else found
        seen_ns = self.frame_to_frame.stamp_ns
        if found is not None and self.motion.state.is_lost and seen_ns is not None:
            # No farther than a robot can have driven since its last frame.
            way_m = greatest_speed_mps(self._map.keyframes) * 1e-9 * (frame.stamp_ns - seen_ns)
            step = found.T_camera_world @ invert(self.motion.T_camera_world)
            if not is_within(step, (SAME[0] + way_m, math.inf)):
                return None
        return found

    def _standing(
        self, images: Images, features: Features, found: Track, expected: PoseEstimate
    ) -> Track:
        """Return, of a pose that was found and one near where it was expected, the likelier by the
        records of their points of standing still: what comes close and fills the image has the most
        points.
        """
        pose, around = expected.T_camera_world, self.local.point_ids
        steady = self.tracker.track_at(images, features, around, pose)
        if steady is None:
            return found
        of_steady, of_found = (
            self.tracker.consensus.record(t.point_ids, t.T_camera_world).sum()
            - t.estimate.surprise(expected)
            for t in (steady, found)
        )
        return steady if of_steady > of_found else found

    def _starts(
        self,
        frame: StereoFrame,
        images: Images,
        features: Features,
        followed: Track | None,
        reach_px: float,
    ) -> Iterator[Start]:
        """Yield where the camera may be, what costs least first. reach_px: up to which points may
        be elsewhere than expected.
        """
        measured = self.motion.measured_pose(frame.stamp_ns)
        predictions = [self.motion.steady(frame.stamp_ns)]
        if measured is not None:
            predictions.insert(0, measured)
        if reach_px < WIDE_PX:
            yield Start(predictions[0], max(reach_px, USUAL_PX), is_sure=True)
        if followed is not None:
            yield Start(followed.T_camera_world)
        yield Start(predictions[0], WIDE_PX)
        located = self.tracker.by_descriptors(features, self.local.point_ids)
        if located is not None:
            yield located
        stepped = self.frame_to_frame.find(frame, images)
        if stepped is not None:
            yield Start(stepped.T_camera_world)
        yield from (Start(T_camera_world) for T_camera_world in predictions)

    def _stepped(self, frame: StereoFrame, images: Images) -> Track | None:
        """Return the pose by the frame before alone: it shows no point of the map."""
        estimate = self.frame_to_frame.find(frame, images)
        if estimate is None:
            return None
        none = np.zeros(0, np.int32)
        nothing = Observations(np.zeros((0, 3)), np.zeros((0, 3)))
        return Track(replace(estimate, inliers=np.zeros(0, bool)), none, nothing, none)

    def _weighed(self, track: Track) -> Track:
        """Return a track with the likeliest pose by images and prior; that of the images where the
        prior contradicts it.
        """
        by_images, prior = track.estimate, track.prior
        if prior is None or differ(by_images, prior):
            return replace(track, prior=None)
        # As sure as the patches are.
        rig = self._map.rig
        seen = track.observations.without_offset(rig.offset)
        seen = seen.with_noise_factor(by_images.noise_factor)
        points, start = self._map.xyz_world[track.point_ids], by_images.T_camera_world
        known = rig.camera, start, points, seen, prior
        found = refine_pose(*known, is_noise_known=True, readout=rig.shutter.expected)
        pose, covariance = found.T_camera_world, found.covariance
        weighed = replace(by_images, T_camera_world=pose, covariance=covariance)
        return replace(track, estimate=weighed)

    def bridge(self, frame: StereoFrame, fault: str) -> None:
        """Go on without the images, where the sensors allow it."""
        if self.motion.bridge(frame.stamp_ns):
            self.local.move_to(np.zeros(0, np.int32), self.motion.T_camera_world)
            self.frames_since_keyframe += 1
        elif not fault or self.motion.state is not TrackingState.TRACKING:
            self.motion.lose(frame.stamp_ns)

    def _relocalise(
        self, images: Images, features: Features, stamp_ns: int, found: Track | None = None
    ) -> Track | None:
        """Look for the view in the whole map, unless it was found there already, and track all that
        is in view there.
        """
        if found is None:
            motion = self.motion
            expected = motion.expected(stamp_ns)
            is_possible = partial(is_near, expected=expected)
            lost_at = motion.T_camera_world if motion.state is TrackingState.LOST_NEAR else None
            lost_at = motion.steady(stamp_ns) if motion.state.is_resuming else lost_at
            found = self.relocaliser.find(images, features, stamp_ns, is_possible, lost_at)
        if found is None:
            return None
        around = self.local.points_around(found.point_ids, found.T_camera_world)
        return self.tracker.track_at(images, features, around, found.T_camera_world)

    def is_new_place(self) -> bool:
        """Whether the sensors have the camera somewhere new: the map goes on from there."""
        motion = self.motion
        state = motion.state
        is_held = state is TrackingState.HELD
        if not state.is_blind or is_held or sigma_m(motion.covariance) > SAME[0]:
            return False
        return self.local.is_new_view(motion.T_camera_world)

    def exclude(self, images: Images, region: Region | None) -> Images:
        """Return the images without a region in which something moves."""
        if region is None:
            return images
        self.follower.drop_inside(region)
        excluded, moving = (union(known, region) for known in (images.excluded, images.moving))
        return replace(images, excluded=excluded, moving=moving)

    @timed
    def observe(
        self, frame: StereoFrame, images: Images, track: Track | None
    ) -> ObservedFeatures | None:
        """Return the features of a frame and which of them show map points, now that the pose is
        known; it is refined by all of them. None where too few do.
        """
        if track is not None and track.observed is not None:
            inside = is_inside(images.excluded, track.observed.features.uv_px)
            return track.observed.take(np.flatnonzero(~inside))
        features = self.extractor.extract(frame.left, images.excluded)
        if track is None or len(track.point_ids) == 0:
            if not self._map.keyframes:
                first, sure = self.motion.T_camera_world, np.zeros((6, 6))
                self.motion.take(first, sure, frame.stamp_ns, T_seen=first)
                estimate = PoseEstimate(first, np.zeros(0, bool), sure, 1.0)
                self.frame_to_frame.see(frame, images, estimate)
            none = np.full(len(features), NO_POINT, np.int32)
            return ObservedFeatures(features, features.observations, none)
        pose = self.motion.T_camera_world
        matched = self.tracker.track_at(
            images, features, self.local.point_ids, pose, track.estimate
        )
        if matched is None:
            return None
        assert matched.observed is not None
        weighed = self._weighed(replace(matched, prior=track.prior))
        self.motion.T_camera_world = weighed.T_camera_world
        self._map.points.note_tracking(matched.visible_ids, matched.point_ids)
        return matched.observed

    def continue_from(self, images: Images, keyframe: KeyframeRecord, uv_px: Array) -> None:
        """Track on from the points of a keyframe, old and new. uv_px: (F, 2) of its features."""
        self._map.rig.shutter.see_keyframe(self.motion.velocity)
        rows = np.flatnonzero(keyframe.point_id != NO_POINT)
        ids = keyframe.point_id[rows]
        self.follower.see(images, ids, uv_px[rows])
        self.local.move_to(ids, keyframe.T_camera_world)
        self.frames_since_keyframe, self.keyframe_ns = 0, keyframe.stamp_ns


def is_near(T_camera_world: Array, expected: PoseEstimate | None) -> bool:
    """Whether a camera can be at a pose (4, 4). expected: where it is, as far as that is known."""
    return expected is None or not differ(
        replace(expected, T_camera_world=T_camera_world), expected
    )
