"""How the camera moves by an accelerometer, where images and wheels show nothing.

Where up is, by an accelerometer.

What it measures is integrated twice between three poses that the images show (preintegration;
Forster et al., On-Manifold Preintegration, IEEE T-RO 2017). The speeds drop out, as in the
alignment of Qin et al., VINS-Mono, IEEE T-RO 2018, section V-B: no acceleration of the robot is
taken for gravity.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from segfloor_ros.core.contracts import UNKNOWN_COVARIANCE, Up
from segfloor_ros.core.geometry import Array, rotation_angle
from segfloor_ros.core.plugins.sensors.gyroscope import MOMENT_NS, SIGMA_SEEN_M, STEP_NS, Gyroscope
from segfloor_ros.core.slam.rig import is_gated
from segfloor_ros.core.slam.thresholds import PROOF, SPEED_SIGMA

SIGMA_INTEGRATED = 0.01
"""Error of a speed that is integrated, m/s per root second: noise and shaking."""

FIRST_ERROR_SIGMA_M_S2, ERROR_DRIFT = 0.1, 0.01
"""Error of the acceleration freed of gravity, m/s², and its drift, m/s² per root second."""

MAX_TURN_RAD = 0.5
"""Turn between two of the poses: in a fast one the IMU measures its own circle."""

SIGMA_LIFT_M_S2 = 0.08
"""Error of what is found of three poses: of their places and of the camera's shaking."""

SIGMA_BIAS_M_S2 = 0.2
"""Bias of a cheap accelerometer."""

GRAVITY_M_S2, MAX_OFF_M_S2 = 9.81, 1.0
"""An accelerometer with another gravity measures something else, or nothing."""


@dataclass(frozen=True)
class Way:
    """A way (3,) in metres in the axes of odom, the variance of each of its components, and whether
    it was measured; else its speed is taken for constant.
    """

    moved_m: Array
    variance_m2: float
    is_measured: bool


@dataclass(frozen=True)
class _State:
    """mean: place, speed and error of the acceleration (3, 3), a row each, in the axes of odom;
    covariance: (3, 3) of them, the same along each axis.
    """

    stamp_ns: int
    R_odom_camera: Array
    mean: Array
    covariance: Array


class InertialOdometry:
    """A Kalman filter of place, speed and error of the acceleration; speed is taken for constant
    where there is no accelerometer or gravity is unknown.
    """

    def __init__(self, gyroscope: Gyroscope, gravity: Gravity) -> None:
        self._gyroscope = gyroscope
        self._gravity = gravity
        self._state: _State | None = None

    def see(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Take in the pose of a frame that images or wheels show."""
        predicted = self._predicted(stamp_ns, R_world_odom)
        if predicted is None:
            sigma = (SIGMA_SEEN_M, SPEED_SIGMA, FIRST_ERROR_SIGMA_M_S2)
            mean = np.stack([T_odom_camera[:3, 3], np.zeros(3), np.zeros(3)])
            predicted = mean, np.diag(np.square(sigma))
        mean, P = predicted
        gain = P[:, 0] / (P[0, 0] + SIGMA_SEEN_M**2)
        mean = mean + np.outer(gain, T_odom_camera[:3, 3] - mean[0])
        P = P - np.outer(gain, P[0])
        self._state = _State(stamp_ns, T_odom_camera[:3, :3], mean, P)

    def carry(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Go on without a pose, as predicted."""
        predicted = self._predicted(stamp_ns, R_world_odom)
        R_odom_camera = T_odom_camera[:3, :3]
        self._state = None if predicted is None else _State(stamp_ns, R_odom_camera, *predicted)

    def reset(self) -> None:
        """Forget the latest pose and speed."""
        self._state = None

    def way(self, stamp_ns: int, R_world_odom: Array) -> Way | None:
        """Return the way since the last frame; None where the IMU measures nothing."""
        predicted = self._predicted(stamp_ns, R_world_odom)
        if predicted is None or self._state is None:
            return None
        (place, _, _), P = predicted
        grown = P[0, 0] - self._state.covariance[0, 0]
        moved_m = place - self._state.mean[0]
        return Way(moved_m, max(float(grown), 0.0), self._gravity.up_world is not None)

    def _predicted(self, stamp_ns: int, R_world_odom: Array) -> tuple[Array, Array] | None:
        """Return mean and covariance at a time."""
        before = self._state
        if before is None or stamp_ns <= before.stamp_ns:
            return None
        integrated = self._gyroscope.preintegrated(before.stamp_ns, stamp_ns)
        if integrated is None:
            return None
        s = (stamp_ns - before.stamp_ns) * 1e-9
        F = np.array([[1.0, s, -(s**2) / 2], [0.0, 1.0, -s], [0.0, 0.0, 1.0]])
        mean, P = before.mean, before.covariance
        lift = self._gravity.lift(R_world_odom @ before.R_odom_camera)
        if lift is None:
            known = np.array([1.0, 1.0, 0.0])
            P = P * np.outer(known, known) + np.diag([0.0, 0.0, FIRST_ERROR_SIGMA_M_S2**2])
            F[:2, 2] = 0.0
            grown = SPEED_SIGMA
        else:
            against = R_world_odom.T @ lift
            way = before.R_odom_camera @ integrated.way - against * s**2 / 2
            speed = before.R_odom_camera @ integrated.speed - against * s
            mean = mean + np.stack([way, speed, 0 * way])
            grown = SIGMA_INTEGRATED
        error_variance = ERROR_DRIFT**2 * s + (GRAVITY_M_S2 * integrated.sigma_rad) ** 2
        noise = np.diag([grown**2 * s**3 / 3, grown**2 * s, error_variance])
        noise[0, 1] = noise[1, 0] = grown**2 * s**2 / 2
        return F @ before.mean + (mean - before.mean), F @ P @ F.T + noise


class Gravity:
    """Estimates where up is in the world, and how the camera stands to it.

    The lift L in world axes and the bias b in the camera's are what the measurements y = L + R b
    fit best (recursive least squares): they are separated where the camera turns.
    """

    def __init__(self, gyroscope: Gyroscope) -> None:
        self._gyroscope = gyroscope
        self._poses: deque[tuple[int, Array]] = deque(maxlen=3)
        self._latest: tuple[Array, Array, Array] | None = None
        self._measured = 0
        self._state: Array = np.zeros(6)
        variance = np.repeat([UNKNOWN_COVARIANCE, SIGMA_BIAS_M_S2**2], 3)
        self._covariance: Array = np.diag(variance)

    @property
    def up_world(self) -> Up | None:
        """Up in the world, None before enough is known."""
        return _up(self._state[:3], self._covariance[:3, :3]) if self._is_known else None

    @property
    def _is_known(self) -> bool:
        off_m_s2 = abs(float(np.linalg.norm(self._state[:3])) - GRAVITY_M_S2)
        return self._measured >= PROOF and off_m_s2 < MAX_OFF_M_S2

    def lift(self, R_world_camera: Array) -> Array | None:
        """Return what is measured at rest (3,), in axes of the world; None before enough is
        known.
        """
        return _design(R_world_camera) @ self._state if self._is_known else None

    def up_camera(self, T_odom_camera: Array) -> Up | None:
        """Return up in the camera's axes as the latest measurement has it, which is given out once.
        sigma_rad: of its difference to `up_world`.
        """
        latest, self._latest = self._latest, None
        if latest is None or not self._is_known:
            return None
        lift_world, R_world_measured, R_world_odom = latest
        R_camera_world = (R_world_odom @ T_odom_camera[:3, :3]).T
        # The bias is that of the axes in which it was measured; the camera may have turned since.
        H = R_camera_world @ _design(R_world_measured)
        covariance = H @ self._covariance @ H.T + SIGMA_LIFT_M_S2**2 * np.eye(3)
        lift = R_camera_world @ (lift_world - R_world_measured @ self._state[3:])
        return _up(lift, covariance)

    def see(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Take in the pose of a frame that images or wheels show."""
        if self._poses and stamp_ns - self._poses[-1][0] < STEP_NS:
            return
        if self._poses and stamp_ns - self._poses[-1][0] > MOMENT_NS:
            self.reset()
        self._poses.append((stamp_ns, T_odom_camera))
        lift_odom = self._lift()
        if lift_odom is None:
            return
        R_world_camera = R_world_odom @ self._poses[1][1][:3, :3]
        lift_world = R_world_odom @ lift_odom
        if self._learn(lift_world, _design(R_world_camera)):
            self._latest = lift_world, R_world_camera, R_world_odom

    def reset(self) -> None:
        """Forget the latest poses; what is known of gravity stays."""
        self._poses.clear()

    def _lift(self) -> Array | None:
        """Return what carries the camera against gravity (3,), in axes of odom, from the last three
        poses; None where they are too few or the IMU measures too little.
        """
        if len(self._poses) < 3:
            return None
        (t0, T0), (t1, T1), (t2, T2) = self._poses
        first, then = self._gyroscope.preintegrated(t0, t1), self._gyroscope.preintegrated(t1, t2)
        if first is None or then is None:
            return None
        if max(rotation_angle(one.turn) for one in (first, then)) > MAX_TURN_RAD:
            return None
        a, b = (t1 - t0) * 1e-9, (t2 - t1) * 1e-9
        R0, R1 = T0[:3, :3], T1[:3, :3]
        p0, p1, p2 = (T[:3, 3] for T in (T0, T1, T2))
        moved = (p2 - p1) - (b / a) * (p1 - p0)
        integrated = R1 @ then.way + R0 @ (b * first.speed - (b / a) * first.way)
        return np.asarray((integrated - moved) / (b * (a + b) / 2))

    def _learn(self, lift: Array, H: Array) -> bool:
        """Take in a measurement of L + R b; returns whether it agrees with those before."""
        P, noise = self._covariance, SIGMA_LIFT_M_S2**2 * np.eye(3)
        error, S = lift - H @ self._state, H @ self._covariance @ H.T + noise
        if not is_gated(error, S):
            return False
        gain = P @ H.T @ np.linalg.inv(S)
        self._state = self._state + gain @ error
        self._covariance = P - gain @ S @ gain.T
        self._measured += 1
        return True


def _design(R_world_camera: Array) -> Array:
    return np.hstack([np.eye(3), R_world_camera])


def _up(lift: Array, covariance: Array) -> Up:
    length = float(np.linalg.norm(lift))
    direction = lift / length
    across = np.eye(3) - np.outer(direction, direction)
    variance = float(np.linalg.eigvalsh(across @ covariance @ across)[-1])
    return Up(direction, float(np.sqrt(variance)) / length)
