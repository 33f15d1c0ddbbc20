"""The stereo camera: its settings, the rectified pair of pinholes and its place on the robot; and
what the robot measures besides images, by stamp: wheel odometry and an IMU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import CalibrationError, SettingsError
from segfloor_ros.core.geometry import (
    R_ROS_OPTICAL,
    Array,
    angles_of_rotation,
    make_transform,
    rotation_from_angles,
)
from segfloor_ros.core.settings import StageSettings, setting

SENSORS = ('wheel_odometry', 'imu')
"""Sensors of a recording that can be left out."""

MAX_BASELINE_M = 10.0
"""No robot carries eyes farther apart; a baseline in millimetres is larger."""

MAX_LAG_S = 0.1
"""So much later than those of the images the stamps of a sensor may be."""


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo pair: two pinholes with equal intrinsics, the right one `baseline_m`
    along the left's x. Pixels are (u, v) = (column, row), the centre of the top-left pixel is
    (0, 0). Depth is Z = fx * baseline / d for the disparity d = u_left - u_right > 0. Raises
    CalibrationError for impossible values.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, self.baseline_m)
        if not np.isfinite(values).all():
            raise CalibrationError(f'calibration has values that are not finite: {values}')
        if self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(
                f'focal length fx = {self.fx:g}, fy = {self.fy:g} px: '
                'the camera is not calibrated (K[0] = 0)'
            )
        if self.baseline_m <= 0:
            raise CalibrationError(
                f'baseline is {self.baseline_m:g} m, it must be positive: '
                'are left and right swapped, or is P[3] of the right camera missing?'
            )
        if self.baseline_m > MAX_BASELINE_M:
            raise CalibrationError(
                f'baseline is {self.baseline_m:g} m; are lengths in millimetres? They must be in '
                'metres: P[3] of the right camera is -fx times the baseline'
            )
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(f'image size {self.width}x{self.height} is impossible')

    @property
    def K(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def disparity_times_depth(self) -> float:
        """fx * baseline in pixel metres: disparity = this / depth."""
        return self.fx * self.baseline_m

    def project(self, points: Array) -> Array:
        """Project points (N, 3) of the left optical frame to (N, 3) = (u, v, u_right) in pixels.

        Points must lie in front of the camera (z > 0).
        """
        inverse_z = 1.0 / points[:, 2]
        u = self.fx * points[:, 0] * inverse_z + self.cx
        v = self.fy * points[:, 1] * inverse_z + self.cy
        return np.stack([u, v, u - self.disparity_times_depth * inverse_z], axis=1)

    def back_project(self, uv_px: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Array:
        """Return the points (N, 3) of the left optical frame at pixels (N, 2) and depths (N,) in
        metres.
        """
        uv = np.asarray(uv_px, np.float64)
        z = np.asarray(depth_m, np.float64)
        return np.stack(
            [(uv[:, 0] - self.cx) * z / self.fx, (uv[:, 1] - self.cy) * z / self.fy, z], axis=1
        )


@dataclass(frozen=True)
class Mount:
    """Where the left camera sits on the base (`base_link`: on the floor below the robot's
    centre, x forward, z up). height_m: of the left camera's centre above the floor. pitch_rad:
    positive looks down. roll_rad: positive when the camera is rolled to its right, yaw_rad:
    positive looks to the left (REP-103 angles, applied yaw, pitch, roll). forward_m, left_m:
    of the camera's centre ahead of and to the left of the base.
    """

    height_m: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0
    yaw_rad: float = 0.0

    @cached_property
    def T_base_left(self) -> Array:
        """The pose (4, 4) of the left optical frame in the base frame; not to be written to."""
        R_base_camera = rotation_from_angles(self.yaw_rad, self.pitch_rad, self.roll_rad)
        translation = np.array([self.forward_m, self.left_m, self.height_m])
        T_base_left = make_transform(R_base_camera @ R_ROS_OPTICAL, translation)
        T_base_left.flags.writeable = False
        return T_base_left

    @classmethod
    def from_transform(cls, T_base_left: Array) -> Mount:
        """Return the mount of a (4, 4) pose of the left optical frame in the base frame."""
        R_base_camera = T_base_left[:3, :3] @ R_ROS_OPTICAL.T
        yaw, pitch, roll = angles_of_rotation(R_base_camera)
        x, y, z = (float(value) for value in T_base_left[:3, 3])
        return cls(z, pitch, roll, x, y, yaw)

    @property
    def up_in_camera(self) -> Array:
        """The floor's unit normal (3,) pointing up, in the left optical frame."""
        return self.T_base_left[2, :3].copy()

    def heights_m(self, points_left: Array) -> Array:
        """Return the heights (N,) above the floor of points (N, 3) of the left optical frame."""
        return points_left @ self.up_in_camera + self.height_m


@dataclass(frozen=True)
class StereoFrame:
    """One rectified grey stereo pair: images (H, W) uint8, the frame's number in its recording,
    its stamp in ns. right: of a depth camera, in its place, the disparity (H, W) float32 (see
    `depth`). excluded: mask (H, W) uint8 of the left image, 255 where something moves, as
    far as a segmentation network says. colour: the left image (H, W, 3) BGR, if it was asked
    for and there is one.
    """

    index: int
    stamp_ns: int
    left: NDArray[np.uint8]
    right: NDArray[Any]
    excluded: NDArray[np.uint8] | None = None
    colour: NDArray[np.uint8] | None = None


def is_disparity(image: NDArray[np.generic]) -> bool:
    """Whether what stands in place of a right image is a disparity."""
    return image.dtype == np.float32


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
