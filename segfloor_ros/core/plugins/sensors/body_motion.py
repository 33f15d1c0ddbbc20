"""The motion of the camera between two frames as wheels and gyroscope measure it."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np

from segfloor_ros.core.contracts import Measurement, RelativeMotion, Up, WheelPose
from segfloor_ros.core.geometry import Array, invert, make_transform, rotation_from_angles
from segfloor_ros.core.plugins.sensors.gyroscope import MOMENT_NS, Gyroscope
from segfloor_ros.core.plugins.sensors.inertial_odometry import Gravity, InertialOdometry
from segfloor_ros.core.plugins.sensors.wheel_odometry import (
    SIGMA_ROOT_M,
    SIGMA_ROOT_RAD,
    Stretch,
    WheelCalibration,
    WheelCalibrator,
    WheelOdometry,
    Window,
    wheels_m,
    yaw_of,
)
from segfloor_ros.core.slam.thresholds import ENOUGH, SPEED_SIGMA
from segfloor_ros.core.twists import adjoint, is_within

SIGMA_TURN_SHARE = 0.03
"""Error of a turn measured by wheels, as a share of it."""

AT_REST = 1e-4, 1e-4
"""The base stands where its wheels turn by less, in metres and radians, between two frames."""

WINDOW = 0.1, 0.1
"""A stretch of the drive to learn from ends after so many metres or radians, or a moment."""

SLIP_REMARK = 'wheel odometry and images disagreed; the wheels slip, or the images show what moves'

logger = logging.getLogger(__name__)


class BodyMotion:
    """Measures the motion between frames, and learns from the images what is wrong with the
    sensors.

    T_base_left: (4, 4), the mount; without it wheels cannot be used. messages: used, by sensor.
    slips: stretches in which the wheels did not agree with the images. remarks: what seems wrong
    with wheels and IMU, in words.
    """

    def __init__(self) -> None:
        self.T_base_left: Array | None = None
        self.messages = {'wheel_odometry': 0, 'imu': 0}
        self._dropped = dict.fromkeys(self.messages, 0)
        self.slips = 0
        self.remarks: dict[str, str] = {}
        self.gyroscope = Gyroscope()
        self.gravity = Gravity(self.gyroscope)
        self._inertial = InertialOdometry(self.gyroscope, self.gravity)
        self._wheels = WheelOdometry()
        self._calibrator = WheelCalibrator()
        self._window: tuple[int, Array] | None = None
        self._window_rate_rad_s = math.nan
        self._last_seen: tuple[int, Array] | None = None
        self._slipped_ns: int | None = None
        self._stood_ns = -1

    def add(self, measurement: Measurement) -> None:
        """Take in what a sensor measured; what is no measurement is dropped and counted."""
        name = 'wheel_odometry' if isinstance(measurement, WheelPose) else 'imu'
        if not is_sound(measurement):
            self._dropped[name] += 1
            words = f'{name}: messages without finite numbers, dropped: {self._dropped[name]}'
            self.remark({f'dropped {name}': words})
            return
        self.messages[name] += 1
        if isinstance(measurement, WheelPose):
            self._wheels.add(measurement)
        else:
            self.gyroscope.add(measurement)

    @property
    def latest_wheels(self) -> list[WheelPose]:
        """The last poses that the wheels measured: enough for the motion since."""
        return self._wheels.latest

    @property
    def up_world(self) -> Up | None:
        """Up in the world, as the accelerometer has it; None before enough is known."""
        return self.gravity.up_world

    def up_camera(self, T_odom_camera: Array) -> Up | None:
        """Return up in the camera's axes as the latest measurement has it, given out once."""
        return self.gravity.up_camera(T_odom_camera)

    def turn(self, before_ns: int, now_ns: int) -> tuple[Array, float] | None:
        """Return R_now_before (3, 3) of the camera as the gyroscope measures it, and the standard
        deviation of its angles in radians.
        """
        turn = self.gyroscope.turn(before_ns, now_ns)
        return None if turn is None else (turn[0].T, turn[1])

    @property
    def lag_ns(self) -> int:
        """How much later than that of an image the stamps of what is measured at its time are."""
        return max(0, round(1e9 * max(self.gyroscope.lag_s, self._calibrator.current.lag_s)))

    def between(self, before_ns: int, now_ns: int) -> RelativeMotion | None:
        """Return the motion of the camera between two times; None where wheels measure nothing."""
        lag_ns = round(self._calibrator.current.lag_s * 1e9)
        measured = self._wheels.stretch(before_ns + lag_ns, now_ns + lag_ns)
        if measured is None or self.T_base_left is None:
            return None
        if is_within(measured.T_before_now, AT_REST) and before_ns >= self._stood_ns:
            # Also of a frame in which the images show nothing; each is asked for several times.
            self.gyroscope.learn(np.eye(3), before_ns, now_ns, 0.0)
            self._stood_ns = now_ns
        R_base_left = self.T_base_left[:3, :3]
        seconds = (now_ns - before_ns) * 1e-9
        turn = self.gyroscope.turn(before_ns, now_ns)
        R: Array | None = None if turn is None else R_base_left @ turn[0] @ R_base_left.T
        calibration = self._calibrator.current.believed()
        way_m, turn_rad = calibration.base_motion(
            measured.T_before_now, None if R is None else yaw_of(R)
        )
        if R is None:
            R = rotation_from_angles(turn_rad, 0.0, 0.0)
        T_before_now = make_transform(R, np.append(way_m, 0.0))
        variance = _variance(measured, calibration, None if turn is None else turn[1])
        if self._slipped_ns is not None and before_ns < self._slipped_ns + MOMENT_NS:
            variance[:2] += (SPEED_SIGMA * seconds) ** 2
        A = adjoint(invert(self.T_base_left))
        return RelativeMotion(
            invert(self.T_base_left) @ invert(T_before_now) @ self.T_base_left,
            A @ np.diag(variance) @ A.T,
        )

    def learn(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Learn from the pose of a frame that the images show well."""
        self.gravity.see(stamp_ns, T_odom_camera, R_world_odom)
        self._inertial.see(stamp_ns, T_odom_camera, R_world_odom)
        rate_before, rate_rad_s = self._window_rate_rad_s, self._turn_rate(stamp_ns, T_odom_camera)
        if self._window is None:
            self._window, self._window_rate_rad_s = (stamp_ns, T_odom_camera), rate_rad_s
            return
        before_ns, T_odom_before = self._window
        T_before_now = invert(T_odom_before) @ T_odom_camera
        if is_within(T_before_now, WINDOW) and stamp_ns - before_ns < MOMENT_NS:
            return
        self._window, self._window_rate_rad_s = (stamp_ns, T_odom_camera), rate_rad_s
        self.gyroscope.learn(T_before_now[:3, :3], before_ns, stamp_ns)
        self.remark(self.gyroscope.remarks())
        turning_up = 0.0 if math.isnan(rate_before) else rate_rad_s - rate_before
        self._learn_wheels(T_before_now, before_ns, stamp_ns, turning_up)

    def _turn_rate(self, stamp_ns: int, T_odom_camera: Array) -> float:
        """Return how fast the base turns as the last two frames see it, NaN after one."""
        before, self._last_seen = self._last_seen, (stamp_ns, T_odom_camera)
        if before is None or self.T_base_left is None:
            return math.nan
        turned = self.T_base_left[:3, :3] @ before[1][:3, :3].T @ T_odom_camera[:3, :3]
        return yaw_of(turned @ self.T_base_left[:3, :3].T) * 1e9 / max(stamp_ns - before[0], 1)

    def by_inertia(
        self, before_ns: int, now_ns: int, T_odom_before: Array, R_world_odom: Array
    ) -> RelativeMotion | None:
        """Return the motion of the camera since the last pose as an IMU alone measures it."""
        turn, way = self.turn(before_ns, now_ns), self._inertial.way(now_ns, R_world_odom)
        if turn is None or way is None:
            return None
        R_now_before, sigma_rad = turn
        moved_m = -R_now_before @ T_odom_before[:3, :3].T @ way.moved_m
        variance = np.array([way.variance_m2] * 3 + [sigma_rad**2] * 3)
        return RelativeMotion(
            make_transform(R_now_before, moved_m),
            np.diag(variance),
            'IMU' if way.is_measured else 'gyroscope',
        )

    def carry(
        self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array, on_wheels: bool
    ) -> None:
        """Note the pose of a frame that no image shows, but wheels or an IMU alone."""
        self._window = self._last_seen = None
        if on_wheels:
            self.gravity.see(stamp_ns, T_odom_camera, R_world_odom)
            self._inertial.see(stamp_ns, T_odom_camera, R_world_odom)
        else:
            self._inertial.carry(stamp_ns, T_odom_camera, R_world_odom)

    def reset(self) -> None:
        """Begin anew after a frame without a pose; what is known of the sensors stays."""
        self._window = self._last_seen = None
        self.gravity.reset()
        self._inertial.reset()

    def reset_world(self) -> None:
        """Forget where up is: the world is another one."""
        self.gravity = Gravity(self.gyroscope)
        self._inertial = InertialOdometry(self.gyroscope, self.gravity)

    def _learn_wheels(
        self, T_before_now: Array, before_ns: int, now_ns: int, turning_up_rad_s: float
    ) -> None:
        measured = self._wheels.stretch(before_ns, now_ns)
        if measured is None or self.T_base_left is None:
            return
        seen = self.T_base_left @ T_before_now @ invert(self.T_base_left)
        window = Window(seen[:2, 3], yaw_of(seen), turning_up_rad_s, measured)
        if not self._calibrator.add(window):
            self.slips += 1
            in_a_row = self._slipped_ns is not None and before_ns < self._slipped_ns + MOMENT_NS
            self._slipped_ns = now_ns
            logger.info('wheel odometry and images disagree at %.3f s', now_ns / 1e9)
            if in_a_row:
                self.remark({'slip': SLIP_REMARK})
        if len(self._calibrator) >= ENOUGH:  # the slip of a few is not worth a word
            self.remark(self._calibrator.current.remarks())

    def remark(self, remarks: Mapping[str, str]) -> None:
        """Say each thing that is wrong once."""
        for what, remark in remarks.items():
            if what not in self.remarks:
                logger.warning('%s', remark)
            self.remarks[what] = remark


def _variance(measured: Stretch, calibration: WheelCalibration, sigma_turn: float | None) -> Array:
    """Return the variances (6,) of a motion in the base's axes."""
    length_m, turn_rad = wheels_m(measured.T_before_now), yaw_of(measured.T_before_now)
    on_floor = (SIGMA_ROOT_M**2 + calibration.sigma[0] ** 2) * length_m
    on_floor += (2 * np.sin(turn_rad / 2) * max(calibration.sigma[2:4])) ** 2
    on_floor += float(calibration.lag_sigma_s * np.linalg.norm(measured.speeding_up_m_s)) ** 2
    up = SIGMA_ROOT_M**2 * length_m
    tilt = SIGMA_ROOT_RAD**2 * length_m
    yaw = SIGMA_ROOT_RAD**2 * length_m + (SIGMA_TURN_SHARE * turn_rad) ** 2
    yaw += (calibration.lag_sigma_s * measured.turning_up_rad_s) ** 2
    if sigma_turn is not None:
        tilt = yaw = sigma_turn**2
    return np.array([on_floor, on_floor, up, tilt, tilt, yaw]) + 1e-10


def is_sound(measurement: Measurement) -> bool:
    """Whether all that was measured are numbers that can be reckoned with: finite, as their squares
    are.
    """
    if isinstance(measurement, WheelPose):
        values = measurement.T_wheels_base
    else:
        values = np.concatenate([measurement.gyro_rad_s, measurement.accel_m_s2])
    with np.errstate(over='ignore', invalid='ignore'):
        return bool(np.isfinite(np.square(values.astype(np.float32))).all())
