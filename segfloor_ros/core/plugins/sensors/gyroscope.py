"""The gyroscope and the accelerometer: how the camera turned, and where up is.

By how much the stamps of a sensor are later than those of the images.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np

from segfloor_ros.core.camera.recording import MAX_LAG_S
from segfloor_ros.core.contracts import ImuSample
from segfloor_ros.core.geometry import Array, rotation_angle
from segfloor_ros.core.slam.rig import is_gated
from segfloor_ros.core.twists import rotation_vectors, rotations_by

LATE_NS = 100_000_000
"""Messages may be so late; until then what is measured is taken to go on as it did."""

MOMENT_NS = 1_000_000_000
"""What lies further back belongs to another situation: stamps that jump back by more begin a new
recording, and wheels that slipped are believed again."""

STEP_NS = 500_000_000
"""Between two looks at what changes slowly: three poses so far apart show where up is, for errors
of millimetres in their place are little then. Wheels are asked for a pose as often at least."""

KEPT_NS = 40 * MOMENT_NS
"""How long samples are kept."""

SIGMA_ROOT_S, SIGMA_SHARE = 3e-4, 0.005
"""Error of an angle: rad per root second, of which consumer gyroscopes have 0.005 to 0.02 degrees,
and a share of it, by scale and alignment of the axes."""

FIRST_BIAS_SIGMA, BIAS_DRIFT = 0.02, 1e-4
"""Bias of a cheap gyroscope, rad/s, and its drift, rad/s per root second."""

FIRST_LAG_SIGMA_S, LAG_DRIFT = 0.02, 1e-5
"""By how much the stamps of an IMU are late: clocks of drivers differ by hundredths of a second."""

STEADY_RAD_S = 0.02
"""Noise alone shows smaller changes of the rate: they say nothing of a lag."""

SIGMA_SEEN_M, SIGMA_SEEN_RAD = 0.003, 1e-3
"""Error of the place of a frame, and of a turn, as the images show it."""

SAID_S = 0.01
"""A lag that is worth a word; less is what a driver may be off."""


class Stamped(Protocol):
    """What a sensor measured at a time."""

    @property
    def stamp_ns(self) -> int:
        """When."""


Sample = TypeVar('Sample', bound=Stamped)


class TimedSeries(Generic[Sample]):
    """The latest samples of a sensor, in the order of their stamps."""

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._samples: list[Sample] = []

    def __iter__(self) -> Iterator[Sample]:
        return iter(self._samples)

    def add(self, sample: Sample) -> None:
        """Take in a sample; one that comes late is put where it belongs."""
        if self._samples and sample.stamp_ns < self._samples[-1].stamp_ns - MOMENT_NS:
            self._samples.clear()
        insort(self._samples, sample, key=_stamp)
        kept_ns = self._samples[-1].stamp_ns - KEPT_NS
        if self._samples[0].stamp_ns < kept_ns - KEPT_NS:
            del self._samples[: bisect_left(self._samples, kept_ns, key=_stamp)]

    def latest(self) -> list[Sample]:
        """Return the samples of the last moment."""
        start_ns = self._samples[-1].stamp_ns - MOMENT_NS if self._samples else 0
        return self._samples[bisect_left(self._samples, start_ns, key=_stamp) :]

    def window(self, before_ns: int, now_ns: int) -> list[Sample]:
        """Return the samples from the last one before a time to the first one after another; none
        where they have gaps or do not reach so far. Where the last comes before the end, or before
        a gap, there are at least two, to go on from.
        """
        first = max(bisect_right(self._samples, before_ns, key=_stamp) - 1, 0)
        last = bisect_left(self._samples, now_ns, key=_stamp)
        around = self._samples[max(last - 1, 0) : last + 1]
        gap_ns = around[-1].stamp_ns - around[0].stamp_ns if around else 0
        if last == len(self._samples) or (
            gap_ns > self._max_gap_ns and around[-1].stamp_ns > now_ns
        ):
            last -= 1
            first = max(min(first, last - 1), 0)
        samples = self._samples[first : last + 1]
        stamps = [before_ns, *(sample.stamp_ns for sample in samples)]
        if not samples or now_ns - stamps[-1] > LATE_NS:
            return []
        gap_ns = max(later - one for one, later in pairwise(stamps))
        return samples if gap_ns <= self._max_gap_ns else []


@dataclass(frozen=True)
class Preintegrated:
    """What an IMU measured between two times, in the axes of the first: R_before_now (3, 3) and the
    standard deviation of its angles, and the acceleration of the camera, gravity's included,
    integrated once (3,) in m/s and twice (3,) in m.
    """

    turn: Array
    sigma_rad: float
    speed: Array
    way: Array


@dataclass(frozen=True)
class _Path:
    """Seconds (N,), R_before_now (N, 3, 3), and rates of the turn and acceleration (N, 3) in the
    axes of that moment. place_m: (3,) of the IMU on the camera.
    """

    seconds: Array
    turns: Array
    rates_rad_s: Array
    accel_m_s2: Array
    place_m: Array

    @property
    def speeding_up(self) -> Array:
        """By how much the rate of the turn grew (3,), in rad/s, in the axes of the end."""
        return np.asarray(self.rates_rad_s[-1] - self.turns[-1].T @ self.rates_rad_s[0])

    @property
    def circle(self) -> tuple[Array, Array]:
        """The speed and the way (3,) that an IMU beside the camera has because it turns: what is
        measured of them is the difference of both ends, whatever happens between.
        """
        first, last = np.cross(self.rates_rad_s[[0, -1]], self.place_m)
        swept = self.turns[-1] @ self.place_m - self.place_m
        return self.turns[-1] @ last - first, swept - self.seconds[-1] * first

    @property
    def angle_rad(self) -> float:
        """The angle of the whole turn."""
        return rotation_angle(self.turns[-1])

    def sigma_rad(self, sigma: Array) -> float:
        """Return the standard deviation of the whole turn, about any axis; sigma: (4,) of bias and
        lag.
        """
        seconds = float(self.seconds[-1])
        parts = (
            SIGMA_ROOT_S * np.sqrt(seconds),
            sigma[:3].max() * seconds,
            sigma[3] * np.linalg.norm(self.speeding_up),
            SIGMA_SHARE * self.angle_rad,
        )
        return float(np.linalg.norm(parts))


class Gyroscope:
    """The latest samples of an IMU, the bias of its gyroscope (3,), and by how much its stamps are
    later than those of the images.
    """

    def __init__(self) -> None:
        self.bias_rad_s: Array = np.zeros(3)
        self.lag_s = 0.0
        self._covariance: Array = np.diag([FIRST_BIAS_SIGMA**2] * 3 + [FIRST_LAG_SIGMA_S**2])
        self.samples: TimedSeries[ImuSample] = TimedSeries(LATE_NS)
        self._latest: tuple[tuple[int, int], _Path | None] | None = None

    def add(self, sample: ImuSample) -> None:
        """Take in a sample."""
        self._latest = None
        self.samples.add(sample)

    def turn(self, before_ns: int, now_ns: int) -> tuple[Array, float] | None:
        """Return R_before_now (3, 3) of the left optical frame, freed of the bias, and the standard
        deviation of its angles in radians; None where samples are missing.
        """
        path = self._path(before_ns, now_ns)
        return None if path is None else (path.turns[-1], path.sigma_rad(self._sigma))

    def preintegrated(self, before_ns: int, now_ns: int) -> Preintegrated | None:
        """Return what was measured between two times; None where samples are missing."""
        path = self._path(before_ns, now_ns)
        if path is None:
            return None
        accel = np.einsum('nij,nj->ni', path.turns, path.accel_m_s2)
        step_s = np.diff(path.seconds)[:, None]
        speed = np.cumsum((accel[1:] + accel[:-1]) / 2 * step_s, axis=0)
        before = np.vstack([np.zeros(3), speed[:-1]])
        way = ((before + speed) / 2 * step_s).sum(axis=0)
        turning, swept = path.circle
        sigma_rad = path.sigma_rad(self._sigma)
        return Preintegrated(path.turns[-1], sigma_rad, speed[-1] - turning, way - swept)

    def _path(self, before_ns: int, now_ns: int) -> _Path | None:
        """Return what was measured between two times; many ask for the motion of the same frame."""
        if self._latest is None or self._latest[0] != (before_ns, now_ns):
            self._latest = (before_ns, now_ns), self._integrated(before_ns, now_ns)
        return self._latest[1]

    def _integrated(self, before_ns: int, now_ns: int) -> _Path | None:
        """Return turn and acceleration at two times and at all samples between. The rate between
        two samples is their mean.
        """
        lag_ns = round(self.lag_s * 1e9)
        before_ns, now_ns = before_ns + lag_ns, now_ns + lag_ns
        samples = self.samples.window(before_ns, now_ns)
        if not samples:
            return None
        times_ns = np.array([sample.stamp_ns for sample in samples], np.int64)
        measured = np.stack([[*sample.gyro_rad_s, *sample.accel_m_s2] for sample in samples])
        inner = times_ns[(times_ns > before_ns) & (times_ns < now_ns)]
        nodes = (np.concatenate([[before_ns], inner, [now_ns]]) - before_ns) * 1e-9
        seconds = (times_ns - before_ns) * 1e-9
        at_nodes = np.stack([np.interp(nodes, seconds, axis) for axis in measured.T], axis=1)
        rates = at_nodes[:, :3] - self.bias_rad_s
        steps = (rates[1:] + rates[:-1]) / 2 * np.diff(nodes)[:, None]
        turns = [np.eye(3)]
        for R in rotations_by(steps):
            turns.append(turns[-1] @ R)
        return _Path(nodes, np.stack(turns), rates, at_nodes[:, 3:], samples[-1].place_m)

    def learn(
        self, seen: Array, before_ns: int, now_ns: int, sigma_seen_rad: float = SIGMA_SEEN_RAD
    ) -> None:
        """Learn bias and lag from R_before_now (3, 3) as it was seen (a Kalman filter)."""
        path = self._path(before_ns, now_ns)
        if path is None or now_ns <= before_ns:
            return
        seconds = float(path.seconds[-1])
        excess = rotation_vectors((seen.T @ path.turns[-1])[None])[0]
        noise = sigma_seen_rad + SIGMA_ROOT_S * np.sqrt(seconds) + SIGMA_SHARE * path.angle_rad
        # What is measured is late by what is left of the lag: by its rate of the turn at either
        # end.
        speeding_up = path.speeding_up
        speeding_up = speeding_up * (np.linalg.norm(speeding_up) > STEADY_RAD_S)
        H = np.column_stack([seconds * np.eye(3), -speeding_up])
        self._covariance += np.diag([BIAS_DRIFT**2] * 3 + [LAG_DRIFT**2]) * seconds
        S = H @ self._covariance @ H.T + noise**2 * np.eye(3)
        if not is_gated(excess, S):
            return
        self._latest = None
        gain = self._covariance @ H.T @ np.linalg.inv(S)
        change = gain @ excess
        self.bias_rad_s = self.bias_rad_s + change[:3]
        self.lag_s = float(np.clip(self.lag_s + change[3], -MAX_LAG_S, MAX_LAG_S))
        self._covariance = self._covariance - gain @ S @ gain.T

    def remarks(self) -> dict[str, str]:
        """Return in words what is wrong enough, and known well enough, to be said."""
        if not is_late(self.lag_s, float(self._sigma[3])):
            return {}
        return {'imu lag': lag_in_words('IMU', self.lag_s)}

    @property
    def _sigma(self) -> Array:
        """The standard deviations (4,) of bias and lag."""
        return np.sqrt(np.diag(self._covariance))


def _stamp(sample: Stamped) -> int:
    return sample.stamp_ns


def is_late(lag_s: float, sigma_s: float) -> bool:
    """Whether a lag is large enough, and known well enough, to be said."""
    return abs(lag_s) > max(SAID_S, 3 * sigma_s)


def lag_in_words(sensor: str, lag_s: float) -> str:
    """Return that the stamps of a sensor are late, in words."""
    later = 'later' if lag_s > 0 else 'earlier'
    return (
        f'the stamps of the {sensor} are {1e3 * abs(lag_s):.0f} ms {later} than those of the '
        'images; this is taken into account'
    )
