"""Stereo SLAM: from stereo frames to poses, keyframes and a sparse map.

What SLAM asks of whoever measures the camera's mount.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, adjoint, invert
from segfloor_ros.map_file import Arrays
from segfloor_ros.measurements import Measurement, Up
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.snapshot import HeldResults, in_joined_map, take_snapshot
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.back_end import BackEnd
from segfloor_ros.slam.moving.motion_search import MotionSearch, Searched
from segfloor_ros.slam.places.loops import Candidate
from segfloor_ros.slam.results import UNKNOWN_COVARIANCE, FrameResult, Keyframe, LastPose, Track
from segfloor_ros.slam.sensors.body_motion import BodyMotion
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.tracking.front_end import FrontEnd
from segfloor_ros.slam.tracking.images import Images
from segfloor_ros.slam.tracking.patch_alignment import sample_patches
from segfloor_ros.timing import StageTimes

START_NS, LOST_NS = 1_000_000_000, 1_500_000_000
"""For how long the camera is looked for in the map: of a new drive in the map that was loaded, and
of one that got lost or was broken off. After that it maps on its own."""

HARDLY_BEGUN = 5
"""A map of so few keyframes in which the camera gets lost is given up (Mur-Artal and Tardos,
ORB-SLAM2, 2017, does the same)."""

HELD = 'held where the drive was broken off'
REPEATED = 'tracking: the image is the one before; the motion is taken to go on'
NOTHING_SEEN = 'too few known points in view'
MAPPED_APART = ', mapped before the map was recognised'
NOT_RECOGNISED = 'mapped, but no place of the map was recognised'
UNSURE_M = 0.005
"""A place that the images leave more uncertain than this is said to be."""


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
        self._lost_ns: int | None = None
        self._patience_ns = LOST_NS
        self._is_shown = True
        self._began_unsure: tuple[Array, Array] | None = None

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
        """Whether the drive has been found in the map that was loaded, or none was loaded."""
        return self._is_shown or not self._back_end.is_apart

    @property
    def is_apart(self) -> bool:
        """Whether the camera maps on its own since it got lost: its results are held back."""
        return self._is_shown and self._back_end.is_apart

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
        """The newest pose while results are held back: while the mount is being measured, by the
        mount as it seems so far; or of a drive that was broken off and maps on its own since, as
        uncertain as its beginning. None before the first frame, and once `process` returns results.
        """
        if self.is_apart and self._began_unsure is not None and self.mount is not None:
            return self._held.newest(self.mount)
        if self.mount is not None or self._mount_meter is None:
            return None
        return self._held.newest(self._mount_meter.provisional)

    @property
    def last_pose(self) -> LastPose | None:
        """What a drive that is broken off now goes on from; None where it is lost."""
        last = self._front_end.motion.last_pose()
        if self.mount is None or self._front_end.motion.is_lost:
            return None
        return replace(last, covariance=self._covariance())

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
            if self._front_end.repeats.is_carried and not fault:
                return self._hold(self._carried(frame))
            images = Images.of(frame, self._camera, self._settings.mask_dilation_px)
            track = (
                self._front_end.track(frame, images) if self.map.keyframes and not fault else None
            )
            if track is not None:
                self._lost_ns, self._patience_ns = None, LOST_NS
                if not self._back_end.is_apart:
                    self._is_shown, self._began_unsure = True, None
            elif self.map.keyframes:
                self._front_end.bridge(frame, fault)
                self._search_on(frame, images, fault)
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
        return self._hold(result)

    def _hold(self, result: FrameResult) -> list[FrameResult]:
        """Add a result to those that are held back, and return what is ready."""
        self._held.add(result)
        return [] if self.is_apart else self._held.release(self.mount)

    def _carried(self, frame: StereoFrame) -> FrameResult:
        """Return the outcome of a frame whose image is the one before: the motion goes on."""
        motion = self._front_end.motion
        expected = motion.expected(frame.stamp_ns)
        result = self._result(frame, None, '', None)
        return replace(
            result,
            tracked=True,
            T_odom_base=invert(expected.T_camera_world @ motion.T_world_odom),
            covariance=self._covariance() - motion.covariance + expected.covariance,
            state=REPEATED,
        )

    def finish(self) -> list[FrameResult]:
        """Return the results that are still held back after the last frame: as lost, for no place
        of the map was recognised since.
        """
        if self.is_apart:
            self._give_up_part()
        return self._held.release(self.mount)

    def to_arrays(self) -> Arrays:
        """Return the map, for a file; without a part that is apart from it."""
        self._take_adjustment(wait=True)
        return self._back_end.to_arrays(of_known=self._is_shown)

    def load(
        self, arrays: Arrays, mount: Mount, localize: bool, last: LastPose | None = None
    ) -> None:
        """Go on with a map, before the first frame; the camera must be found in it. localize: the
        map stays as it is. last: where the drive that made the map was broken off, which goes on:
        until the camera is seen there, by what wheels tell, or with the last pose and a covariance
        that grows. Raises KeyError or ValueError for arrays that are no map.
        """
        self._back_end.from_arrays(arrays)
        self.mount, self._front_end.is_fixed = mount, localize
        if last is None:
            self._is_shown, self._patience_ns = False, START_NS
            self._front_end.motion.stop()
        else:
            self._front_end.resume(last)

    def search_near(self, T_map_base: Array, reach_m: float, reach_rad: float) -> None:
        """Look for the camera around a pose of the base (4, 4) alone, as far as somebody who knows
        it may be wrong; also where it is tracked, but elsewhere.
        """
        assert self.mount is not None
        T_left_base = invert(self.mount.T_base_left)
        T_world_camera = T_left_base @ T_map_base @ self.mount.T_base_left
        if self.is_apart:
            self._give_up_part()
        self._front_end.search_near(T_world_camera, reach_m, reach_rad)

    def close(self) -> None:
        """End the background threads, if there are any."""
        self._back_end.close()

    def _search_on(self, frame: StereoFrame, images: Images, fault: str) -> None:
        """Map on its own where the camera was looked for in vain for some time; or where it did so
        before and is lost again, look for it in the known map.
        """
        front_end = self._front_end
        if fault or not front_end.is_searching:
            self._lost_ns = None
            return
        self._lost_ns = frame.stamp_ns if self._lost_ns is None else self._lost_ns
        is_long = frame.stamp_ns - self._lost_ns >= self._patience_ns
        if self.is_apart:
            features = front_end.extractor.extract(frame.left, images.excluded)
            if is_long or self._back_end.sees_known(images, features, frame.stamp_ns):
                self._give_up_part()
        elif is_long and not (front_end.is_fixed or self._back_end.is_apart):
            self._map_apart()

    def _map_apart(self) -> None:
        """Begin another part of the map: where the camera seems to be, or at the origin, where this
        is all there is of the drive. A map that had hardly begun is not worth waiting for.
        """
        self._lost_ns = None
        motion = self._front_end.motion
        is_resuming = motion.is_held
        if is_resuming:
            self._began_unsure = motion.T_camera_world, motion.covariance
        self._take_adjustment(wait=True)
        if self._is_shown and not is_resuming and len(self.map.keyframes) <= HARDLY_BEGUN:
            self._back_end.begin_again()
        else:
            self._back_end.map_apart(self._is_shown)
        if self._mount_meter is not None:
            self._mount_meter.start_over()
        if not self._is_shown:
            self._front_end.motion.reset()
            self._body.reset_world()
        self._front_end.leave_map()
        self._forget_views()

    def _give_up_part(self) -> None:
        """Look for the camera in the known map again; what was mapped beside it is lost."""
        self._lost_ns = None
        self._take_adjustment(wait=True)
        self._back_end.give_up_part()
        self._front_end.leave_map()
        self._forget_views()
        self._held.change(_lost)

    def _forget_views(self) -> None:
        """Look for what moves by what is seen from now on: earlier poses are of another world."""
        self._moving = MotionSearch(self._camera) if self._moving is not None else None

    def _wants_keyframe(self, track: Track | None) -> bool:
        front_end, back_end = self._front_end, self._back_end
        most = self._settings.keyframe_max_frames // 3
        if front_end.is_fixed or not back_end.takes_keyframes:
            return False
        if track is None:
            return not self.map.keyframes or front_end.is_new_place()
        if front_end.is_poor and front_end.frames_since_keyframe < most:
            return False
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
            self._forget_views()
            self._body.reset_world()
            self._began_unsure = None
            self._held.change(in_joined_map(self.map, self.T_world_odom))
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

    def _covariance(self) -> Array:
        """Return the covariance (6, 6) of the last pose, with that of where its map began."""
        motion, began = self._front_end.motion, self._began_unsure
        if began is None:
            return motion.covariance
        A = adjoint(motion.T_camera_world @ invert(began[0]))
        return motion.covariance + A @ began[1] @ A.T

    def _result(
        self, frame: StereoFrame, track: Track | None, fault: str, keyframe: Keyframe | None
    ) -> FrameResult:
        """Return the outcome of a frame in optical axes."""
        motion, why = self._front_end.motion, fault or NOTHING_SEEN
        sigma_m = self._front_end.seen_sigma_m
        unsure = f'what is seen leaves the place uncertain by {1000 * sigma_m:.0f} mm'
        tracked = track is not None or keyframe is not None or motion.is_blind
        blind = f'on {motion.carried_by}' if not motion.is_held else HELD
        state = f'{blind}: {why}' if motion.is_blind else 'tracking'
        state += f': {unsure}' if sigma_m > UNSURE_M and not motion.is_blind else ''
        if self._back_end.is_apart:
            state += MAPPED_APART if self._is_shown else ', outside the loaded map'
        unknown: Array = np.eye(6) * UNKNOWN_COVARIANCE
        return FrameResult(
            frame.index,
            frame.stamp_ns,
            tracked,
            motion.T_odom_camera,
            motion.T_world_odom,
            self._covariance() if tracked else unknown,
            len(track.point_ids) if track else 0,
            state if tracked else f'lost: {why}',
            self.map.keyframes[-1].stamp_ns if self.map.keyframes else frame.stamp_ns,
            keyframe,
            blind=motion.is_blind,
            apart=self.is_apart,
            repeated=self._front_end.repeats.is_repeated,
        )


def _lost(result: FrameResult) -> FrameResult:
    """Return what is left of a frame where the map was, in the end, not recognised."""
    return replace(
        result,
        tracked=False,
        covariance=np.eye(6) * UNKNOWN_COVARIANCE,
        state=f'lost: {NOT_RECOGNISED}',
        keyframe=None,
        moving=None,
        blind=False,
    )


class MountMeter(Protocol):
    """Measures the camera's mount from the floor it sees."""

    def add(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        T_world_left: Array,
        up_world: Up | None,
    ) -> None:
        """Take in one keyframe: rectified images (H, W), camera pose (4, 4) in the first one's
        frame, and where an accelerometer has up in that frame.
        """

    def start_over(self) -> None:
        """Forget all keyframes: where the next ones are relative to them is not known."""

    @property
    def mount(self) -> Mount | None:
        """The mount at the first frame, once it is known."""

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, whatever little is known."""
