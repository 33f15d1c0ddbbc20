"""The tools behind README's picture and its figures."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from stereo_drive import room_drive, write_kitti

from segfloor_ros.core.errors import InputError
from tools import figures
from tools.moving_picture import moving_picture
from tools.symptoms import delay, scale_calibration


@pytest.mark.slow
def test_the_picture_shows_the_floor_that_was_found_and_a_map_that_grows(tmp_path) -> None:
    recording = write_kitti(tmp_path / 'drive', room_drive(14, step_m=0.12)[0])
    moving_picture(str(recording), tmp_path / 'drive.gif', width=400, count=40, seconds=2.0)
    with Image.open(tmp_path / 'drive.gif') as picture:
        shown = []
        for index in range(picture.n_frames):
            picture.seek(index)
            shown.append(np.asarray(picture.convert('RGB')).astype(int))
    assert len(shown) > 2
    left, right = np.split(np.stack(shown), 2, axis=2)
    green = left[..., 1] - np.maximum(left[..., 0], left[..., 2]) > 25
    assert green.mean(axis=(1, 2)).min() > 0.05
    white = (right.min(axis=-1) > 250).sum(axis=(1, 2))
    assert white[-1] > white[0]


def test_a_drive_without_a_map_has_no_picture(tmp_path) -> None:
    dark = [
        dataclasses.replace(frame, left=0 * frame.left, right=0 * frame.right)
        for frame in room_drive(3)[0]
    ]
    recording = write_kitti(tmp_path / 'drive', dark)
    with pytest.raises(InputError, match='no keyframe'):
        moving_picture(str(recording), tmp_path / 'drive.gif', width=400, count=4, seconds=2.0)
    assert not (tmp_path / 'drive.gif').exists()


def test_a_planar_path_is_compared_at_the_lag_of_its_clock(tmp_path) -> None:
    def place(t):
        return np.stack([0.3 * t, np.sin(0.4 * t)], axis=-1)

    times = np.arange(0.0, 60.0, 1.0)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    lines = [
        f'{100 + t:.3f} {x:.9f} {y:.9f} 0 0 0 0 1'
        for t, (x, y) in zip(times, place(times + 3.2) @ turn, strict=True)
    ]
    (tmp_path / 'trajectory.txt').write_text('\n'.join(lines))
    true = np.arange(0.0, 80.0, 0.01)
    rows = [f'{t},{x},{y}' for t, (x, y) in zip(true, place(true), strict=True)]
    (tmp_path / 'truth.csv').write_text('\n'.join(['time,x,y', *rows]))
    error = figures.planar_error_m(tmp_path / 'trajectory.txt', tmp_path / 'truth.csv')
    assert error < 1e-3
    # Another place of 0.1 m at every second stamp is an error of 0.1 / 2 after the alignment.
    bent = [line.split() for line in lines]
    for words in bent[::2]:
        words[1] = str(float(words[1]) + 0.1)
    (tmp_path / 'trajectory.txt').write_text('\n'.join(' '.join(words) for words in bent))
    error = figures.planar_error_m(tmp_path / 'trajectory.txt', tmp_path / 'truth.csv')
    assert error == pytest.approx(0.05, abs=0.003)


def test_a_page_gets_the_figures_between_its_marks(tmp_path, monkeypatch) -> None:
    drive = {'tracked_percent': 99.5, 'path_error_m': 0.0125, 'frames': 10, 'length_m': 4.0,
             'moving_frames': 1, 'wall_s': 3.0}  # fmt: skip
    found = {'drives': dict.fromkeys(figures.DRIVES, drive), 'demo': drive}
    (tmp_path / 'figures.json').write_text(json.dumps(found))
    monkeypatch.setattr(figures, 'FIGURES', tmp_path / 'figures.json')
    mark = '<!-- measured: python -m tools.figures write -->'
    page = f'before\n{mark}\nold\n<!-- end of measured -->\nafter\n'
    once = figures.written(page)
    assert once.startswith('before\n') and once.endswith('<!-- end of measured -->\nafter\n')
    assert '| 99.5 % | 0.0125 m | – |' in once and 'old' not in once
    assert figures.written(once) == once


def test_the_faults_of_the_symptoms_are_put_in_once(tmp_path) -> None:
    calibration, poses = tmp_path / 'calib.txt', tmp_path / 'wheel_odometry.txt'
    calibration.write_text('P0: 8 0 3 0 0 8 2 0 0 0 1 0\nP1: 8 0 3 -40 0 8 2 0 0 0 1 0\n')
    poses.write_text('# t x y z qx qy qz qw\n0.5 1 2 3 0 0 0 1\n')
    for _ in range(2):
        scale_calibration(calibration, 1.5, 0.5)
        rows = [line.split() for line in calibration.read_text().splitlines()]
        for name, row, shift in zip(('P0:', 'P1:'), rows, (0, -30), strict=True):
            assert row[0] == name
            assert [float(word) for word in row[1:]] == [4, 0, 3, shift, 0, 4, 2, 0, 0, 0, 1, 0]
        delay(poses, 0.25)
        assert [float(word) for word in poses.read_text().split()] == [0.75, 1, 2, 3, 0, 0, 0, 1]
