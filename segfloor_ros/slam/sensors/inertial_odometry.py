"""How the camera moves as an accelerometer feels it, where images and wheels tell nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from segfloor_ros.geometry import Array
from segfloor_ros.slam.sensors.gravity import GRAVITY_M_S2, Gravity
from segfloor_ros.slam.sensors.gyroscope import Gyroscope

SIGMA_SEEN_M = 0.003
"""Error of the place of a frame as the images tell it."""

FIRST_SPEED_SIGMA_M_S = 0.3
SIGMA_STEADY = 0.5
"""How much a speed that is taken for constant changes, m/s per root second."""

SIGMA_FELT = 0.01
"""Error of a speed that is felt, m/s per root second: noise and shaking."""

FIRST_ERROR_SIGMA_M_S2, ERROR_DRIFT = 0.1, 0.01
"""Error of what is felt once gravity is taken off, m/s², and its drift, m/s² per root second."""


@dataclass(frozen=True)
class Way:
    """A way (3,) in metres in the axes of odom, the variance of each of its components, and whether
    it was felt; else its speed is taken for constant.
    """

    moved_m: Array
    variance_m2: float
    is_felt: bool


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
    where no accelerometer is felt or gravity is unknown.
    """

    def __init__(self, gyroscope: Gyroscope, gravity: Gravity) -> None:
        self._gyroscope = gyroscope
        self._gravity = gravity
        self._state: _State | None = None

    def see(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Take in the pose of a frame that images or wheels tell."""
        predicted = self._predicted(stamp_ns, R_world_odom)
        if predicted is None:
            sigma = (SIGMA_SEEN_M, FIRST_SPEED_SIGMA_M_S, FIRST_ERROR_SIGMA_M_S2)
            mean = np.stack([T_odom_camera[:3, 3], np.zeros(3), np.zeros(3)])
            predicted = mean, np.diag(np.square(sigma))
        mean, P = predicted
        gain = P[:, 0] / (P[0, 0] + SIGMA_SEEN_M**2)
        mean = mean + np.outer(gain, T_odom_camera[:3, 3] - mean[0])
        P = P - np.outer(gain, P[0])
        self._state = _State(stamp_ns, T_odom_camera[:3, :3], mean, P)

    def carry(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Go on without a pose, as felt."""
        predicted = self._predicted(stamp_ns, R_world_odom)
        R_odom_camera = T_odom_camera[:3, :3]
        self._state = None if predicted is None else _State(stamp_ns, R_odom_camera, *predicted)

    def stop(self) -> None:
        """Note that nothing tells where the camera is."""
        self._state = None

    def way(self, stamp_ns: int, R_world_odom: Array) -> Way | None:
        """Return the way since the last frame; None where the IMU tells nothing."""
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
        felt = self._gyroscope.felt(before.stamp_ns, stamp_ns)
        if felt is None:
            return None
        s = (stamp_ns - before.stamp_ns) * 1e-9
        F = np.array([[1.0, s, -(s**2) / 2], [0.0, 1.0, -s], [0.0, 0.0, 1.0]])
        mean, P = before.mean, before.covariance
        lift = self._gravity.lift(R_world_odom @ before.R_odom_camera)
        if lift is None:
            known = np.array([1.0, 1.0, 0.0])
            P = P * np.outer(known, known) + np.diag([0.0, 0.0, FIRST_ERROR_SIGMA_M_S2**2])
            F[:2, 2] = 0.0
            grown = SIGMA_STEADY
        else:
            against = R_world_odom.T @ lift
            way = before.R_odom_camera @ felt.way - against * s**2 / 2
            mean = mean + np.stack([way, before.R_odom_camera @ felt.speed - against * s, 0 * way])
            grown = SIGMA_FELT
        error_variance = ERROR_DRIFT**2 * s + (GRAVITY_M_S2 * felt.sigma_rad) ** 2
        noise = np.diag([grown**2 * s**3 / 3, grown**2 * s, error_variance])
        noise[0, 1] = noise[1, 0] = grown**2 * s**2 / 2
        return F @ before.mean + (mean - before.mean), F @ P @ F.T + noise
