"""The runner of ORB-SLAM3, with a stand-in for its Python package."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA

from tools import orb3_kitti

STAND_IN = """
from pathlib import Path
class Sensor:
    STEREO = 'stereo'
class Result:
    def __init__(self, ok):
        self.ok = ok
class Slam:
    def __init__(self, vocabulary, settings, sensor):
        assert sensor == 'stereo' and Path(vocabulary).read_text() == 'words'
        self.times, self.settings, self.is_shut = [], Path(settings).read_text(), False
    def track_stereo(self, left, right, time_s):
        assert left.ndim == right.ndim == 2 and (left != right).any()
        self.times.append(time_s)
        return Result(len(self.times) != 2)
    def map_changed(self):
        return len(self.times) == 3
    def shutdown(self):
        self.is_shut = True
    def save_trajectory_tum(self, path):
        assert self.is_shut
        Path(path).write_text(''.join(f'{t:.6f} 0 0 0 0 0 0 1\\n' for t in self.times))
"""


@pytest.fixture
def recording(tmp_path):
    return write_kitti(tmp_path / 'room', room_drive(4)[0])


def test_a_recording_is_tracked_at_its_own_pace(tmp_path, recording):
    (tmp_path / 'pyorbslam3.py').write_text(STAND_IN)
    (tmp_path / 'words.txt').write_text('words')
    out = tmp_path / 'path.txt'
    done = subprocess.run(
        [sys.executable, orb3_kitti.__file__, tmp_path / 'words.txt', recording, '--out', out],
        capture_output=True,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(tmp_path)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('orbslam3 frames 4 tracked 3 map_changes 1 median_ms ')
    times = (recording / 'times.txt').read_text().split()
    assert [line.split()[0] for line in out.read_text().splitlines()] == times


def test_the_settings_have_the_camera_of_the_recording(recording):
    found = orb3_kitti.read_recording(recording)
    assert found.baseline_m == pytest.approx(CAMERA.baseline_m)
    assert found.interval_s == pytest.approx(0.1)
    lines = orb3_kitti.settings(found).splitlines()
    assert lines[0] == '%YAML:1.0'
    values = dict(line.split(': ') for line in lines[1:])
    assert float(values['Camera.fx']) == pytest.approx(CAMERA.K[0, 0])
    assert float(values['Camera.cy']) == pytest.approx(CAMERA.K[1, 2])
    assert float(values['Camera.bf']) == pytest.approx(CAMERA.disparity_times_depth)
    assert (values['Camera.width'], values['Camera.height']) == (
        str(CAMERA.width),
        str(CAMERA.height),
    )
    assert (float(values['Camera.fps']), values['ORBextractor.nFeatures']) == (10.0, '1200')


def test_a_missing_image_is_named(recording):
    (recording / 'image_1' / '000002.png').unlink()
    with pytest.raises(SystemExit, match=r'000002\.png: no image'):
        orb3_kitti.read_recording(recording).image(1, 2)


def test_the_runner_can_be_linked_into_a_folder_of_runners():
    path = Path(orb3_kitti.__file__)
    assert os.access(path, os.X_OK) and path.read_text().startswith('#!/usr/bin/env python3\n')
