"""Drawn chessboards, plain and with markers, seen by a stereo camera that is known exactly."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.core.geometry import invert, make_transform

BOARD, SQUARE_M = (7, 5), 0.03
SIZE = (320, 240)
K_TRUE = np.array([[290.0, 0.0, 163.0], [0.0, 290.0, 118.0], [0.0, 0.0, 1.0]])
BASELINE_M = 0.06

MARKER_M, DICTIONARY = 0.022, '4X4_50'
MARKED_SIZE = (640, 480)
K_MARKED = (
    np.array([[580.0, 0.0, 326.0], [0.0, 580.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([[600.0, 0.0, 312.0], [0.0, 600.0, 243.0], [0.0, 0.0, 1.0]]),
)
T_LEFT_RIGHT = make_transform(
    Rotation.from_euler('xyz', (0.5, -2.0, 1.0), degrees=True).as_matrix(),
    np.array([0.08, 0.002, -0.001]),
)
"""The camera of the boards with markers: two eyes that differ, toed in and rolled."""

PX_PER_SQUARE = 40


def plain_texture() -> NDArray[np.uint8]:
    """Return the picture of the plain board with a white border as wide as a square."""
    squares = np.indices((BOARD[1] + 1, BOARD[0] + 1)).sum(axis=0) % 2 * 200 + 30
    large = np.kron(np.pad(squares, 1, constant_values=230), np.ones((PX_PER_SQUARE,) * 2))
    return large.astype(np.uint8)


def marked_board() -> Any:
    """Return the board with markers as OpenCV has it."""
    aruco, squares = cv2.aruco, (BOARD[0] + 1, BOARD[1] + 1)
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, f'DICT_{DICTIONARY}'))
    if hasattr(aruco, 'CharucoBoard_create'):  # before OpenCV 4.7
        return aruco.CharucoBoard_create(*squares, SQUARE_M, MARKER_M, dictionary)
    return aruco.CharucoBoard(squares, SQUARE_M, MARKER_M, dictionary)


def marked_texture(board: Any = None) -> NDArray[np.uint8]:
    """Return the picture of a board with markers, by default ours, with such a border."""
    board = marked_board() if board is None else board
    draw_board = board.draw if hasattr(board, 'draw') else board.generateImage
    drawn = draw_board(((BOARD[0] + 1) * PX_PER_SQUARE, (BOARD[1] + 1) * PX_PER_SQUARE))
    return np.pad(drawn // 255 * 200 + 30, PX_PER_SQUARE, constant_values=230).astype(np.uint8)


def draw(
    texture: NDArray[np.uint8],
    T_eye_board: NDArray[np.floating],
    K: NDArray[np.floating] = K_TRUE,
    size: tuple[int, int] = SIZE,
) -> NDArray[np.uint8]:
    """Draw the board as a camera without distortion sees it, four times oversampled."""
    # Texture pixel -> board in metres, its origin at the first inner corner (two squares in).
    scale = SQUARE_M / PX_PER_SQUARE
    board = np.array([[scale, 0, 0], [0, scale, 0], [0, 0, 1.0]])
    board[:2, 2] = scale / 2 - 2 * SQUARE_M
    # Centres of the pixels of the oversampled image: u_4 = 4 u + 1.5.
    finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1.0]])
    homography = finer @ K @ T_eye_board[:3, [0, 1, 3]] @ board
    large = cv2.warpPerspective(texture, homography, (4 * size[0], 4 * size[1]), borderValue=120)
    return cv2.resize(large, size, interpolation=cv2.INTER_AREA)


def pose(
    generator: np.random.Generator, middle_m: float, spread: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return a pose (4, 4) of a board in the left eye that looks at it: turned at random, its
    middle beside `middle_m` along x and 0.5 m away, give or take `spread` (3,) in m.
    """
    middle = np.array([(BOARD[0] - 1) / 2, (BOARD[1] - 1) / 2, 0]) * SQUARE_M
    angles = generator.uniform(-0.5, 0.5, 3) * (1, 1, 0.4)
    rotation = Rotation.from_euler('xyz', angles).as_matrix()
    centre = np.array([middle_m, 0, 0.51]) + generator.uniform(-spread, spread)
    return make_transform(rotation, centre - rotation @ middle)


def write_boards(folder: Path, count: int) -> Path:
    """Write pairs of a right camera 60 mm beside the left one, looking the same way."""
    folder.mkdir(parents=True)
    generator, texture = np.random.default_rng(3), plain_texture()
    T_right_left = make_transform(np.eye(3), np.array([-BASELINE_M, 0, 0]))
    for i in range(1, count + 1):
        T = pose(generator, BASELINE_M / 2, np.array([0.05, 0.05, 0.09]))
        cv2.imwrite(str(folder / f'left{i:02d}.png'), draw(texture, T))
        cv2.imwrite(str(folder / f'right{i:02d}.png'), draw(texture, T_right_left @ T))
    return folder


def write_marked_boards(folder: Path, count: int) -> Path:
    """Write pairs of the camera `K_MARKED`, `T_LEFT_RIGHT`: of some of them the board leaves one
    image or both.
    """
    folder.mkdir(parents=True)
    generator, texture = np.random.default_rng(4), marked_texture()
    for i in range(1, count + 1):
        T = pose(generator, 0.04, np.array([0.2, 0.15, 0.12]))
        for side, T_eye_left, K in (
            ('left', np.eye(4), K_MARKED[0]),
            ('right', invert(T_LEFT_RIGHT), K_MARKED[1]),
        ):
            image = draw(texture, T_eye_left @ T, K, MARKED_SIZE)
            cv2.imwrite(str(folder / f'{side}{i:02d}.png'), image)
    return folder
