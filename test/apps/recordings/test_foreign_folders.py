"""Folders as other benchmarks and tools lay them out, and the units they use."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import (
    BASELINE_M,
    FX,
    MS,
    calibration,
    grey_pairs,
    image_message,
    info_message,
    opened,
    write_euroc,
    write_folders,
    write_image,
    write_kitti,
    write_rosbag2,
)

from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.core.camera.depth import VIRTUAL_BASELINE_M
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.errors import CalibrationError, InputError
from segfloor_ros.core.files.whole import digits_of, time_of
from segfloor_ros.core.plugins.rig.check import RigCheck

PAIRS = grey_pairs(4)


@pytest.mark.parametrize('start', [0, 1_700_000_000])
@pytest.mark.parametrize(('per_second', 'unit'), [(10**3, 'ms'), (10**6, 'µs'), (10**9, 'ns')])
def test_times_in_another_unit_are_recognised(tmp_path: Path, caplog, start, per_second, unit):
    folder = write_kitti(tmp_path, PAIRS)
    whole = [start * per_second + i * per_second // 10 for i in range(4)]
    (folder / 'times.txt').write_text(''.join(f'{time}\n' for time in whole))
    source = opened(folder)
    assert source.rate_hz == pytest.approx(10.0)
    assert [f.stamp_ns for f in source.frames()] == [start * 10**9 + i * 100 * MS for i in range(4)]
    assert [r.getMessage() for r in caplog.records if f'are read as {unit}' in r.getMessage()]


def test_times_of_wheels_in_ns_are_recognised(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path, PAIRS)
    rows = (f'{i * 100 * MS} {0.1 * i} 0 0 0 0 0 1\n' for i in range(4))
    (folder / 'wheel_odometry.txt').write_text(''.join(rows))
    (wheels,) = opened(folder).sensors
    assert [m.stamp_ns for m in wheels.read()] == [i * 100 * MS for i in range(4)]


@pytest.mark.parametrize(
    ('words', 'digits'),
    [
        ('0 16 33 50 66', 3),  # 60 Hz
        ('0 2000000 4000000 6000000', 9),  # 500 Hz
        ('1700000000000 1700000004000 1700000008000', 3),  # a step that µs would fit, too
        ('1700000000000000 1700000004000000 1700000008000000', 6),
        ('1700000000 1700000030 1700000060', 0),
        ('0.0 30.5 61.0', 0),
    ],
)
def test_a_date_tells_the_unit_before_a_step_does(words, digits) -> None:
    assert digits_of(words.split(), 'times.txt') == digits


def test_odd_rows_have_a_time_or_are_named_by_it() -> None:
    assert time_of(',,,') == ',,,'
    assert time_of('2011-09-26 13:02:25,964 1 2') == time_of('2011-09-26 13:02:25.964')


def test_whole_seconds_stay_seconds(tmp_path: Path, caplog) -> None:
    folder = write_kitti(tmp_path, PAIRS)
    (folder / 'times.txt').write_text('1700000000\n1700000001\n1700000002\n1700000003\n')
    assert opened(folder).rate_hz == 1.0
    assert not caplog.records


@pytest.mark.parametrize('has_sensor_yaml', [True, False])
def test_euroc_without_its_files_is_recognised(tmp_path: Path, has_sensor_yaml: bool) -> None:
    stamps = [1_403_636_579_763_555_584 + i * 50 * MS for i in range(4)]
    folder = write_euroc(tmp_path, PAIRS, stamps, stamps)
    for camera in ('cam0', 'cam1'):
        (folder / 'mav0' / camera / 'data.csv').unlink()
        if not has_sensor_yaml:
            (folder / 'mav0' / camera / 'sensor.yaml').unlink()
    if not has_sensor_yaml:
        with pytest.raises(CalibrationError, match=r'no calibration; put left.yaml and right.yaml'):
            opened(folder)
        for side in ('left', 'right'):
            eye = getattr(calibration(), side)
            write_ros_calibration(folder / 'mav0' / f'{side}.yaml', eye, side)
    source = opened(folder)
    assert [frame.stamp_ns for frame in source.frames()] == stamps
    assert source.camera.baseline_m == pytest.approx(BASELINE_M)


def test_euroc_with_numbers_for_names_is_read_at_a_rate(tmp_path: Path) -> None:
    folder = write_folders(tmp_path, PAIRS, ('mav0/cam0/data/{}.png', 'mav0/cam1/data/{}.png'))
    for side in ('left', 'right'):
        (folder / f'{side}.yaml').rename(folder / 'mav0' / f'{side}.yaml')
    assert [f.stamp_ns for f in opened(folder).frames()] == [i * 100 * MS for i in range(4)]


@pytest.mark.parametrize('place', ['', 'left'])
def test_times_beside_the_left_images_are_read(tmp_path: Path, place: str) -> None:
    folder = write_folders(tmp_path, PAIRS)
    (folder / place / 'timestamps.txt').write_text('2.0\n2.2\n2.4\n2.6\n')
    assert opened(folder).rate_hz == pytest.approx(5.0)


def tum(folder: Path, size: tuple[int, int] = (640, 480), units: int = 10000) -> Path:
    """Write a sequence with associations.txt alone; what is seen is 10000 units away."""
    lines = []
    for i, (left, _) in enumerate(PAIRS):
        write_image(folder / 'rgb' / f'{i}.png', cv2.resize(left, size))
        write_image(folder / 'depth' / f'{i}.png', np.full(size[::-1], units, np.uint16))
        lines.append(f'{1.5 + 0.1 * i:.6f} rgb/{i}.png {1.505 + 0.1 * i:.6f} depth/{i}.png\n')
    (folder / 'associations.txt').write_text(''.join(lines))
    return folder


@pytest.mark.parametrize('name', ['associations.txt', 'associate.txt', 'assoc.txt'])
@pytest.mark.parametrize('is_depth_first', [True, False])
def test_a_list_of_pairs_alone_is_read(tmp_path: Path, name: str, is_depth_first: bool) -> None:
    folder = tum(tmp_path / 'freiburg3_room')
    rows = [line.split() for line in (folder / 'associations.txt').read_text().splitlines()]
    (folder / 'associations.txt').unlink()
    rows = [row[2:] + row[:2] if is_depth_first else row for row in rows]
    (folder / name).write_text(''.join(' '.join(row) + '\n' for row in rows))
    frames = list(opened(folder).frames())
    assert [frame.stamp_ns // MS for frame in frames] == [1500, 1600, 1700, 1800]
    # 10000 units of a fifth of a millimetre are two metres.
    np.testing.assert_allclose(frames[0].right, 535.4 * VIRTUAL_BASELINE_M / 2.0, rtol=1e-5)


def test_numbers_of_frames_are_no_times(tmp_path: Path) -> None:
    folder = tum(tmp_path / 'living_room')
    lines = [f'{i + 1} ./depth/{i}.png {i + 1} ./rgb/{i}.png\n' for i in range(4)]  # ICL-NUIM
    (folder / 'associations.txt').write_text(''.join(lines))
    assert opened(folder, rate_hz=30.0).rate_hz == pytest.approx(30.0, rel=1e-6)


def test_the_calibration_of_a_benchmark_is_not_that_of_other_images(tmp_path: Path, caplog) -> None:
    with pytest.raises(CalibrationError, match=r'its images are 320x240, those .* are 640x480'):
        opened(tum(tmp_path / 'freiburg1_small', (320, 240)))
    folder = tum(tmp_path / 'mine')
    opened(folder)
    assert 'no calibration; that of a first Kinect is taken' in caplog.text
    caplog.clear()
    eye = calibration().left
    write_ros_calibration(tmp_path / 'mine' / 'camera.yaml', eye, 'rgb')
    tum(folder, (64, 48))
    assert opened(folder).camera.fx == FX
    assert not caplog.records


def test_an_image_list_without_depth_is_named(tmp_path: Path) -> None:
    folder = tum(tmp_path)
    (folder / 'associations.txt').write_text('1.5 rgb/0.png 1.5 other/0.png\n')
    with pytest.raises(InputError, match=r'associations.txt, line 1: expected a time, an rgb'):
        opened(folder)


def depth_bag(path: Path, depth: np.ndarray, encoding: str) -> Path:
    messages = []
    for stamp_ns, (left, _) in zip((MS, 101 * MS), PAIRS, strict=False):
        messages += [
            info_message('/camera/color/camera_info', stamp_ns, calibration().left, p=np.zeros(12)),
            image_message('/camera/color/image_raw', stamp_ns, left),
            image_message('/camera/aligned_depth_to_color/image_raw', stamp_ns, depth, encoding),
        ]
    return write_rosbag2(path, messages)


def depth_folder(path: Path, depth: np.ndarray) -> Path:
    """Write depth beside the left images, with a calibration that has no projection."""
    for i, (left, _) in enumerate(PAIRS):
        write_image(path / 'left' / f'{i}.png', left)
        write_image(path / 'depth' / f'{i}.png', depth)
    write_ros_calibration(path / 'left.yaml', calibration().left, 'left')
    text = (path / 'left.yaml').read_text()
    (path / 'left.yaml').write_text(text[: text.index('projection_matrix')])
    return path


DEPTH_M = 2.0


@pytest.mark.parametrize('kind', ['TUM', 'folder', 'bag', 'float bag'])
@pytest.mark.parametrize('scale', [0.0, 0.001, 0.0002, 0.00025])
def test_depth_has_the_unit_that_is_given(tmp_path: Path, kind: str, scale: float) -> None:
    usual = {'TUM': 0.0002, 'folder': 0.001, 'bag': 0.001, 'float bag': 1.0}[kind]
    units = round(DEPTH_M / (scale or usual))
    depth = np.full((48, 64), units, np.float32 if kind == 'float bag' else np.uint16)
    if kind == 'TUM':
        path = tum(tmp_path / 'freiburg3', units=units)
    elif kind == 'folder':
        path = depth_folder(tmp_path / 'drive', depth)
    else:
        path = depth_bag(tmp_path / 'drive', depth, '16UC1' if kind == 'bag' else '32FC1')
    source = opened(path, depth_scale=scale)
    frame = next(source.frames())
    expected = source.camera.disparity_times_depth / DEPTH_M
    np.testing.assert_allclose(frame.right, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ('depth_m', 'is_right'),
    [
        (2.0, True),
        (0.6, True),
        (0.8 / 5, True),
        (0.3 / 5, False),
        (1.5 * 5, True),
        (3.0 * 5, False),
        (2e3, False),
    ],
)
def test_a_unit_that_cannot_be_is_said(depth_m: float, is_right: bool) -> None:
    source_camera = calibration().camera
    check = RigCheck(source_camera)
    disparity = np.full((48, 64), source_camera.disparity_times_depth / depth_m, np.float32)
    for i, (left, _) in enumerate(grey_pairs(20)):
        check.see(StereoFrame(i, i * 100 * MS, left, disparity))
    assert ('depth_scale' not in check.faults) == is_right
    if not is_right:
        line = check.faults['depth_scale'].line()
        assert 'stereo_camera.depth_scale' in line and f'{depth_m:.2g} m' in line
