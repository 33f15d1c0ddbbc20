"""The calibration out of `sensor_msgs/CameraInfo`, of `rclpy` as well as of `rosbags`."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from segfloor_ros import MAX_PIXELS
from segfloor_ros.core.camera.calibration import EyeCalibration
from segfloor_ros.core.errors import CalibrationError, InputError


def eye_calibration(info: Any, name: str, is_rectified: bool = False) -> EyeCalibration:
    """Return the calibration of the images that belong to a CameraInfo, of ROS 1 or 2, by what
    the message defines: R and P without values are those of a camera alone, of images that are
    rectified P or else K counts; K and P are those of the whole image, of which `roi` and then
    `binning_x` and `binning_y` leave a part. name: of the topic, for messages. Raises
    CalibrationError or InputError.

    A principal point may lie outside of an image that a roi says to be a part.
    """
    width, height = int(info.width), int(info.height)
    if width * height > MAX_PIXELS:
        raise InputError(f'{name}: a calibration of images of {width}x{height} pixels is not taken')
    # ROS 1 names the matrices in capitals, ROS 2 does not.
    K, D, R, P = (np.array(getattr(info, n if hasattr(info, n) else n.lower())) for n in 'KDRP')
    K, R, P = K.reshape(3, 3), R if R.any() else np.eye(3), P.reshape(3, 4)
    P = P if P.any() else np.hstack([K, np.zeros((3, 1))])
    if is_rectified:
        whole = EyeCalibration.of_rectified(width, height, P, name, bool(info.roi.width))
    else:
        lens = D, R, P, info.distortion_model
        whole = EyeCalibration(width, height, K, *lens, name, bool(info.roi.width))
    return _part_of(whole, info)


def _part_of(whole: EyeCalibration, info: Any) -> EyeCalibration:
    """Return the calibration of what `roi` and binning of a CameraInfo leave of the whole image.
    A pixel that is binned has its centre in the middle of those it is made of.
    """
    roi, bins = info.roi, np.maximum((info.binning_x, info.binning_y), 1)
    corner, all_of = np.array((roi.x_offset, roi.y_offset), int), (whole.width, whole.height)
    size = np.where((roi.width, roi.height), (roi.width, roi.height), all_of - corner)
    if (corner + size > all_of).any() or size.min() <= 0:
        raise CalibrationError(
            f'{whole.origin}: roi, {size[0]}x{size[1]} from ({corner[0]}, {corner[1]}), reaches '
            f'beyond the image of {whole.width}x{whole.height}; width and height are those of the '
            'whole image of the camera'
        )
    if (bins == 1).all() and tuple(size) == all_of:
        return whole
    A = np.diag([*1.0 / bins, 1.0])
    A[:2, 2] = (0.5 - corner) / bins - 0.5
    width, height = (size // bins).tolist()
    words = f'{whole.origin} (of its {whole.width}x{whole.height}, by roi and binning)'
    K, P = A @ whole.K, A @ whole.P
    return dataclasses.replace(
        whole, width=width, height=height, K=K, P=P, origin=words, is_part=True
    )
