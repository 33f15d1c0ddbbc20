"""`segfloor convert` and `segfloor calibrate` for real."""

import numpy as np
from chessboards import BOARD, K_TRUE, SQUARE_M, write_boards
from command_line import segfloor
from stereo_drive import room_drive, write_kitti

import segfloor_ros
from segfloor_ros.camera.calibration.files import read_calibration
from segfloor_ros.camera.model import StereoCameraSettings
from segfloor_ros.camera.sources import open_source


def test_a_converted_recording_has_the_same_frames(tmp_path):
    frames, _ = room_drive(4)
    folder = write_kitti(tmp_path / 'drive', frames)
    done = segfloor('convert', folder, tmp_path / 'drive.mcap', '--images', 'png')
    assert done.returncode == 0, done.stderr
    assert '4 pairs' in done.stdout
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
    calibration = read_calibration(tmp_path / 'left.yaml', tmp_path / 'right.yaml')
    np.testing.assert_allclose(calibration.left.K, K_TRUE, atol=3.0)


def test_calibrate_solves_the_pictures_of_opencv(shared_data, tmp_path):
    done = segfloor('calibrate', shared_data / 'chessboard', '--square', 0.025, '--out', tmp_path)
    assert done.returncode == 0, done.stderr
    assert '13 of 13' in done.stdout
    calibration = read_calibration(tmp_path / 'left.yaml', tmp_path / 'right.yaml')
    # OpenCV's sample publishes fx = 534 px for these pictures.
    assert abs(calibration.left.K[0, 0] - 534) < 10


def test_calibrate_refuses_a_board_in_no_form(tmp_path):
    done = segfloor('calibrate', tmp_path, '--square', 0.03, '--board', 'nine')
    assert done.returncode == 2
    assert '--board nine' in done.stderr
