"""Calibration of a stereo pair from images of a chessboard."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import ros_calibration
from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.image_folders import find_image_pairs
from segfloor_ros.errors import CalibrationError, InputError, os_errors
from segfloor_ros.files.images import CorruptImageError, read_grey
from segfloor_ros.files.results import add_files, check_target
from segfloor_ros.geometry import Array, make_transform

MIN_PAIRS = 5
"""Fewer views do not hold the intrinsics (Zhang needs 3; distortion needs more)."""

SOLVER_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)

FILES = ('left.yaml', 'right.yaml')

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CalibrationResult:
    """A calibration and how well it explains the corners.

    rms_px: of the reprojected corners, both eyes. epipolar_rms_px: of the difference in rows
    between the rectified corners of both eyes. pairs_used, pairs_total: where both eyes saw the
    whole board.
    """

    calibration: StereoCalibration
    rms_px: float
    epipolar_rms_px: float
    pairs_used: int
    pairs_total: int


@dataclass(frozen=True)
class _Views:
    """Corners (n, 1, 2) float32 of the board in each pair, and the image size."""

    left: list[NDArray[np.float32]]
    right: list[NDArray[np.float32]]
    size: tuple[int, int]


def calibrate_folder(
    folder: Path,
    square_m: float,
    board: tuple[int, int] = (9, 6),
    out: Path | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> CalibrationResult:
    """Calibrate from a folder of chessboard images; write left.yaml and right.yaml.

    board: inner corners along the long and the short side. square_m: side of a square; it sets
    the baseline. out: folder for the files, else `folder`. on_progress is told the number of
    pairs searched. Zhang, A flexible new technique for camera calibration, TPAMI 2000; both
    eyes and their relative pose are refined together. Raises InputError or CalibrationError.
    """
    if not 0 < square_m < 100 or min(board) < 3:
        raise InputError(f'a board of {board[0]}x{board[1]} corners and {square_m} m is impossible')
    left, right = find_image_pairs(folder)
    target = folder if out is None else out
    check_target(target, FILES)
    views = _find_boards(folder, left, right, board, on_progress)
    calibration, rms_px = _solve(views, board, square_m, str(folder))
    texts = ros_calibration(calibration.left, 'left'), ros_calibration(calibration.right, 'right')
    with os_errors(f'{target}: cannot be written', '; choose another --out'):
        add_files(target, {n: text.encode() for n, text in zip(FILES, texts, strict=True)})
    error_px = epipolar_rms_px(calibration, views.left, views.right)
    return CalibrationResult(calibration, rms_px, error_px, len(views.left), len(left))


def epipolar_rms_px(
    calibration: StereoCalibration,
    left: list[NDArray[np.float32]],
    right: list[NDArray[np.float32]],
) -> float:
    """Return the RMS difference in rows of matching raw pixels (n, 1, 2) after rectification."""
    rows = [
        rectified_pixels(eye, np.concatenate(corners))[:, 1]
        for eye, corners in ((calibration.left, left), (calibration.right, right))
    ]
    return float(np.sqrt(np.mean((rows[0] - rows[1]) ** 2)))


def rectified_pixels(eye: EyeCalibration, uv_px: NDArray[np.floating]) -> Array:
    """Return where raw pixels (n, 1, 2) of one eye are in its rectified image, (n, 2)."""
    undistort = cv2.undistortPoints
    if eye.distortion_model == 'equidistant':
        undistort = cv2.fisheye.undistortPoints
    points = undistort(uv_px.astype(np.float64), eye.K, eye.D, R=eye.R, P=eye.P[:, :3].copy())
    return points.reshape(-1, 2)


def _find_boards(
    folder: Path,
    left: list[Path],
    right: list[Path],
    board: tuple[int, int],
    on_progress: Callable[[int], None],
) -> _Views:
    views = _Views([], [], (0, 0))
    for done, (left_path, right_path) in enumerate(zip(left, right, strict=True), 1):
        left_view, right_view = (find_corners(path, board) for path in (left_path, right_path))
        on_progress(done)
        if left_view is None or right_view is None:
            logger.warning('%s, %s: the board is not seen whole', left_path, right_path.name)
            continue
        (left_corners, left_size), (right_corners, right_size) = left_view, right_view
        if len({left_size, right_size, views.size} - {(0, 0)}) > 1:
            raise InputError(f'{left_path}, {right_path.name}: not of the size of the other images')
        # A board seen upside down in one eye would be matched corner by corner in reverse.
        if np.vdot(left_corners[-1] - left_corners[0], right_corners[-1] - right_corners[0]) < 0:
            right_corners = right_corners[::-1].copy()
        views.left.append(left_corners)
        views.right.append(right_corners)
        views = dataclasses.replace(views, size=left_size)
    if len(views.left) < MIN_PAIRS:
        raise CalibrationError(
            f'{folder}: a board of {board[0]}x{board[1]} inner corners is seen whole in '
            f'{len(views.left)} of {len(left)} pairs, {MIN_PAIRS} are needed; check the number of '
            'corners, or take more images'
        )
    return views


def _solve(
    views: _Views, board: tuple[int, int], square_m: float, name: str
) -> tuple[StereoCalibration, float]:
    corners = np.zeros((board[0] * board[1], 3), np.float32)
    corners[:, :2] = np.mgrid[: board[0], : board[1]].T.reshape(-1, 2) * square_m
    boards = [corners] * len(views.left)
    K, D = [], []
    for pixels in (views.left, views.right):
        _, intrinsics, distortion, *_ = cv2.calibrateCamera(
            boards, pixels, views.size, None, None, criteria=SOLVER_END
        )
        K.append(intrinsics)
        D.append(distortion)
    rms_px, K1, D1, K2, D2, R, t, *_ = cv2.stereoCalibrate(
        boards, views.left, views.right, K[0], D[0], K[1], D[1], views.size,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=SOLVER_END,
    )  # fmt: skip
    eyes = (_raw_eye(K1, D1, views.size, name), _raw_eye(K2, D2, views.size, name))
    T_right_left = make_transform(R, t.ravel())
    return StereoCalibration.from_extrinsics(*eyes, T_right_left), float(rms_px)


def _raw_eye(K: Array, D: Array, size: tuple[int, int], name: str) -> EyeCalibration:
    P = np.hstack([K, np.zeros((3, 1))])
    return EyeCalibration(*size, K, D.ravel()[:5], np.eye(3), P, origin=name)


def find_corners(
    path: Path, board: tuple[int, int]
) -> tuple[NDArray[np.float32], tuple[int, int]] | None:
    """Return the inner corners (n, 1, 2) of the board in an image file, row by row, and the image
    size (width, height); None, with a warning for a damaged file, where the board is not seen.

    board: corners along the long and the short side.
    """
    try:
        image = read_grey(path)
    except CorruptImageError as error:
        logger.warning('%s', error)
        return None
    if image.dtype != np.uint8:
        image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    if min(image.shape) < 2 * max(board):
        return None  # OpenCV refuses images of a few pixels
    found, corners = cv2.findChessboardCorners(image, board)
    if not found:
        return None
    corners = corners.reshape(-1, 1, 2).astype(np.float32)
    # The window stays within the squares, or it would catch the next corner.
    grid = corners.reshape(board[1], board[0], 2)
    spacing_px = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min())
    half = int(np.clip(spacing_px / 3, 2, 11))
    cv2.cornerSubPix(image, corners, (half, half), (-1, -1), SOLVER_END)
    return corners, (image.shape[1], image.shape[0])
