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
from segfloor_ros.core.slam.held_results import HeldResults, in_map, left_out
from segfloor_ros.core.slam.mapping.back_end import BackEnd, Submap
from segfloor_ros.core.slam.optional import MountMeter, Plugins
from segfloor_ros.core.slam.places.views import GroundViews
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES, Rig
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.snapshot import in_merged_map, take_snapshot
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images, dilate, is_inside
from segfloor_ros.core.slam.tracking.motion import CameraMotion, TrackingState
from segfloor_ros.core.slam.tracking.patch_alignment import sample_patches
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.timing import StageTimes
from segfloor_ros.core.twists import adjoint

LOOK_NS = 500_000_000
"""The floor is looked at again after so long, for the mount of a camera that is not known yet."""

LOST_NS = 1_500_000_000
"""For so long every frame is looked for in the map; after that the camera maps on its own. Beside a
loaded map it does so from the start, and what it maps is outside after so long."""

HARDLY_BEGUN = 5
"""A map of so few keyframes in which the camera gets lost is given up (Mur-Artal and Tardos,
ORB-SLAM2, 2017, does the same)."""

REPEATED = 'tracking: the image is the one before; the motion is taken to go on'
NOTHING_SEEN = 'too few known points in view'
SUBMAP_WORDS = {
    Submap.LOST: ', mapped before the map was recognised',
    Submap.OUTSIDE: ', outside the loaded map',
}
UNSURE_M = 0.005
"""A place that the images leave more uncertain than this is said to be."""


class LateMasks:
    """Takes back the points of keyframes where masks that come later show what moves."""

    def __init__(self, front_end: FrontEnd, sparse_map: SparseMap, dilation_px: int) -> None:
        self._front_end, self._map, self._dilation_px = front_end, sparse_map, dilation_px
        self._masks: list[tuple[KeyframeRecord, Region]] = []

    def add(self, stamp_ns: int, mask: Region) -> None:
        """Take in a mask (H, W) of the left image of a keyframe, 255 where something moves, for
        the next frame. A stamp of no keyframe says nothing.
        """
        recent = self._map.keyframes[-LOCAL_KEYFRAMES:]  # others hardly change any more
        keyframe = next((k for k in recent if k.stamp_ns == stamp_ns), None)
        if keyframe is not None and not self._front_end.is_fixed:
            self._masks.append((keyframe, dilate(mask, self._dilation_px)))

    def take_points_back(self) -> None:
        """Remove the points; while nothing is being adjusted."""
        for keyframe, mask in self._masks:
            if keyframe.index >= len(self._map.keyframes):
                continue
            if self._map.keyframes[keyframe.index] is not keyframe:
                continue  # of a submap that was given up or merged
            ids = keyframe.point_id[is_inside(mask, keyframe.observations.uvd_px[:, :2])]
            ids = ids[ids != NO_POINT]
            self._map.remove_points(ids[self._map.points['born'][ids] >= keyframe.index])
        if self._masks:
            self._masks.clear()
            self._front_end.drop_dead()


class StereoSlam:
    """Tracks a stereo camera and maps what it sees.

    One call of `process` per frame, in order. Results are held back until the camera's mount is
    known, since frame `map` lies on the floor; then all of them come at once, none is lost. Until
    then `provisional` is the newest pose. Where `mount` changes later, all of them come once more,
    from the first one on.
    plugins: what it can do without. background: adjust the map on a thread beside tracking; a
    keyframe is then published before its adjustment, and results depend on timing. rig, map,
    sensors: what is known of each. rig_check: what is wrong with the images. sessions: the
    drives that made the map it goes on with. front_end, back_end: tracking and mapping.
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
        self._mount_meter = mount_meter
        self._camera = camera
        self._settings = settings
        self._times = times or StageTimes()
        self.sensors, self.rig_check = plugins.sensors, plugins.rig_check
        self.front_end = FrontEnd(settings, self.map, self.sensors)
        self.back_end = BackEnd(settings, self.map, self.front_end, background, plugins.keeper)
        self._ground = GroundViews(self.rig)
        self._border = BlankBorder()
        self._held = HeldResults()
        self._moving = plugins.moving
        self._lost_ns: int | None = None
        self._looked_ns = 0
        self._shows_nothing = False
        self._began_unsure: tuple[Array, Array] | None = None
        self._loaded_ns: int | None = None
        self.late_masks = LateMasks(self.front_end, self.map, settings.mask_dilation_px)
        self.announce: Callable[[FrameResult, StereoFrame, Region | None], None] | None = None

    @property
    def mount(self) -> Mount | None:
        """The mount of the camera, None until it is measured."""
        return self.rig.mount

    @property
    def provisional(self) -> FrameResult | None:
        """The newest pose while results are held back: while the mount is being measured, by the
        mount as it seems so far; or of a drive that was broken off and maps on its own since, as
        uncertain as its beginning. None before the first frame, and once `process` returns results.
        """
        if (
            self.back_end.submap is Submap.LOST
            and self._began_unsure is not None
            and self.mount is not None
        ):
            return self._held.newest(self.mount)
        if self.mount is not None or self._mount_meter is None:
            return None
        return self._held.newest(self._mount_meter.provisional)

    @property
    def last_pose(self) -> LastPose | None:
        """What a drive that is broken off now goes on from; None where it is lost."""
        last = self.front_end.motion.last_pose()
        if self.mount is None or self.front_end.motion.state.is_lost:
            return None
        return replace(last, covariance=_covariance(self.front_end.motion, self._began_unsure))

    def add(self, measurement: Measurement) -> None:
        """Take in what wheels or an IMU measured; those up to a frame come before it."""
        self.sensors.add(measurement)

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Track one frame and return the results that are ready, oldest first."""
        with self._times.measure('tracking'):
            self._take_adjustment(wait=False)
            if not self.back_end.holds_one():
                self.late_masks.take_points_back()
            self.sensors.T_base_left = self.mount.T_base_left if self.mount else None
            fault = self.front_end.fault(frame)
            if self.front_end.repeats.is_carried and not fault:
                result = self._result(frame, None, '', None)
                result = _carried(
                    result,
                    self.front_end.motion,
                    _covariance(self.front_end.motion, self._began_unsure),
                )
                return self._held.take(result, self.mount)
            if not fault:
                motion = self.front_end.motion
                turned = motion.steady(frame.stamp_ns) @ invert(motion.T_camera_world)
                self.rig_check.watch(frame, float(rotation_angle(turned[:3, :3])))
                frame = self.rig_check.corrected(frame)
            images = Images.of(
                frame, self._camera, self._border.see(frame.left), self._settings.mask_dilation_px
            )
            found, proof = self._find_in_loaded(frame, images, fault)
            track = (
                self.front_end.track(frame, images, found)
                if self.map.keyframes and not fault
                else None
            )
            if track is not None:
                proof |= self.front_end.relocaliser.take_proof()
                self._held.recognise(proof, self.front_end.motion.T_world_odom)
                self._lost_ns = None
                if not self.back_end.submap.is_beside:
                    self.back_end.submap, self._began_unsure = Submap.KNOWN, None
            elif self.map.keyframes:
                self.front_end.bridge(frame, fault)
                self._search_on(frame, images, fault)
        is_wanted = not fault and self.back_end.wants_keyframe(track, frame.stamp_ns)
        searched = None
        if self._moving.is_due(frame.stamp_ns, is_wanted, track is not None):
            with self._times.measure('moving'):
                searched = self._moving.search(
                    frame,
                    self.front_end.motion.T_camera_world,
                    self.front_end.motion.T_odom_camera,
                    self.mount,
                )
                images = self.front_end.exclude(images, searched.region)
        keyframe = None
        if is_wanted:
            with self._times.measure('mapping'):
                keyframe = self._add_keyframe(frame, images, track, searched)
        if track is not None or keyframe is not None:
            self._look_for_mount(frame, keyframe is not None)
        result = self._result(frame, track, fault, keyframe)
        if searched is not None:
            result = replace(result, moving=searched.points)
        return self._held.take(result, self.mount)

    def finish(self) -> list[FrameResult]:
        """Return the results that are still held back after the last frame. Of a map and a submap
        that was not recognised in it the larger one stays, and frames of the other are in none
        (`left_out`): those that were returned before, where the map begins after them. A map that
        was loaded stays; what was mapped while it was searched is outside of it.
        """
        if self.back_end.is_beside_loaded:
            self.back_end.submap = Submap.OUTSIDE
            self._held.change(_outside)
        if self.back_end.submap is Submap.LOST:
            self._take_adjustment(wait=True)
            if not self.sessions and self.back_end.keep_submap():
                T_world_odom = self.front_end.motion.T_world_odom
                self._held.keep_submap(in_merged_map(self.map, T_world_odom))
            else:
                self._drop_submap()
        return self._held.release(self.mount)

    def to_arrays(self) -> Arrays:
        """Return the map, for a file; without a submap that is beside it."""
        self._take_adjustment(wait=True)
        return self.back_end.to_arrays()

    def load(
        self, arrays: Arrays, mount: Mount, localize: bool, last: LastPose | None = None
    ) -> None:
        """Go on with a map, before the first frame; the camera must be found in it. localize: the
        map stays as it is. last: where the drive that made the map was broken off, which goes on:
        until the camera is seen there, by what wheels measure, or with the last pose and a
        covariance that grows. Raises KeyError or ValueError for arrays that are no map.
        """
        self.back_end.from_arrays(arrays)
        self.rig.mount, self.front_end.is_fixed = mount, localize
        if self._mount_meter is not None:
            self._mount_meter.use(mount)
        if last is None:
            self.back_end.submap = Submap.LOADED
            self.front_end.reset()
        else:
            self.front_end.resume(last)

    def search_near(self, T_map_base: Array, reach_m: float, reach_rad: float) -> None:
        """Look for the camera around a pose of the base (4, 4) alone, as far as somebody who knows
        it may be wrong; also where it is tracked, but elsewhere.
        """
        assert self.mount is not None
        T_left_base = invert(self.mount.T_base_left)
        T_world_camera = T_left_base @ T_map_base @ self.mount.T_base_left
        if self.back_end.submap is Submap.LOST:
            self._drop_submap()
        self.front_end.search_near(T_world_camera, (reach_m, reach_rad))

    def close(self) -> None:
        """End the background threads, if there are any."""
        self.back_end.close()

    def _find_in_loaded(
        self, frame: StereoFrame, images: Images, fault: str
    ) -> tuple[Track | None, dict[int, Track]]:
        """Map on its own from the first frame on after a map was loaded, and look for every frame
        in that map for some time; what is mapped after that is outside. Returns a frame that was
        found, and those before that prove it, by stamp; what was mapped is given up then, as it is
        where an image cannot be tracked.
        """
        back_end, front_end = self.back_end, self.front_end
        if fault and back_end.is_beside_loaded:
            self._drop_submap()
        if fault or front_end.is_fixed:
            return None, {}
        if back_end.submap is Submap.LOADED and front_end.is_searching:
            self._start_submap()
            self._loaded_ns = None
        elif back_end.is_beside_loaded and self._loaded_ns is None:
            # Not before: to make a submap beside a large map takes so long that frames are skipped.
            self._loaded_ns = frame.stamp_ns
        if not back_end.is_beside_loaded:
            return None, {}
        if self._loaded_ns is not None and frame.stamp_ns - self._loaded_ns >= LOST_NS:
            back_end.submap = Submap.OUTSIDE
            self._held.change(_outside)
            return None, {}
        features = front_end.extractor.extract(frame.left, images.excluded)
        found, proof = back_end.find_in_known(images, features, frame.stamp_ns)
        if found is not None:
            self._drop_submap()
        return found, proof

    def _search_on(self, frame: StereoFrame, images: Images, fault: str) -> None:
        """Map on its own where the camera was looked for in vain for some time; or where it did so
        before and is lost again, look for it in the known map.
        """
        front_end = self.front_end
        if fault or not front_end.is_searching:
            self._lost_ns = None
            return
        self._lost_ns = frame.stamp_ns if self._lost_ns is None else self._lost_ns
        is_long = frame.stamp_ns - self._lost_ns >= LOST_NS
        if self.back_end.is_beside_loaded:
            if is_long:
                self._drop_submap()
        elif self.back_end.submap is Submap.LOST:
            features = front_end.extractor.extract(frame.left, images.excluded)
            found, _ = self.back_end.find_in_known(images, features, frame.stamp_ns)
            if is_long or found is not None:
                self._drop_submap()
        elif (
            self.back_end.keeper.can_hold
            and is_long
            and not (front_end.is_fixed or self.back_end.submap.is_beside)
        ):
            self._start_submap()

    def _start_submap(self) -> None:
        """Begin a submap: where the camera seems to be, or at the origin, where this is all there
        is of the drive. A map that had hardly begun is not worth waiting for.
        """
        self._lost_ns = None
        motion = self.front_end.motion
        is_resuming = motion.state is TrackingState.HELD
        if is_resuming:
            self._began_unsure = motion.T_camera_world, motion.covariance
        self._take_adjustment(wait=True)
        is_known = self.back_end.submap is Submap.KNOWN
        if is_known and not is_resuming and len(self.map.keyframes) <= HARDLY_BEGUN:
            self.back_end.reset()
        else:
            self.back_end.start_submap()
        if self.mount is not None and is_known:
            self._mount_meter, self.rig.mount_may_change = None, False
            self._held.keep(False)
        elif self._mount_meter is not None:
            self._mount_meter.reset()
        if not is_known:
            self.front_end.motion.reset()
            self.sensors.reset_world()
        self.front_end.reset()
        self._moving.reset()

    def _drop_submap(self) -> None:
        """Look for the camera in the known map again; what was mapped beside it is lost."""
        self._lost_ns = None
        was_looked_for = self.back_end.is_beside_loaded
        self._take_adjustment(wait=True)
        self.back_end.drop_submap()
        self.front_end.reset()
        if was_looked_for:
            self.sensors.reset_world()
        if self._mount_meter is not None:
            self._mount_meter.reset()
        self._moving.reset()
        self._held.change(_looked_for if was_looked_for else left_out)

    def _add_keyframe(
        self, frame: StereoFrame, images: Images, track: Track | None, searched: Searched | None
    ) -> Keyframe | None:
        """Make the frame a keyframe; None where its features do not show what was tracked."""

        def announce() -> None:
            is_public = self._held.is_empty and not self.back_end.submap.is_beside
            if self.announce and track is not None and self.mount is not None and is_public:
                result = in_map(self._result(frame, track, '', None), self.mount.T_base_left)
                self.announce(result, frame, images.excluded)

        # Not early where the map may move before, nor after a frame that did not become one.
        is_late = self.back_end.holds_one(of_all=True) or self._shows_nothing
        if not is_late:
            announce()
        observed = self.front_end.observe(frame, images, track)
        self._shows_nothing = observed is None
        if observed is None:
            return None
        self._take_adjustment(wait=True)
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
            observed.observations,
            self.map.living(observed.point_id),
            motion.since_keyframe.start(
                motion.T_camera_world, observed.known_share * motion.covariance
            ),
            self.sensors.up_camera(self.front_end.motion.T_odom_camera),
            ground=self._ground.take(frame.left),
        )
        patches = sample_patches(images.left, keyframe.observations.uvd_px[:, :2]).astype(np.uint8)
        self.back_end.mapper.insert(keyframe, patches)
        if searched is not None:
            self._moving.remember(keyframe, searched.disparity)
            ids = np.setdiff1d(self.front_end.local.point_ids, keyframe.point_id)
            points = transform_points(keyframe.T_camera_world, self.map.xyz_world[ids])
            gone = ids[self._moving.seen_through(searched.disparity, points)]
            self.map.points.note_seen_through(gone)
        up = self.sensors.up_world
        self._follow_map(partial(self.back_end.take_in, keyframe, images, up))
        if self.map.keyframes[-1] is not keyframe:  # it was merged into the known map
            keyframe = self.map.keyframes[-1]
            self._moving.reset()
            if self._mount_meter is not None:
                self._mount_meter.reset()
            self.sensors.reset_world()
            self._began_unsure = None
            self._held.change(in_merged_map(self.map, self.front_end.motion.T_world_odom))
        self.front_end.continue_from(images, keyframe)
        return take_snapshot(self.map, keyframe, frame, images.excluded)

    def _look_for_mount(self, frame: StereoFrame, is_new_view: bool) -> None:
        """Look for the floor at a keyframe; at other frames now and then: a camera that stands may
        see it better than in its first image, or know by now where up is. Where the floor shows
        another mount than the one in use, all results come once more.
        """
        meter = self._mount_meter
        if meter is None or meter.is_final:
            return
        is_late = frame.stamp_ns - self._looked_ns >= LOOK_NS
        if not is_new_view and (self.mount is not None or not is_late):
            return
        self._looked_ns = frame.stamp_ns
        T_world_camera = invert(self.front_end.motion.T_camera_world)
        up = self.sensors.up_world
        meter.add(frame.left, frame.right, T_world_camera, up, is_new_view)
        if self.mount is not None and meter.mount != self.mount:
            self._held.take_back()
        if meter.remark is not None:
            self.sensors.remark({'mount': meter.remark})
        self.rig.mount = meter.mount
        self.rig.mount_may_change = meter.may_change
        self._held.keep(meter.may_change)

    def _take_adjustment(self, wait: bool) -> None:
        """Bring a finished adjustment into the map."""
        if self.map.keyframes:
            self._follow_map(partial(self.back_end.collect, wait))

    def _follow_map(self, change: Callable[[], bool]) -> None:
        """Let the camera, and with it `odom`, move along with the latest keyframe. change: of the
        map; returns whether there was any.
        """
        before = self.map.keyframes[-1].T_camera_world
        if change():
            self.front_end.follow_map(before, self.map.keyframes[-1].T_camera_world)

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
        state += SUBMAP_WORDS.get(self.back_end.submap, '')
        unknown: Array = np.eye(6) * UNKNOWN_COVARIANCE
        return FrameResult(
            frame.index,
            frame.stamp_ns,
            tracked,
            motion.T_odom_camera,
            motion.T_world_odom,
            _covariance(self.front_end.motion, self._began_unsure) if tracked else unknown,
            len(track.point_ids) if track else 0,
            state if tracked else f'lost: {why}',
            self.map.keyframes[-1].stamp_ns if self.map.keyframes else frame.stamp_ns,
            keyframe,
            blind=is_blind,
            in_submap=self.back_end.submap is Submap.LOST,
            repeated=self.front_end.repeats.is_repeated,
            outside=self.back_end.submap is Submap.OUTSIDE,
        )


def _covariance(motion: CameraMotion, began: tuple[Array, Array] | None) -> Array:
    """Return the covariance (6, 6) of the last pose; began: pose (4, 4) and covariance of where its
    map began, if that was unsure.
    """
    if began is None:
        return motion.covariance
    A = adjoint(motion.T_camera_world @ invert(began[0]))
    return motion.covariance + A @ began[1] @ A.T


def _looked_for(result: FrameResult) -> FrameResult:
    """Return what is left of a frame of a camera that was looked for in a loaded map, and mapped
    meanwhile.
    """
    return replace(left_out(result), in_submap=False, state=f'lost: {NOTHING_SEEN}')


def _outside(result: FrameResult) -> FrameResult:
    """Return a frame that was not found in a loaded map, as one outside of it."""
    lost, outside = SUBMAP_WORDS[Submap.LOST], SUBMAP_WORDS[Submap.OUTSIDE]
    state = result.state.replace(lost, outside)
    return replace(result, in_submap=False, outside=result.tracked, state=state)


def _carried(result: FrameResult, motion: CameraMotion, covariance: Array) -> FrameResult:
    """Return the outcome of a frame whose image is the one before: the motion goes on. covariance:
    (6, 6), of the last pose.
    """
    expected = motion.expected(result.stamp_ns)
    if expected is None:
        return result
    return replace(
        result,
        tracked=True,
        T_odom_base=invert(expected.T_camera_world @ motion.T_world_odom),
        covariance=covariance - motion.covariance + expected.covariance,
        state=REPEATED,
    )


CAMERA_AS_BASE = Mount(0.0, 0.0, 0.0)
"""Where nothing is known of the mount: the camera in the axes of a base."""
