"""What a recording or device delivers: raw pairs, and what was measured beside the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import ImuSample, Measurement
from segfloor_ros.core.geometry import Array

MAX_LAG_S = 0.1
"""So much later than those of the images the stamps of a sensor may be."""


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


@dataclass(frozen=True)
class RawPair:
    """One grey pair as the camera saw it, not rectified: images (H, W) uint8, the pair's number
    in its recording, its stamp in ns. colour: the left one in BGR (H, W, 3), if asked for.
    """

    index: int
    stamp_ns: int
    left: NDArray[np.uint8]
    right: NDArray[Any]
    colour: NDArray[np.uint8] | None = None


IMU_FRAME = 'imu_link'
"""Of an IMU that is not where the left camera is; its axes are those of the raw left images."""
