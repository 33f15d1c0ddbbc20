"""Stereo SLAM: from stereo frames to poses, keyframes and a sparse map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import (
    Array,
    invert,
    make_transform,
    rotation_angle,
    se3_exp,
    se3_log,
    transform_points,
)
from segfloor_ros.slam.adjustment_runner import AdjustmentRunner
from segfloor_ros.slam.features import FeatureExtractor, Features
from segfloor_ros.slam.following import Follower, Sighting, Track
from segfloor_ros.slam.image_check import FrozenCheck, image_fault
from segfloor_ros.slam.image_rotation import ImageRotation
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.keyframe_policy import SEEN_BY_SEVERAL, View, is_keyframe
from segfloor_ros.slam.mapping import LocalMapper
from segfloor_ros.slam.mount_meter import MountMeter
from segfloor_ros.slam.outcome import MapSnapshot, Outcome, in_map, take_snapshot
from segfloor_ros.slam.patch_alignment import sample_patches
from segfloor_ros.slam.places import view_novelty, views_near
from segfloor_ros.slam.residuals import MIN_DEPTH_M
from segfloor_ros.slam.results import NO_POINT, FrameResult
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.slam.tracking import FeatureTrack, Tracker
from segfloor_ros.timing import StageTimes

LOCAL_MAP_KEYFRAMES = 20
PLACE_KEYFRAMES = 10
"""Keyframes of the local map that belong to it by where they are."""

RECOVERY_KEYFRAMES = 3
UNKNOWN_COVARIANCE = 1e6
MAX_HELD_KEYFRAMES = 50
"""Keyframes that wait with their images for the mount to be known."""


class StereoSlam:
    """Tracks a stereo camera and maps what it sees.

    One call of `process` per frame, in order. Results are held back until the camera's mount is
    known, since frame `map` lies on the floor; then all of them come at once, none is lost.
    background: adjust the map on a thread beside tracking; a keyframe is then published before its
    adjustment, and results depend on timing.
    """

    def __init__(
        self,
        camera: StereoCamera,
        settings: StereoSlamSettings,
        mount: Mount | None = None,
        mount_meter: MountMeter | None = None,
        times: StageTimes | None = None,
        background: bool = False,
    ) -> None:
        self.map = SparseMap()
        self.mount = mount
        self._mount_meter = mount_meter
        self._camera = camera
        self._settings = settings
        self._background = background
        self._times = times or StageTimes()
        self._extractor = FeatureExtractor(settings)
        self._frozen = FrozenCheck()
        self._rotation = ImageRotation(camera)
        self._tracker = Tracker(camera, settings)
        self._follower = Follower(camera, settings)
        self._mapper = LocalMapper(camera, settings)
        self._adjusting = AdjustmentRunner(self._mapper, background)
        self._held: list[Outcome] = []
        self._T_camera_world: Array = np.eye(4)
        self._velocity: Array = np.zeros(6)
        self._sighting: Sighting | None = None
        self._last_stamp_ns = 0
        self._lost = False
        self._recovery_turn = 0
        self._T_world_odom: Array = np.eye(4)
        self._frames_since_keyframe = 0
        self._local_ids: NDArray[np.int32] = np.zeros(0, np.int32)

    @property
    def disparity_offset_px(self) -> float:
        """The error that all disparities share, measured minus true, as estimated so far."""
        return self._mapper.offset.value_px

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Track one frame and return the results that are ready, oldest first."""
        with self._times.measure('tracking'):
            self._take_adjustment(wait=False)
            fault = self._fault(frame)
            images = Images.of(frame)
            track = None
            if not fault and self.map.keyframes:
                track = self._track(frame, images)
        snapshot = None
        if not fault and (not self.map.keyframes or (track and self._wants_keyframe(track))):
            with self._times.measure('mapping'):
                snapshot = self._add_keyframe(frame, images, track)
        outcome = self._outcome(frame, track, fault, snapshot)
        if outcome.tracked:
            self._last_stamp_ns = frame.stamp_ns
        return self._release(outcome)

    def close(self) -> None:
        """End the background thread, if there is one."""
        self._adjusting.close()

    def _fault(self, frame: StereoFrame) -> str:
        """Return why a pair of images cannot be tracked, or ''."""
        frozen = self._frozen.frozen(frame.left, lambda: self._expected_shift(frame.stamp_ns))
        fault = image_fault(frame.left, frame.right)
        if frozen and not fault:
            return 'the image is the one before although the camera was moving'
        return fault

    def _expected_shift(self, stamp_ns: int) -> float:
        """Return how far the picture should have moved since the last pose, in image widths."""
        if self._sighting is None or len(self._sighting.ids) == 0:
            return 0.0
        dt_s = (stamp_ns - self._last_stamp_ns) * 1e-9
        steady = se3_exp(self._velocity * dt_s) @ self._T_camera_world
        points = self.map.xyz_world[self._sighting.ids]
        now, then = (
            self._camera.project(transform_points(T, points))[:, :2]
            for T in (steady, self._T_camera_world)
        )
        return float(np.median(np.linalg.norm(now - then, axis=1))) / self._camera.width

    def _track(self, frame: StereoFrame, images: Images) -> Track | None:
        dt_s = max((frame.stamp_ns - self._last_stamp_ns) * 1e-9, 1e-3)
        steady: Array = se3_exp(self._velocity * dt_s) @ self._T_camera_world
        self._rotation.see(images.left)
        track: Track | None = None
        if self._sighting is not None:
            track = self._follower.follow(
                self._sighting,
                images,
                self.map,
                self._local_ids,
                steady,
                self.disparity_offset_px,
            )
        if track is None:
            track = self._search(frame, images, steady)
        if track is None or not (self._lost or self._plausible(track, dt_s)):
            self._lost = True
            self._velocity = np.zeros(6)
            self._sighting = None
            return None
        motion = se3_log(track.T_camera_world @ invert(self._T_camera_world))
        velocity: Array = np.zeros(6) if self._lost else motion / dt_s
        self._velocity = velocity
        self._lost = False
        self._T_camera_world = track.T_camera_world
        self._sighting = Sighting(images.small, track.point_ids, track.uv_px)
        self._local_ids = self._choose_local_points(track.point_ids, track.T_camera_world)
        self.map.note_tracking(track.visible_ids, track.point_ids)
        self._frames_since_keyframe += 1
        return track

    def _search(
        self,
        frame: StereoFrame,
        images: Images,
        steady: Array,
    ) -> FeatureTrack | None:
        """Find the pose by the features of the frame, without its predecessor."""
        features = self._extractor.extract(frame.left)
        turned = self._rotation.turn_since_last() @ self._T_camera_world
        track = self._tracker.track(
            images,
            features,
            self.map,
            self._local_ids,
            [steady, turned],
            self.disparity_offset_px,
        )
        if not self._lost:
            return track
        if track is None or not self._recognised(track):
            track = self._recover(images, features)
        return track if track and self._recognised(track) else None

    def _recover(self, images: Images, features: Features) -> FeatureTrack | None:
        """Look for the view among the keyframes, a few per frame, the latest ones first."""
        views = [k.index for k in self.map.keyframes if k.retired is None]
        count = len(views)
        first = self._recovery_turn * RECOVERY_KEYFRAMES % count
        self._recovery_turn += 1
        turn = count - 1 - (first + np.arange(min(RECOVERY_KEYFRAMES, count))) % count
        ids = self.map.points_of(np.array(views)[turn])
        observations = self._tracker.pixel_observations(features)
        tree = cKDTree(features.uv_px)
        estimate = self._tracker.locate(features, tree, observations, self.map, ids)
        if estimate is None:
            return None
        return self._tracker.track_at(
            images,
            features,
            self.map,
            self._choose_local_points(ids, estimate.T_camera_world),
            estimate.T_camera_world,
            self.disparity_offset_px,
        )

    def _recognised(self, track: Track) -> bool:
        """Whether a camera that was lost sees enough of what it should see there: far points alone
        fit many places.
        """
        return len(track.point_ids) >= self._settings.recovery_ratio * len(track.visible_ids)

    def _plausible(self, track: Track, dt_s: float) -> bool:
        motion = track.T_camera_world @ invert(self._T_camera_world)
        speed = float(np.linalg.norm(motion[:3, 3])) / dt_s
        turn = rotation_angle(motion[:3, :3]) / dt_s
        return speed <= self._settings.max_speed_mps and turn <= self._settings.max_turn_radps

    def _choose_local_points(
        self, ids: NDArray[np.int32], T_camera_world: Array
    ) -> NDArray[np.int32]:
        """Return the points of keyframes that share points with a view, or stand where it is."""
        order, _ = self.map.covisible(ids)
        depth_m = self._median_depth(ids, T_camera_world)
        here = views_near(self.map, T_camera_world, depth_m, PLACE_KEYFRAMES)
        local = self.map.points_of(np.append(order[:LOCAL_MAP_KEYFRAMES], here))
        # The oldest first: of two points that fit a feature equally well it is the one to keep.
        return local[np.argsort(self.map.stable_id[local])]

    def _median_depth(self, ids: NDArray[np.int32], T_camera_world: Array) -> float:
        depth = transform_points(T_camera_world, self.map.xyz_world[ids])[:, 2]
        return max(float(np.median(depth)), MIN_DEPTH_M) if len(ids) else MIN_DEPTH_M

    def _wants_keyframe(self, track: Track) -> bool:
        order, _ = self.map.covisible(track.point_ids)
        reference = self.map.keyframes[order[0]]
        known = reference.point_id[reference.point_id != NO_POINT]
        reliable = known[self.map.observer_count[known] >= SEEN_BY_SEVERAL]
        depth_m = self._median_depth(reliable if len(reliable) else known, track.T_camera_world)
        view = View(
            self._frames_since_keyframe,
            len(track.point_ids),
            min(len(reliable), self._settings.tracked_points),
            view_novelty(
                self._camera,
                self._settings,
                self.map,
                track.point_ids,
                track.T_camera_world,
                depth_m,
            ),
            self._adjusting.idle,
        )
        return is_keyframe(view, self._settings)

    def _add_keyframe(
        self,
        frame: StereoFrame,
        images: Images,
        track: Track | None,
    ) -> MapSnapshot | None:
        """Make the frame a keyframe; None where its features do not show what was tracked."""
        if isinstance(track, FeatureTrack):
            matched: FeatureTrack | None = track
            features = track.features
        else:
            features = self._extractor.extract(frame.left)
            matched = self._match_features(images, features) if track else None
            if track and matched is None:
                return None
        self._take_adjustment(wait=True)
        point_id = np.full(len(features), NO_POINT, np.int32)
        if matched is None:
            observations = self._tracker.pixel_observations(features)
        else:
            observations = matched.observations
            alive = self.map.alive[matched.point_ids]
            point_id[matched.feature_rows[alive]] = matched.point_ids[alive]
        self._mapper.measure_stereo(frame, images, observations)
        keyframe = KeyframeRecord(
            len(self.map.keyframes),
            frame.index,
            frame.stamp_ns,
            self._T_camera_world,
            features,
            observations,
            point_id,
        )
        patches = sample_patches(images.left, observations.uvd_px[:, :2]).astype(np.uint8)
        self._mapper.insert(self.map, keyframe, patches)
        if keyframe.index > 0:
            self._adjusting.submit(self._mapper.plan_adjustment(self.map, keyframe))
            if not self._background:
                self._take_adjustment(wait=True)
        self._frames_since_keyframe = 0
        self._see_keyframe(images, keyframe)
        if self.mount is None and self._mount_meter is not None:
            self._mount_meter.add(frame.left, frame.right, keyframe.T_world_camera)
            self.mount = self._mount_meter.mount
        return take_snapshot(self.map, keyframe, frame)

    def _match_features(self, images: Images, features: Features) -> FeatureTrack | None:
        """Find which features show map points, now that the pose is known; it is refined by all
        of them.
        """
        matched = self._tracker.track_at(
            images,
            features,
            self.map,
            self._local_ids,
            self._T_camera_world,
            self.disparity_offset_px,
        )
        if matched is not None:
            self._T_camera_world = matched.T_camera_world
            self.map.note_tracking(matched.visible_ids, matched.point_ids)
        return matched

    def _see_keyframe(self, images: Images, keyframe: KeyframeRecord) -> None:
        """Go on from the points of a keyframe, old and new."""
        rows = np.flatnonzero(keyframe.point_id != NO_POINT)
        ids = keyframe.point_id[rows]
        self._sighting = Sighting(images.small, ids, keyframe.observations.uvd_px[rows, :2])
        self._local_ids = self._choose_local_points(ids, keyframe.T_camera_world)

    def _take_adjustment(self, wait: bool) -> None:
        """Bring a finished adjustment into the map. The camera, and with it `odom`, moves along
        with the latest keyframe.
        """
        finished = self._adjusting.collect(wait)
        if finished is None:
            return
        reference = self.map.keyframes[-1]
        T_camera_reference = self._T_camera_world @ reference.T_world_camera
        T_odom_camera = invert(self._T_world_odom) @ invert(self._T_camera_world)
        self._mapper.apply(self.map, *finished)
        self._T_camera_world = _without_drift(T_camera_reference @ reference.T_camera_world)
        self._T_world_odom = _without_drift(invert(self._T_camera_world) @ invert(T_odom_camera))
        self._local_ids = self._local_ids[self.map.alive[self._local_ids]]
        if self._sighting is not None:
            self._sighting = self._sighting.take(self.map.alive[self._sighting.ids])

    def _outcome(
        self, frame: StereoFrame, track: Track | None, fault: str, snapshot: MapSnapshot | None
    ) -> Outcome:
        tracked = track is not None or snapshot is not None
        covariance: Array = np.eye(6) * UNKNOWN_COVARIANCE
        if track is not None:
            covariance = track.covariance
        elif tracked:
            covariance = np.zeros((6, 6))
        state = 'tracking' if tracked else f'lost: {fault or "too few known points in view"}'
        return Outcome(
            frame.index,
            frame.stamp_ns,
            tracked,
            invert(self._T_world_odom) @ invert(self._T_camera_world),
            self._T_world_odom,
            covariance,
            len(track.point_ids) if track else 0,
            state,
            self.map.keyframes[-1].stamp_ns if self.map.keyframes else frame.stamp_ns,
            snapshot,
        )

    def _release(self, outcome: Outcome) -> list[FrameResult]:
        self._held.append(outcome)
        if self.mount is None:
            self._let_go_of_old_snapshots()
            return []
        ready, self._held = self._held, []
        return [in_map(outcome, self.mount.T_base_left) for outcome in ready]

    def _let_go_of_old_snapshots(self) -> None:
        """Keep the images of the latest keyframes only: a camera that never sees the floor must not
        fill the memory. The poses of all frames are kept.
        """
        holders = [i for i, held in enumerate(self._held) if held.snapshot is not None]
        for i in holders[:-MAX_HELD_KEYFRAMES]:
            self._held[i] = replace(self._held[i], snapshot=None)


def _without_drift(T: Array) -> Array:
    """Return a product of poses (4, 4) with its rotation orthonormal again: `invert` transposes,
    so the rounding errors of repeated products would grow threefold each time.
    """
    return make_transform(Rotation.from_matrix(T[:3, :3]).as_matrix(), T[:3, 3])
