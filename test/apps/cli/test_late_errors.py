"""A drive is not lost for what goes wrong late: bad messages, a stage that fails, a full disk, an
interrupt. Real processes, real signals.
"""

import dataclasses
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import segfloor
from stereo_drive import KNOWN_MOUNT, room_drive, write_kitti

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.bag_writer import convert
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.files.results import read_map_file
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.plugins.sensors.body_motion import is_sound
from segfloor_ros.core.slam.stereo_slam import StereoSlam

FRAMES = 30


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    frames, _ = room_drive(FRAMES)
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)


@pytest.fixture(scope='module')
def whole(drive, tmp_path_factory) -> Path:
    """The result of the whole drive."""
    out = tmp_path_factory.mktemp('whole') / 'out'
    done = segfloor('run', drive, '--out', out, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    return out


def run(*words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'run', *map(str, words), *KNOWN_MOUNT],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def summary_of(out: Path) -> dict:
    return json.loads((out / 'summary.json').read_text())


def stop_midway(process: subprocess.Popen[str], folder: Path, number: int) -> str:
    """Send a signal once the first keyframes are mapped, and return what was said."""
    while (
        len(list(folder.glob('out/.segfloor-*/floor_masks/*.png'))) < 2 and process.poll() is None
    ):
        time.sleep(0.01)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    return ' '.join(errors.split())


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_keeps_what_is_mapped_and_no_whole_result_goes(drive, tmp_path, number):
    out, saved = tmp_path / 'out', tmp_path / 'room.map'
    process = run(drive, '--out', out, '--save-map', saved)
    errors = stop_midway(process, tmp_path, number)
    assert process.returncode == 128 + number, errors
    summary = summary_of(out)
    assert summary['interrupted'] is True
    assert 2 <= summary['frames'] < FRAMES
    assert len(read_trajectory(out / 'trajectory.txt')[0]) == summary['tracked_frames']
    assert len(read_map_file(saved).parts['slam']['keyframe_stamp_ns']) == summary['keyframes']
    # A whole result takes the place of an interrupted one, never the other way round.
    done = segfloor('run', drive, '--out', out, '--save-map', saved, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    assert (summary_of(out)['frames'], summary_of(out)['interrupted']) == (FRAMES, False)
    before = {path: path.read_bytes() for path in [saved, *out.rglob('*')] if path.is_file()}
    for _ in range(2):
        process = run(drive, '--out', out, '--save-map', saved)
        errors = stop_midway(process, tmp_path, number)
        assert process.returncode == 128 + number
        assert f'what is mapped is in {out}.interrupted; the whole result in {out} stays' in errors
        assert summary_of(tmp_path / 'out.interrupted')['interrupted'] is True
        assert {path: path.read_bytes() for path in before} == before
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {'out', 'out.interrupted', 'room.map', 'room.map.interrupted'}


def test_a_killed_run_leaves_what_was_there_and_nothing_else(drive, whole, tmp_path):
    out = shutil.copytree(whole, tmp_path / 'out')
    before = {path: path.read_bytes() for path in out.rglob('*') if path.is_file()}
    masks = len(list(out.rglob('floor_masks/*.png')))
    process = run(drive, '--out', out)
    while len(list(tmp_path.rglob('floor_masks/*.png'))) <= masks and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    process.communicate()
    segfloor('convert', drive, tmp_path / 'next.mcap')  # removes what is left
    assert {path.name for path in tmp_path.iterdir()} == {'out', 'next.mcap'}
    assert {path: path.read_bytes() for path in out.rglob('*') if path.is_file()} == before


def test_what_cannot_be_written_is_said_before_the_first_frame(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(StereoSlam, 'process', lambda *_: pytest.fail('a frame was processed'))
    (tmp_path / 'file').write_text('mine')
    (tmp_path / 'photo.map').write_text('mine')
    (tmp_path / 'link.map').symlink_to(tmp_path / 'photo.map')
    (tmp_path / 'theirs').mkdir()
    (tmp_path / 'theirs' / 'report.html').write_text('mine')
    for words, said in (
        (['--out', tmp_path / 'file'], 'exists and is no folder'),
        (['--out', tmp_path / 'file' / 'out'], 'cannot be written'),
        (
            ['--out', tmp_path / 'theirs'],
            'holds files and no .segfloor_result, so they may be yours',
        ),
        (['--out', drive / 'out'], 'which is read'),
        (['--out', tmp_path / 'out', '--save-map', '/proc/a.map'], '--save-map /proc/a.map'),
        (
            ['--out', tmp_path / 'out', '--save-map', tmp_path / 'photo.map'],
            'exists and is no saved map that segfloor wrote',
        ),
        (['--out', tmp_path / 'out', '--save-map', tmp_path / 'link.map'], 'is a link'),
    ):
        done = segfloor('run', drive, *words)
        assert done.returncode == 2, said
        assert said in ' '.join(done.stderr.split())
        assert len(done.stderr.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        *('file', 'photo.map', 'link.map', 'theirs')
    }
    assert (tmp_path / 'photo.map').read_text() == 'mine'


@pytest.mark.slow
def test_files_that_cannot_be_written_late_are_elsewhere(drive, whole, tmp_path):
    """As on a disk that is full: no file may be larger than the summary is."""
    elsewhere, saved = tmp_path / 'elsewhere', tmp_path / 'room.map'
    elsewhere.mkdir()
    out = shutil.copytree(whole, tmp_path / 'out')
    before = {path: path.read_bytes() for path in out.rglob('*') if path.is_file()}
    limit = 6000
    assert (out / 'map.pgm').stat().st_size > limit > (out / 'keyframes.txt').stat().st_size
    process = subprocess.run(
        [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'run', str(drive), '--out', str(out),
         '--save-map', str(saved), *KNOWN_MOUNT],
        capture_output=True,
        text=True,
        env={**os.environ, 'TMPDIR': str(elsewhere)},
        cwd=elsewhere,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    errors = ' '.join(process.stderr.split())
    assert process.returncode == 1, errors
    assert 'room.map: cannot be written (File too large)' in errors
    assert 'Traceback' not in errors
    assert {path: path.read_bytes() for path in out.rglob('*') if path.is_file()} == before
    (rescued,) = [path for path in elsewhere.iterdir() if path.name.startswith('segfloor-result-')]
    assert str(rescued) in errors and 'map.yaml' in errors.partition(str(rescued))[2]
    assert summary_of(rescued)['frames'] == FRAMES
    assert (rescued / 'keyframes.txt').read_bytes() == (out / 'keyframes.txt').read_bytes()
    assert not (rescued / 'map.pgm').exists()
    assert {path.name for path in tmp_path.iterdir()} == {'elsewhere', 'out'}


@pytest.mark.slow
def test_a_frame_and_a_keyframe_at_which_a_stage_fails_are_lost_alone(drive, tmp_path, monkeypatch):
    process_frame, process_floor = StereoSlam.process, FloorSegmentation.process
    failed = []

    def fail_at_frame(slam, frame):
        if frame.index == 17:
            raise np.linalg.LinAlgError('singular')
        return process_frame(slam, frame)

    def fail_once(floor, *arguments):
        failed.append(True)
        if len(failed) == 3:
            raise IndexError('beyond')
        return process_floor(floor, *arguments)

    monkeypatch.setattr(StereoSlam, 'process', fail_at_frame)
    monkeypatch.setattr(FloorSegmentation, 'process', fail_once)
    out = tmp_path / 'out'
    done = segfloor('run', drive, '--out', out, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    summary = summary_of(out)
    assert (summary['failed_frames'], summary['failed_keyframes']) == (1, 1)
    assert summary['lost_intervals'] == [[17, 17]]
    assert summary['tracked_frames'] == FRAMES - 1
    assert summary['map_updates'] == summary['keyframes'] - 1
    assert summary['interrupted'] is False
    assert 'frames that failed' in done.stdout and 'keyframes that failed' in done.stdout


def recorded(drive: Path, bag: Path, spoil: bool) -> Path:
    """Return a bag of the drive with wheels and an IMU, of which two messages each are bad."""
    source = open_source(StereoCameraSettings(input=str(drive)))
    stamps = range(0, 100_000_000 * FRAMES, 10_000_000)
    imu, wheels = [], []
    for i, stamp_ns in enumerate(stamps):
        is_bad = spoil and i in (90, 150)
        gyro = np.full(3, np.nan) if is_bad else np.zeros(3)
        imu.append(ImuSample(stamp_ns, gyro, np.array([0.0, -9.81, 0.0])))
        x_m = np.inf if is_bad else 0.006 * i
        wheels.append(WheelPose(stamp_ns, make_transform(np.eye(3), np.array([x_m, 0.0, 0.0]))))
    source.sensors = [
        RecordedSensor('imu', 'imu', len(imu), True, lambda: imu),
        RecordedSensor('wheel_odometry', 'wheels', len(wheels), True, lambda: wheels),
    ]
    convert(source, bag)
    return bag


@pytest.mark.slow
def test_messages_that_hold_no_numbers_are_dropped_and_counted(drive, tmp_path):
    paths = []
    for spoil in (False, True):
        bag = recorded(drive, tmp_path / f'{spoil}.mcap', spoil)
        out = tmp_path / f'out-{spoil}'
        done = segfloor('run', bag, '--out', out, *KNOWN_MOUNT)
        assert done.returncode == 0, done.stderr
        paths.append(read_trajectory(out / 'trajectory.txt')[1])
    remarks = ' '.join(summary_of(out)['sensor_remarks'])
    for name in ('imu', 'wheel_odometry'):
        assert f'{name}: messages without finite numbers, dropped: 2' in remarks
        assert (
            summary_of(out)['sensors'][name]
            == summary_of(tmp_path / 'out-False')['sensors'][name] - 2
        )
    assert summary_of(out)['tracked_frames'] == FRAMES
    assert np.abs(paths[0] - paths[1])[:, :3].max() < 0.01


@pytest.mark.parametrize('bad', [np.nan, np.inf, -1e300])
def test_what_is_no_measurement_is_told(bad):
    imu = ImuSample(0, np.zeros(3), np.array([0.0, -9.81, 0.0]))
    assert is_sound(imu)
    assert not is_sound(dataclasses.replace(imu, gyro_rad_s=np.array([0.0, bad, 0.0])))
    assert not is_sound(dataclasses.replace(imu, accel_m_s2=np.array([0.0, bad, 0.0])))
    assert not is_sound(WheelPose(0, make_transform(np.eye(3), np.array([bad, 0.0, 0.0]))))
