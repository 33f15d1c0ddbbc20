"""Stereo SLAM: from stereo frames to poses, keyframes and a sparse map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import BlankBorder, Region
from segfloor_ros.core.contracts import (
    NO_POINT,
    UNKNOWN_COVARIANCE,
    FrameResult,
    Keyframe,
    LastPose,
    Measurement,
    Mount,
    Searched,
    StereoFrame,
)
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array, invert, rotation_angle, transform_points
from segfloor_ros.core.slam.held_results import NOTHING_SEEN, HeldResults, in_map
from segfloor_ros.core.slam.mapping.back_end import BackEnd
from segfloor_ros.core.slam.mount_search import MountMeter, MountSearch
from segfloor_ros.core.slam.optional import Plugins
from segfloor_ros.core.slam.places.views import GroundViews
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.session import Parts, SessionState
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.snapshot import take_snapshot
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.patch_alignment import sample_patches
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.timing import StageTimes

REPEATED = 'tracking: the image is the one before; the motion is taken to go on'
UNSURE_M = 0.005
"""A place that the images leave more uncertain than this is said to be."""


class StereoSlam:
    """Tracks a stereo camera and maps what it sees.

    One call of `process` per frame, in order. Results are held back until the camera's mount is
    known, since frame `map` lies on the floor; then all of them come at once, none is lost. Until
    then `session.provisional` is the newest pose. Where `mount` changes later, all of them come
    once more, from the first one on.
    plugins: what it can do without. background: adjust the map on a thread beside tracking; a
    keyframe is then published before its adjustment, and results depend on timing. rig, map,
    sensors: what is known of each. rig_check, image_check: what is wrong with the images. sessions:
    the drives that made the map it goes on with. front_end, back_end: tracking and mapping.
    session: which map the camera is in, and what results wait for.
    late_masks: of keyframes, when they come. announce: where given, is called with the outcome
    of a frame that becomes a keyframe, in ROS frames, the frame and what moves in it, before
    the map has taken it in; only where results depend on timing.
    """

    def __init__(
        self,
        camera: StereoCamera,
        settings: StereoSlamSettings,
        mount: Mount | None = None,
        mount_meter: MountMeter | None = None,
        times: StageTimes | None = None,
        background: bool = False,
        plugins: Plugins | None = None,
    ) -> None:
        plugins = plugins or Plugins()
        self.rig = Rig(camera, mount)
        self.map = SparseMap(self.rig)
        self.sessions: list[dict[str, int]] = []
        self._times = times or StageTimes()
        self.sensors, self.rig_check = plugins.sensors, plugins.rig_check
        self.image_check = plugins.image_check
        self.front_end = FrontEnd(settings, self.map, self.sensors)
        self.back_end = BackEnd(self.map, self.front_end, background)
        self._ground = GroundViews(self.rig)
        self._border = BlankBorder()
        self._moving = plugins.moving
        held = HeldResults(self.rig)
        search = MountSearch(self.rig, mount_meter, self.sensors, held)
        self._mount_search = search
        self.session = plugins.session(
            Parts(self.map, self.front_end, self.back_end, self.sensors, self._moving, search, held)
        )
        self._shows_nothing = False
        self.late_masks = plugins.late_masks(self.front_end, self.map)
        self.announce: Callable[[FrameResult, StereoFrame, Region | None], None] | None = None

    @property
    def mount(self) -> Mount | None:
        """The mount of the camera, None until it is measured."""
        return self.rig.base_mount

    @property
    def last_pose(self) -> LastPose | None:
        """Where a drive that is interrupted now is resumed; None where it is lost."""
        motion = self.front_end.motion
        if self.mount is None or motion.state.is_lost:
            return None
        return replace(motion.last_pose(), covariance=self.session.covariance)

    def add(self, measurement: Measurement) -> None:
        """Take in what wheels or an IMU measured; those up to a frame come before it."""
        self.sensors.add(measurement)

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Track one frame and return the results that are ready, oldest first."""
        with self._times.measure('tracking'):
            self._take_in_changes()
            expected_shift = partial(self.front_end.expected_shift, frame.stamp_ns)
            fault = self.image_check.fault(frame, expected_shift)
            if self.image_check.is_carried and not fault:
                return self.session.take(self._carried(frame))
            frame, images = self._prepared(frame, fault)
            track = self._track(frame, images, fault)
        is_wanted = not fault and self.back_end.wants_keyframe(track, frame.stamp_ns)
        moves = self._search_moving(frame, is_wanted, track is not None)
        if moves is not None:
            images = self.front_end.exclude(images, moves.region)
        keyframe = None
        if is_wanted:
            with self._times.measure('mapping'):
                keyframe = self._add_keyframe(frame, images, track, moves)
        if track is not None or keyframe is not None:
            pose = self.front_end.motion.T_camera_world
            self._mount_search.look(frame, pose, keyframe is not None)
        result = self._result(frame, track, fault, keyframe)
        if moves is not None:
            result = replace(result, moving=moves.points)
        return self.session.take(result)

    def finish(self) -> list[FrameResult]:
        """Return the results that are still held back after the last frame. If a submap was not
        recognised in the map of this drive, the larger of both stays. Frames of the other are left
        out (`left_out`): those that were returned before, if the map begins after them. A loaded
        map stays; frames that were mapped while it was searched are outside of it.
        """
        return self.session.finish(may_replace=not self.sessions)

    def to_arrays(self) -> Arrays:
        """Return the map, for a file; without a submap that is not merged."""
        return self.session.to_arrays()

    def load(
        self, arrays: Arrays, mount: Mount, localize: bool, last: LastPose | None = None
    ) -> None:
        """Continue with a map, before the first frame; the camera must be found in it. localize:
        the map stays as it is. last: where the drive that made the map was interrupted, which is
        resumed: until the camera is seen there, by what wheels measure, or with the last pose and a
        covariance that grows. Raises KeyError or ValueError for arrays that are no map.
        """
        self.session.load(arrays, last)
        self.front_end.is_fixed = localize
        self.rig.base = None
        self._mount_search.use(mount)

    def search_near(self, T_map_base: Array, reach_m: float, reach_rad: float) -> None:
        """Look for the camera around a pose of the base (4, 4) alone, as far as somebody who knows
        it may be wrong; also where it is tracked, but elsewhere.
        """
        assert self.mount is not None
        T_left_base = invert(self.mount.T_base_left)
        T_world_camera = T_left_base @ T_map_base @ self.mount.T_base_left
        self.session.search_near(T_world_camera, (reach_m, reach_rad))

    def close(self) -> None:
        """End the background threads, if there are any."""
        self.back_end.close()

    def _take_in_changes(self) -> None:
        """Take in what was solved, masked and measured since the last frame."""
        self.back_end.collect(wait=False)
        if not self.back_end.holds_one():
            self.late_masks.take_points_back()
        mount = self.rig.mount
        self.sensors.T_base_left = mount.T_base_left if mount else None

    def _prepared(self, frame: StereoFrame, fault: str) -> tuple[StereoFrame, Images]:
        """Return a frame corrected by the check of the rig, and its images."""
        if not fault:
            motion = self.front_end.motion
            turned = motion.steady(frame.stamp_ns) @ invert(motion.T_camera_world)
            self.rig_check.watch(frame, float(rotation_angle(turned[:3, :3])))
            frame = self.rig_check.corrected(frame)
        border = self._border.see(frame.left)
        return frame, Images.of(frame, self.rig.camera, border)

    def _track(self, frame: StereoFrame, images: Images, fault: str) -> Track | None:
        """Find the pose of a frame in the map; by sensors, or by a search, where that fails."""
        found, proof = self.session.find_in_loaded(frame, images, fault)
        if not self.map.keyframes:
            return None
        track = None if fault else self.front_end.track(frame, images, found)
        if track is not None:
            self.session.found(proof | self.front_end.relocaliser.take_proof())
        else:
            self.front_end.bridge(frame, fault)
            self.session.search(frame, images, fault)
        return track

    def _search_moving(
        self, frame: StereoFrame, is_wanted: bool, is_tracked: bool
    ) -> Searched | None:
        """Search a frame for what moves, if it is due."""
        if not self._moving.is_due(frame.stamp_ns, is_wanted, is_tracked):
            return None
        motion = self.front_end.motion
        with self._times.measure('moving'):
            return self._moving.search(
                frame, motion.T_camera_world, motion.T_odom_camera, self.rig.mount
            )

    def _add_keyframe(
        self, frame: StereoFrame, images: Images, track: Track | None, searched: Searched | None
    ) -> Keyframe | None:
        """Make the frame a keyframe; None where its features do not show what was tracked."""

        def announce() -> None:
            if not (self.announce and self.session.is_public):
                return
            if track is not None and self.mount is not None:
                result = in_map(self._result(frame, track, '', None), self.mount.T_base_left)
                self.announce(result, frame, images.moving)

        # Not early where the map may move before, nor after a frame that did not become one.
        is_late = self.back_end.holds_one(of_all=True) or self._shows_nothing
        if not is_late:
            announce()
        observed = self.front_end.observe(frame, images, track)
        self._shows_nothing = observed is None
        if observed is None:
            return None
        self.back_end.collect(wait=True)
        if is_late:
            announce()
        self.back_end.mapper.measure_stereo(frame, images, observed)
        motion = self.front_end.motion
        keyframe = KeyframeRecord(
            len(self.map.keyframes),
            frame.index,
            frame.stamp_ns,
            motion.T_camera_world,
            observed.features,
            observed.features.octave,
            observed.at_once(self.rig),
            self.map.living(observed.point_id),
            motion.since_keyframe.start(
                motion.T_camera_world, observed.known_share * motion.covariance
            ),
            self.sensors.up_camera(self.front_end.motion.T_odom_camera),
            ground=self._ground.take(frame.left),
        )
        uv_px = observed.observations.uvd_px[:, :2]
        self.back_end.add(keyframe, sample_patches(images.left, uv_px).astype(np.uint8))
        if searched is not None:
            self._moving.remember(keyframe, searched.disparity)
            ids = np.setdiff1d(self.front_end.local.point_ids, keyframe.point_id)
            points = transform_points(keyframe.T_camera_world, self.map.xyz_world[ids])
            gone = ids[self._moving.seen_through(searched.disparity, points)]
            self.map.points.note_seen_through(gone)
        if self.session.join(keyframe, images):  # whose features without points are gone
            uv_px, keyframe = uv_px[keyframe.point_id != NO_POINT], self.map.keyframes[-1]
        else:
            self.back_end.take_in(keyframe, images, self.sensors.up_world)
        self.front_end.continue_from(images, keyframe, uv_px)
        return take_snapshot(self.map, keyframe, frame, images.moving, uv_px)

    def _result(
        self, frame: StereoFrame, track: Track | None, fault: str, keyframe: Keyframe | None
    ) -> FrameResult:
        """Return the outcome of a frame in optical axes."""
        motion, why = self.front_end.motion, fault or NOTHING_SEEN
        is_blind, sigma_m = motion.state.is_blind, track.sigma_m if track else 0.0
        tracked = track is not None or keyframe is not None or is_blind
        state = f'{motion.state.value}: {why}' if is_blind else 'tracking'
        if sigma_m > UNSURE_M:
            state += f': what is seen leaves the place uncertain by {1000 * sigma_m:.0f} mm'
        session = self.session
        state += session.state.words
        unknown: Array = np.eye(6) * UNKNOWN_COVARIANCE
        return FrameResult(
            frame.index,
            frame.stamp_ns,
            tracked,
            motion.T_odom_camera,
            motion.T_world_odom,
            session.covariance if tracked else unknown,
            len(track.point_ids) if track else 0,
            state if tracked else f'lost: {why}',
            self.map.keyframes[-1].stamp_ns if self.map.keyframes else frame.stamp_ns,
            keyframe,
            blind=is_blind,
            in_submap=session.state.holds_results,
            repeated=self.image_check.is_repeated,
            outside=session.state is SessionState.OUTSIDE,
        )

    def _carried(self, frame: StereoFrame) -> FrameResult:
        """Return the outcome of a frame whose image is the one before: the motion goes on."""
        result, motion = self._result(frame, None, '', None), self.front_end.motion
        expected = motion.expected(frame.stamp_ns)
        if expected is None:
            return result
        return replace(
            result,
            tracked=True,
            T_odom_base=invert(expected.T_camera_world @ motion.T_world_odom),
            covariance=self.session.covariance - motion.covariance + expected.covariance,
            state=REPEATED,
        )


CAMERA_AS_BASE = Mount(0.0, 0.0, 0.0)
"""Where nothing is known of the mount: the camera in the axes of a base."""
