"""The motion of the camera: where it is, where it will be next, and the continuous frame `odom`."""

from __future__ import annotations

from enum import Enum

import numpy as np

from segfloor_ros.core.contracts import BodySensors, LastPose, RelativeMotion
from segfloor_ros.core.geometry import Array, invert, make_transform
from segfloor_ros.core.slam.thresholds import SAME, SPEED_SIGMA
from segfloor_ros.core.slam.tracking.pose import ANYWHERE, PoseEstimate, knows_more
from segfloor_ros.core.twists import Uncertain, compounded, se3_exp, se3_log, without_drift

MIN_STEP_S = 1e-3

ACCELERATION = 2.0
"""Of a robot on wheels, m/s² and rad/s², until its motion shows another one."""

LEARNT_FROM, LARGEST = 30, 10.0
"""Frames that count for how a motion goes on, and by how many times one surprise may exceed what is
known.
"""


class TrackingState(Enum):
    """How the latest pose is known; the words are those of the state of a frame."""

    TRACKING = 'tracking'
    ON_WHEELS = 'on wheels'
    ON_IMU = 'on IMU'
    ON_GYROSCOPE = 'on gyroscope'
    RESUMING = 'resuming a drive that was broken off'
    HELD = 'held where the drive was broken off'
    LOST_NEAR = 'lost near the last pose'
    LOST = 'lost'

    @property
    def is_lost(self) -> bool:
        """Whether there is no pose."""
        return self in (TrackingState.LOST_NEAR, TrackingState.LOST)

    @property
    def is_blind(self) -> bool:
        """Whether there is a pose that no image shows."""
        seen = self in (TrackingState.TRACKING, TrackingState.RESUMING)
        return not (seen or self.is_lost)

    @property
    def is_resuming(self) -> bool:
        """Whether the drive was broken off, and nothing has measured the pose since."""
        return self in (TrackingState.RESUMING, TrackingState.HELD)


class CameraMotion:
    """Measured by wheels and gyroscope, or else taken for constant velocity between frames
    (Mur-Artal et al., ORB-SLAM, 2015, section V-B).

    T_camera_world: the latest pose (4, 4). covariance: (6, 6) of its twist. T_world_odom: the
    correction of the odometry; both frames are the camera's first pose. velocity: (6,) of the
    twist, per second. state: of the latest frame; while it is
    lost, `T_camera_world` turns on as a gyroscope measures.
    """

    def __init__(self, max_speed_mps: float, body: BodySensors) -> None:
        self._body = body
        self._max_speed_mps = max_speed_mps
        self.reset()

    def reset(self) -> None:
        """Begin at the origin."""
        self.T_camera_world: Array = np.eye(4)
        self.covariance: Array = np.zeros((6, 6))
        self.T_world_odom: Array = np.eye(4)
        self.state = TrackingState.TRACKING
        self.velocity: Array = np.zeros(6)
        self._last_stamp_ns = 0
        self._surprises = Surprises()
        self._heading_sigma_rad: float | None = None
        self.since_keyframe = KeyframeMotion(self.T_camera_world, self.covariance)
        self._latest: tuple[tuple[int, int], RelativeMotion | None] | None = None
        self._broken_off: tuple[LastPose, float] | None = None

    @property
    def T_odom_camera(self) -> Array:
        """The camera in the continuous frame."""
        return invert(self.T_world_odom) @ invert(self.T_camera_world)

    def prior(self, stamp_ns: int) -> PoseEstimate | None:
        """Return where wheels have the camera by its motion since the last keyframe; None where
        they did not measure all of it. The same points of several frames err together: they
        count once.
        """
        measured = self.measured(stamp_ns)
        pose = self.since_keyframe.moved(measured) if measured and measured.by_wheels else None
        return None if pose is None else _estimate(*pose)

    def predict(self, stamp_ns: int) -> Array:
        """Return where the camera will be, T_camera_world (4, 4)."""
        measured = self.measured_pose(stamp_ns)
        return self.steady(stamp_ns) if measured is None else measured

    def measured_pose(self, stamp_ns: int) -> Array | None:
        """Return where the sensors have the camera, T_camera_world (4, 4)."""
        if self.state.is_lost:
            turned = self._turned(stamp_ns)
            return None if turned is None else turned[0]
        measured = self.measured(stamp_ns)
        return None if measured is None else measured.T_now_before @ self.T_camera_world

    def steady(self, stamp_ns: int) -> Array:
        """Return where the camera will be if it moves on as it did, T_camera_world (4, 4)."""
        return se3_exp(self.velocity * _step_s(self._last_stamp_ns, stamp_ns)) @ self.T_camera_world

    def velocity_at(self, stamp_ns: int) -> tuple[Array, Array]:
        """Return the velocity (6,) of the camera in an image, in m/s and rad/s, and its variance,
        as far as it changed so far.
        """
        step_s = _step_s(self._last_stamp_ns, stamp_ns)
        motion = se3_log(self.predict(stamp_ns) @ invert(self.T_camera_world))
        return motion / step_s, np.diag(self._surprises.covariance(step_s)) / step_s**2

    def expected(self, stamp_ns: int) -> PoseEstimate | None:
        """Return where the camera will be: as wheels or an IMU measure, or if its motion goes on,
        as far as it did so far; of a lost one by the gyroscope's turn. None where nothing is known.
        """
        if self.state.is_lost:
            turned = self._turned(stamp_ns)
            if turned is None or self._heading_sigma_rad is None:
                return None
            sigma_rad = self._heading_sigma_rad + turned[1] + SAME[1] / 3
            covariance = ANYWHERE.copy()
            covariance[3:, 3:] = sigma_rad**2 * np.eye(3)
            return _estimate(turned[0], covariance)
        step_s = _step_s(self._last_stamp_ns, stamp_ns)
        measured = self.measured(stamp_ns)
        if measured is None:
            motion = self.steady(stamp_ns) @ invert(self.T_camera_world)
            goes_on = motion, self._surprises.covariance(step_s)
            return _estimate(*compounded((self.T_camera_world, self.covariance), goes_on))
        pose, covariance = self._predicted(measured)
        if not measured.by_wheels:
            covariance[:3, :3] += (SPEED_SIGMA * step_s) ** 2 * np.eye(3)
        return _estimate(pose, covariance)

    def is_plausible(self, T_camera_world: Array, stamp_ns: int) -> bool:
        """Whether a robot can have come to a pose since the last frame; of a lost one nothing is
        known.
        """
        if self.state.is_lost or self.state.is_resuming:
            return True
        motion = T_camera_world @ invert(self.T_camera_world)
        step_s = _step_s(self._last_stamp_ns, stamp_ns)
        return bool(np.linalg.norm(motion[:3, 3]) <= self._max_speed_mps * step_s)

    def knows_more(self, by_images: PoseEstimate, stamp_ns: int) -> bool:
        """Whether sensors know some direction of a pose better than the images: wheels since the
        last keyframe, others since the last pose.
        """
        measured = None if self.state.is_lost else self.measured(stamp_ns)
        known = self.prior(stamp_ns) or measured
        return known is not None and knows_more(known.covariance, by_images)

    def last_pose(self) -> LastPose:
        """Return what a drive that is broken off here goes on from."""
        return LastPose(
            self._last_stamp_ns,
            self.T_camera_world,
            self.T_world_odom,
            self.covariance,
            self.velocity,
            tuple(self._body.latest_wheels),
        )

    def resume(self, last: LastPose, sigma_per_s: float) -> None:
        """Go on where a drive was broken off. sigma_per_s: by how many metres and radians a pose
        that is held becomes less certain per second.
        """
        self.lose()
        self.state = TrackingState.RESUMING
        self.T_camera_world, self.T_world_odom = last.T_camera_world, last.T_world_odom
        self.covariance, self.velocity = last.covariance, last.velocity
        self._last_stamp_ns = last.stamp_ns
        self._broken_off = last, sigma_per_s
        for pose in last.wheels:
            self._body.add(pose)

    def take(
        self, T_camera_world: Array, covariance: Array, stamp_ns: int, T_seen: Array | None = None
    ) -> None:
        """Go on from the pose of a frame, found in its images. T_seen: (4, 4), as the images alone
        have it, where they know it better than the sensors: these learn from that. After a blind
        stretch `odom` goes on where the sensors had the camera: the error of the stretch is a
        correction of `odom`.
        """
        measured = self.measured(stamp_ns)
        if self.state.is_blind and measured is not None:
            T_odom_camera = invert(self._predicted(measured)[0] @ self.T_world_odom)
            self.T_world_odom = without_drift(invert(T_camera_world) @ invert(T_odom_camera))
        motion = se3_log(T_camera_world @ invert(self.T_camera_world))
        steady = not (self.state.is_lost or self.state.is_blind)
        if steady and self.velocity.any():
            step_s = _step_s(self._last_stamp_ns, stamp_ns)
            self._surprises.learn(motion - self.velocity * step_s, step_s)
        self.velocity = motion / _step_s(self._last_stamp_ns, stamp_ns) if steady else np.zeros(6)
        self.since_keyframe.add(measured)
        self.T_camera_world, self.covariance = T_camera_world, covariance
        self._last_stamp_ns = stamp_ns
        self.state = TrackingState.TRACKING
        R_world_odom = self.T_world_odom[:3, :3]
        if T_seen is not None or measured is None:
            T_seen = T_camera_world if T_seen is None else T_seen
            T_odom_seen = invert(self.T_world_odom) @ invert(T_seen)
            self._body.learn(stamp_ns, T_odom_seen, R_world_odom)
        else:
            self._body.carry(stamp_ns, self.T_odom_camera, R_world_odom, measured.by_wheels)

    def bridge(self, stamp_ns: int) -> bool:
        """Go on without the images to where the sensors have the camera. Returns whether they
        measure it.
        """
        measured = self.measured(stamp_ns)
        if measured is None or self.state.is_lost:
            return False
        pose, covariance = self._predicted(measured)
        if measured.source == 'nothing':
            self.covariance, self.state = covariance, TrackingState.HELD
            return True
        if not measured.by_wheels and sigma_m(covariance) > SAME[0]:
            return False
        self.since_keyframe.add(measured)
        self.T_camera_world, self.covariance = without_drift(pose), covariance
        self._last_stamp_ns = stamp_ns
        self.state = TrackingState(f'on {measured.source}')
        R_world_odom = self.T_world_odom[:3, :3]
        self._body.carry(stamp_ns, self.T_odom_camera, R_world_odom, measured.by_wheels)
        return True

    def lose(self, stamp_ns: int | None = None) -> None:
        """Note that a frame has no pose: the camera is near the last one, unless it was lost.
        Without a stamp: nothing is known of where it is.
        """
        before, turned, sigma_rad = self.state, None, self._heading_sigma_rad
        if stamp_ns is not None:
            turned = self._turned(stamp_ns)
            sigma_rad = sigma_rad if before.is_lost else 0.0
        is_near = stamp_ns is not None and before is not TrackingState.LOST
        self.state = TrackingState.LOST_NEAR if is_near else TrackingState.LOST
        self.velocity = np.zeros(6)
        self._heading_sigma_rad = self._latest = self.since_keyframe.motion = None
        self._body.reset()
        if stamp_ns is not None and turned is not None and sigma_rad is not None:
            self.T_camera_world = without_drift(turned[0])
            self._last_stamp_ns = stamp_ns
            self._heading_sigma_rad = sigma_rad + turned[1]

    def move_map(self, T_reference_before: Array, T_reference_after: Array) -> None:
        """Move the camera along with a keyframe (T_camera_world, (4, 4)) that the map has moved;
        `odom` stays where the camera sees it.
        """
        T_odom_camera = self.T_odom_camera
        T_keyframe = self.since_keyframe.T_camera_world @ invert(T_reference_before)
        self.since_keyframe.T_camera_world = without_drift(T_keyframe @ T_reference_after)
        T_camera_reference = self.T_camera_world @ invert(T_reference_before)
        self.T_camera_world = without_drift(T_camera_reference @ T_reference_after)
        self.T_world_odom = without_drift(invert(self.T_camera_world) @ invert(T_odom_camera))

    def measured(self, stamp_ns: int) -> RelativeMotion | None:
        """Return the motion since the last pose, by wheels or by an IMU alone, or none where the
        pose is held; asked for often.
        """
        stretch = self._last_stamp_ns, stamp_ns
        if self._latest is None or self._latest[0] != stretch:
            measured = self._body.between(*stretch)
            if measured is None:
                R_world_odom = self.T_world_odom[:3, :3]
                measured = self._body.by_inertia(*stretch, self.T_odom_camera, R_world_odom)
            if measured is None and self._broken_off and self.state.is_resuming:
                sigma = self._broken_off[1] * _step_s(self._last_stamp_ns, stamp_ns)
                measured = RelativeMotion(np.eye(4), sigma**2 * np.eye(6), 'nothing')
            self._latest = stretch, measured
        return self._latest[1]

    def _turned(self, stamp_ns: int) -> tuple[Array, float] | None:
        """Return the camera at its last place, turned on as a gyroscope measures, (4, 4), and the
        standard deviation of the turn in radians.
        """
        turn = self._body.turn(self._last_stamp_ns, stamp_ns)
        if turn is None:
            return None
        return make_transform(turn[0], np.zeros(3)) @ self.T_camera_world, turn[1]

    def _predicted(self, measured: RelativeMotion) -> Uncertain:
        """Return where the sensors have the camera after a motion, while it is not lost."""
        covariance = self.covariance
        if self._broken_off is not None and self.state.is_resuming:
            covariance = self._broken_off[0].covariance
        before = self.T_camera_world, covariance
        return compounded(before, (measured.T_now_before, measured.covariance))


class Surprises:
    """How far motions went on otherwise than they did, in m/s² and rad/s², as the drive shows."""

    def __init__(self) -> None:
        self._squares = np.full(2, ACCELERATION**2)
        self._count = LEARNT_FROM / 10

    def learn(self, error: Array, step_s: float) -> None:
        """Take in the error (6,) of a motion that was expected to go on."""
        seen = (error.reshape(2, 3) ** 2).mean(axis=1) / step_s**4
        self._count = min(self._count + 1, LEARNT_FROM)
        self._squares += (np.minimum(seen, LARGEST * self._squares) - self._squares) / self._count

    def covariance(self, step_s: float) -> Array:
        """Return the covariance (6, 6) of a motion that goes on."""
        return np.diag(np.repeat(self._squares * step_s**4, 3))


class KeyframeMotion:
    """The motion since the last keyframe as sensors measure it, None where they did not.

    T_camera_world, covariance: (4, 4) and (6, 6), of the keyframe.
    """

    def __init__(self, T_camera_world: Array, covariance: Array) -> None:
        self.T_camera_world, self.covariance = T_camera_world, covariance
        self.motion: RelativeMotion | None = None

    def start(self, T_camera_world: Array, covariance: Array) -> RelativeMotion | None:
        """Begin at a keyframe; returns the motion before it, if wheels measured it, or images
        alone without the map."""
        before, self.motion = self.motion, RelativeMotion.none()
        self.T_camera_world, self.covariance = T_camera_world, covariance
        return before if before is not None and before.source in ('wheels', 'images') else None

    def add(self, measured: RelativeMotion | None) -> None:
        """Add the motion of a frame."""
        self.motion = joined_motion(self.motion, measured) if self.motion and measured else None

    def see(self, T_camera_world: Array, covariance: Array) -> None:
        """Take in a pose (4, 4) that images show without the map, with its covariance (6, 6)."""
        if self.motion is None or not self.motion.by_wheels:
            T_now_keyframe = T_camera_world @ invert(self.T_camera_world)
            self.motion = RelativeMotion(T_now_keyframe, covariance, 'images')

    def moved(self, measured: RelativeMotion) -> Uncertain | None:
        """Return the pose after the motion by wheels so far and one of a frame, with covariance."""
        if self.motion is None or not self.motion.by_wheels:
            return None
        motion = joined_motion(self.motion, measured)
        before = self.T_camera_world, self.covariance
        return compounded(before, (motion.T_now_before, motion.covariance))


def joined_motion(first: RelativeMotion, later: RelativeMotion) -> RelativeMotion:
    """Return the motion over two stretches."""
    both = ((motion.T_now_before, motion.covariance) for motion in (first, later))
    return RelativeMotion(*compounded(*both), later.source if first.by_wheels else first.source)


def _estimate(T_camera_world: Array, covariance: Array) -> PoseEstimate:
    return PoseEstimate(T_camera_world, np.zeros(0, bool), covariance, 1.0)


def _step_s(before_ns: int, now_ns: int) -> float:
    return max((now_ns - before_ns) * 1e-9, MIN_STEP_S)


def sigma_m(covariance: Array) -> float:
    """Return the standard deviation of the place of a pose with a covariance (6, 6)."""
    return float(np.sqrt(np.diag(covariance)[:3].max()))
