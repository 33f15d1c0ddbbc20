"""`segfloor info` on real files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import segfloor
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA

from segfloor_ros.core.contracts import StereoFrame

FRAMES = 64


@pytest.fixture(scope='module')
def frames() -> list[StereoFrame]:
    """A drive along a circle: 1.5 degrees and 2 cm a frame."""
    return room_drive(FRAMES, 0.02, math.radians(1.5))[0]


@pytest.fixture(scope='module')
def drive(tmp_path_factory: pytest.TempPathFactory, frames: list[StereoFrame]) -> Path:
    return write_kitti(tmp_path_factory.mktemp('info') / 'drive', frames)


def said_of(path: Path, *options: object) -> dict[str, Any]:
    done = segfloor('info', path, '--json', *options)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def test_a_good_recording_has_nothing_to_mend(drive: Path) -> None:
    said = said_of(drive)
    assert said['kind'] == 'KITTI odometry folder'
    assert (said['pairs'], said['skipped'], said['image']) == (FRAMES, 0, '320x240')
    assert said['duration_s'] == pytest.approx((FRAMES - 1) / 10)
    assert said['rate_hz'] == pytest.approx(10.0)
    assert said['is_rectified']
    assert said['distortion'] == 'none'
    assert said['baseline_m'] == pytest.approx(CAMERA.baseline_m)
    assert said['focal_px'] == pytest.approx(CAMERA.fx)
    assert said['fov_deg'] == pytest.approx([90.0, math.degrees(2 * math.atan(0.75))])
    assert said['rows_px'] < 0.3
    assert said['faults'] == said['to_mend'] == []
    assert said['size_mb'] == pytest.approx(
        sum(file.stat().st_size for file in drive.rglob('*') if file.is_file()) / 1e6
    )
    (pairs,) = said['streams']
    assert (pairs['messages'], pairs['rate_hz']) == (FRAMES, pytest.approx(10.0))
    assert pairs['longest_gap_s'] == pytest.approx(0.1)


def test_the_tables_say_the_same(drive: Path) -> None:
    done = segfloor('info', drive)
    assert done.returncode == 0
    for words in ('KITTI odometry folder', '320x240, rectified', '90 x 74 deg', '0.1200 m'):
        assert words in done.stdout
    assert done.stdout.endswith('- nothing to fix\n')


def test_a_part_of_a_recording_is_read(drive: Path) -> None:
    said = said_of(drive, '--start', 10, '--frames', 5, '--every', 2)
    assert said['pairs'] == 5
    assert said['duration_s'] == pytest.approx(0.8)


def test_what_is_wrong_is_said_with_its_remedy(tmp_path: Path, frames: list[StereoFrame]) -> None:
    off = [replace(frame, right=np.roll(frame.right, 3, axis=0)) for frame in frames]
    said = said_of(write_kitti(tmp_path / 'off', off))
    (fault,) = said['faults']
    assert fault['fault'] == 'rows_apart'
    assert fault['value'] == pytest.approx(said['rows_px'], abs=0.01)
    assert said['rows_px'] == pytest.approx(3.0, abs=0.3)
    (line,) = said['to_mend']
    assert 'calibrate again' in line


def test_a_calibration_of_another_lens_is_said(tmp_path: Path, frames: list[StereoFrame]) -> None:
    folder = write_kitti(tmp_path / 'drive', frames)
    calib = folder / 'calib.txt'
    lines = []
    for line in calib.read_text().splitlines():
        name, *numbers = line.split()
        P = np.array(numbers, float).reshape(3, 4)
        P[:2, [0, 1, 3]] *= 1.2  # the baseline stays
        lines.append(' '.join([name, *(f'{value:.9e}' for value in P.ravel())]))
    calib.write_text('\n'.join(lines) + '\n')
    (fault,) = said_of(folder)['faults']
    assert fault['fault'] == 'focal_length'
    assert fault['value'] == pytest.approx(20, abs=5)


def test_sensors_and_pauses_are_found(tmp_path: Path, frames: list[StereoFrame]) -> None:
    begin_ns, pause_ns = 7 * 10**9, 3 * 10**9
    stamps = [begin_ns + f.stamp_ns + (pause_ns if f.index >= 20 else 0) for f in frames]
    late = [replace(f, stamp_ns=stamp) for f, stamp in zip(frames, stamps, strict=True)]
    folder = write_kitti(tmp_path / 'drive', late)
    rows = [f'{begin_ns + i * 10_000_000},0,0,0,0,-9.81,0' for i in range(900)]
    (folder / 'imu.csv').write_text('\n'.join(rows) + '\n')
    said = said_of(folder)
    pairs, imu = said['streams']
    assert pairs['longest_gap_s'] == pytest.approx(3.1)
    assert (imu['what'], imu['messages']) == ('imu', 900)
    assert imu['rate_hz'] == pytest.approx(100.0)
    (line,) = said['to_mend']
    assert line.startswith('1 pauses, the longest of 3.1 s after 1.9 s; ')
    assert 'imu, not used' in segfloor('info', folder, '--ignore', 'imu').stdout


def test_bags_list_their_topics(tmp_path: Path, drive: Path) -> None:
    assert segfloor('convert', drive, tmp_path / 'drive.mcap').returncode == 0
    said = said_of(tmp_path / 'drive.mcap')
    assert (said['kind'], said['pairs']) == ('ROS bag', FRAMES)
    assert said['faults'] == []
    topics = {stream['where']: stream for stream in said['streams']}
    infos = [name for name in topics if name.endswith('right/camera_info')]
    assert [topics[name]['what'] for name in infos] == ['sensor_msgs/msg/CameraInfo']
    assert topics[infos[0]]['messages'] == FRAMES


def test_results_and_other_things_are_said_in_a_line(tmp_path: Path, drive: Path) -> None:
    out = tmp_path / 'out'
    assert segfloor('run', drive, '--out', out, '--no-map', '--frames', 3).returncode == 0
    done = segfloor('info', out)
    assert done.stdout.startswith(f'{out}: results of a drive, without a map: 3 of 3 frames')
    assert done.stdout.count('\n') == 1
    assert said_of(out)['kind'].startswith('results of a drive')
    (tmp_path / 'notes.txt').write_text('hello')
    done = segfloor('info', tmp_path / 'notes.txt')
    assert done.returncode == 2
    assert 'not a known kind of recording' in done.stderr
    assert done.stderr.count('\n') == 1
