"""Stereo SLAM: from stereo frames to poses, keyframes and a sparse map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.camera.depth import is_disparity
from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, invert
from segfloor_ros.map_file import Arrays
from segfloor_ros.measurements import Measurement
from segfloor_ros.slam.back_end import BackEnd
from segfloor_ros.slam.body_motion import BodyMotion
from segfloor_ros.slam.consensus import Consensus
from segfloor_ros.slam.excluded import Region, is_inside, join
from segfloor_ros.slam.features import FeatureExtractor, Features
from segfloor_ros.slam.firm_points import count_firm
from segfloor_ros.slam.following import Follower
from segfloor_ros.slam.held_results import HeldResults
from segfloor_ros.slam.image_check import FrozenCheck, expected_shift, image_fault
from segfloor_ros.slam.image_rotation import ImageRotation
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.local_map import LocalMap
from segfloor_ros.slam.loops import Candidate
from segfloor_ros.slam.map_arrays import fill_map, map_to_arrays
from segfloor_ros.slam.motion import CameraMotion
from segfloor_ros.slam.motion_search import MotionSearch, Searched
from segfloor_ros.slam.mount_meter import MountMeter
from segfloor_ros.slam.patch_alignment import sample_patches
from segfloor_ros.slam.relocalisation import Relocaliser, is_within
from segfloor_ros.slam.results import NO_POINT, FrameResult, Keyframe
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.snapshot import take_snapshot
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.track import ObservedFeatures, Track
from segfloor_ros.slam.tracking import Tracker
from segfloor_ros.timing import StageTimes

RECOVERY_RATIO = 0.15
"""Share of the points expected in view that a camera which was lost must find: far points alone
fit many places."""

CONTRARY, CONTRARY_WHEN_BLIND = (100, 0.3), (200, 0.5)
"""Points, and their share of those expected, that must be found where the sensors have the camera
somewhere else: wheels slip, but a view that begins anew may be of another place."""

FEW_POINTS, RESUMING_POINTS = 60, 100
"""Wheels tell the pose better than fewer points that do not slide along edges. So many more end a
blind stretch."""

MAX_BLIND_SIGMA_M = 0.5
"""Uncertainty of the pose up to which keyframes are made of it."""

START_NS, RESUMING_NS = 1_000_000_000, 5_000_000_000
"""For how long a drive, new or going on, is looked for in the map that was loaded."""

UNKNOWN_COVARIANCE = 1e6
NOTHING_SEEN = 'too few known points in view'


class StereoSlam:
    """Tracks a stereo camera and maps what it sees.

    One call of `process` per frame, in order. Results are held back until the camera's mount is
    known, since frame `map` lies on the floor; then all of them come at once, none is lost. Until
    then `provisional` tells the newest pose.
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
        self._times = times or StageTimes()
        self._extractor = FeatureExtractor(settings)
        self._frozen = FrozenCheck()
        self._rotation = ImageRotation(camera)
        self._body = BodyMotion()
        self._motion = CameraMotion(settings.max_speed_mps, self._body)
        self._local = LocalMap(camera, settings, self.map)
        self._consensus = Consensus(camera)
        self._follower = Follower(camera, self._consensus, settings.tracked_points)
        self._tracker = Tracker(camera, self._consensus)
        self._back_end = BackEnd(camera, settings, self.map, self._tracker, background)
        self._relocaliser = Relocaliser(self.map, self._back_end.places)
        self._held = HeldResults()
        self._moving = MotionSearch(camera) if settings.detect_moving else None
        self._frames_since_keyframe = 0
        self._is_fixed = False
        self._not_found_yet: Arrays | None = None
        self._first_ns: int | None = None
        self._patience_ns = START_NS

    @property
    def disparity_offset_px(self) -> float:
        """The error that all disparities share, measured minus true, as estimated so far."""
        return self._back_end.offset_px

    @property
    def loop_count(self) -> int:
        """How many loops were closed."""
        return self._back_end.loop_count

    @property
    def loop_candidates(self) -> Sequence[Candidate]:
        """What was taken for a place seen again lately, and what became of it."""
        return self._back_end.loops.candidates

    @property
    def T_world_odom(self) -> Array:
        """The present correction (4, 4) of the odometry, in optical axes."""
        return self._motion.T_world_odom

    @property
    def is_adjusting(self) -> bool:
        """Whether the map is being adjusted beside tracking."""
        return not self._back_end.idle

    @property
    def sensors(self) -> BodyMotion:
        """What wheels and IMU told, and what was found to be wrong with them."""
        return self._body

    @property
    def provisional(self) -> FrameResult | None:
        """The newest pose while the mount is being measured, by the mount as it seems so far; None
        before the first frame, and once `process` returns results.
        """
        if self._mount_meter is None:
            return None
        return self._held.newest(self._mount_meter.provisional)

    def add(self, measurement: Measurement) -> None:
        """Take in what wheels or an IMU measured; those up to a frame come before it."""
        self._body.add(measurement)

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Track one frame and return the results that are ready, oldest first."""
        with self._times.measure('tracking'):
            self._take_adjustment(wait=False)
            self._body.T_base_left = self.mount.T_base_left if self.mount else None
            self._consensus.mount = self.mount
            fault = self._fault(frame)
            images = Images.of(frame, self._camera, self._settings.mask_dilation_px)
            track = self._track(frame, images) if self.map.keyframes and not fault else None
            if track is None and self.map.keyframes:
                self._bridge(frame, fault)
                self._map_apart(frame.stamp_ns)
        is_wanted = not fault and self._wants_keyframe(track)
        searched = None
        if self._moving is not None and self._moving.is_due(is_wanted, track is not None):
            with self._times.measure('moving'):
                searched = self._moving.search(
                    frame, self._motion.T_camera_world, self._motion.T_odom_camera, self.mount
                )
                images = self._exclude(images, searched.region)
        keyframe = None
        if is_wanted:
            with self._times.measure('mapping'):
                keyframe = self._add_keyframe(frame, images, track, searched)
        result = self._result(frame, track, fault, keyframe)
        if searched is not None:
            result = replace(result, moving=searched.points)
        return self._held.release(result, self.mount)

    def to_arrays(self) -> Arrays:
        """Return the map, for a file."""
        self._take_adjustment(wait=True)
        return map_to_arrays(self.map) | self._back_end.to_arrays()

    def load(
        self, arrays: Arrays, mount: Mount, localize: bool, T_world_odom: Array | None = None
    ) -> None:
        """Go on with a map, before the first frame; the camera must be found in it. localize: the
        map stays as it is. T_world_odom: (4, 4), where the drive that made the map goes on. Raises
        KeyError or ValueError for arrays that are no map.
        """
        fill_map(self.map, arrays)
        self._back_end.from_arrays(arrays)
        self.mount, self._is_fixed = mount, localize
        self._not_found_yet = None if localize else arrays
        if T_world_odom is not None:
            self._patience_ns = RESUMING_NS
            last = self.map.keyframes[-1]
            self._motion.T_camera_world = last.T_camera_world
            self._motion.T_world_odom = T_world_odom
            self._local.move_to(last.point_id[last.point_id != NO_POINT], last.T_camera_world)
        self._motion.stop()

    def search_near(self, T_map_base: Array, reach_m: float, reach_rad: float) -> None:
        """Look for the camera around a pose of the base (4, 4) alone, as far as somebody who knows
        it may be wrong; also where it is tracked, but elsewhere.
        """
        assert self.mount is not None
        T_left_base = invert(self.mount.T_base_left)
        T_world_camera = T_left_base @ T_map_base @ self.mount.T_base_left
        motion = self._motion
        here = is_within(motion.T_camera_world @ T_world_camera, reach_m, reach_rad)
        if here and not motion.is_lost:
            return
        self._relocaliser.search_near(T_world_camera, reach_m, reach_rad)
        self._follower.reset()
        motion.stop()
        self._local.point_ids = np.zeros(0, np.int32)

    def close(self) -> None:
        """End the background threads, if there are any."""
        self._back_end.close()

    def _fault(self, frame: StereoFrame) -> str:
        """Return why a pair of images cannot be tracked, or ''."""
        points = self.map.xyz_world[self._follower.seen_ids]
        motion = self._motion
        shift = partial(
            expected_shift,
            self._camera,
            points,
            motion.T_camera_world,
            motion.predict(frame.stamp_ns),
        )
        frozen = self._frozen.frozen(frame.left, shift)
        fault = image_fault(frame.left, frame.left if is_disparity(frame.right) else frame.right)
        if frozen and not fault:
            return 'the image is the one before although the camera was moving'
        return fault

    def _track(self, frame: StereoFrame, images: Images) -> Track | None:
        """Find the pose of a frame: from the one before, else by its features."""
        predictions = self._predict_poses(frame, images)
        track = self._follower.follow(
            images, self.map, self._local.point_ids, predictions[0], self.disparity_offset_px
        )
        if track is None:
            track = self._search(frame, images, predictions)
        if track is None or not self._is_believable(track, images, frame.stamp_ns):
            self._follower.reset()
            return None
        self._not_found_yet = None
        self._motion.take(track.T_camera_world, track.covariance, frame.stamp_ns)
        self._follower.see(images, track.point_ids, track.uv_px)
        self._local.move_to(track.point_ids, track.T_camera_world)
        if not self._is_fixed:
            self.map.note_tracking(track.visible_ids, track.point_ids)
        self._frames_since_keyframe += 1
        return track

    def _is_believable(self, track: Track, images: Images, stamp_ns: int) -> bool:
        """Whether the camera can have come to where the images have it."""
        motion, pose = self._motion, track.T_camera_world
        if motion.is_lost:
            return True
        few = RESUMING_POINTS if motion.is_blind else FEW_POINTS
        if motion.is_held(stamp_ns) and count_firm(images.left, track.uv_px) < few:
            return False
        if motion.is_consistent(pose, track.covariance, stamp_ns):
            return motion.is_plausible(pose, stamp_ns)
        least, ratio = CONTRARY_WHEN_BLIND if motion.is_blind else CONTRARY
        return len(track.point_ids) >= least and _recognised(track, ratio)

    def _bridge(self, frame: StereoFrame, fault: str) -> None:
        """Go on without the images, where the sensors allow it."""
        if self._motion.bridge(frame.stamp_ns):
            self._local.move_to(np.zeros(0, np.int32), self._motion.T_camera_world)
            self._frames_since_keyframe += 1
        elif not fault or self._motion.is_blind:
            self._motion.stop()

    def _map_apart(self, stamp_ns: int) -> None:
        """Map on its own where the camera is not found in the map that was loaded."""
        known = self._not_found_yet
        if known is None:
            return
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        if stamp_ns - self._first_ns < self._patience_ns:
            return
        self._not_found_yet = None
        self._back_end.map_apart(known)
        self._motion.reset()
        self._body.reset_world()
        self._local.point_ids = np.zeros(0, np.int32)
        self._follower.reset()

    def _predict_poses(self, frame: StereoFrame, images: Images) -> list[Array]:
        """Return where the camera may be now, T_camera_world (4, 4) each, the likeliest first."""
        self._rotation.see(images.left)
        turned = self._rotation.turn_since_last() @ self._motion.T_camera_world
        steady = self._motion.steady(frame.stamp_ns)
        measured = self._motion.measured_pose(frame.stamp_ns)
        return [steady, turned] if measured is None else [measured, steady, turned]

    def _search(self, frame: StereoFrame, images: Images, predictions: list[Array]) -> Track | None:
        """Find the pose by the features of the frame, without its predecessor."""
        features = self._extractor.extract(frame.left, images.excluded)
        track = self._tracker.track(
            images,
            features,
            self.map,
            self._local.point_ids,
            predictions,
            self.disparity_offset_px,
        )
        if not (self._motion.is_lost or self._motion.is_blind):
            return track
        if track is not None and _recognised(track, RECOVERY_RATIO):
            return track
        return self._relocalise(images, features)

    def _relocalise(self, images: Images, features: Features) -> Track | None:
        """Look for the view in the whole map."""
        found = self._relocaliser.find(images, features, self.disparity_offset_px)
        if found is None:
            return None
        pose = found.T_camera_world
        around = self._local.points_around(found.point_ids, pose)
        return self._tracker.track_at(
            images, features, self.map, around, pose, self.disparity_offset_px
        )

    def _wants_keyframe(self, track: Track | None) -> bool:
        if self._is_fixed or not self._back_end.takes_keyframes:
            return False
        if track is None:
            return not self.map.keyframes or self._wants_blind_keyframe()
        return self._local.wants_keyframe(track, self._frames_since_keyframe, self._back_end.idle)

    def _wants_blind_keyframe(self) -> bool:
        """Whether the sensors have the camera somewhere new: the map goes on from there."""
        motion = self._motion
        if not motion.is_blind or motion.sigma_m > MAX_BLIND_SIGMA_M:
            return False
        return self._local.is_new_view(motion.T_camera_world)

    def _add_keyframe(
        self, frame: StereoFrame, images: Images, track: Track | None, searched: Searched | None
    ) -> Keyframe | None:
        """Make the frame a keyframe; None where its features do not show what was tracked."""
        observed = self._observe(frame, images, track)
        if observed is None:
            return None
        self._take_adjustment(wait=True)
        self._back_end.mapper.measure_stereo(frame, images, observed.observations)
        keyframe = KeyframeRecord(
            len(self.map.keyframes),
            frame.index,
            frame.stamp_ns,
            self._motion.T_camera_world,
            observed.features,
            observed.observations,
            self.map.living(observed.point_id),
            self._motion.start_keyframe(),
            self._body.gravity.up_camera(self._motion.T_odom_camera),
        )
        patches = sample_patches(images.left, keyframe.observations.uvd_px[:, :2]).astype(np.uint8)
        self._back_end.mapper.insert(self.map, keyframe, patches)
        if self._moving is not None and searched is not None:
            self._moving.remember(keyframe, searched)
            gone = self._moving.seen_through(searched, self.map, self._local.point_ids, keyframe)
            self.map.note_seen_through(gone)
        up = self._body.gravity.up_world
        self._follow_map(partial(self._back_end.take_in, keyframe, images, self.mount, up))
        if self.map.keyframes[-1] is not keyframe:  # it has become part of the loaded map
            keyframe = self.map.keyframes[-1]
            self._moving = MotionSearch(self._camera) if self._moving is not None else None
            self._body.reset_world()
        self._go_on_from(images, keyframe)
        self._measure_mount(frame, keyframe)
        return take_snapshot(self.map, keyframe, frame, images.excluded)

    def _exclude(self, images: Images, region: Region | None) -> Images:
        """Return the images without a region in which something moves."""
        if region is None:
            return images
        self._follower.drop_inside(region)
        return replace(images, excluded=join(images.excluded, region))

    def _observe(
        self, frame: StereoFrame, images: Images, track: Track | None
    ) -> ObservedFeatures | None:
        """Return the features of a frame and which of them show map points, now that the pose is
        known; it is refined by all of them. None where too few do.
        """
        if track is not None and track.observed is not None:
            inside = is_inside(images.excluded, track.observed.features.uv_px)
            return track.observed.take(np.flatnonzero(~inside))
        features = self._extractor.extract(frame.left, images.excluded)
        if track is None:
            if not self.map.keyframes:
                self._motion.take(self._motion.T_camera_world, np.zeros((6, 6)), frame.stamp_ns)
            none = np.full(len(features), NO_POINT, np.int32)
            return ObservedFeatures(features, self._tracker.pixel_observations(features), none)
        pose = self._motion.T_camera_world
        matched = self._tracker.track_at(
            images,
            features,
            self.map,
            self._local.point_ids,
            pose,
            self.disparity_offset_px,
            track.estimate,
        )
        if matched is None:
            return None
        self._motion.T_camera_world = matched.T_camera_world
        self.map.note_tracking(matched.visible_ids, matched.point_ids)
        return matched.observed

    def _go_on_from(self, images: Images, keyframe: KeyframeRecord) -> None:
        """Track on from the points of a keyframe, old and new."""
        rows = np.flatnonzero(keyframe.point_id != NO_POINT)
        ids = keyframe.point_id[rows]
        self._follower.see(images, ids, keyframe.observations.uvd_px[rows, :2])
        self._local.move_to(ids, keyframe.T_camera_world)
        self._frames_since_keyframe = 0

    def _measure_mount(self, frame: StereoFrame, keyframe: KeyframeRecord) -> None:
        if self.mount is None and self._mount_meter is not None:
            up = self._body.gravity.up_world
            self._mount_meter.add(frame.left, frame.right, keyframe.T_world_camera, up)
            self.mount = self._mount_meter.mount

    def _take_adjustment(self, wait: bool) -> None:
        """Bring a finished adjustment into the map."""
        if self.map.keyframes:
            self._follow_map(partial(self._back_end.collect, wait))

    def _follow_map(self, change: Callable[[], bool]) -> None:
        """Let the camera, and with it `odom`, move along with the latest keyframe. change: of the
        map; returns whether there was any.
        """
        before = self.map.keyframes[-1].T_camera_world
        if change():
            self._motion.move_map(before, self.map.keyframes[-1].T_camera_world)
            self._local.drop_dead()
            self._follower.drop_dead(self.map)

    def _result(
        self, frame: StereoFrame, track: Track | None, fault: str, keyframe: Keyframe | None
    ) -> FrameResult:
        """Return the outcome of a frame in optical axes."""
        motion, why = self._motion, fault or NOTHING_SEEN
        tracked = track is not None or keyframe is not None or motion.is_blind
        state = f'on {motion.carried_by}: {why}' if motion.is_blind else 'tracking'
        state += '' if self._back_end.is_joined else ', outside the loaded map'
        unknown: Array = np.eye(6) * UNKNOWN_COVARIANCE
        return FrameResult(
            frame.index,
            frame.stamp_ns,
            tracked,
            motion.T_odom_camera,
            motion.T_world_odom,
            motion.covariance if tracked else unknown,
            len(track.point_ids) if track else 0,
            state if tracked else f'lost: {why}',
            self.map.keyframes[-1].stamp_ns if self.map.keyframes else frame.stamp_ns,
            keyframe,
            blind=motion.is_blind,
        )


def _recognised(track: Track, ratio: float) -> bool:
    """Whether a camera that was lost sees enough of what it should see there."""
    return len(track.point_ids) >= ratio * len(track.visible_ids)
