"""Stereo SLAM: from stereo frames to poses, keyframes and a sparse map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, invert
from segfloor_ros.map_file import Arrays
from segfloor_ros.measurements import Measurement
from segfloor_ros.slam.back_end import BackEnd
from segfloor_ros.slam.body_motion import BodyMotion
from segfloor_ros.slam.front_end import FrontEnd
from segfloor_ros.slam.held_results import HeldResults
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.loops import Candidate
from segfloor_ros.slam.map_arrays import fill_map, map_to_arrays
from segfloor_ros.slam.motion_search import MotionSearch, Searched
from segfloor_ros.slam.mount_meter import MountMeter
from segfloor_ros.slam.patch_alignment import sample_patches
from segfloor_ros.slam.results import FrameResult, Keyframe
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.snapshot import take_snapshot
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.track import Track
from segfloor_ros.timing import StageTimes

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
        self._body = BodyMotion()
        self._front_end = FrontEnd(camera, settings, self.map, self._body)
        self._back_end = BackEnd(camera, settings, self.map, self._front_end, background)
        self._held = HeldResults()
        self._moving = MotionSearch(camera) if settings.detect_moving else None
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
        return self._front_end.motion.T_world_odom

    @property
    def is_in_loaded_map(self) -> bool:
        """Whether the drive goes on in the map that was loaded, not in one of its own; also where
        none was loaded.
        """
        return self._back_end.is_joined

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
            self._front_end.consensus.mount = self.mount
            self._front_end.offset_px = self.disparity_offset_px
            fault = self._front_end.fault(frame)
            images = Images.of(frame, self._camera, self._settings.mask_dilation_px)
            track = (
                self._front_end.track(frame, images) if self.map.keyframes and not fault else None
            )
            if track is not None:
                self._not_found_yet = None
            elif self.map.keyframes:
                self._front_end.bridge(frame, fault)
                self._map_apart(frame.stamp_ns)
        is_wanted = not fault and self._wants_keyframe(track)
        searched = None
        if self._moving is not None and self._moving.is_due(is_wanted, track is not None):
            with self._times.measure('moving'):
                searched = self._moving.search(
                    frame,
                    self._front_end.motion.T_camera_world,
                    self._front_end.motion.T_odom_camera,
                    self.mount,
                )
                images = self._front_end.exclude(images, searched.region)
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
        self.mount, self._front_end.is_fixed = mount, localize
        self._not_found_yet = None if localize else arrays
        self._patience_ns = START_NS if T_world_odom is None else RESUMING_NS
        self._front_end.start_lost(T_world_odom)

    def search_near(self, T_map_base: Array, reach_m: float, reach_rad: float) -> None:
        """Look for the camera around a pose of the base (4, 4) alone, as far as somebody who knows
        it may be wrong; also where it is tracked, but elsewhere.
        """
        assert self.mount is not None
        T_left_base = invert(self.mount.T_base_left)
        T_world_camera = T_left_base @ T_map_base @ self.mount.T_base_left
        self._front_end.search_near(T_world_camera, reach_m, reach_rad)

    def close(self) -> None:
        """End the background threads, if there are any."""
        self._back_end.close()

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
        self._front_end.reset()
        self._body.reset_world()

    def _wants_keyframe(self, track: Track | None) -> bool:
        front_end, back_end = self._front_end, self._back_end
        if front_end.is_fixed or not back_end.takes_keyframes:
            return False
        if track is None:
            return not self.map.keyframes or front_end.is_new_place()
        return front_end.local.wants_keyframe(track, front_end.frames_since_keyframe, back_end.idle)

    def _add_keyframe(
        self, frame: StereoFrame, images: Images, track: Track | None, searched: Searched | None
    ) -> Keyframe | None:
        """Make the frame a keyframe; None where its features do not show what was tracked."""
        observed = self._front_end.observe(frame, images, track)
        if observed is None:
            return None
        self._take_adjustment(wait=True)
        self._back_end.mapper.measure_stereo(frame, images, observed.observations)
        keyframe = KeyframeRecord(
            len(self.map.keyframes),
            frame.index,
            frame.stamp_ns,
            self._front_end.motion.T_camera_world,
            observed.features,
            observed.observations,
            self.map.living(observed.point_id),
            self._front_end.motion.start_keyframe(),
            self._body.gravity.up_camera(self._front_end.motion.T_odom_camera),
        )
        patches = sample_patches(images.left, keyframe.observations.uvd_px[:, :2]).astype(np.uint8)
        self._back_end.mapper.insert(self.map, keyframe, patches)
        if self._moving is not None and searched is not None:
            self._moving.remember(keyframe, searched)
            gone = self._moving.seen_through(
                searched, self.map, self._front_end.local.point_ids, keyframe
            )
            self.map.note_seen_through(gone)
        up = self._body.gravity.up_world
        self._follow_map(partial(self._back_end.take_in, keyframe, images, self.mount, up))
        if self.map.keyframes[-1] is not keyframe:  # it has become part of the loaded map
            keyframe = self.map.keyframes[-1]
            self._moving = MotionSearch(self._camera) if self._moving is not None else None
            self._body.reset_world()
        self._front_end.continue_from(images, keyframe)
        self._measure_mount(frame, keyframe)
        return take_snapshot(self.map, keyframe, frame, images.excluded)

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
            self._front_end.follow_map(before, self.map.keyframes[-1].T_camera_world)

    def _result(
        self, frame: StereoFrame, track: Track | None, fault: str, keyframe: Keyframe | None
    ) -> FrameResult:
        """Return the outcome of a frame in optical axes."""
        motion, why = self._front_end.motion, fault or NOTHING_SEEN
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
