"""The calibration of a stereo pair whose relative pose is known: Bouguet's rectification."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import Array, invert


def calibration_from_extrinsics(
    left: EyeCalibration, right: EyeCalibration, T_right_left: Array
) -> StereoCalibration:
    """Return the rectified pair of two cameras of known relative pose; their R and P are
    replaced.

    T_right_left (4, 4) maps points of the left raw optical frame into the right one. Bouguet's
    rectification as in `cv2.stereoRectify`, cropped to the pixels both images have; of a
    fisheye a view of `FISHEYE_RESOLUTION`, whose corners the raw images need not reach.
    """
    size = (left.width, left.height)
    rotation, translation = T_right_left[:3, :3].copy(), T_right_left[:3, 3:].copy()
    eyes = (left.K, left.D, right.K, right.D, size, rotation, translation)
    if left.distortion_model != right.distortion_model:
        raise CalibrationError(
            f'{left.origin} is {left.distortion_model}, {right.origin} is '
            f'{right.distortion_model}; both eyes need the same distortion model'
        )
    offset_m = invert(T_right_left)[:3, 3]
    if offset_m[0] <= np.abs(offset_m[1:]).max():
        x, y, z = (f'{value:g}' for value in offset_m + 0.0)
        raise CalibrationError(
            f'{right.origin}: the right camera is at ({x}, {y}, {z}) m in the left optical '
            'frame, but the baseline along x must be positive and the longest: are left and '
            'right swapped?'
        )
    if left.distortion_model == 'equidistant':
        R1, R2, *_ = cv2.fisheye.stereoRectify(*eyes, cv2.CALIB_ZERO_DISPARITY)
        P1, P2 = _fisheye_projections(left, right, float(np.linalg.norm(translation)))
    else:
        R1, R2, P1, P2, *_ = cv2.stereoRectify(*eyes, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    return StereoCalibration(
        dataclasses.replace(left, R=R1, P=P1), dataclasses.replace(right, R=R2, P=P2)
    )


FISHEYE_RESOLUTION = 0.7
"""So much of a fisheye's resolution its rectified view keeps in the middle. A plane cannot have all
of it and the borders, too: this leaves 125 degrees of an image of two radians and a half.
"""


def _fisheye_projections(
    left: EyeCalibration, right: EyeCalibration, baseline_m: float
) -> tuple[Array, Array]:
    """Return the projections (3, 4) of the rectified views of two fisheyes."""
    f = FISHEYE_RESOLUTION * float(np.mean([eye.K[i, i] for eye in (left, right) for i in (0, 1)]))
    middle = (left.width - 1) / 2, (left.height - 1) / 2
    P = np.array([[f, 0.0, middle[0], 0.0], [0.0, f, middle[1], 0.0], [0.0, 0.0, 1.0, 0.0]])
    shift = np.zeros((3, 4))
    shift[0, 3] = -f * baseline_m
    return P, P + shift
