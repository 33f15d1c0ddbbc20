"""Calibration from drawn chessboards of a camera that is known exactly."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import write_image
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.calibrate import calibrate_folder
from segfloor_ros.camera.calibration_files import read_calibration
from segfloor_ros.errors import CalibrationError, InputError

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
    generator = np.random.default_rng(3)
    middle = np.array([(BOARD[0] - 1) / 2, (BOARD[1] - 1) / 2, 0]) * SQUARE_M
    for i in range(1, count + 1):
        angles = generator.uniform(-0.5, 0.5, 3) * (1, 1, 0.4)
        rotation = Rotation.from_euler('xyz', angles).as_matrix()
        x_m, y_m, depth_m = generator.uniform((-0.05, -0.05, 0.42), (0.05, 0.05, 0.6))
        centre = np.array([x_m + BASELINE_M / 2, y_m, depth_m])
        translation = centre - rotation @ middle
        write_image(folder / f'left{i:02d}.png', draw(rotation, translation))
        offset = np.array([BASELINE_M, 0, 0])
        write_image(folder / f'right{i:02d}.png', draw(rotation, translation - offset))
    return folder


def test_a_known_camera_is_found_again(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 10)
    progress: list[int] = []
    result = calibrate_folder(folder, SQUARE_M, BOARD, on_progress=progress.append)
    assert progress == list(range(1, 11))
    assert (result.pairs_used, result.pairs_total) == (10, 10)
    assert result.rms_px < 0.15
    assert result.epipolar_rms_px < 0.15
    for eye in (result.calibration.left, result.calibration.right):
        np.testing.assert_allclose(eye.K, K_TRUE, atol=2.0)
    assert result.calibration.camera.baseline_m == pytest.approx(BASELINE_M, abs=5e-4)
    # The files give the same camera back.
    again = read_calibration(folder / 'left.yaml', folder / 'right.yaml')
    assert again.camera == result.calibration.camera


def test_pairs_without_the_whole_board_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_boards(tmp_path / 'boards', 6)
    write_image(folder / 'right02.png', np.full(SIZE[::-1], 90, np.uint8))
    with caplog.at_level(logging.WARNING):
        result = calibrate_folder(folder, SQUARE_M, BOARD, out=tmp_path / 'out')
    assert (result.pairs_used, result.pairs_total) == (5, 6)
    assert 'left02.png, right02.png: the board is not seen whole' in caplog.text
    assert sorted(p.name for p in (tmp_path / 'out').iterdir()) == ['left.yaml', 'right.yaml']


def test_faults_are_named(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 5)
    with pytest.raises(CalibrationError, match=r'9x6 inner corners is seen whole in 0 of 5 pairs'):
        calibrate_folder(folder, SQUARE_M)
    with pytest.raises(InputError, match=r'0 m is impossible'):
        calibrate_folder(folder, 0.0, BOARD)
    write_image(
        folder / 'left03.png', cv2.resize(cv2.imread(str(folder / 'left03.png')), (480, 360))
    )
    with pytest.raises(InputError, match=r'left03.png, right03.png: not of the size of the other'):
        calibrate_folder(folder, SQUARE_M, BOARD)
    (folder / 'left03.png').unlink()
    with pytest.raises(InputError, match=r'4 left and 5 right images'):
        calibrate_folder(folder, SQUARE_M, BOARD)
    with pytest.raises(InputError, match=r'expected image folders left and right, or images'):
        calibrate_folder(tmp_path, SQUARE_M, BOARD)
    assert not (folder / 'left.yaml').exists()
