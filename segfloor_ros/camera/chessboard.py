"""Finding the corners of a chessboard in an image."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.images import CorruptImageError
from segfloor_ros.camera.sources.files import read_grey

SUBPIX_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)

logger = logging.getLogger(__name__)


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
    found, corners = cv2.findChessboardCorners(image, board)
    if not found:
        return None
    corners = corners.reshape(-1, 1, 2).astype(np.float32)
    # The window stays within the squares, or it would catch the next corner.
    grid = corners.reshape(board[1], board[0], 2)
    spacing_px = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min())
    half = int(np.clip(spacing_px / 3, 2, 11))
    cv2.cornerSubPix(image, corners, (half, half), (-1, -1), SUBPIX_END)
    return corners, (image.shape[1], image.shape[0])
