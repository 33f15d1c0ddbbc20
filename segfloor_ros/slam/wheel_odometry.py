"""Wheel odometry: how far the base went between two times, and what is wrong with what it tells."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.frames import between
from segfloor_ros.geometry import Array, invert, make_transform
from segfloor_ros.measurements import WheelPose

HISTORY = 2000
MAX_GAP_NS = 500_000_000
MAX_AHEAD_NS = 100_000_000
"""Messages may be so late; until then the base is taken to go on as it did."""

RESTART_NS = 1_000_000_000
"""Stamps that jump back by more begin a new recording."""


class WheelOdometry:
    """The latest poses that the wheels told."""

    def __init__(self) -> None:
        self._poses: list[WheelPose] = []

    def add(self, pose: WheelPose) -> None:
        """Take in a pose; one that comes late is put where it belongs."""
        if self._poses and pose.stamp_ns < self._poses[-1].stamp_ns - RESTART_NS:
            self._poses.clear()
        insort(self._poses, pose, key=_stamp)
        if len(self._poses) > 2 * HISTORY:
            del self._poses[:-HISTORY]

    def motion(self, before_ns: int, now_ns: int) -> Array | None:
        """Return T_before_now (4, 4) of the base as told; None where too little was told."""
        before, now = self._at(before_ns), self._at(now_ns)
        return None if before is None or now is None else invert(before) @ now

    def _at(self, stamp_ns: int) -> Array | None:
        place = bisect_left(self._poses, stamp_ns, key=_stamp)
        if place < len(self._poses) and self._poses[place].stamp_ns == stamp_ns:
            return self._poses[place].T_wheels_base
        if place == 0 or len(self._poses) < 2:
            return None
        if place == len(self._poses):
            if stamp_ns - self._poses[-1].stamp_ns > MAX_AHEAD_NS:
                return None
            place -= 1
        one, other = self._poses[place - 1 : place + 1]
        if other.stamp_ns - one.stamp_ns > MAX_GAP_NS:
            return None
        share = (stamp_ns - one.stamp_ns) / max(other.stamp_ns - one.stamp_ns, 1)
        return between(one.T_wheels_base, other.T_wheels_base, share)


def _stamp(pose: WheelPose) -> int:
    return pose.stamp_ns


@dataclass(frozen=True)
class Window:
    """A stretch of the drive as the images and the wheels tell it: translations (2,) in metres in
    the base's plane, and turns in radians.
    """

    seen_m: Array
    seen_rad: float
    told_m: Array
    told_rad: float


@dataclass(frozen=True)
class WheelCalibration:
    """What is wrong with wheel odometry. scale: metres told per metre driven; turn_scale: radians
    told per radian turned. yaw_rad, offset_m (2,): of the base as the camera's mount has it in the
    base whose motion the wheels tell. sigma: (6,) of scale, yaw, offset x, y and turn_scale.
    """

    scale: float = 1.0
    yaw_rad: float = 0.0
    offset_m: tuple[float, float] = (0.0, 0.0)
    turn_scale: float = 1.0
    sigma: tuple[float, ...] = (0.05, 0.05, 0.1, 0.1, 0.05)

    def base_motion(self, told: Array, turn_rad: float | None) -> tuple[Array, float]:
        """Return translation (2,) and turn of the base of the camera's mount.

        told: (4, 4) as the wheels tell it. turn_rad: as a gyroscope tells it, which is better.
        """
        told_rad = yaw_of(told) / self.turn_scale
        turn = told_rad if turn_rad is None else turn_rad
        # The chord of an arc points half the turn to the side.
        way_m = rotation_2d((turn - yaw_of(told)) / 2) @ told[:2, 3] / self.scale
        lever_m = (rotation_2d(turn) - np.eye(2)) @ np.array(self.offset_m)
        return rotation_2d(-self.yaw_rad) @ (way_m + lever_m), turn

    def remarks(self) -> dict[str, str]:
        """Return in words what is wrong enough, and known well enough, to be said."""
        scale_sigma, yaw_sigma, *offset_sigma, turn_sigma = self.sigma
        said = {}
        if abs(self.scale - 1) > max(0.02, 3 * scale_sigma):
            said['scale'] = (
                f'wheel odometry tells {self.scale:.3f} m for each metre driven; correct the '
                'radius of the wheels'
            )
        if abs(self.turn_scale - 1) > max(0.03, 3 * turn_sigma):
            said['turn_scale'] = (
                f'wheel odometry tells {self.turn_scale:.3f} rad for each radian turned; correct '
                'the track of the wheels'
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
        return said


MAX_WINDOWS = 300
SIGMA_REST_M, SIGMA_ROOT_M = 0.003, 0.01
"""Error of the way of a stretch: at rest, and per root metre."""

SIGMA_REST_RAD, SIGMA_ROOT_RAD = 0.003, 0.02
OUTLIER_CHI2 = 9.0
ROUNDS = 4


class WheelCalibrator:
    """Estimates what is wrong with wheel odometry from stretches that the images tell, too.

    With the base's motion (R, t) as seen and t' as told, t' = s R(yaw) t - (R - I) s x: linear in
    s cos(yaw), s sin(yaw) and s x (after Censi et al., Simultaneous calibration of odometry and
    sensor parameters for mobile robots, IEEE T-RO 2013). Stretches with slip are outliers, whose
    weight falls with their error (Geman-McClure).
    """

    def __init__(self) -> None:
        self.current = WheelCalibration()
        self._windows: list[Window] = []

    def __len__(self) -> int:
        return len(self._windows)

    def add(self, window: Window) -> bool:
        """Take in a stretch; returns whether it agrees with the others: the wheels did not slip."""
        agrees = self._chi2(window) < OUTLIER_CHI2
        self._windows = [*self._windows, window][-MAX_WINDOWS:]
        self.current = self._solved()
        return agrees

    def _chi2(self, window: Window) -> float:
        """Return the squared, normalised error of the way and the turn that the wheels tell."""
        told = make_transform(
            Rotation.from_rotvec([0.0, 0.0, window.told_rad]).as_matrix(),
            np.append(window.told_m, 0.0),
        )
        way_m, turn_rad = self.current.base_motion(told, None)
        length_m = float(np.linalg.norm(window.seen_m))
        unsure_m = length_m * self.current.sigma[0]
        way = np.linalg.norm(way_m - window.seen_m) / np.hypot(_sigma_m(window), unsure_m)
        unsure_rad = abs(window.seen_rad) * self.current.sigma[-1]
        turn = (turn_rad - window.seen_rad) / np.hypot(_sigma_rad(window), unsure_rad)
        return float(max(way, abs(turn)) ** 2)

    def _solved(self) -> WheelCalibration:
        rows = np.concatenate([_way_rows(w) / _sigma_m(w) for w in self._windows])
        told = np.concatenate([w.told_m / _sigma_m(w) for w in self._windows])
        turns = np.array([[w.seen_rad / _sigma_rad(w)] for w in self._windows])
        told_turns = np.array([w.told_rad / _sigma_rad(w) for w in self._windows])
        first = WheelCalibration().sigma
        (a, b, y0, y1), way_sigma = _robust(
            rows, told, np.array([1.0, 0.0, 0.0, 0.0]), np.array(first[:4])
        )
        (turn_scale,), turn_sigma = _robust(turns, told_turns, np.array([1.0]), np.array(first[4:]))
        scale = float(np.hypot(a, b))
        sigma = (*way_sigma.tolist(), *turn_sigma.tolist())
        offset_m = (float(y0) / scale, float(y1) / scale)
        return WheelCalibration(scale, float(np.arctan2(b, a)), offset_m, float(turn_scale), sigma)


def _way_rows(window: Window) -> Array:
    """Return the rows (2, 4) for s cos(yaw), s sin(yaw) and s x of the equation of a stretch."""
    x, y = window.seen_m
    lever = np.eye(2) - rotation_2d(window.seen_rad)
    return np.column_stack([np.array([[x, -y], [y, x]]), lever])


def _robust(rows: Array, told: Array, prior: Array, sigma: Array) -> tuple[Array, Array]:
    """Solve weighted least squares with a prior, outliers weighed down; returns solution and
    standard deviations.
    """
    solution = prior
    information = np.diag(sigma**-2)
    for _ in range(ROUNDS):
        chi2 = (told - rows @ solution) ** 2
        weight = 1 / (1 + chi2 / OUTLIER_CHI2) ** 2
        weighted = rows * weight[:, None]
        H = information + weighted.T @ rows
        solution = np.linalg.solve(H, information @ prior + weighted.T @ told)
    return solution, np.sqrt(np.diag(np.linalg.inv(H)))


def _sigma_m(window: Window) -> float:
    return SIGMA_REST_M + SIGMA_ROOT_M * float(np.sqrt(np.linalg.norm(window.told_m)))


def _sigma_rad(window: Window) -> float:
    return SIGMA_REST_RAD + SIGMA_ROOT_RAD * float(np.sqrt(abs(window.told_rad)))


def rotation_2d(angle_rad: float) -> Array:
    """Return the matrix (2, 2) of a rotation in the plane."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def yaw_of(T: Array) -> float:
    """Return the rotation of a transform (4, 4) about z in radians."""
    return float(np.arctan2(T[1, 0], T[0, 0]))
