"""The calibration of a stereo pair and of each of its cameras.

The fields of one camera are those of ROS calibration files and of `sensor_msgs/CameraInfo`, as
arrays.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import Array

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

MOST_SKEW_PX = 1.0
"""Calibrations that estimate a skew find as much where there is none."""

PINHOLE_ZEROS = {(0, 1): MOST_SKEW_PX, (1, 0): SAME_PX, (2, 0): 1e-6, (2, 1): 1e-6, (2, 2): 1e-6}
"""How far the other elements of K and P may be from those of the identity, by row and column."""

SAME_ROWS = 0.1
"""Share of the baseline by which one eye may be higher; KITTI's are by 0.007."""


@dataclass(frozen=True, eq=False)
class EyeCalibration:
    """One camera of the pair.

    K (3, 3): intrinsics of the raw image; D (n,): distortion; R (3, 3): rotation from the raw
    to the rectified optical frame; P (3, 4): projection of the rectified camera, P[0, 3] = -fx *
    baseline for the right one. Raw and rectified images have the same size. `origin` names the
    file or topic in messages. is_part: of an image cut out of the camera's, whose principal point
    may lie outside of it. Raises CalibrationError for impossible values.
    """

    width: int
    height: int
    K: Array
    D: Array
    R: Array
    P: Array
    distortion_model: str = 'plumb_bob'
    origin: str = 'calibration'
    is_part: bool = False

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
        cls,
        width: int,
        height: int,
        P: ArrayLike,
        origin: str = 'calibration',
        is_part: bool = False,
    ) -> EyeCalibration:
        """Return the calibration of images that are rectified already, with projection P (3, 4)."""
        matrix = np.asarray(P, np.float64).reshape(3, 4)
        K, straight = matrix[:, :3], np.eye(3)
        return cls(width, height, K, np.zeros(5), straight, matrix, '', origin, is_part)

    @classmethod
    def of_raw(
        cls, size: tuple[int, int], K: Array, D: Array, model: str = 'plumb_bob', origin: str = ''
    ) -> EyeCalibration:
        """Return the calibration of a camera of a size (width, height) of which no more is known
        than its intrinsics (3, 3) and distortion.
        """
        return cls(*size, K, D, np.eye(3), np.hstack([K, np.zeros((3, 1))]), model, origin)

    def rectified(self) -> EyeCalibration:
        """Return the calibration of the rectified images."""
        return self.of_rectified(self.width, self.height, self.P, self.origin, self.is_part)

    @property
    def is_straight(self) -> bool:
        """Whether the lens is a pinhole: a fisheye is none, whatever its coefficients."""
        return self.distortion_model != 'equidistant' and not self.D.any()

    @property
    def is_rectified(self) -> bool:
        """Whether the raw image is the rectified one."""
        return (
            self.is_straight
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
        for name, matrix in (('P', self.P), ('K', self.K)):
            if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
                raise CalibrationError(
                    f'{self.origin}: {name}[0] = {matrix[0, 0]:g}, so the camera is not '
                    'calibrated; calibrate the pair first, e.g. with segfloor calibrate'
                )
            for (row, column), most in PINHOLE_ZEROS.items():
                if abs(matrix[row, column] - (row == column)) > most:
                    raise CalibrationError(
                        f'{self.origin}: {name}[{row * matrix.shape[1] + column}] = '
                        f'{matrix[row, column]:g}, so {name} holds a skew or a rotation, which no '
                        'pinhole has; the rotation belongs to R; calibrate the pair again'
                    )
        cx, cy = self.K[0, 2], self.K[1, 2]
        if not (self.is_part or (0 < cx < self.width and 0 < cy < self.height)):
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
        if self.D.size > max(counts) and not self.D[max(counts) :].any():
            object.__setattr__(self, 'D', self.D[: max(counts)])  # some drivers fill up with 0
        if self.D.size not in counts:
            raise CalibrationError(
                f'{self.origin}: {self.distortion_model} has {" or ".join(map(str, counts))} '
                f'coefficients, not {self.D.size}'
            )


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
        # P is f times the place of the left camera in the right one.
        baseline_m, down_m = (P[i, 3] / P[i, i] - right.P[i, 3] / right.P[i, i] for i in (0, 1))
        if abs(down_m) > SAME_ROWS * abs(baseline_m):
            raise CalibrationError(
                f'{right.origin}: P[3] and P[7] put the right camera {baseline_m:.3g} m beside and '
                f'{abs(down_m):.3g} m {"below" if down_m > 0 else "above"} the left one; one above '
                'the other is not supported: turn the pair, or calibrate it again'
            )
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

    @property
    def is_rectified(self) -> bool:
        """Whether the raw images are the rectified ones already."""
        return self.left.is_rectified and self.right.is_rectified

    def rectified(self) -> StereoCalibration:
        """Return the calibration that belongs to the rectified images."""
        return StereoCalibration(self.left.rectified(), self.right.rectified())

    def check_size(self, width: int, height: int, what: str) -> None:
        """Raise CalibrationError unless images of `width` x `height` belong to this calibration."""
        if (width, height) != (self.left.width, self.left.height):
            raise CalibrationError(
                f'{what} is {width}x{height}, but {self.left.origin} is for images of '
                f'{self.left.width}x{self.left.height}; use the calibration of these images'
            )
