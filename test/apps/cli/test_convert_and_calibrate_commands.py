"""`segfloor convert` and `segfloor calibrate` for real."""

import json
import re

import cv2
import numpy as np
import pytest
from chessboards import (
    BOARD,
    DICTIONARY,
    K_TRUE,
    MARKER_M,
    SQUARE_M,
    write_boards,
    write_marked_boards,
)
from command_line import segfloor
from stereo_drive import room_drive, write_kitti

import segfloor_ros
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.calibration_files import read_calibration
from segfloor_ros.core.camera.settings import StereoCameraSettings


def test_a_converted_recording_has_the_same_frames(tmp_path):
    frames, _ = room_drive(4)
    folder = write_kitti(tmp_path / 'drive', frames)
    done = segfloor('convert', folder, tmp_path / 'drive.mcap', '--images', 'png')
    assert done.returncode == 0, done.stderr
    assert '4 pairs' in done.stdout
    done = segfloor('convert', folder, tmp_path / 'again.mcap', '--frames', 3, '--json')
    assert json.loads(done.stdout)['pairs'] == 3
    source = open_source(StereoCameraSettings(input=str(tmp_path / 'drive.mcap')))
    for frame, original in zip(source.frames(), frames, strict=True):
        assert frame.stamp_ns == original.stamp_ns
        np.testing.assert_array_equal(frame.left, original.left)
        np.testing.assert_array_equal(frame.right, original.right)


def test_a_part_of_a_recording_is_converted(tmp_path):
    frames, _ = room_drive(6, 0.05)
    folder = write_kitti(tmp_path / 'drive', frames)
    out = tmp_path / 'part.mcap'
    done = segfloor('convert', folder, out, '--start', 1, '--frames', 2, '--every', 2)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('2 pairs')
    whole = list(open_source(StereoCameraSettings(input=str(folder))).raw_pairs())
    part = list(open_source(StereoCameraSettings(input=str(out))).raw_pairs())
    assert [pair.stamp_ns for pair in part] == [whole[1].stamp_ns, whole[3].stamp_ns]
    np.testing.assert_array_equal(part[1].left, whole[3].left)


def test_the_version_is_that_of_the_package():
    done = segfloor('--version')
    assert done.stdout == f'segfloor_ros {segfloor_ros.__version__}\n'


def test_convert_does_not_overwrite(tmp_path):
    folder = write_kitti(tmp_path / 'drive', room_drive(2)[0])
    (tmp_path / 'drive.mcap').write_text('precious')
    done = segfloor('convert', folder, tmp_path / 'drive.mcap')
    assert done.returncode == 2
    assert 'exists already' in done.stderr
    assert (tmp_path / 'drive.mcap').read_text() == 'precious'


def test_calibrate_writes_what_the_reader_reads(tmp_path):
    boards = write_boards(tmp_path / 'boards', 8)
    form = ('--square', SQUARE_M, '--board', 'x'.join(map(str, BOARD)))
    done = segfloor('calibrate', boards, *form, '--out', tmp_path)
    assert done.returncode == 0, done.stderr
    assert '8 of 8' in done.stdout
    assert done.stdout.splitlines()[-1] == str(tmp_path / 'calibration.html')
    page = (tmp_path / 'calibration.html').read_text()
    # Every pair has its row, and both pictures are there: coverage and the worst pair.
    assert [f'left{i:02d}.png, right{i:02d}.png</td>' in page for i in range(1, 9)] == [True] * 8
    assert page.count('<img') == 2
    calibration = read_calibration(tmp_path / 'left.yaml', tmp_path / 'right.yaml')
    np.testing.assert_allclose(calibration.left.K, K_TRUE, atol=3.0)


def test_calibrate_solves_the_pictures_of_opencv(shared_data, tmp_path):
    done = segfloor('calibrate', shared_data / 'chessboard', '--square', 0.025, '--out', tmp_path)
    assert done.returncode == 0, done.stderr
    assert '13 of 13' in done.stdout
    calibration = read_calibration(tmp_path / 'left.yaml', tmp_path / 'right.yaml')
    # OpenCV's sample publishes fx = 534 px for these pictures.
    assert abs(calibration.left.K[0, 0] - 534) < 10
    # The board is never in the right part of the right image.
    assert re.search(r'verdict +│ not good yet', done.stdout)
    assert re.search(r'the board covers 4\d% of the right image.* until it covers 80%', done.stdout)


def test_calibrate_writes_beside_the_pictures_only_where_told_to(tmp_path, monkeypatch):
    boards = write_boards(tmp_path / 'boards', 8)
    before = sorted(boards.rglob('*'))
    monkeypatch.chdir(tmp_path)
    form = ('--square', SQUARE_M, '--board', 'x'.join(map(str, BOARD)))
    done = segfloor('calibrate', boards, *form, '--json')
    assert done.returncode == 0, done.stderr
    assert sorted(boards.rglob('*')) == before
    assert {path.name for path in (tmp_path / 'calibration').iterdir()} >= {
        'left.yaml', 'right.yaml', 'calibration.html',
    }  # fmt: skip
    figures = json.loads(done.stdout)
    assert (figures['pairs_used'], figures['pairs_total']) == (8, 8)
    assert figures['is_good'] == (figures['advice'] == [])
    left_share, right_share = figures['seen_share']
    assert ('of the left image' in ' '.join(figures['advice'])) == (left_share < 0.8)
    assert ('of the right image' in ' '.join(figures['advice'])) == (right_share < 0.8)


def test_pictures_of_another_board_end_in_one_line(tmp_path):
    boards = write_boards(tmp_path / 'boards', 8)
    done = segfloor('calibrate', boards, '--square', 0.03, '--board', '8x6', '--out', tmp_path)
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line.startswith('segfloor')]
    assert len(said) == 1
    assert '0 of 8 pairs' in said[0]
    assert '8 do not show enough of it in both eyes (first: left01.png' in said[0]
    assert not list(tmp_path.glob('*.*'))


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='OpenCV without aruco')
def test_calibrate_takes_boards_with_markers(tmp_path):
    boards = write_marked_boards(tmp_path / 'boards', 6)
    (boards / 'left03.png').write_bytes(b'no image')
    form = ('--square', SQUARE_M, '--board', 'x'.join(map(str, BOARD)))
    markers = ('--marker', MARKER_M, '--dictionary', DICTIONARY)
    done = segfloor('calibrate', boards, *form, *markers, '--out', tmp_path)
    assert done.returncode == 0, done.stderr
    assert '5 of 6' in done.stdout
    assert 'left out: 1 cannot be read (first: ' in done.stderr


def test_calibrate_refuses_a_board_in_no_form(tmp_path):
    done = segfloor('calibrate', tmp_path, '--square', 0.03, '--board', 'nine')
    assert done.returncode == 2
    assert '--board nine' in done.stderr


def test_calibrate_checks_a_recording(tmp_path):
    boards = write_boards(tmp_path / 'boards', 11)
    form = ('--square', SQUARE_M, '--board', 'x'.join(map(str, BOARD)))
    assert segfloor('calibrate', boards, *form, '--out', boards).returncode == 0
    done = segfloor('calibrate', '--check', boards, *form)
    assert done.returncode == 0, done.stderr
    assert 'm for 0.2163 m, in 2 pairs' in done.stdout
    # The same pictures of larger squares: the calibration makes them too small.
    larger = ('--square', 1.2 * SQUARE_M, *form[2:])
    done = segfloor('calibrate', '--check', boards, *larger)
    assert done.returncode == 1
    assert 'show the board 0.83' in done.stderr
    done = segfloor('calibrate')
    assert done.returncode == 2
    assert 'give a folder of pictures and --square, or --check RECORDING' in done.stderr
