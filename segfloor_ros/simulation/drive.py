"""The drive of the base: a smooth path through waypoints, driven at a believable speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array
from segfloor_ros.simulation.scene import Route

STEP_M = 0.0025
MIN_SPEED_M_S = 0.02
LONGEST_M, MOST_FRAMES = 1e5, 10**6
"""Of a drive: a day of a robot."""


@dataclass(frozen=True)
class Drive:
    """Where the base is: times (N,) in seconds and x, y, yaw (N, 3), metres and radians, yaw
    without jumps.
    """

    times_s: Array
    xy_yaw: Array

    @property
    def length_m(self) -> float:
        """Length of the path in metres."""
        return float(np.hypot(*np.diff(self.xy_yaw[:, :2], axis=0).T).sum())

    def at(self, times_s: Array) -> Array:
        """Return x, y, yaw (M, 3) at other times by linear interpolation."""
        columns = [np.interp(times_s, self.times_s, column) for column in self.xy_yaw.T]
        return np.stack(columns, axis=1)


def plan_drive(path: Route, rate_hz: float) -> Drive:
    """Return the drive sampled at the camera's rate, from standstill to standstill.

    Raises InputError for fewer than two different waypoints.
    """
    line = smooth_line(path)
    step = np.diff(line, axis=0)
    distance_m = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    heading = np.arctan2(step[:, 1], step[:, 0])
    yaw = np.unwrap(np.append(heading, heading[-1]))
    times_s = _times(path, distance_m, yaw)
    if times_s[-1] * rate_hz > MOST_FRAMES:
        raise InputError(f'the drive takes {times_s[-1]:.3g} s, which are too many images')
    frame_times_s = np.arange(int(times_s[-1] * rate_hz) + 1) / rate_hz
    dense = Drive(times_s, np.column_stack([line, yaw]))
    return Drive(frame_times_s, dense.at(frame_times_s))


def smooth_line(path: Route) -> Array:
    """Return the way (N, 2) through the waypoints, a point per `STEP_M`, corners rounded by a
    Gaussian of deviation `smoothing_m`, so that its curvature is continuous.
    """
    corners = np.array(path.waypoints, np.float64).reshape(-1, 2)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    corners = corners[np.concatenate([[True], lengths > 0])] if len(corners) else corners
    if len(corners) < 2:
        raise InputError('a path needs at least two different waypoints')
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    if along[-1] > LONGEST_M:
        raise InputError(f'the path is {along[-1]:.3g} m long, at most {LONGEST_M:g} are driven')
    wanted = np.linspace(0.0, along[-1], max(2, round(along[-1] / STEP_M) + 1))
    line = np.stack([np.interp(wanted, along, column) for column in corners.T], axis=1)
    return _smooth(line, path.smoothing_m / STEP_M)


def _smooth(line: Array, deviation: float) -> Array:
    """Smooth a line, both ends kept in place by continuing it straight beyond them."""
    if deviation <= 0:
        return line
    extra = np.arange(1, int(4 * deviation) + 1)[:, None]
    before = line[0] - extra[::-1] * (line[1] - line[0])
    after = line[-1] + extra * (line[-1] - line[-2])
    smoothed = gaussian_filter1d(np.vstack([before, line, after]), deviation, axis=0)
    inner = smoothed[len(extra) : -len(extra)]
    moves = np.hypot(*np.diff(inner, axis=0).T) > 1e-6
    return inner[np.append(True, moves)]


def _times(path: Route, distance_m: Array, yaw: Array) -> Array:
    """Return when each point of the line is reached: v² ≤ v₀² + 2as from either end and along
    every bend. Where the way turns back the base turns on the spot.
    """
    turn_rate = np.radians(path.turn_rate_deg_s)
    curvature = np.abs(np.gradient(yaw) / np.gradient(distance_m))
    limit = np.minimum(path.speed_m_s, turn_rate / np.maximum(curvature, 1e-6))
    limit[[0, -1]] = 0.0
    gain = 2 * path.acceleration_m_s2 * distance_m
    # The lowest parabola through any earlier (later) limit: a running minimum of v² -+ 2as.
    forward = np.minimum.accumulate(limit**2 - gain) + gain
    backward = np.minimum.accumulate((limit**2 + gain)[::-1])[::-1] - gain
    speed = np.sqrt(np.maximum(np.minimum(forward, backward), MIN_SPEED_M_S**2))
    seconds = np.diff(distance_m) * 2 / (speed[1:] + speed[:-1])
    seconds = np.maximum(seconds, np.abs(np.diff(yaw)) / turn_rate)
    return np.concatenate([[0.0], np.cumsum(seconds)])
