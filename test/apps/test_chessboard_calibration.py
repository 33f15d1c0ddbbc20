"""Calibration from drawn boards of a camera that is known exactly."""

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import opened, write_image
from chessboards import (
    BASELINE_M,
    BOARD,
    DICTIONARY,
    K_MARKED,
    K_TRUE,
    MARKER_M,
    SIZE,
    SQUARE_M,
    T_LEFT_RIGHT,
    marked_board,
    marked_texture,
    write_boards,
    write_marked_boards,
)
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.calibration import Board, calibrate_folder, check_recording
from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.calibration_files import read_calibration, write_ros_calibration
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.errors import CalibrationError, InputError
from segfloor_ros.core.geometry import rotation_angle

PLAIN = Board(*BOARD, SQUARE_M)
needs_aruco = pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='OpenCV without aruco')


def test_a_known_camera_is_found_again(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 10)
    progress: list[int] = []
    result = calibrate_folder(folder, PLAIN, on_progress=progress.append)
    assert progress == list(range(1, 11))
    assert (len(result.views), result.pairs_total, result.left_out) == (10, 10, '')
    assert result.rms_px < 0.15
    assert result.epipolar_rms_px < 0.15
    for eye in (result.calibration.left, result.calibration.right):
        np.testing.assert_allclose(eye.K, K_TRUE, atol=2.0)
    assert result.calibration.camera.baseline_m == pytest.approx(BASELINE_M, abs=5e-4)
    # The files give the same camera back.
    again = read_calibration(folder / 'left.yaml', folder / 'right.yaml')
    assert again.camera == result.calibration.camera


@needs_aruco
def test_a_known_camera_is_found_by_markers_where_the_board_leaves_the_images(
    tmp_path: Path,
) -> None:
    folder = write_marked_boards(tmp_path / 'boards', 16)
    board = Board(*BOARD, SQUARE_M, MARKER_M, DICTIONARY)
    result = calibrate_folder(folder, board)
    seen = [len(view.ids) for view in result.views]
    assert min(seen) < 0.5 * np.prod(BOARD)
    assert max(seen) == np.prod(BOARD)
    assert result.rms_px < 0.2
    calibration = result.calibration
    for eye, K in zip((calibration.left, calibration.right), K_MARKED, strict=True):
        np.testing.assert_allclose(eye.K, K, atol=3.0)
    R_left_right = calibration.left.R.T @ calibration.right.R
    assert rotation_angle(R_left_right.T @ T_LEFT_RIGHT[:3, :3]) < np.radians(0.2)
    baseline_m = np.linalg.norm(T_LEFT_RIGHT[:3, 3])
    assert calibration.camera.baseline_m == pytest.approx(baseline_m, abs=5e-4)
    # A board that may leave the image is seen in more of it than a whole one can be.
    for side in (0, 1):
        assert 0.4 < result.seen_share(side) < 0.7


@needs_aruco
def test_boards_as_printed_before_opencv_4_6_are_known_by_themselves() -> None:
    if hasattr(cv2.aruco, 'CharucoBoard_create'):
        pytest.skip('OpenCV before 4.7 draws one kind only')
    board = Board(*BOARD, SQUARE_M, MARKER_M, DICTIONARY)
    old = marked_board()
    old.setLegacyPattern(True)
    for texture in (marked_texture(), marked_texture(old)):
        found = board.find(texture)
        assert found is not None
        ids, corners_px = found
        assert ids.tolist() == list(range(35))
        # Corner 8 is the second of the second row: three squares from the edge of the picture.
        np.testing.assert_allclose(corners_px[8, 0], (3 * 40 - 0.5, 3 * 40 - 0.5), atol=0.3)


@needs_aruco
def test_impossible_markers_are_named() -> None:
    with pytest.raises(InputError, match=r'no dictionary 3X3; known are .*4X4_50'):
        Board(*BOARD, SQUARE_M, MARKER_M, '3X3')
    with pytest.raises(InputError, match=r'20x20 .* more markers than the dictionary 4X4_50'):
        Board(20, 20, SQUARE_M, MARKER_M, '4X4_50')
    with pytest.raises(InputError, match=r'markers of 0.04 m is impossible'):
        Board(*BOARD, SQUARE_M, 0.04)


def test_an_opencv_without_markers_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, 'aruco', raising=False)
    with pytest.raises(InputError, match=r'no cv2.aruco.* install opencv-python-headless 4.7'):
        Board(*BOARD, SQUARE_M, MARKER_M)
    Board(*BOARD, SQUARE_M)


def test_the_worst_pair_is_the_one_that_is_wrong(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 8)
    path = folder / 'right05.png'
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    # As if the board had bent: the rows of the picture, moved along a wave of half a pixel.
    u, v = np.meshgrid(*(np.arange(size, dtype=np.float32) for size in SIZE))
    wave = (0.5 * np.sin(u / 20)).astype(np.float32)
    write_image(path, cv2.remap(image, u, v + wave, cv2.INTER_LINEAR))
    result = calibrate_folder(folder, PLAIN)
    assert result.views[0].paths[1] == path
    assert result.view_errors_px[0, 1] > 0.2
    sizes_px = np.linalg.norm(result.view_errors_px[:, :2], axis=1)
    assert sizes_px[0] > 2 * sizes_px[1]
    # All corners count the same: the error of all follows from those of the pairs.
    assert np.sqrt(np.mean(result.view_errors_px[:, :2] ** 2)) == pytest.approx(result.rms_px)


def test_pairs_without_the_whole_board_are_left_out(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 8)
    for name in ('right02.png', 'left04.png'):
        write_image(folder / name, np.full(SIZE[::-1], 90, np.uint8))
    (folder / 'left06.png').write_bytes((folder / 'left06.png').read_bytes()[:200])
    result = calibrate_folder(folder, PLAIN, out=tmp_path / 'out')
    assert (len(result.views), result.pairs_total) == (5, 8)
    assert result.left_out == (
        '2 do not show enough of it in both eyes (first: left02.png, right02.png), '
        f'1 cannot be read (first: {folder}/left06.png: the PNG is truncated)'
    )
    assert sorted(p.name for p in (tmp_path / 'out').glob('*')) == ['left.yaml', 'right.yaml']


def test_faults_are_named_in_a_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_boards(tmp_path / 'boards', 5)
    with (
        caplog.at_level(logging.WARNING),
        pytest.raises(
            CalibrationError,
            match=r'9x6 .* seen in 0 of 5 pairs, .*: 5 do .* \(first: left01.png, right01.png\)',
        ),
    ):
        calibrate_folder(folder, Board(9, 6, SQUARE_M))
    assert not caplog.records
    with pytest.raises(InputError, match=r'0 m is impossible'):
        Board(*BOARD, 0)
    write_image(
        folder / 'left03.png', cv2.resize(cv2.imread(str(folder / 'left03.png')), (480, 360))
    )
    with pytest.raises(InputError, match=r'left03.png, right03.png: not of the size of the other'):
        calibrate_folder(folder, PLAIN)
    (folder / 'left03.png').unlink()
    with pytest.raises(CalibrationError, match=r'seen in 4 of 4 pairs, 5 are needed'):
        calibrate_folder(folder, PLAIN)
    assert [r.getMessage() for r in caplog.records] == [
        f'{folder}: 0 left and 1 right images have no partner of the same number; they are left out'
    ]
    with pytest.raises(InputError, match=r'expected image folders left and right, or images'):
        calibrate_folder(tmp_path, PLAIN)
    assert not (folder / 'left.yaml').exists()


def known_calibration(baseline_m: float) -> StereoCalibration:
    """Return the calibration of the drawn boards, but for its baseline."""
    eyes = []
    for shift in (0.0, -K_TRUE[0, 0] * baseline_m):
        P = np.column_stack([K_TRUE, [shift, 0, 0]])
        eyes.append(EyeCalibration.of_rectified(*SIZE, P))
    return StereoCalibration(*eyes)


def write_calibrated(folder: Path, calibration: StereoCalibration) -> StereoSource:
    write_ros_calibration(folder / 'left.yaml', calibration.left, 'left')
    write_ros_calibration(folder / 'right.yaml', calibration.right, 'right')
    return opened(folder)


def test_a_calibration_that_fits_a_recording_has_no_fault(tmp_path: Path) -> None:
    source = write_calibrated(write_boards(tmp_path / 'boards', 11), known_calibration(BASELINE_M))
    progress: list[int] = []
    found = check_recording(source, PLAIN, progress.append)
    assert progress == list(range(1, 12))
    assert (found.pairs, found.boards) == (11, 2)  # every tenth pair is searched
    assert found.scale == pytest.approx(1.0, abs=0.003)
    assert found.rows_px is not None
    assert found.rows_px[0] <= found.rows_px[1] < 0.1
    assert found.faults == []


def test_a_wrong_baseline_is_seen_by_the_board(tmp_path: Path) -> None:
    wrong = known_calibration(1.15 * BASELINE_M)
    source = write_calibrated(write_boards(tmp_path / 'boards', 5), wrong)
    found = check_recording(source, PLAIN)
    assert found.scale == pytest.approx(1.15, abs=0.004)
    assert [(fault.fault, fault.unit) for fault in found.faults] == [('scale', '%')]
    assert found.faults[0].value == pytest.approx(15, abs=0.4)
    assert 'the board 1.15' in found.faults[0].line()
    # Without the board nothing is known of it.
    assert check_recording(source).scale is None


def test_rows_that_are_off_are_seen_with_and_without_a_board(tmp_path: Path) -> None:
    folder = write_boards(tmp_path / 'boards', 5)
    for path in folder.glob('right*.png'):
        write_image(path, np.roll(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 3, axis=0))
    found = check_recording(write_calibrated(folder, known_calibration(BASELINE_M)), PLAIN)
    assert found.rows_px == pytest.approx((3.0, 3.0), abs=0.1)
    assert [fault.fault for fault in found.faults] == ['rows_apart']
    frames = [replace(f, right=np.roll(f.right, -2, axis=0)) for f in room_drive(21)[0]]
    found = check_recording(opened(write_kitti(tmp_path / 'room', frames)), PLAIN)
    assert found.rows_px == pytest.approx((2.0, 2.0), abs=0.1)
    assert (found.pairs, found.boards, found.scale) == (21, 0, None)
    assert [fault.fault for fault in found.faults] == ['rows_apart']
