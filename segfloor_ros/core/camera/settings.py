"""The settings of the stereo camera: what is read, and how."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.settings import StageSettings, setting

SENSORS = ('wheel_odometry', 'imu')
"""Sensors of a recording that can be left out."""


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
    left_image_topic: str = setting('', 'Left image topic in a bag; empty: found by its name.')
    right_image_topic: str = setting('', 'Right image topic in a bag; empty: found by its name.')
    wheel_odometry_topic: str = setting('', 'Wheel odometry topic of a bag; empty: by its type.')
    depth: bool = setting(
        False,
        'Take depth images in place of the right ones; without right images it is done anyway.',
    )
    depth_scale: float = setting(
        0.0,
        'Metres of one unit of depth images; 0: 0.001 of whole numbers, 0.0002 of TUM RGB-D.',
        within=(0.0, 1.0),
    )
    depth_topic: str = setting('', 'Depth image topic in a bag; empty: found by its name.')
    imu_topic: str = setting('', 'IMU topic in a bag; empty: found by its type.')
    ignore: str = setting('', 'Sensors to leave out, with commas: wheel_odometry, imu.')

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
