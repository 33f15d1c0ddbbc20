"""The gyroscope and the accelerometer: how the camera turned, and where up is."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import Array
from segfloor_ros.measurements import ImuSample

HISTORY = 8000
MAX_GAP_NS = 100_000_000
MAX_AHEAD_NS = 60_000_000
"""Messages may be so late; until then the camera is taken to turn on as it did."""

RESTART_NS = 1_000_000_000
SIGMA_ROOT_S = 1e-3
"""Error of an angle, rad per root second."""

SIGMA_SHARE = 0.005
"""Error of an angle as a share of it: scale and alignment of the axes."""

FIRST_BIAS_SIGMA = 0.02
BIAS_DRIFT = 1e-4
"""Bias of a cheap gyroscope, rad/s, and its drift, rad/s per root second."""

SIGMA_SEEN_RAD = 2e-3
"""Error of a turn as the images tell it."""

OUTLIER_SIGMAS = 4.0


class Gyroscope:
    """The latest samples of an IMU, and the bias of its gyroscope."""

    def __init__(self) -> None:
        self.bias_rad_s: Array = np.zeros(3)
        self.bias_sigma = FIRST_BIAS_SIGMA
        self._samples: list[ImuSample] = []

    def add(self, sample: ImuSample) -> None:
        """Take in a sample; one that comes late is put where it belongs."""
        if self._samples and sample.stamp_ns < self._samples[-1].stamp_ns - RESTART_NS:
            self._samples.clear()
        insort(self._samples, sample, key=_stamp)
        if len(self._samples) > 2 * HISTORY:
            del self._samples[:-HISTORY]

    def turn(self, before_ns: int, now_ns: int) -> Array | None:
        """Return R_before_now (3, 3) of the left optical frame, freed of the bias; None where
        samples are missing. The rate between two samples is their mean.
        """
        first = bisect_right(self._samples, before_ns, key=_stamp) - 1
        last = bisect_left(self._samples, now_ns, key=_stamp)
        samples = self._samples[max(first, 0) : last + 1]
        if not samples or samples[0].stamp_ns - before_ns > MAX_GAP_NS:
            return None
        times_ns = np.array([sample.stamp_ns for sample in samples], np.int64)
        late_ns = now_ns - times_ns[-1]
        if late_ns > MAX_AHEAD_NS or np.diff(times_ns).max(initial=0) > MAX_GAP_NS:
            return None
        rates = np.stack([sample.gyro_rad_s for sample in samples]) - self.bias_rad_s
        inner = times_ns[(times_ns > before_ns) & (times_ns < now_ns)]
        nodes = (np.concatenate([[before_ns], inner, [now_ns]]) - before_ns) * 1e-9
        seconds = (times_ns - before_ns) * 1e-9
        at_nodes = np.stack([np.interp(nodes, seconds, axis) for axis in rates.T], axis=1)
        steps = (at_nodes[1:] + at_nodes[:-1]) / 2 * np.diff(nodes)[:, None]
        turn: Array = np.eye(3)
        for R in Rotation.from_rotvec(steps).as_matrix():
            turn = turn @ R
        return turn

    def sigma_rad(self, turn: Array, seconds: float) -> float:
        """Return the standard deviation, about any axis, of a turn (3, 3) in so many seconds."""
        angle = float(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()))
        parts = (SIGMA_ROOT_S * np.sqrt(seconds), self.bias_sigma * seconds, SIGMA_SHARE * angle)
        return float(np.linalg.norm(parts))

    def learn(self, seen: Array, before_ns: int, now_ns: int) -> None:
        """Learn the bias from R_before_now (3, 3) as the images tell it (a Kalman filter)."""
        told, seconds = self.turn(before_ns, now_ns), (now_ns - before_ns) * 1e-9
        if told is None or seconds <= 0:
            return
        excess = Rotation.from_matrix(seen.T @ told).as_rotvec() / seconds
        angle = float(np.linalg.norm(Rotation.from_matrix(told).as_rotvec()))
        noise = SIGMA_SEEN_RAD + SIGMA_ROOT_S * np.sqrt(seconds) + SIGMA_SHARE * angle
        variance = (noise / seconds) ** 2
        before = self.bias_sigma**2 + BIAS_DRIFT**2 * seconds
        self.bias_sigma = float(np.sqrt(before))
        if np.abs(excess).max() > OUTLIER_SIGMAS * np.sqrt(before + variance):
            return
        gain = before / (before + variance)
        self.bias_rad_s = self.bias_rad_s + gain * excess
        self.bias_sigma = float(np.sqrt((1 - gain) * before))


def _stamp(sample: ImuSample) -> int:
    return sample.stamp_ns
