"""Calibration of a stereo pair and of each of its cameras, and rectification by it: epipolar lines
become rows.

The fields of one camera are those of ROS calibration files and of `sensor_msgs/CameraInfo`, as
arrays.

The block grid of JPEG images is smoothed first. Where texture is weaker than the quantisation a
block of 8 x 8 pixels becomes flat, and the steps between blocks are the strongest texture there is.
They stand still in the image: a stereo matcher finds them at the one disparity at which the grids
of both images coincide, however far away the surface is.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import Array, invert

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

FISHEYE_RESOLUTION = 0.7
"""So much of a fisheye's resolution its rectified view keeps in the middle. A plane cannot have all
of it and the borders, too: this leaves 125 degrees of an image of two radians and a half.
"""

Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]

_BLOCK_PX = 8
_QUIET_GREY = 3
_SIGNIFICANT_GREY = 8
"""Larger steps are edges of things, wherever they are."""
_MIN_RATIO, _MIN_PIXELS = 1.5, 200
"""A grid is where steps across it are so many times as large, over so many pixels."""
_MAX_STEP_GREY = 16.0
"""Larger steps at the grid are left alone, too."""


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

    @classmethod
    def of_raw(
        cls, size: tuple[int, int], K: Array, D: Array, model: str = 'plumb_bob', origin: str = ''
    ) -> EyeCalibration:
        """Return the calibration of a camera of a size (width, height) of which no more is known
        than its intrinsics (3, 3) and distortion.
        """
        return cls(*size, K, D, np.eye(3), np.hstack([K, np.zeros((3, 1))]), model, origin)

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
        if self.D.size > max(counts) and not self.D[max(counts) :].any():
            object.__setattr__(self, 'D', self.D[: max(counts)])  # some drivers fill up with 0
        if self.D.size not in counts:
            raise CalibrationError(
                f'{self.origin}: {self.distortion_model} has {" or ".join(map(str, counts))} '
                f'coefficients, not {self.D.size}'
            )


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


class StereoRectifier:
    """Rectifies pairs of one calibration. The maps are computed once, in fixed point (a 32nd of
    a pixel); pairs that are rectified already keep their geometry.
    """

    def __init__(self, calibration: StereoCalibration) -> None:
        self.calibration = calibration
        self.camera = calibration.camera
        self._maps: tuple[Maps, Maps] | None = None
        if not calibration.is_rectified:
            self._maps = rectification_maps(calibration.left), rectification_maps(calibration.right)

    def rectify(
        self, left: NDArray[np.uint8], right: NDArray[Any]
    ) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        """Return the rectified grey images (H, W) of a raw grey pair (H, W), uint8. A disparity in
        place of the right image is aligned with the left one.

        The block grid of compressed images is smoothed. Pixels that lie outside of the raw image
        are 0. Raises CalibrationError when the size is not the calibration's.
        """
        for side, image in (('the left image', left), ('the right image', right)):
            self.calibration.check_size(image.shape[1], image.shape[0], side)
        left, right = (im if is_disparity(im) else deblocked(im) for im in (left, right))
        if self._maps is None:
            return left, right
        left_maps, right_maps = self._maps
        rectified = cv2.remap(left, *left_maps, cv2.INTER_LINEAR)
        if is_disparity(right):
            nan = (float('nan'),)
            return rectified, cv2.remap(right, *left_maps, cv2.INTER_NEAREST, borderValue=nan)
        return rectified, cv2.remap(right, *right_maps, cv2.INTER_LINEAR)

    def rectify_colour(self, left: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the rectified left image (H, W, 3) of a raw one."""
        if self._maps is None:
            return left
        return np.asarray(cv2.remap(left, *self._maps[0], cv2.INTER_LINEAR), np.uint8)

    def rectify_mask(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a mask (H, W) of the raw left image on the rectified one: 255 where it is more
        than half, 0 elsewhere. Raises CalibrationError when the size is not the calibration's.
        """
        self.calibration.check_size(mask.shape[1], mask.shape[0], 'the mask of what moves')
        if self._maps is not None:
            mask = np.asarray(cv2.remap(mask, *self._maps[0], cv2.INTER_NEAREST), np.uint8)
        return np.where(mask > 127, np.uint8(255), np.uint8(0))


def rectification_maps(eye: EyeCalibration) -> Maps:
    """Return where each pixel of the rectified image is in the raw one, as fixed-point maps of
    `cv2.remap`.
    """
    size = (eye.width, eye.height)
    arguments = (eye.K, eye.D, eye.R, eye.P[:, :3].copy(), size, cv2.CV_16SC2)
    if eye.distortion_model != 'equidistant':
        maps = cv2.initUndistortRectifyMap(*arguments)
        return maps[0], maps[1]
    maps = cv2.fisheye.initUndistortRectifyMap(*arguments)
    maps[0][_is_beyond_lens(eye)] = np.iinfo(np.int16).min
    return maps[0], maps[1]


def _is_beyond_lens(eye: EyeCalibration) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of the view of a fisheye lie further out than its model goes: up
    to where the radius in the raw image grows with the angle. What lies behind it would be a
    mirror image (Kannala and Brandt, A generic camera model, PAMI 2006).
    """
    angles = np.linspace(0, np.pi / 2, eye.width + eye.height)
    falling = np.flatnonzero(np.diff(angles * np.polyval([*eye.D[::-1], 1.0], angles**2)) <= 0)
    limit = angles[falling[0]] if len(falling) else np.pi / 2
    u, v = np.meshgrid(np.arange(eye.width), np.arange(eye.height))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays = pixels @ np.linalg.inv(eye.P[:, :3]).T @ eye.R
    return np.asarray(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]) > limit)


def deblocked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a raw grey image (H, W) with the steps between flat blocks smoothed, the image itself
    where it shows no block grid.

    The grid is that of the compressed image: not to be used on rectified ones.
    """
    if not is_blocky(image):
        return image
    smooth = image.astype(np.float32)
    _smooth_columns(smooth)
    _smooth_columns(smooth.T)
    return np.clip(np.rint(smooth), 0, 255).astype(np.uint8)


def is_blocky(image: NDArray[np.uint8]) -> bool:
    """Return whether quiet parts of a grey image (H, W) have larger steps on the grid of eight
    pixels than within its blocks, along the rows or along the columns.
    """
    half = _BLOCK_PX // 2
    return max(_blockiness(image[::half]), _blockiness(image[:, ::half].T)) > _MIN_RATIO


def _blockiness(image: NDArray[np.uint8]) -> float:
    """Return the ratio of the mean step across the borders of blocks to that in their middle."""
    grey = image.astype(np.int16)

    def mean_step(first: int) -> float:
        before, at, after, beyond = (
            grey[:, first + i : grey.shape[1] - 8 + i : _BLOCK_PX] for i in (-2, -1, 0, 1)
        )
        quiet = (np.abs(at - before) < _QUIET_GREY) & (np.abs(beyond - after) < _QUIET_GREY)
        step = np.abs(after - at)
        quiet &= step <= _SIGNIFICANT_GREY
        return float(step[quiet].mean()) if np.count_nonzero(quiet) >= _MIN_PIXELS else 0.0

    within = 0.5 * (mean_step(_BLOCK_PX + 3) + mean_step(_BLOCK_PX + 5))
    return mean_step(_BLOCK_PX) / max(within, 0.1)


def _smooth_columns(grey: NDArray[np.float32]) -> None:
    """Turn the steps between the columns of two blocks into ramps, in place.

    Only steps that are larger than what goes on in the half blocks beside them.
    """
    half = _BLOCK_PX // 2
    last = grey.shape[1] - half + 1

    def column(offset: int) -> NDArray[np.float32]:
        return grey[:, _BLOCK_PX + offset : last + offset : _BLOCK_PX]

    step = column(0) - column(-1)
    size = np.abs(step)
    activity = np.abs(column(-1) - column(-half))
    activity += np.abs(column(half - 1) - column(0))
    step[(size >= _MAX_STEP_GREY) | (activity >= np.maximum(size, 2))] = 0
    for i in range(half):
        share = step * np.float32(0.5 - (i + 0.5) / _BLOCK_PX)
        before, after = column(-1 - i), column(i)
        before += share
        after -= share
