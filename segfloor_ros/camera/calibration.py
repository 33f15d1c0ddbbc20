"""Calibration of a stereo pair."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from segfloor_ros.camera.eye_calibration import EyeCalibration
from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.errors import CalibrationError
from segfloor_ros.geometry import Array, invert

__all__ = ['EyeCalibration', 'StereoCalibration']


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """Both eyes of a stereo pair, and the rectified camera they make.

    The projections are brought to the usual form: both with the left one's intrinsics, P[0, 3]
    = 0 for the left and -fx * baseline for the right. Raises CalibrationError for impossible
    pairs.
    """

    left: EyeCalibration
    right: EyeCalibration
    camera: StereoCamera = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        left, right = self.left, self.right
        if (left.width, left.height) != (right.width, right.height):
            raise CalibrationError(
                f'{left.origin} is for images of {left.width}x{left.height}, {right.origin} for '
                f'{right.width}x{right.height}; both eyes need the same size'
            )
        P = left.P
        baseline_m = left.P[0, 3] / left.P[0, 0] - right.P[0, 3] / right.P[0, 0]
        values = (float(v) for v in (P[0, 0], P[1, 1], P[0, 2], P[1, 2], baseline_m))
        try:
            camera = StereoCamera(left.width, left.height, *values)
        except CalibrationError as error:
            raise CalibrationError(f'{right.origin}: {error}') from None
        object.__setattr__(self, 'camera', camera)
        self._unify_projections()

    def _unify_projections(self) -> None:
        K = self.left.P[:, :3]
        right = self.right.P
        if self.left.P[:, 3].any() or np.abs(right[:, :3] - K).max() > 0 or right[1:, 3].any():
            zero = np.zeros((3, 1))
            shift = np.array([[-self.camera.disparity_times_depth], [0.0], [0.0]])
            for name, eye, offset in (('left', self.left, zero), ('right', self.right, shift)):
                P = np.hstack([K, offset])
                object.__setattr__(self, name, dataclasses.replace(eye, P=P))

    @classmethod
    def from_extrinsics(
        cls, left: EyeCalibration, right: EyeCalibration, T_right_left: Array
    ) -> StereoCalibration:
        """Return the rectified pair of two cameras of known relative pose; their R and P are
        replaced.

        T_right_left (4, 4) maps points of the left raw optical frame into the right one. Bouguet's
        rectification as in `cv2.stereoRectify`, cropped to the pixels both images have.
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
            R1, R2, P1, P2, _ = cv2.fisheye.stereoRectify(*eyes, cv2.CALIB_ZERO_DISPARITY)
        else:
            R1, R2, P1, P2, *_ = cv2.stereoRectify(*eyes, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
        return cls(dataclasses.replace(left, R=R1, P=P1), dataclasses.replace(right, R=R2, P=P2))

    @property
    def is_rectified(self) -> bool:
        """Whether the raw images are the rectified ones already."""
        return self.left.is_rectified and self.right.is_rectified

    def rectified(self) -> StereoCalibration:
        """Return the calibration that belongs to the rectified images."""
        eyes = (
            EyeCalibration.of_rectified(eye.width, eye.height, eye.P, eye.origin)
            for eye in (self.left, self.right)
        )
        return StereoCalibration(*eyes)

    def check_size(self, width: int, height: int, what: str) -> None:
        """Raise CalibrationError unless images of `width` x `height` belong to this calibration."""
        if (width, height) != (self.left.width, self.left.height):
            raise CalibrationError(
                f'{what} is {width}x{height}, but {self.left.origin} is for images of '
                f'{self.left.width}x{self.left.height}; use the calibration of these images'
            )
