"""Calibration of one camera of the pair: intrinsics, distortion and rectification.

The fields are those of ROS calibration files and of `sensor_msgs/CameraInfo`, as plain arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from segfloor_ros.errors import CalibrationError
from segfloor_ros.geometry import Array

COEFFICIENTS = {'plumb_bob': (4, 5), 'rational_polynomial': (8, 12, 14), 'equidistant': (4,)}
"""Number of distortion coefficients by model (REP-104 names)."""

MODEL_ALIASES = {
    '': 'plumb_bob',
    'none': 'plumb_bob',
    'radtan': 'plumb_bob',
    'radial-tangential': 'plumb_bob',
    'fisheye': 'equidistant',
    'equi': 'equidistant',
    'kannala_brandt4': 'equidistant',
}

SAME_PX = 1e-3
"""Intrinsics that differ by less than this are the same."""


@dataclass(frozen=True, eq=False)
class EyeCalibration:
    """One camera of the pair.

    K (3, 3): intrinsics of the raw image; D (n,): distortion; R (3, 3): rotation from the raw
    to the rectified optical frame; P (3, 4): projection of the rectified camera, P[0, 3] = -fx *
    baseline for the right one. Raw and rectified images have the same size. `origin` names the
    file or topic in messages. Raises CalibrationError for impossible values.
    """

    width: int
    height: int
    K: Array
    D: Array
    R: Array
    P: Array
    distortion_model: str = 'plumb_bob'
    origin: str = 'calibration'

    def __post_init__(self) -> None:
        model = MODEL_ALIASES.get(self.distortion_model.lower(), self.distortion_model)
        object.__setattr__(self, 'distortion_model', model)
        for name, shape in (('K', (3, 3)), ('R', (3, 3)), ('P', (3, 4)), ('D', (-1,))):
            object.__setattr__(self, name, self._checked_array(name, shape))
        self._check_intrinsics()
        self._check_distortion()
        if np.abs(self.R @ self.R.T - np.eye(3)).max() > 1e-3:
            raise CalibrationError(
                f'{self.origin}: the rectification R is not a rotation; calibrate the pair again'
            )

    @classmethod
    def of_rectified(
        cls, width: int, height: int, P: ArrayLike, origin: str = 'calibration'
    ) -> EyeCalibration:
        """Return the calibration of images that are rectified already, with projection P (3, 4)."""
        matrix = np.asarray(P, np.float64).reshape(3, 4)
        return cls(width, height, matrix[:, :3], np.zeros(5), np.eye(3), matrix, origin=origin)

    @property
    def is_rectified(self) -> bool:
        """Whether the raw image is the rectified one."""
        return (
            not self.D.any()
            and np.array_equal(self.R, np.eye(3))
            and bool(np.abs(self.K - self.P[:, :3]).max() < SAME_PX)
        )

    def _checked_array(self, name: str, shape: tuple[int, ...]) -> Array:
        try:
            array = np.array(getattr(self, name), np.float64).reshape(shape)
        except ValueError:
            raise CalibrationError(
                f'{self.origin}: {name} has {np.size(getattr(self, name))} numbers instead of '
                f'{int(np.prod(shape))}'
            ) from None
        if not np.isfinite(array).all():
            raise CalibrationError(
                f'{self.origin}: {name} holds values that are not finite; calibrate the pair again'
            )
        if name == 'D' and array.size == 0:
            array = np.zeros(COEFFICIENTS.get(self.distortion_model, (5,))[-1])
        array.setflags(write=False)
        return array

    def _check_intrinsics(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(
                f'{self.origin}: image size {self.width}x{self.height} is impossible'
            )
        for name, matrix in (('K', self.K), ('P', self.P)):
            if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
                raise CalibrationError(
                    f'{self.origin}: {name}[0] = {matrix[0, 0]:g}, so the camera is not '
                    'calibrated; calibrate the pair first, e.g. with segfloor calibrate'
                )
        cx, cy = self.K[0, 2], self.K[1, 2]
        if not (0 < cx < self.width and 0 < cy < self.height):
            raise CalibrationError(
                f'{self.origin}: the principal point ({cx:g}, {cy:g}) lies outside of the image of '
                f'{self.width}x{self.height}; use the calibration of images of this size'
            )

    def _check_distortion(self) -> None:
        counts = COEFFICIENTS.get(self.distortion_model)
        if counts is None:
            raise CalibrationError(
                f'{self.origin}: unknown distortion model {self.distortion_model}; '
                f'known are {", ".join(COEFFICIENTS)}'
            )
        if self.D.size not in counts:
            raise CalibrationError(
                f'{self.origin}: {self.distortion_model} has {" or ".join(map(str, counts))} '
                f'coefficients, not {self.D.size}'
            )
