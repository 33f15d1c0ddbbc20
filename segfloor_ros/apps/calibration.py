"""Calibration of a stereo pair from images of a chessboard, plain or with markers (ChArUco), and
the check of a calibration on a recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings.calibration_files import (
    holds_both,
    read_calibration,
    ros_calibration,
)
from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.apps.recordings.image_folders import find_image_pairs
from segfloor_ros.apps.recordings.other_calibrations import form_of, read_other
from segfloor_ros.apps.recordings.source import StereoSource
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import Grey
from segfloor_ros.core.contracts import InputFault, StereoFrame
from segfloor_ros.core.errors import CalibrationError, CorruptImageError, InputError
from segfloor_ros.core.files.images import read_grey
from segfloor_ros.core.files.writing import PAGE as HTML
from segfloor_ros.core.files.writing import YAML, check_output, write_output
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.core.plugins.rig.check import EVERY, RigCheck
from segfloor_ros.core.plugins.rig.estimates import ROWS_PX

MIN_PAIRS = 5
"""Fewer views do not hold the intrinsics (Zhang needs 3; distortion needs more)."""

MIN_CORNERS = 6
"""Corners of a board with markers that both eyes must see: four give the pose of a plane, all of
which is then fitted to their noise."""

COVERED = 0.8
"""Share of an image that the hull of all corners should have: a margin of 5 % of the width and of
the height on each side. Beyond the hull the model of the lens is extrapolated.
"""

CORNER_PX = 0.3
"""RMS error of the corners of sharp pictures of a flat board; more is blur, motion or a bent board.
"""

MAX_SCALE_ERROR = 0.01
"""A ruler shows the side of a square to half of this."""

SOLVER_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)

FILES, PAGE = ('left.yaml', 'right.yaml'), 'calibration.html'
KINDS = dict.fromkeys(FILES, YAML) | {PAGE: HTML}

DICTIONARY = '5X5_1000'
"""Of the markers of a ChArUco board; it has those of 5X5_50, 5X5_100 and 5X5_250 as its first."""

Corners = NDArray[np.float32]
"""Pixels (n, 1, 2) of corners in an image."""


def eight_bit(image: Grey) -> NDArray[np.uint8]:
    """Return an image with its darkest pixel at 0 and its brightest at 255, one of 8 bits as it
    is.
    """
    if image.dtype != np.uint8:
        image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    return np.asarray(image, np.uint8)


@dataclass(frozen=True)
class Board:
    """A flat chessboard.

    columns, rows: inner corners along its two sides, of a plain board the long one first. square_m:
    side of a square; it sets the baseline. marker_m: side of the markers in the white squares of a
    ChArUco board, 0: a plain one. dictionary: of the markers, e.g. 5X5_100. Raises InputError for
    an impossible board, and where OpenCV cannot find its markers.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = DICTIONARY

    def __post_init__(self) -> None:
        if not (0 < self.square_m < 100 and 0 <= self.marker_m < self.square_m) or (
            min(self.columns, self.rows) < 3
        ):
            raise InputError(f'{self} is impossible')
        if self.marker_m:
            _ = self._find_marked

    def __str__(self) -> str:
        marked = f' with markers of {self.marker_m} m' if self.marker_m else ''
        return f'a board of {self.columns}x{self.rows} corners and {self.square_m} m{marked}'

    @property
    def corners_m(self) -> NDArray[np.float32]:
        """The inner corners (columns * rows, 3), row by row."""
        corners = np.zeros((self.columns * self.rows, 3), np.float32)
        corners[:, :2] = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) * self.square_m
        return corners

    @property
    def diagonal_m(self) -> float:
        """The distance between the first and the last inner corner."""
        return float(np.linalg.norm(self.corners_m[-1]))

    def find(self, image: Grey) -> tuple[NDArray[np.intp], Corners] | None:
        """Return which corners (n,) of the board a grey image (H, W) shows and where, None where
        there is no board: all corners of a plain board, at least `MIN_CORNERS` of a marked one.
        """
        image = eight_bit(image)
        if min(image.shape) < 2 * max(self.columns, self.rows):
            return None  # OpenCV refuses images of a few pixels
        if self.marker_m:
            corners, ids = self._find_marked(image)
            if ids is None or len(ids) < MIN_CORNERS:
                return None
            return ids.ravel().astype(np.intp), corners.reshape(-1, 1, 2)
        found, corners = cv2.findChessboardCorners(image, (self.columns, self.rows))
        if not found:
            return None
        corners = corners.reshape(-1, 1, 2).astype(np.float32)
        # The window stays within the squares, or it would catch the next corner.
        grid = corners.reshape(self.rows, self.columns, 2)
        spacing_px = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min())
        half = int(np.clip(spacing_px / 3, 2, 11))
        cv2.cornerSubPix(image, corners, (half, half), (-1, -1), SOLVER_END)
        return np.arange(len(corners)), corners

    def find_in_both(
        self, left: Grey, right: Grey
    ) -> tuple[NDArray[np.intp], tuple[Corners, Corners]] | None:
        """Return which corners (n,) of the board both images of a pair show and where, None where
        there are too few.
        """
        found = self.find(left)
        other = None if found is None else self.find(right)
        if found is None or other is None:
            return None
        ids, here, there = np.intersect1d(found[0], other[0], return_indices=True)
        left_px, right_px = found[1][here], other[1][there]
        shown = self.corners_m[ids]
        if len(ids) < MIN_CORNERS or np.linalg.matrix_rank(shown - shown[0]) < 2:
            return None
        # A board seen upside down in one eye would be matched corner by corner in reverse.
        if np.vdot(left_px[-1] - left_px[0], right_px[-1] - right_px[0]) < 0:
            right_px = right_px[::-1].copy()
        return ids, (left_px, right_px)

    @cached_property
    def _find_marked(self) -> Callable[[Grey], tuple[Any, Any]]:
        """What returns corners and their numbers, None without any: the way to them is another one
        since OpenCV 4.7.
        """
        aruco = getattr(cv2, 'aruco', None)
        if aruco is None:
            raise InputError(
                f'OpenCV {cv2.__version__} here has no cv2.aruco, which finds ChArUco boards; '
                'install opencv-python-headless 4.7 or later, or take a plain chessboard'
            )
        known = [name[5:] for name in dir(aruco) if name.startswith('DICT_')]
        if self.dictionary not in known:
            raise InputError(f'no dictionary {self.dictionary}; known are {", ".join(known)}')
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, f'DICT_{self.dictionary}'))
        size, sides = (self.columns + 1, self.rows + 1), (self.square_m, self.marker_m)
        if size[0] * size[1] // 2 > len(dictionary.bytesList):
            raise InputError(f'{self}: has more markers than the dictionary {self.dictionary}')
        if hasattr(aruco, 'CharucoDetector'):
            boards = [aruco.CharucoBoard(size, *sides, dictionary) for _ in range(2)]
            boards[1].setLegacyPattern(True)  # as printed before OpenCV 4.6
            detectors = [aruco.CharucoDetector(board) for board in boards]

            def find(image: Grey) -> tuple[Any, Any]:
                found = (detector.detectBoard(image)[:2] for detector in detectors)
                return next((one for one in found if one[1] is not None), (None, None))

            return find
        board = aruco.CharucoBoard_create(*size, *sides, dictionary)

        def find_by_functions(image: Grey) -> tuple[Any, Any]:
            markers, ids, _ = aruco.detectMarkers(image, dictionary)
            if ids is None:
                return None, None
            return aruco.interpolateCornersCharuco(markers, ids, image, board)[1:]

        return find_by_functions


@dataclass(frozen=True)
class View:
    """A board in both images of a pair: which corners (n,) of it, and where in each."""

    paths: tuple[Path, Path]
    ids: NDArray[np.intp]
    corners: tuple[Corners, Corners]


@dataclass(frozen=True)
class CalibrationResult:
    """A calibration and how well it explains the corners.

    rms_px: of the reprojected corners, both eyes. views: the pairs in which both eyes saw the
    board, the worst first, view_errors_px (N, 3) of each: RMS of the reprojected corners in the
    left and the right eye, and of the difference in rows after rectification. left_out: what was
    wrong with other pairs, empty where nothing was. pairs_total: with them.
    """

    calibration: StereoCalibration
    board: Board
    rms_px: float
    views: list[View]
    view_errors_px: Array
    left_out: str
    pairs_total: int

    @property
    def epipolar_rms_px(self) -> float:
        """The RMS difference in rows between the rectified corners of both eyes."""
        counts = [len(view.ids) for view in self.views]
        return float(np.sqrt(np.average(self.view_errors_px[:, 2] ** 2, weights=counts)))

    def seen_share(self, side: int) -> float:
        """Return the share of an image that the hull of all corners in it has: of the left eye
        (side 0) or the right one.
        """
        corners = np.concatenate([view.corners[side] for view in self.views])
        eye = self.calibration.left
        return cv2.contourArea(cv2.convexHull(corners)) / (eye.width * eye.height)

    @property
    def advice(self) -> list[str]:
        """What to do before the calibration is used, each in a line; empty where it is good."""
        lines = []
        for side, name in enumerate(('left', 'right')):
            share = self.seen_share(side)
            if share < COVERED:
                lines.append(
                    f'the board covers {int(100 * share)}% of the {name} image, and beyond that '
                    'the lens is a guess: add pairs with the board at the borders and in the '
                    'corners, until '
                    f'it covers {COVERED:.0%}'
                )
        worst_px = max(self.rms_px, self.epipolar_rms_px)
        if worst_px > CORNER_PX:
            lines.append(
                f'the corners err by {worst_px:.2f} px, sharp pictures of a flat board by '
                f'{CORNER_PX} px at most: look at {self.views[0].paths[0].name}, take out pairs '
                'that are blurred or show a bent board, and calibrate again'
            )
        return lines


def calibrate_folder(
    folder: Path,
    board: Board,
    out: Path | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> CalibrationResult:
    """Calibrate from a folder of images of a board; write left.yaml and right.yaml.

    out: folder for the files, else `folder`. on_progress is called with the number of pairs
    searched. Zhang, A flexible new technique for camera calibration, TPAMI 2000; both eyes and
    their relative pose are refined together. Boards with markers: Garrido-Jurado et al., Automatic
    generation and detection of highly reliable fiducial markers under occlusion, Pattern
    Recognition 2014. Raises InputError or CalibrationError.
    """
    left, right = find_image_pairs(folder)
    target = folder if out is None else out
    for name, kind in KINDS.items():
        check_output(target / name, kind)
    views, size, left_out = _find_boards(list(zip(left, right, strict=True)), board, on_progress)
    if len(views) < MIN_PAIRS:
        raise CalibrationError(
            f'{folder}: {board} is seen in {len(views)} of {len(left)} pairs, {MIN_PAIRS} are '
            f'needed{left_out and ": "}{left_out}; check what the board is, or take more pictures'
        )
    calibration, rms_px, errors_px = _solve(views, size, board, str(folder))
    write_calibration(calibration, target)
    rows_px = [_rows_rms_px(calibration, view) for view in views]
    errors_px = np.column_stack([errors_px, rows_px])
    order = np.argsort(-np.linalg.norm(errors_px[:, :2], axis=1), kind='stable')
    views = [views[i] for i in order]
    return CalibrationResult(
        calibration, board, rms_px, views, errors_px[order], left_out, len(left)
    )


def write_calibration(calibration: StereoCalibration, folder: Path) -> None:
    """Write left.yaml and right.yaml. Raises InputError."""
    for name, eye in zip(FILES, (calibration.left, calibration.right), strict=True):
        text = ros_calibration(eye, name.removesuffix('.yaml'))
        write_output(folder / name, YAML, text.encode())


def convert_calibration(file: Path, size: tuple[int, int] | None, out: Path) -> StereoCalibration:
    """Write the calibration that another tool has put into one file as left.yaml and right.yaml.
    size: (width, height) of the images, where the file does not say it. Raises InputError or
    CalibrationError.
    """
    for name in FILES:
        check_output(out / name, YAML, [file])
    is_other = form_of(file) is not None or not holds_both(file)
    calibration = read_other(file, size=size) if is_other else read_calibration(file, file)
    write_calibration(calibration, out)
    return calibration


@dataclass(frozen=True)
class RecordingCheck:
    """How a calibration fits a recording. pairs: of it. rows_px: by how much the same points stand
    in other rows, the median and the most along it. scale: lengths on a board as measured, as
    multiples of the true ones, the median of `boards` pairs that show it. None: not seen. faults:
    of the check of the rig, and what the board shows.
    """

    pairs: int
    rows_px: tuple[float, float] | None
    scale: float | None
    boards: int
    faults: list[InputFault]


def check_recording(
    source: StereoSource,
    board: Board | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> RecordingCheck:
    """Measure how the calibration of a recording fits it: by the check of the rig, and where a
    board is in view by its corners, which look alike to the former. Raises InputError.
    """
    if source.takes_depth:
        raise InputError(f'{source.name}: has depth for right images; two eyes are checked only')
    check, shows_board, pairs = RigCheck(source.camera), False, 0
    rows_px: list[float] = []
    on_boards: list[tuple[float, float]] = []
    for frame in source.frames():
        if board is not None and pairs % EVERY == 0:
            seen = _rows_and_scale(board, frame, source.camera)
            on_boards += seen
            if shows_board and not seen:
                check.jump()
            shows_board = bool(seen)
        if not shows_board:
            check.see(frame)
            if check.frames % EVERY == 1 and np.isfinite(check.rows_px):
                rows_px.append(check.rows_px)
        pairs += 1
        on_progress(pairs)
    faults = [*check.faults.values()]
    scale = None
    if on_boards:
        board_rows_px, scales = np.array(on_boards).T
        rows_px += board_rows_px.tolist()
        scale = float(np.median(scales))
        faults += _faults_on_boards(float(np.median(board_rows_px)), scale)
    rows = (float(np.median(rows_px)), max(rows_px)) if rows_px else None
    return RecordingCheck(pairs, rows, scale, len(on_boards), faults)


def _faults_on_boards(rows_px: float, scale: float) -> Iterator[InputFault]:
    remedy = 'calibrate again (segfloor calibrate)'
    if rows_px > ROWS_PX:
        finding = f'show the corners of the board {rows_px:.1f} rows apart'
        yield InputFault('rows_apart', round(rows_px, 2), 'px', finding, remedy)
    if abs(scale - 1) > MAX_SCALE_ERROR:
        finding = f'show the board {scale:.3f} times as large as it is'
        remedy = f'measure its squares; if they are as given, {remedy}'
        yield InputFault('scale', round(100 * (scale - 1), 1), '%', finding, remedy)


def _rows_and_scale(
    board: Board, frame: StereoFrame, camera: StereoCamera
) -> list[tuple[float, float]]:
    """Return by how many rows the corners of a board in a rectified pair are off (median), and how
    many times as large as it is it is measured; nothing where it is not seen. Umeyama,
    Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
    """
    found = board.find_in_both(frame.left, frame.right)
    if found is None:
        return []
    ids, (left, right) = found
    disparity_px, rows_px = (left - right)[:, 0].T
    if disparity_px.min() <= 0:
        return []
    measured = camera.back_project(left[:, 0], camera.disparity_times_depth / disparity_px)
    true = board.corners_m[ids]
    measured, true = measured - measured.mean(axis=0), true - true.mean(axis=0)
    scale = np.linalg.svd(measured.T @ true, compute_uv=False).sum() / (true**2).sum()
    return [(float(np.median(np.abs(rows_px))), float(scale))]


def rectified_pixels(eye: EyeCalibration, uv_px: NDArray[np.floating]) -> Array:
    """Return where raw pixels (n, 1, 2) of one eye are in its rectified image, (n, 2)."""
    undistort = cv2.undistortPoints
    if eye.distortion_model == 'equidistant':
        undistort = cv2.fisheye.undistortPoints
    points = undistort(uv_px.astype(np.float64), eye.K, eye.D, R=eye.R, P=eye.P[:, :3].copy())
    return points.reshape(-1, 2)


def _find_boards(
    pairs: list[tuple[Path, Path]], board: Board, on_progress: Callable[[int], None]
) -> tuple[list[View], tuple[int, int], str]:
    """Return the pairs that show the board, the size of their images (width, height), and in a line
    what is wrong with the others.
    """
    views: list[View] = []
    shape: tuple[int, ...] | None = None
    faults: dict[str, list[str]] = {}
    for done, paths in enumerate(pairs, 1):
        try:
            left, right = (read_grey(path) for path in paths)
            found = board.find_in_both(left, right)
        except CorruptImageError as error:
            faults.setdefault('cannot be read', []).append(str(error))
        else:
            if found is None:
                names = f'{paths[0].name}, {paths[1].name}'
                faults.setdefault('do not show enough of it in both eyes', []).append(names)
            elif len({left.shape, right.shape, shape or left.shape}) > 1:
                raise InputError(
                    f'{paths[0]}, {paths[1].name}: not of the size of the other images'
                )
            else:
                shape = left.shape
                views.append(View(paths, *found))
        on_progress(done)
    left_out = ', '.join(f'{len(of)} {fault} (first: {of[0]})' for fault, of in faults.items())
    height, width = shape or (0, 0)
    return views, (width, height), left_out


def _solve(
    views: list[View], size: tuple[int, int], board: Board, name: str
) -> tuple[StereoCalibration, float, Array]:
    """Return the calibration, the RMS error of all corners in px, and that of each view (N, 2) in
    the left and the right eye.
    """
    boards = [board.corners_m[view.ids] for view in views]
    left, right = ([view.corners[side] for view in views] for side in (0, 1))
    lenses = [
        cv2.calibrateCamera(boards, pixels, size, None, None, criteria=SOLVER_END)[1:3]
        for pixels in (left, right)
    ]
    rms_px, K1, D1, K2, D2, R, t, *_, errors_px = cv2.stereoCalibrateExtended(
        boards, left, right, *lenses[0], *lenses[1], size, np.zeros((3, 3)), np.zeros((3, 1)),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=SOLVER_END,
    )  # fmt: skip
    left_eye, right_eye = (
        EyeCalibration.of_raw(size, K, D.ravel()[:5], origin=name) for K, D in ((K1, D1), (K2, D2))
    )
    T_right_left = make_transform(R, t.ravel())
    calibration = calibration_from_extrinsics(left_eye, right_eye, T_right_left)
    return calibration, float(rms_px), np.asarray(errors_px).reshape(-1, 2)


def _rows_rms_px(calibration: StereoCalibration, view: View) -> float:
    left_px = rectified_pixels(calibration.left, view.corners[0])
    right_px = rectified_pixels(calibration.right, view.corners[1])
    return float(np.sqrt(np.mean((left_px - right_px)[:, 1] ** 2)))
