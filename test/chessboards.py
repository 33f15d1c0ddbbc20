"""Drawn chessboards, seen by a stereo camera that is known exactly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

BOARD, SQUARE_M = (7, 5), 0.03
SIZE = (320, 240)
K_TRUE = np.array([[290.0, 0.0, 163.0], [0.0, 290.0, 118.0], [0.0, 0.0, 1.0]])
BASELINE_M = 0.06


def draw(R_eye_board: NDArray[np.floating], t_eye_board: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Draw the board as a camera without distortion sees it, four times oversampled."""
    squares = np.indices((BOARD[1] + 1, BOARD[0] + 1)).sum(axis=0) % 2 * 200 + 30
    texture = np.kron(np.pad(squares, 1, constant_values=230), np.ones((40, 40))).astype(np.uint8)
    # Texture pixel -> board in metres, its origin at the first inner corner (two squares in).
    scale = SQUARE_M / 40
    board = np.array([[scale, 0, 0], [0, scale, 0], [0, 0, 1.0]])
    board[:2, 2] = scale / 2 - 2 * SQUARE_M
    plane = np.column_stack([R_eye_board[:, 0], R_eye_board[:, 1], t_eye_board])
    # Centres of the pixels of the oversampled image: u_4 = 4 u + 1.5.
    finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1.0]])
    homography = finer @ K_TRUE @ plane @ board
    size = (4 * SIZE[0], 4 * SIZE[1])
    image = cv2.warpPerspective(texture, homography, size, borderValue=120)
    return cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)


def write_boards(folder: Path, count: int) -> Path:
    """Write pairs of a right camera 60 mm beside the left one, looking the same way."""
    folder.mkdir(parents=True)
    generator = np.random.default_rng(3)
    middle = np.array([(BOARD[0] - 1) / 2, (BOARD[1] - 1) / 2, 0]) * SQUARE_M
    for i in range(1, count + 1):
        angles = generator.uniform(-0.5, 0.5, 3) * (1, 1, 0.4)
        rotation = Rotation.from_euler('xyz', angles).as_matrix()
        x_m, y_m, depth_m = generator.uniform((-0.05, -0.05, 0.42), (0.05, 0.05, 0.6))
        centre = np.array([x_m + BASELINE_M / 2, y_m, depth_m])
        translation = centre - rotation @ middle
        cv2.imwrite(str(folder / f'left{i:02d}.png'), draw(rotation, translation))
        offset = np.array([BASELINE_M, 0, 0])
        cv2.imwrite(str(folder / f'right{i:02d}.png'), draw(rotation, translation - offset))
    return folder
