"""The motion of the camera: where it is, where it will be next, and the continuous frame `odom`."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import (
    Array,
    adjoint,
    invert,
    make_transform,
    rotation_angle,
    se3_exp,
    se3_log,
)
from segfloor_ros.slam.results import LastPose
from segfloor_ros.slam.sensors.body_motion import BodyMotion, RelativeMotion
from segfloor_ros.slam.tracking.pose import PoseEstimate

MAX_TURN_RADPS = 6.0
"""A robot does not spin faster than once a second."""

MIN_STEP_S = 1e-3

ACCELERATION = 2.0
"""Of a robot on wheels, m/s² and rad/s²."""

MAX_BLIND_SIGMA_M = 0.5
"""Uncertainty of the place up to which an IMU alone tells it, and up to which keyframes are made of
a pose that no image tells."""

MAX_LOST_TURN_RAD = 0.3
"""A camera that was lost is found only where a gyroscope that went on has it look, by so much."""

SIGMA_FELT_M_S = 0.3
"""A speed that is only felt speaks against images that tell another by much more."""

CONSISTENT_CHI2 = 22.46
"""Bound on the difference between images and sensors: 99.9 % of six degrees of freedom."""


class CameraMotion:
    """Measured by wheels and gyroscope, or else taken for constant velocity between frames
    (Mur-Artal et al., ORB-SLAM, 2015, section V-B).

    T_camera_world: the latest pose (4, 4). covariance: (6, 6) of its twist. T_world_odom: the
    correction of the odometry; both frames are the camera's first pose. is_lost: whether the last
    frame had no pose; `T_camera_world` then turns on as a gyroscope tells. lost_here: whether that
    is where the camera was lost. carried_by: the sensor that told the last pose alone, or '';
    'nothing' where a pose is held. is_resuming: whether the drive was broken off, and
    nothing has told the pose since.
    """

    def __init__(self, max_speed_mps: float, body: BodyMotion) -> None:
        self._body = body
        self._max_speed_mps = max_speed_mps
        self.reset()

    def reset(self) -> None:
        """Begin at the origin."""
        self.T_camera_world: Array = np.eye(4)
        self.covariance: Array = np.zeros((6, 6))
        self.T_world_odom: Array = np.eye(4)
        self.is_lost = self.lost_here = False
        self.carried_by = ''
        self._velocity: Array = np.zeros(6)
        self._last_stamp_ns = 0
        self._heading_sigma_rad: float | None = None
        self._since_keyframe: RelativeMotion | None = None
        self._at_keyframe: tuple[Array, Array] = self.T_camera_world, self.covariance
        self._latest: tuple[tuple[int, int], RelativeMotion | None] | None = None
        self._broken_off: tuple[LastPose, float] | None = None

    @property
    def is_resuming(self) -> bool:
        """Whether the drive was broken off, and nothing has told the pose since."""
        return self._broken_off is not None

    @property
    def is_held(self) -> bool:
        """Whether the last pose is that from before the drive was broken off."""
        return self.carried_by == 'nothing'

    @property
    def T_odom_camera(self) -> Array:
        """The camera in the continuous frame."""
        return invert(self.T_world_odom) @ invert(self.T_camera_world)

    @property
    def is_blind(self) -> bool:
        """Whether the last pose was not seen in the images."""
        return bool(self.carried_by)

    def prior(self, stamp_ns: int) -> PoseEstimate | None:
        """Return where wheels have the camera by its motion since the last keyframe; None where
        they did not tell all of it. What frames since tell by the same points errs together: it
        counts once.
        """
        measured, since = self._measured(stamp_ns), self._since_keyframe
        if measured is None or since is None or not (measured.by_wheels and since.by_wheels):
            return None
        T, covariance = _moved(self._at_keyframe, since.then(measured))
        return PoseEstimate(T, np.zeros(0, bool), covariance, 1.0)

    def is_felt(self, stamp_ns: int) -> bool:
        """Whether an IMU tells where the camera is, for some seconds."""
        measured = self._measured(stamp_ns)
        return measured is not None and measured.told_by == 'IMU'

    @property
    def sigma_m(self) -> float:
        """The standard deviation of the position, along the axis on which it is largest."""
        return sigma_m(self.covariance)

    def predict(self, stamp_ns: int) -> Array:
        """Return where the camera will be, T_camera_world (4, 4)."""
        measured = self.measured_pose(stamp_ns)
        return self.steady(stamp_ns) if measured is None else measured

    def measured_pose(self, stamp_ns: int) -> Array | None:
        """Return where the sensors have the camera, T_camera_world (4, 4)."""
        if self.is_lost:
            turned = self._turned(stamp_ns)
            return None if turned is None else turned[0]
        measured = self._measured(stamp_ns)
        return None if measured is None else measured.T_now_before @ self.T_camera_world

    def steady(self, stamp_ns: int) -> Array:
        """Return where the camera will be if it moves on as it did, T_camera_world (4, 4)."""
        return se3_exp(self._velocity * self._step_s(stamp_ns)) @ self.T_camera_world

    def expected(self, stamp_ns: int) -> PoseEstimate:
        """Return where the camera will be if its motion goes on, as far as that of a robot does."""
        sigma = 0.5 * self._step_s(stamp_ns) ** 2 * ACCELERATION
        covariance = self.covariance + np.diag(np.repeat(sigma**2, 6))
        return PoseEstimate(self.predict(stamp_ns), np.zeros(0, bool), covariance, 1.0)

    def is_plausible(self, T_camera_world: Array, stamp_ns: int) -> bool:
        """Whether a robot can have come to a pose since the last frame."""
        motion = T_camera_world @ invert(self.T_camera_world)
        step_s = self._step_s(stamp_ns)
        speed = float(np.linalg.norm(motion[:3, 3])) / step_s
        turn = rotation_angle(motion[:3, :3]) / step_s
        return speed <= self._max_speed_mps and turn <= MAX_TURN_RADPS

    def is_consistent(self, T_camera_world: Array, covariance: Array, stamp_ns: int) -> bool:
        """Whether a pose that the images tell, with its covariance (6, 6), fits what the sensors
        tell.
        """
        measured = self._measured(stamp_ns)
        prior = self._predicted(measured)
        if measured is None or prior is None:
            return True
        error, P = se3_log(T_camera_world @ invert(prior[0])), prior[1] + covariance
        if not measured.by_wheels:
            P[:3, :3] += (SIGMA_FELT_M_S * self._step_s(stamp_ns)) ** 2 * np.eye(3)
        return float(error @ np.linalg.solve(P, error)) < CONSISTENT_CHI2

    def may_face(self, T_camera_world: Array, stamp_ns: int) -> bool:
        """Whether a camera that was lost may have turned to a pose since."""
        turned = self._turned(stamp_ns)
        if turned is None or self._heading_sigma_rad is None:
            return True
        off_rad = rotation_angle(T_camera_world[:3, :3] @ turned[0][:3, :3].T)
        return off_rad < MAX_LOST_TURN_RAD + 3 * (self._heading_sigma_rad + turned[1])

    def last_pose(self) -> LastPose:
        """Return what a drive that is broken off here goes on from."""
        return LastPose(
            self._last_stamp_ns,
            self.T_camera_world,
            self.T_world_odom,
            self.covariance,
            self._velocity,
            tuple(self._body.latest_wheels),
        )

    def resume(self, last: LastPose, sigma_per_s: float) -> None:
        """Go on where a drive was broken off. sigma_per_s: by how many metres and radians a pose
        that is held becomes less certain per second.
        """
        self.stop()
        self.is_lost = False
        self.T_camera_world, self.T_world_odom = last.T_camera_world, last.T_world_odom
        self.covariance, self._velocity = last.covariance, last.velocity
        self._last_stamp_ns = last.stamp_ns
        self._broken_off = last, sigma_per_s
        for pose in last.wheels:
            self._body.add(pose)

    def take(
        self,
        T_camera_world: Array,
        covariance: Array,
        stamp_ns: int,
        T_seen: Array | None = None,
    ) -> None:
        """Go on from the pose of a frame, found in its images. T_seen: (4, 4), as the images alone
        have it: the sensors learn from that. After a blind stretch `odom` goes on where the sensors
        had the camera: the error of the stretch is a correction of `odom`.
        """
        measured = self._measured(stamp_ns)
        predicted = self._predicted(measured)
        if self.is_blind and predicted is not None:
            T_odom_camera = invert(predicted[0] @ self.T_world_odom)
            self.T_world_odom = _without_drift(invert(T_camera_world) @ invert(T_odom_camera))
        motion = se3_log(T_camera_world @ invert(self.T_camera_world))
        steady = not (self.is_lost or self.is_blind)
        self._velocity = motion / self._step_s(stamp_ns) if steady else np.zeros(6)
        self._note(measured)
        self.T_camera_world, self.covariance = T_camera_world, covariance
        self._last_stamp_ns = stamp_ns
        self.is_lost, self.lost_here, self.carried_by = False, False, ''
        self._broken_off = None
        T_seen = T_camera_world if T_seen is None else T_seen
        T_odom_seen = invert(self.T_world_odom) @ invert(T_seen)
        self._body.learn(stamp_ns, T_odom_seen, self.T_world_odom[:3, :3])

    def bridge(self, stamp_ns: int) -> bool:
        """Go on without the images to where the sensors have the camera. Returns whether they tell
        it.
        """
        measured = self._measured(stamp_ns)
        predicted = self._predicted(measured)
        if measured is None or predicted is None:
            return False
        if measured.told_by == 'nothing':
            self.covariance, self.carried_by = predicted[1], measured.told_by
            return True
        if not measured.by_wheels and sigma_m(predicted[1]) > MAX_BLIND_SIGMA_M:
            return False
        self._broken_off = None
        self._note(measured)
        self.T_camera_world, self.covariance = _without_drift(predicted[0]), predicted[1]
        self._last_stamp_ns = stamp_ns
        self.carried_by = measured.told_by
        R_world_odom = self.T_world_odom[:3, :3]
        self._body.carry(stamp_ns, self.T_odom_camera, R_world_odom, measured.by_wheels)
        return True

    def lose(self, stamp_ns: int) -> None:
        """Note that a frame has no pose."""
        turned = self._turned(stamp_ns)
        sigma_rad = self._heading_sigma_rad if self.is_lost else 0.0
        lost_here = self.lost_here or not self.is_lost
        self.stop()
        self.lost_here = lost_here
        if turned is not None and sigma_rad is not None:
            self.T_camera_world = _without_drift(turned[0])
            self._last_stamp_ns = stamp_ns
            self._heading_sigma_rad = sigma_rad + turned[1]

    def stop(self) -> None:
        """Note that nothing is known of where the camera is."""
        self._velocity = np.zeros(6)
        self.is_lost, self.lost_here, self.carried_by = True, False, ''
        self._heading_sigma_rad = self._latest = None
        self._since_keyframe = self._broken_off = None
        self._body.stop()

    def start_keyframe(self) -> RelativeMotion | None:
        """Return the motion since the last keyframe as the wheels tell it; the next begins."""
        since, self._since_keyframe = self._since_keyframe, RelativeMotion.none()
        self._at_keyframe = self.T_camera_world, self.covariance
        return since if since is not None and since.by_wheels else None

    def move_map(self, T_reference_before: Array, T_reference_after: Array) -> None:
        """Move the camera along with a keyframe (T_camera_world, (4, 4)) that the map has moved;
        `odom` stays where the camera sees it.
        """
        T_odom_camera = self.T_odom_camera
        T_at_keyframe, covariance = self._at_keyframe
        T_at_keyframe = T_at_keyframe @ invert(T_reference_before) @ T_reference_after
        self._at_keyframe = _without_drift(T_at_keyframe), covariance
        T_camera_reference = self.T_camera_world @ invert(T_reference_before)
        self.T_camera_world = _without_drift(T_camera_reference @ T_reference_after)
        self.T_world_odom = _without_drift(invert(self.T_camera_world) @ invert(T_odom_camera))

    def _measured(self, stamp_ns: int) -> RelativeMotion | None:
        """Return the motion since the last pose, by wheels or by an IMU alone, or none where the
        pose is held; asked for often.
        """
        stretch = self._last_stamp_ns, stamp_ns
        if self._latest is None or self._latest[0] != stretch:
            measured = self._body.between(*stretch)
            if measured is None:
                R_world_odom = self.T_world_odom[:3, :3]
                measured = self._body.felt(*stretch, self.T_odom_camera, R_world_odom)
            if measured is None and self._broken_off is not None:
                sigma = self._broken_off[1] * self._step_s(stamp_ns)
                measured = RelativeMotion(np.eye(4), sigma**2 * np.eye(6), 'nothing')
            self._latest = stretch, measured
        return self._latest[1]

    def _turned(self, stamp_ns: int) -> tuple[Array, float] | None:
        """Return the camera at its last place, turned on as a gyroscope tells, (4, 4), and the
        standard deviation of the turn in radians.
        """
        turn = self._body.turn(self._last_stamp_ns, stamp_ns)
        if turn is None:
            return None
        return make_transform(turn[0], np.zeros(3)) @ self.T_camera_world, turn[1]

    def _predicted(self, measured: RelativeMotion | None) -> tuple[Array, Array] | None:
        """Return where the sensors have the camera after a motion (4, 4), and the covariance."""
        if measured is None or self.is_lost:
            return None
        held = self._broken_off
        covariance = self.covariance if held is None else held[0].covariance
        return _moved((self.T_camera_world, covariance), measured)

    def _note(self, measured: RelativeMotion | None) -> None:
        """Add the motion of a frame to that since the last keyframe."""
        since = self._since_keyframe
        self._since_keyframe = since.then(measured) if since and measured else None

    def _step_s(self, stamp_ns: int) -> float:
        return max((stamp_ns - self._last_stamp_ns) * 1e-9, MIN_STEP_S)


def _moved(before: tuple[Array, Array], motion: RelativeMotion) -> tuple[Array, Array]:
    """Return a pose (4, 4) and its covariance (6, 6) after a motion."""
    A = adjoint(motion.T_now_before)
    return motion.T_now_before @ before[0], A @ before[1] @ A.T + motion.covariance


def sigma_m(covariance: Array) -> float:
    """Return the standard deviation of the place of a pose with a covariance (6, 6)."""
    return float(np.sqrt(np.diag(covariance)[:3].max()))


def _without_drift(T: Array) -> Array:
    """Return a product of poses (4, 4) with its rotation orthonormal again: `invert` transposes,
    so the rounding errors of repeated products would grow threefold each time.
    """
    return make_transform(Rotation.from_matrix(T[:3, :3]).as_matrix(), T[:3, 3])
