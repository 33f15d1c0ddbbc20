"""The calibration of a recording: given in the settings, or found beside the images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.calibration_files import read_calibration
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.errors import CalibrationError

FILE_NAMES = (
    ('left.yaml', 'right.yaml'),
    ('left.yml', 'right.yml'),
    ('left_camera.yaml', 'right_camera.yaml'),
    ('camera_left.yaml', 'camera_right.yaml'),
    ('left/left.yaml', 'right/right.yaml'),
    ('left/camera.yaml', 'right/camera.yaml'),
    ('calibration/left.yaml', 'calibration/right.yaml'),
    ('calib/left.yaml', 'calib/right.yaml'),
)


def given_calibration(settings: StereoCameraSettings) -> StereoCalibration | None:
    """Return the calibration that the settings name, or None when they name none.

    Raises CalibrationError, also when only one of the two files is given.
    """
    left, right = settings.left_calibration, settings.right_calibration
    if not left and not right:
        return None
    if not left or not right:
        raise CalibrationError(
            'stereo_camera.left_calibration and stereo_camera.right_calibration belong together; '
            f'only {left or right} is given'
        )
    return read_calibration(Path(left), Path(right))


def find_calibration(
    name: str, folders: Sequence[Path], settings: StereoCameraSettings
) -> StereoCalibration:
    """Return the calibration the settings name, else the first found in `folders`.

    Raises CalibrationError saying where one was expected.
    """
    given = given_calibration(settings)
    if given is not None:
        return given
    for folder in folders:
        for left, right in FILE_NAMES:
            if (folder / left).exists() or (folder / right).exists():
                return read_calibration(folder / left, folder / right)
    raise CalibrationError(
        f'{name}: no calibration; put left.yaml and right.yaml (ROS camera_calibration) into '
        f'{folders[0]}, or give stereo_camera.left_calibration and right_calibration'
    )
