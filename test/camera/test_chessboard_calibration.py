"""Calibration from drawn chessboards of a camera that is known exactly."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import write_image
from chessboards import BASELINE_M, BOARD, K_TRUE, SIZE, SQUARE_M, write_boards

from segfloor_ros.camera.calibration.chessboard import calibrate_folder
from segfloor_ros.camera.calibration.files import read_calibration
from segfloor_ros.errors import CalibrationError, InputError


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
    assert sorted(p.name for p in (tmp_path / 'out').glob('*')) == [
        '.segfloor_result',
        'left.yaml',
        'right.yaml',
    ]


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
