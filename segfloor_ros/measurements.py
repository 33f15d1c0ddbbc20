"""What a robot measures besides images: wheel odometry and an IMU, by stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

MAX_LAG_S = 0.1
"""So much later than those of the images the stamps of a sensor may be."""


@dataclass(frozen=True)
class WheelPose:
    """Where wheel odometry has the base at a time: (4, 4) in a frame of its own."""

    stamp_ns: int
    T_wheels_base: Array


@dataclass(frozen=True)
class ImuSample:
    """Angular velocity and specific force (3,) at a time, and where the IMU is (3,), all in the
    rectified left optical frame.
    """

    stamp_ns: int
    gyro_rad_s: Array
    accel_m_s2: Array
    place_m: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def seen_from(T_left_imu: Array, stamp_ns: int, gyro: Array, accel: Array) -> ImuSample:
        """Return what an IMU at a pose (4, 4) in the rectified left optical frame measured."""
        R = T_left_imu[:3, :3]
        return ImuSample(stamp_ns, R @ gyro, R @ accel, T_left_imu[:3, 3])


@dataclass(frozen=True)
class Up:
    """A unit vector (3,) that points up, and the standard deviation of its tilt in radians."""

    direction: Array
    sigma_rad: float


Measurement = WheelPose | ImuSample


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


DEPTH = 'depth'
"""Name of the depth images among the sensors of a recording."""


@dataclass(frozen=True)
class RecordedSensor:
    """A sensor that was found in a recording: its name, as in `--ignore`, file or topic, number of
    messages, and whether it is used. read: returns the measurements; depth images have none.
    """

    name: str
    where: str
    messages: int
    used: bool
    read: Callable[[], Sequence[Measurement]] = tuple


class MeasurementLog:
    """All measurements of a recording, handed out as the frames come."""

    def __init__(self, sensors: Sequence[RecordedSensor]) -> None:
        self._streams = [
            _Stream(sorted(sensor.read(), key=lambda m: m.stamp_ns))
            for sensor in sensors
            if sensor.used
        ]

    @property
    def imu_place_m(self) -> Array:
        """Where the IMU is (3,) in the rectified left optical frame; there, without one."""
        firsts = (stream.first for stream in self._streams)
        places = (first.place_m for first in firsts if isinstance(first, ImuSample))
        return next(places, np.zeros(3))

    def until(self, stamp_ns: int) -> Iterator[Measurement]:
        """Yield what has not been handed out yet, up to the first measurement of each sensor at or
        after a time, so that poses can be interpolated there.
        """
        for stream in self._streams:
            yield from stream.until(stamp_ns)


class _Stream:
    def __init__(self, measurements: Sequence[Measurement]) -> None:
        self._measurements = measurements
        self._stamps_ns: NDArray[np.int64] = np.array([m.stamp_ns for m in measurements], np.int64)
        self._next = 0

    @property
    def first(self) -> Measurement | None:
        return self._measurements[0] if self._measurements else None

    def until(self, stamp_ns: int) -> Sequence[Measurement]:
        end = int(np.searchsorted(self._stamps_ns, stamp_ns)) + 1
        begin, self._next = self._next, max(self._next, end)
        return self._measurements[begin:end]
