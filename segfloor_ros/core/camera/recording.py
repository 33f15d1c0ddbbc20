"""What a recording or device delivers: raw pairs, and what was measured beside the images; and the
settings of how it is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import ImuSample, Measurement
from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.settings import StageSettings, setting

SENSORS = ('wheel_odometry', 'imu')
"""Sensors of a recording that can be left out."""

MAX_LAG_S = 0.1
"""So much later than those of the images the stamps of a sensor may be."""


@dataclass(frozen=True)
class StereoCameraSettings(StageSettings):
    """Where images come from and how left and right are paired."""

    input: str = setting(
        '', 'Recording or device to read: folder, bag, video, device, or two devices (0,2).'
    )
    start: int = setting(0, 'First frame of a recording that is read.', within=(0, 10**9))
    frames: int = setting(0, 'Frames that are read; 0: to the end.', within=(0, 10**9))
    every: int = setting(1, 'Read every n-th frame only.', within=(1, 10**6))
    rate_hz: float = setting(
        0.0,
        'Frame rate of a recording without time stamps, or asked of a device; 0 takes 10 Hz.',
        within=(0.0, 1000.0),
    )
    exposure_s: float = setting(
        0.0, 'Exposure that is asked of a device; 0 leaves it to the camera.', within=(0.0, 1.0)
    )
    pairing_tolerance_s: float = setting(
        0.01,
        'Largest difference of stamps at which a left and a right image are one pair.',
        within=(0.0, 1.0),
    )
    left_calibration: str = setting(
        '', 'Calibration file of the left camera; empty: the one that lies with the recording.'
    )
    right_calibration: str = setting(
        '', 'Calibration file of the right camera; empty: the one that lies with the recording.'
    )
    bit_depth: int = setting(
        0,
        'Bits used in the pixels of 16-bit images; 0 takes it from the brightest so far.',
        unit='bits',
        within=(0, 16),
    )
    left_image_topic: str = setting('', 'Left image topic in a bag; empty: found by its name.')
    right_image_topic: str = setting('', 'Right image topic in a bag; empty: found by its name.')
    wheel_odometry_topic: str = setting(
        '', 'Wheel odometry topic in a bag; empty: found by its type.'
    )
    depth: bool = setting(
        False,
        'Take depth images in place of the right ones; without right images it is done anyway.',
    )
    depth_topic: str = setting('', 'Depth image topic in a bag; empty: found by its name.')
    imu_topic: str = setting('', 'IMU topic in a bag; empty: found by its type.')
    ignore: str = setting(
        '', 'Sensors of the recording to leave out, with commas: wheel_odometry, imu.'
    )

    masks: str = setting(
        '',
        'Folder of masks of what moves: %06d.png by frame index, of the left image as recorded, '
        '255 = moving; empty: none.',
    )

    @property
    def ignored_sensors(self) -> frozenset[str]:
        """The names in `ignore`. Raises SettingsError for one that is no sensor."""
        names = frozenset(self.ignore.replace(',', ' ').split())
        unknown = sorted(names - set(SENSORS))
        if unknown:
            raise SettingsError(
                f'stereo_camera.ignore: {unknown[0]} is no sensor; known are {", ".join(SENSORS)}'
            )
        return names


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


UPRIGHT = 0.8
"""Cosine of the angle between gravity and the image's vertical up to which a camera is upright."""


def is_upright(accel_m_s2: Array) -> bool:
    """Whether up is about up in the image for what an IMU at rest feels (3,): its axes may be those
    of the image.
    """
    return bool(-accel_m_s2[1] > UPRIGHT * np.linalg.norm(accel_m_s2))


IMU_FRAME = 'imu_link'
"""Of an IMU that is not where the left camera is; its axes are those of the raw left images."""
