"""Wheel odometry: how far the base went between two times, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from segfloor_ros.core.contracts import WheelPose
from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import Array, invert, make_transform, rotation_from_angles
from segfloor_ros.core.plugins.sensors.gyroscope import (
    LATE_NS,
    STEP_NS,
    TimedSeries,
    is_late,
    lag_in_words,
)
from segfloor_ros.core.slam.rig import GATE, chi2_limit
from segfloor_ros.core.twists import between


class WheelOdometry:
    """The latest poses that the wheels measured."""

    def __init__(self) -> None:
        self._poses: TimedSeries[WheelPose] = TimedSeries(STEP_NS)

    def add(self, pose: WheelPose) -> None:
        """Take in a pose."""
        self._poses.add(pose)

    @property
    def latest(self) -> list[WheelPose]:
        """The poses of the last moment: a drive that was broken off goes on from them."""
        return self._poses.latest()

    def motion(self, before_ns: int, now_ns: int) -> Array | None:
        """Return T_before_now (4, 4) of the base; None where too little was measured."""
        before, now = self._at(before_ns), self._at(now_ns)
        return None if before is None or now is None else invert(before) @ now

    def stretch(self, before_ns: int, now_ns: int) -> Stretch | None:
        """Return what was measured between two times; None where too little was."""
        T_before_now = self.motion(before_ns, now_ns)
        if T_before_now is None:
            return None
        ends = [self.motion(end_ns - LATE_NS, end_ns) for end_ns in (before_ns, now_ns)]
        before, now = (np.eye(4) if end is None else end for end in ends)
        if any(end is None for end in ends):
            before = now = np.eye(4)
        x, y = T_before_now[:2, 3]
        swept = yaw_of(before) * np.array([-y, x])
        sped_up = T_before_now[:2, :2] @ now[:2, 3] - before[:2, 3] - swept
        turned_up = yaw_of(now) - yaw_of(before)
        return Stretch(T_before_now, sped_up * 1e9 / LATE_NS, turned_up * 1e9 / LATE_NS)

    def _at(self, stamp_ns: int) -> Array | None:
        poses = self._poses.window(stamp_ns, stamp_ns)
        if poses and poses[0].stamp_ns == stamp_ns:
            return poses[0].T_wheels_base
        if len(poses) < 2 or poses[0].stamp_ns > stamp_ns:
            return None
        one, other = poses
        share = (stamp_ns - one.stamp_ns) / max(other.stamp_ns - one.stamp_ns, 1)
        return between(one.T_wheels_base, other.T_wheels_base, share)


@dataclass(frozen=True)
class Stretch:
    """What wheels measured between two times: T_before_now (4, 4) of the base, and by how much it
    sped up meanwhile: (2,) in m/s in the axes of the beginning, and in rad/s.
    """

    T_before_now: Array
    speeding_up_m_s: Array
    turning_up_rad_s: float

    def without_lag(self, lag_s: float) -> Stretch:
        """Return what was measured had the stamps not been late."""
        turn = yaw_of(self.T_before_now) + lag_s * self.turning_up_rad_s
        way = self.T_before_now[:2, 3] + lag_s * self.speeding_up_m_s
        R = rotation_from_angles(turn, 0.0, 0.0)
        return replace(self, T_before_now=make_transform(R, np.append(way, 0.0)))


@dataclass(frozen=True)
class Window:
    """A stretch of the drive as the images see it: translation (2,) in metres in the base's plane
    and turn in radians, by how much the rate of the turn grew meanwhile, and what the wheels
    measure.
    """

    seen_m: Array
    seen_rad: float
    turning_up_rad_s: float
    measured: Stretch

    @property
    def measured_m(self) -> Array:
        """The translation (2,) that the wheels measure."""
        return np.asarray(self.measured.T_before_now[:2, 3])

    @property
    def measured_rad(self) -> float:
        """The turn that the wheels measure."""
        return yaw_of(self.measured.T_before_now)


KNOWN_M = 0.01
"""An offset of the camera on the base is believed once it is known so well."""


@dataclass(frozen=True)
class WheelCalibration:
    """What is wrong with wheel odometry. scale: metres measured per metre driven; turn_scale:
    radians measured per radian turned. yaw_rad, offset_m (2,): of the base as the camera's mount
    has it in the base whose motion the wheels measure. lag_s: by how much their stamps are later
    than those of the images. sigma: (6,) of scale, yaw, offset x, y, turn_scale and lag.
    """

    scale: float = 1.0
    yaw_rad: float = 0.0
    offset_m: tuple[float, float] = (0.0, 0.0)
    turn_scale: float = 1.0
    lag_s: float = 0.0
    sigma: tuple[float, ...] = (0.05, 0.05, 0.1, 0.1, 0.05, 0.02)

    def believed(self) -> WheelCalibration:
        """Return what the motion of the base is measured by: an offset only once that is known, for
        the slip of a first turn looks like one.
        """
        sigma_m = max(self.sigma[2:4])
        if sigma_m < KNOWN_M:
            return self
        sigma_m = float(np.hypot(sigma_m, np.hypot(*self.offset_m)))
        sigma = (*self.sigma[:2], sigma_m, sigma_m, *self.sigma[4:])
        return replace(self, offset_m=(0.0, 0.0), sigma=sigma)

    @property
    def lag_sigma_s(self) -> float:
        """The standard deviation of the lag."""
        return self.sigma[5]

    def base_motion(self, measured: Array, turn_rad: float | None) -> tuple[Array, float]:
        """Return translation (2,) and turn of the base of the camera's mount.

        measured: (4, 4) as the wheels measure it. turn_rad: as a gyroscope measures it, which is
        better.
        """
        measured_rad = yaw_of(measured) / self.turn_scale
        turn = measured_rad if turn_rad is None else turn_rad
        # The chord of an arc points half the turn to the side.
        way_m = rotation_2d((turn - yaw_of(measured)) / 2) @ measured[:2, 3] / self.scale
        lever_m = (rotation_2d(turn) - np.eye(2)) @ np.array(self.offset_m)
        return rotation_2d(-self.yaw_rad) @ (way_m + lever_m), turn

    def remarks(self) -> dict[str, str]:
        """Return in words what is wrong enough, and known well enough, to be said."""
        scale_sigma, yaw_sigma, *offset_sigma, turn_sigma, lag_sigma = self.sigma
        said = {}
        if abs(self.scale - 1) > max(0.02, 3 * scale_sigma):
            said['scale'] = (
                f'wheel odometry measures {self.scale:.3f} m for each metre that the images show; '
                'correct the radius of the wheels, or if it is right the baseline of the cameras '
                f'(depth_scale of a depth camera), to {self.scale:.3f} of what it is'
            )
        if abs(self.turn_scale - 1) > max(0.03, 3 * turn_sigma):
            said['turn_scale'] = (
                f'wheel odometry measures {self.turn_scale:.3f} rad for each radian turned; '
                'correct the track of the wheels'
            )
        if abs(self.yaw_rad) > max(np.radians(1.0), 3 * yaw_sigma):
            side = 'left' if self.yaw_rad > 0 else 'right'
            said['yaw'] = (
                f'the camera looks {np.degrees(abs(self.yaw_rad)):.1f} deg further to the {side} '
                'of the way of the wheels than its mount says'
            )
        if any(abs(v) > max(0.05, 3 * s) for v, s in zip(self.offset_m, offset_sigma, strict=True)):
            x, y = self.offset_m
            said['offset'] = (
                f'the camera is {x:+.2f} m ahead and {y:+.2f} m to the left of where its mount '
                'has it on the base of the wheels'
            )
        if is_late(self.lag_s, lag_sigma):
            said['lag'] = lag_in_words('wheel odometry', self.lag_s)
        return said


MAX_WINDOWS = 300
SIGMA_REST_M, SIGMA_ROOT_M = 0.003, 0.01
"""Error of the way of a stretch: at rest, and per root metre."""

SIGMA_REST_RAD, SIGMA_ROOT_RAD = 0.003, 0.02
"""Error of the turn: at rest, and per root metre or radian; a floor tilts by as much, and goes up
as a way errs."""

HALF_TRACK_M = 0.25
"""Wheels go about so far for each radian that the base turns on the spot."""

ROUNDS = 4


class WheelCalibrator:
    """Estimates what is wrong with wheel odometry from stretches that the images show, too.

    With the base's motion (R, t) as seen and t' as measured, t' = s R(yaw) t - (R - I) s x: linear
    in s cos(yaw), s sin(yaw) and s x (after Censi et al., Simultaneous calibration of odometry and
    sensor parameters for mobile robots, IEEE T-RO 2013), and in the lag of the stamps. Stretches
    with slip are outliers, whose weight falls with their error (Geman-McClure).
    """

    def __init__(self) -> None:
        self.current = WheelCalibration()
        self._equations: list[Array] = []

    def __len__(self) -> int:
        return len(self._equations)

    def add(self, window: Window) -> bool:
        """Take in a stretch; returns whether it agrees with the others: the wheels did not slip."""
        agrees = self._chi2(window) < chi2_limit(1, GATE)
        self._equations = [*self._equations, _equations(window)][-MAX_WINDOWS:]
        self.current = self._solved()
        return agrees

    def _chi2(self, window: Window) -> float:
        """Return the squared, normalised error of the way and the turn that the wheels measure."""
        measured = window.measured.without_lag(self.current.lag_s).T_before_now
        way_m, turn_rad = self.current.base_motion(measured, None)
        length_m = float(np.linalg.norm(window.seen_m))
        unsure_m = length_m * self.current.sigma[0]
        sigma_m, _, sigma_rad = _sigmas(window)
        way = np.linalg.norm(way_m - window.seen_m) / np.hypot(sigma_m, unsure_m)
        unsure_rad = abs(window.seen_rad) * self.current.sigma[4]
        unsure_rad += abs(window.measured.turning_up_rad_s) * self.current.lag_sigma_s
        turn = (turn_rad - window.seen_rad) / np.hypot(sigma_rad, unsure_rad)
        return float(max(way, abs(turn)) ** 2)

    def _solved(self) -> WheelCalibration:
        first = WheelCalibration().sigma
        rows = np.concatenate(self._equations)
        prior = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        (a, b, y0, y1, turn_scale, lag_s), sigma = _robust(
            rows[:, :-1], rows[:, -1], prior, np.array(first)
        )
        scale = float(np.hypot(a, b))
        offset_m = (float(y0) / scale, float(y1) / scale)
        yaw_rad = float(np.arctan2(b, a))
        return WheelCalibration(
            scale, yaw_rad, offset_m, float(turn_scale), float(lag_s), tuple(sigma.tolist())
        )


def _equations(window: Window) -> Array:
    """Return the normalised equations (3, 7) of way and turn of a stretch: the factors of s
    cos(yaw), s sin(yaw), s x, turn scale and lag, and what the wheels measure.
    """
    x, y = window.seen_m
    rows = np.zeros((3, 7))
    rows[:2, :2] = [[x, -y], [y, x]]
    rows[:2, 2:4] = np.eye(2) - rotation_2d(window.seen_rad)
    rows[2, 4] = window.seen_rad
    # Only turns show a lag: the way that the images see is a little too long or too short.
    rows[2, 5] = -window.turning_up_rad_s
    rows[:, 6] = np.append(window.measured_m, window.measured_rad)
    return rows / _sigmas(window)[:, None]


def _sigmas(window: Window) -> Array:
    way_m = SIGMA_REST_M + SIGMA_ROOT_M * float(np.sqrt(wheels_m(window.measured.T_before_now)))
    turn_rad = SIGMA_REST_RAD + SIGMA_ROOT_RAD * float(np.sqrt(abs(window.measured_rad)))
    return np.array([way_m, way_m, turn_rad])


def _robust(rows: Array, measured: Array, prior: Array, sigma: Array) -> tuple[Array, Array]:
    """Solve weighted least squares with a prior, outliers weighed down; returns solution and
    standard deviations.
    """
    known = np.diag(sigma**-2)

    def linearise(solution: Array, _: int) -> tuple[Array, Array, None]:
        error = measured - rows @ solution
        weight = 1 / (1 + error**2 / chi2_limit(1, GATE)) ** 2
        weighted = rows.T * weight
        return known + weighted @ rows, known @ (prior - solution) + weighted @ error, None

    solution, information, _ = gauss_newton(prior, linearise, range(ROUNDS), np.add)
    return solution, np.sqrt(np.diag(np.linalg.inv(information)))


def wheels_m(T_before_now: Array) -> float:
    """Return how far the wheels have gone in a motion (4, 4) of the base, which is how they err."""
    return float(np.linalg.norm(T_before_now[:3, 3])) + HALF_TRACK_M * abs(yaw_of(T_before_now))


def rotation_2d(angle_rad: float) -> Array:
    """Return the matrix (2, 2) of a rotation in the plane."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def yaw_of(T: Array) -> float:
    """Return the rotation of a transform (4, 4) about z in radians."""
    return float(np.arctan2(T[1, 0], T[0, 0]))
